"""Where wheels slipped: stretches over which the scans contradict the odometry.

A slip of half a metre over a second is shared out over ten steps, each of which passes for noise; where few points fix
the position along a corridor the solution follows the odometry. Over the whole stretch the two are distinguished: the
motion by the scans alone, and that by the odometry alone, with the covariances of both (an innovation test). Where they
contradict each other, the odometry loses its weight.

A slip along a bare corridor is not noticed by this: recesses and door frames that are displaced by more than the gate
of the registration are not paired, and the side walls agree. Where the scans hardly fix the motion, the scans before
and after the stretch are therefore held against each other with the motion as found, and displaced.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.registration import composed_motions, displaced_agreement, window_motions
from hsloc.model.pose2 import wrap_angles
from hsloc.slam.marginals import information_of_a_point

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.kernels.normal_equations import PairTerms
    from hsloc.kernels.point_to_line import ScanArrays
    from hsloc.slam.joint_registration import Registration
    from hsloc.slam.pose_graph import Edges

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_STEPS = 20
"""Steps of a stretch: longer than a slip, and short enough that the odometry says something."""
_EVERY = 5
"""Steps from the beginning of one stretch to that of the next."""
_CONTRADICTION = 4.0
"""Normalised difference from which on the two contradict each other. Of some 50,000 stretches of simulated drives none
without a slip reaches 3, and most slips have 5 to 60."""
_LEFT_OUT = 100.0
"""Variance (m^2) of a step above which it joins two logs, and no stretch leads over it."""
_HARDLY_M = 0.075
"""Standard deviation [m] of the scans' motion from which on displacements are tried: 4 of it hide 0.3 m, a slip that
matters."""
_DISPLACEMENTS = np.concatenate((np.arange(-24, -4), np.arange(5, 25))) * 0.05
"""Displacements [m] that are tried: from a quarter of a metre, beyond the gate, up to 1.2 m."""
_HERE = np.array((-0.1, -0.05, 0.0, 0.05, 0.1))
"""Displacements [m] that count as none."""
_COMPARED = 4
"""Keyscans before and after a stretch that are held against each other, every third."""
_OTHER_VISIT = 30
"""Keyscans before or after a stretch from which on others are of another visit."""
_AT_AN_END = 6
"""Keyscans at an end of a stretch that other visits may hold."""
_SLIPPED = np.diag((0.1**2, 0.1**2, 0.1**2))
"""Covariance (m^2, rad^2) that is added to each step of such a stretch: as much as the step is long."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Stretches of the path, and what scans and odometry say of the motion along each.

    `ends` (m, 2) are their first and last keyscans. `difference` (m, 3) is the motion by the scans less that by the
    odometry, in the frame of the first, `normalised` (m,) its length in standard deviations. `sigma` (m,) is the
    standard deviation (m) of the scans' motion in its worst direction. `margin` (m,) is by how much more of the points
    of the scans before and after agree with the motion as found than with any that is displaced in that direction, a
    ratio; 1 where the scans fix the motion. `visits_sigma` (m,) is the standard deviation (m) in that direction at
    which scans of other visits hold the ends of the stretch, the worse of the two; infinite without such.
    """

    ends: I64
    difference: F64
    normalised: F64
    sigma: F64
    margin: F64
    visits_sigma: F64

    @property
    def contradicted(self) -> NDArray[np.bool_]:
        """Which of them contradict the odometry, shape (m,)."""
        return self.normalised > _CONTRADICTION

    def slipped(self, steps: int) -> NDArray[np.bool_]:
        """Steps, of that number, in such stretches."""
        slipped = np.zeros(steps, dtype=np.bool_)
        for first, last in self.ends[self.contradicted].tolist():
            slipped[first:last] = True
        return slipped


def compare_with_odometry(refined: Registration, steps: Edges, scans: ScanArrays, observed: PairTerms) -> Stretches:
    """Hold the scans of each stretch against the odometry's `steps` (n - 1) along it.

    `observed` are the terms of `marginals.observed_terms`.
    """
    covariances: F64 = np.asarray(np.linalg.inv(steps.information), dtype=np.float64)
    begin = np.arange(0, max(len(refined.poses) - _STEPS, 0), _EVERY)
    joints = np.concatenate(([0], np.cumsum(covariances[:, 0, 0] > _LEFT_OUT)))
    begin = begin[joints[begin + _STEPS] == joints[begin]]
    ends = np.column_stack((begin, begin + _STEPS)).astype(np.int64)
    seen, driven = np.empty((2, len(ends), 3))
    seen_covariance, driven_covariance, known_covariance = np.empty((3, len(ends), 3, 3))
    of_a_point = information_of_a_point(refined)
    window_motions(refined.linearised_at, refined.pairs, observed, of_a_point, ends, seen, known_covariance)
    window_motions(refined.linearised_at, refined.pairs, refined.terms, of_a_point, ends, seen, seen_covariance)
    composed_motions(steps.measured, covariances, ends, driven, driven_covariance)
    difference = seen - driven
    difference[:, 2] = wrap_angles(difference[:, 2])
    weighed = np.linalg.solve(seen_covariance + driven_covariance, difference[:, :, None])[:, :, 0]
    normalised = np.sqrt(np.maximum((difference * weighed).sum(axis=1), 0.0))
    variances, axes = np.linalg.eigh(known_covariance[:, :2, :2])
    sigma = np.sqrt(np.maximum(variances[:, -1], 0.0))
    margin, visits_sigma = np.ones(len(ends)), np.full(len(ends), np.inf)
    weak = np.flatnonzero(sigma > _HARDLY_M)
    h = observed.information
    across = h[:, :2, :2] - h[:, :2, 2:] * h[:, 2:, :2] / np.maximum(h[:, 2:, 2:], 1e-9)
    for k in weak.tolist():
        heading = refined.poses[ends[k, 0], 2]
        c, s = np.cos(heading), np.sin(heading)
        axis = np.array(((c, -s), (s, c))) @ axes[k, :, -1]
        margin[k] = _margin(refined, scans, ends[k], axis)
        visits_sigma[k] = (of_a_point * _held_by_visits(refined, across, ends[k], axis)) ** -0.5
    return Stretches(ends, difference, normalised, sigma, margin, visits_sigma)


def _held_by_visits(refined: Registration, across: F64, ends: I64, axis: F64) -> float:
    """Information (points) along `axis` (2,), in the map, by which other visits hold either end: the smaller.

    `across` (k, 2, 2) is that of the pairs in x and y, in the frame of their first, whatever the heading.
    """
    first, last = ends.tolist()
    i, j = refined.pairs.T
    held = []
    for begin, end in ((first - _AT_AN_END, first), (last, last + _AT_AN_END)):
        early = (j >= begin) & (j <= end) & (i < first - _OTHER_VISIT)
        late = (i >= begin) & (i <= end) & (j > last + _OTHER_VISIT)
        pairs = np.flatnonzero(early | late)
        heading = refined.poses[i[pairs], 2]
        c, s = np.cos(heading), np.sin(heading)
        along = np.column_stack((c * axis[0] + s * axis[1], c * axis[1] - s * axis[0]))
        held.append(float(np.einsum("mi,mij,mj->", along, across[pairs], along)))
    return max(min(held), 1e-12)


def _margin(refined: Registration, scans: ScanArrays, ends: I64, axis: F64) -> float:
    """Agreement across a stretch as found, less the best agreement displaced along `axis` (2,) in the map."""
    first, last = ends.tolist()
    reach = 3 * _COMPARED
    before = np.arange(max(first - reach + 3, 0), first + 1, 3)
    after = np.arange(last, min(last + reach - 2, len(refined.poses)), 3)
    tried = np.concatenate((_HERE, _DISPLACEMENTS))[:, None] * axis
    agreement = np.empty(len(tried))
    displaced_agreement(refined.poses, (before, after), tried, scans, refined.gate, refined.scale, agreement)
    return float(agreement[: len(_HERE)].max() - agreement[len(_HERE) :].max())


def without_slips(steps: Edges, slipped: NDArray[np.bool_]) -> Edges:
    """The steps, those that are `slipped` (n - 1,) with next to no weight."""
    information = steps.information.copy()
    information[slipped] = np.linalg.inv(np.linalg.inv(steps.information[slipped]) + _SLIPPED)
    return replace(steps, information=information)
