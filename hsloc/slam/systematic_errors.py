"""Systematic errors of the odometry, by the scans of the refined map.

Wheels that are larger than stated, a wheelbase that is wrong and wheels of unequal size make errors that add up over
the whole drive (Borenstein and Feng, "Measurement and correction of systematic odometry errors in mobile robots",
1996). A graph whose odometry edges have independent noise does not allow for them: along corridors, where the odometry
holds the position, the map gets the size that the wheels say. Three factors describe them. They are found by robust
generalised least squares from stretches of the path whose motion the scans know.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.registration import composed_motions, window_motions
from hsloc.localisation.mounting_error import without_each_part
from hsloc.model.pose2 import wrap_angles
from hsloc.slam.marginals import FLAT_IN_A_STRETCH_M, information_of_a_point, observed_terms
from hsloc.slam.result import OdometryErrors
from hsloc.slam.slips import STRETCHES_DEEP, stretch_ends

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.joint_registration import Registration
    from hsloc.slam.pose_graph import Edges

    F64 = NDArray[np.float64]

_PRIOR = np.array((0.1, 0.2, 0.05))
"""Standard deviations of the errors before a log is seen: wheels that are a tenth too large, a robot on tracks that
turns a fifth less than it counts, wheels half a metre apart of which one is 2.5 % larger. Wide: the stretches decide.
"""
_SMALL = np.array((1e-3, 1e-3, 1e-4))
"""Errors by which the derivatives are taken. Internal."""
_SURPRISE = 3.0
"""Scale of the Cauchy weight on a stretch's normalised difference: slips are none of these errors."""
_ROUNDS = 10
_PARTS = 10
"""Parts of the log whose errors count as independent of each other, as for the mounting of the laser."""
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
        return replace(steps, measured=steps.measured + np.tensordot(self.values, self.changes(steps.measured), 1))

    def changes(self, steps: F64) -> F64:
        """Derivatives (3, n - 1, 3) of steps (n - 1, 3) by the three; zero before `first`."""
        found = _derivatives(steps)
        found[:, : self.first] = 0.0
        return found


def _derivatives(steps: F64) -> F64:
    found = np.zeros((3, len(steps), 3))
    found[0, :, :2] = steps[:, :2]
    found[1, :, 2] = steps[:, 2]
    found[2, :, 2] = np.hypot(steps[:, 0], steps[:, 1])
    return found


def find_systematic_errors(refined: Registration, steps: Edges, first: int = 0) -> SystematicErrors:
    """Those of the odometry's `steps` (n - 1) from keyscan `first` on, by the scans alone.

    Where stretches are few nothing is added, and the covariance is that of a robot of which nothing is known.
    """
    covariances: F64 = np.asarray(np.linalg.inv(steps.information), dtype=np.float64)
    ends = stretch_ends(steps, covariances)
    ends = ends[ends[:, 0] >= first]
    if len(ends) < _FEWEST:
        return SystematicErrors(np.zeros(3), np.diag(_PRIOR**2), first)
    seen, driven = np.empty((2, len(ends), 3))
    seen_covariance, driven_covariance = np.empty((2, len(ends), 3, 3))
    of_a_point, terms = information_of_a_point(refined, FLAT_IN_A_STRETCH_M), observed_terms(refined)
    window_motions(refined.linearised_at, refined.pairs, terms, of_a_point, ends, seen, seen_covariance)
    composed_motions(steps.measured, covariances, ends, driven, driven_covariance)
    rows, ignored = np.empty((len(ends), 3, 3)), np.empty((len(ends), 3, 3))
    for k, derivative in enumerate(_derivatives(steps.measured)):
        moved = np.empty((len(ends), 3))
        composed_motions(steps.measured + _SMALL[k] * derivative, covariances, ends, moved, ignored)
        rows[:, :, k] = _difference(moved, driven) / _SMALL[k]
    apart = _difference(seen, driven)
    weights = np.linalg.inv(seen_covariance + driven_covariance)
    values = np.zeros(3)
    for _ in range(_ROUNDS):
        left = apart - rows @ values
        chi2 = np.einsum("mi,mij,mj->m", left, weights, left)
        weight = 1.0 / (1.0 + chi2 / _SURPRISE**2) / STRETCHES_DEEP
        held = np.einsum("mik,m,mij->mkj", rows, weight, weights)
        # The prior is shared out, so that it is in each part of the log.
        information, vectors = held @ rows + np.diag(_PRIOR**-2.0) / len(ends), np.einsum("mkj,mj->mk", held, apart)
        values = np.linalg.solve(information.sum(axis=0), vectors.sum(axis=0))
    without = without_each_part(information, vectors, _PARTS)
    spread = without - without.mean(axis=0)
    # The noise, by the parts of the log, and what is left of the prior where no stretch shows an error.
    left_over = np.linalg.inv(information.sum(axis=0))
    covariance = (_PARTS - 1) / _PARTS * spread.T @ spread + left_over @ np.diag(_PRIOR**-2.0) @ left_over
    return SystematicErrors(values, np.asarray(covariance, dtype=np.float64), first)


def _difference(ends: F64, begins: F64) -> F64:
    found = ends - begins
    found[:, 2] = wrap_angles(found[:, 2])
    return found
