"""Systematic errors of the odometry, by the scans of the refined map.

Wheels that are larger than stated, a wheelbase that is wrong and wheels of unequal size make errors that add up over
the whole drive (Borenstein and Feng, "Measurement and correction of systematic odometry errors in mobile robots",
1996). A graph whose odometry edges have independent noise does not allow for them: along corridors, where the odometry
holds the position, the map gets the size that the wheels say. Three factors describe them. They are found by robust
generalised least squares from stretches of the path whose motion the scans know, and then together with all poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.calibration import OdometryCorrection, step_derivatives
from hsloc.model.pose2 import pose_differences, relative_poses
from hsloc.slam.joint_registration import normal_equations
from hsloc.slam.marginals import information_of_a_point, observed_terms, right_sides, robust_weights
from hsloc.slam.pose_graph import anchored
from hsloc.slam.result import OdometryErrors
from hsloc.slam.slips import (
    STRETCHES_DEEP,
    Motions,
    motions_by_scans,
    motions_by_steps,
    stretch_ends,
    without_slips,
)
from hsloc.slam.sparse_solver import BlockSystem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.kernels.normal_equations import PairTerms
    from hsloc.slam.joint_registration import Registration
    from hsloc.slam.pose_graph import Edges

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_PRIOR = np.array((0.03, 0.1, 0.03))
"""Standard deviations of the errors before a log is seen: worn or soft wheels, robots on tracks that turn less than
they count, wheels half a metre apart of which one is 1.5 % larger. Of five real logs the root mean squares are 0.022,
0.010 and 0.023. Stretches of 50 m know them ten times as well."""
_SMALL = np.array((1e-3, 1e-3, 1e-4))
"""Errors by which the derivatives are taken. Internal."""
_SURPRISE = 3.0
"""Scale of the Cauchy weight on a stretch's normalised difference: slips are none of these errors."""
_ROUNDS = 10
"""Of the robust weights. Internal: they are settled by then."""
_STEADIER = 16.0
"""The information of a step for this, as a multiple of that in the graph, whose noise of 1 cm and more allows for what
is not modelled. That of wheels is 2 to 3 mm in a step of 10 cm, 1 cm in a metre, as their errors add up. Chosen by 13
drives of 100 to 600 m: from 4 to 64 the error of the first factor is 0.16 to 0.19 %, by the stretches alone 0.26 %."""
_PARTS = 10
"""Parts of the building whose errors count as independent of each other."""
_PLACE_M = 10.0
"""Side (m) of the squares of which the parts are made: scans in two of them see other walls, mostly."""
_FEWEST = 2 * _PARTS * STRETCHES_DEEP
"""Stretches without which nothing is found: about 50 m."""


@dataclass(frozen=True, slots=True, eq=False)
class SystematicErrors:
    """What is to be added to the steps of the odometry: `values` (3,) with covariance (3, 3).

    The first is a part of each translation, the second of each rotation; the third is a rotation per metre (rad/m).
    They hold for the steps from keyscan `first` on.
    """

    values: F64
    covariance: F64
    first: int = 0

    @property
    def are_found(self) -> bool:
        """Whether the log was long enough to show any."""
        return bool(self.values.any())

    def summary(self) -> OdometryErrors | None:
        """The three by their names; None where none is found."""
        if not self.are_found:
            return None
        translation, rotation, drift = self.values.tolist()
        sigmas = np.sqrt(np.diag(self.covariance)).tolist()
        return OdometryErrors(
            translation=translation,
            translation_sigma=sigmas[0],
            rotation=rotation,
            rotation_sigma=sigmas[1],
            drift=drift,
            drift_sigma=sigmas[2],
        )

    def added_to(self, steps: Edges) -> Edges:
        """The odometry's steps from keyscan to keyscan with them."""
        translation, rotation, drift = self.values.tolist()
        measured = OdometryCorrection(1.0 + translation, 1.0 + rotation, drift).steps(steps.measured)
        measured[: self.first] = steps.measured[: self.first]
        return replace(steps, measured=measured)

    def changes(self, steps: F64) -> F64:
        """Derivatives (3, n - 1, 3) of steps (n - 1, 3) by the three; zero before `first`."""
        found = step_derivatives(steps)
        found[:, : self.first] = 0.0
        return found


def find_systematic_errors(refined: Registration, steps: Edges, first: int = 0) -> SystematicErrors:
    """Those of the odometry's `steps` (n - 1) from keyscan `first` on, by the scans alone.

    Robustly by stretches, which shows slips, too; then together with all poses, without the slips. Where stretches are
    few nothing is added, and the covariance is that of a robot of which nothing is known.
    """
    covariances: F64 = np.asarray(np.linalg.inv(steps.information), dtype=np.float64)
    ends = stretch_ends(steps, covariances)
    ends = ends[ends[:, 0] >= first]
    if len(ends) < _FEWEST:
        return SystematicErrors(np.zeros(3), np.diag(_PRIOR**2), first)
    terms = observed_terms(refined)
    values, motions = _by_stretches(refined, terms, steps, covariances, ends)
    by_stretches = SystematicErrors(values, np.zeros((3, 3)), first)
    kept = without_slips(by_stretches.added_to(steps), motions.slipped(len(steps)))
    return _with_all_poses(refined, terms, replace(kept, information=_STEADIER * kept.information), by_stretches)


def _by_stretches(
    refined: Registration, terms: PairTerms, steps: Edges, covariances: F64, ends: I64
) -> tuple[F64, Motions]:
    """The errors (3,) that stretches show, robustly, and what the motions differ by without them."""
    seen, seen_covariance = motions_by_scans(refined, terms, ends)
    driven, driven_covariance = motions_by_steps(steps.measured, covariances, ends)
    rows = np.empty((len(ends), 3, 3))
    for k, derivative in enumerate(step_derivatives(steps.measured)):
        moved, _ = motions_by_steps(steps.measured + _SMALL[k] * derivative, covariances, ends)
        rows[:, :, k] = pose_differences(moved, driven) / _SMALL[k]
    apart = pose_differences(seen, driven)
    weights = np.linalg.inv(seen_covariance + driven_covariance)
    values = np.zeros(3)
    for _ in range(_ROUNDS):
        left = apart - rows @ values
        chi2 = np.einsum("mi,mij,mj->m", left, weights, left)
        weight = 1.0 / (1.0 + chi2 / _SURPRISE**2) / STRETCHES_DEEP
        held = np.einsum("mik,m,mij->mkj", rows, weight, weights)
        information = (held @ rows).sum(axis=0) + np.diag(_PRIOR**-2.0)
        values = np.linalg.solve(information, np.einsum("mkj,mj->k", held, apart))
    return values, Motions(ends, left, np.sqrt(chi2))


def _with_all_poses(
    refined: Registration, terms: PairTerms, odometry: Edges, known: SystematicErrors
) -> SystematicErrors:
    """The errors that fit best together with all poses; the `odometry` has those that are `known` already."""
    poses, prior = refined.linearised_at, np.diag(_PRIOR**-2.0)
    pairs = np.concatenate((refined.pairs, odometry.pairs))
    system = BlockSystem(len(poses), pairs[:, 0], pairs[:, 1])
    of_a_point = information_of_a_point(refined)
    diagonal, off_diagonal, right = normal_equations(poses, refined.pairs, terms, of_a_point, odometry)
    changes = known.changes(odometry.measured)
    rights = right_sides(poses, odometry, changes)
    moved = system.solve_each(anchored(diagonal), off_diagonal, np.concatenate((rights, -right[None])))
    response, offset = moved[:3], moved[3]
    weighed = odometry.information * robust_weights(poses, odometry)[:, None, None]
    along = np.einsum("kni,nij->knj", changes, weighed)
    apart = pose_differences(relative_poses(poses[:-1], poses[1:]), odometry.measured)
    # The poses are eliminated (Schur complement): what is left are equations of the errors alone.
    own = np.einsum("kni,lni->kl", along, changes) - np.einsum("kni,lni->kl", rights, response) + prior
    gradient = np.einsum("kni,ni->k", along, apart) + np.einsum("kni,ni->k", rights, offset) - prior @ known.values
    more = np.linalg.solve(own, gradient)
    found = poses + offset + np.tensordot(more, response, 1)
    left = pose_differences(relative_poses(found[:-1], found[1:]), odometry.measured + np.tensordot(more, changes, 1))
    # The noise by parts of the building, not of the time: what scans get wrong of a corridor, they do each time.
    row, column = np.floor(poses[:-1, :2] / _PLACE_M).T
    scores = np.einsum("kni,ni->nk", along, left)[np.lexsort((column, row))]
    sums = np.array([part.sum(axis=0) for part in np.array_split(scores, _PARTS)])
    sums -= sums.mean(axis=0)
    inverse = np.linalg.inv(own)
    # And what is left of the prior where nothing shows an error.
    covariance = inverse @ (_PARTS / (_PARTS - 1) * sums.T @ sums + prior) @ inverse
    return replace(known, values=known.values + more, covariance=np.asarray(covariance, dtype=np.float64))
