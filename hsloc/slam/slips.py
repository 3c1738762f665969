"""Where wheels slipped: stretches over which the scans contradict the odometry.

A slip of half a metre over a second is shared out over ten steps, each of which passes for noise; where few points fix
the position along a corridor the solution follows the odometry. Over the whole stretch the two are distinguished: the
motion by the scans alone, and that by the odometry alone, with the covariances of both (an innovation test). Where they
contradict each other, the odometry loses its weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.registration import composed_motions, window_motions
from hsloc.model.pose2 import wrap_angles
from hsloc.slam.marginals import information_of_a_point

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
_SLIPPED = np.diag((0.1**2, 0.1**2, 0.1**2))
"""Covariance (m^2, rad^2) that is added to each step of such a stretch: as much as the step is long."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Stretches of the path, and what scans and odometry say of the motion along each.

    `ends` (m, 2) are their first and last keyscans. `difference` (m, 3) is the motion by the scans less that by the
    odometry, in the frame of the first, `normalised` (m,) its length in standard deviations. `sigma` (m,) is the
    standard deviation (m) of the scans' motion in its worst direction.
    """

    ends: I64
    difference: F64
    normalised: F64
    sigma: F64

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


def compare_with_odometry(refined: Registration, steps: Edges) -> Stretches:
    """Hold the scans of each stretch against the odometry's `steps` (n - 1) along it."""
    covariances: F64 = np.asarray(np.linalg.inv(steps.information), dtype=np.float64)
    begin = np.arange(0, max(len(refined.poses) - _STEPS, 0), _EVERY)
    joints = np.concatenate(([0], np.cumsum(covariances[:, 0, 0] > _LEFT_OUT)))
    begin = begin[joints[begin + _STEPS] == joints[begin]]
    ends = np.column_stack((begin, begin + _STEPS)).astype(np.int64)
    seen, driven = np.empty((2, len(ends), 3))
    seen_covariance, driven_covariance = np.empty((2, len(ends), 3, 3))
    of_a_point = information_of_a_point(refined)
    window_motions(refined.linearised_at, refined.pairs, refined.terms, of_a_point, ends, seen, seen_covariance)
    composed_motions(steps.measured, covariances, ends, driven, driven_covariance)
    difference = seen - driven
    difference[:, 2] = wrap_angles(difference[:, 2])
    weighed = np.linalg.solve(seen_covariance + driven_covariance, difference[:, :, None])[:, :, 0]
    normalised = np.sqrt(np.maximum((difference * weighed).sum(axis=1), 0.0))
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(seen_covariance[:, :2, :2])[:, -1], 0.0))
    return Stretches(ends, difference, normalised, sigma)


def without_slips(steps: Edges, slipped: NDArray[np.bool_]) -> Edges:
    """The steps, those that are `slipped` (n - 1,) with next to no weight."""
    information = steps.information.copy()
    information[slipped] = np.linalg.inv(np.linalg.inv(steps.information[slipped]) + _SLIPPED)
    return replace(steps, information=information)
