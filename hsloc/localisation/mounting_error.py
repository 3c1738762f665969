"""How far the laser is from where it is said to be, by the steps between matches and those of the odometry.

A laser that is mounted elsewhere by `X` (x, y, yaw in the base frame) puts each match there: `M = B X` in place of the
base's pose `B`. While the robot drives straight on, a wrong yaw looks like driving aslant; while it turns, a wrong
place looks like a step aside. A step of the odometry `S` is seen as `X^-1 S X`; to first order what is seen less the
odometry is `k S_t + (R(S_theta) - 1) (x, y) + yaw (S_y, -S_x)`, linear in `X` and in the odometry's scale `k`. The same
equations as in Censi et al. (T-RO 2013), about the mounting that is stated. `hsloc calibrate` finds more, from the
scans alone; this takes no further match, and shows whether that is worth while.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, inf, isinf, radians
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hsloc.model.pose2 import Pose2, compose_poses, relative_poses, wrap_angles

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.kalman_filter import Anchor

    F64 = NDArray[np.float64]

_FEWEST = 40
"""Steps below which nothing is said: about 8 m."""
PARTS = 10
"""Parts of the run whose errors count as independent of each other: what odometry gets wrong lasts for many steps."""
_LEAST_OTHER_SIDE = 0.1
"""Part of the rotation that goes to the other side, at least: to one side alone, wheels that slip in turns look like a
laser that is mounted aside. One that is ahead or behind moves sideways in turns, as no wheel does."""
_SLIP_M, _SLIP_SIGMAS = 0.05, 3.0
"""Standard deviation (m) of what wheels lose by slip in each radian, a tenth of a bend of half a metre's radius, and by
how many of them a laser has to be aside where all turns go to one side."""
_LONGEST_M = 1.0
"""Steps that are longer hold refused scans (m)."""
MIN_SIGMAS = 7.0
"""Minimum ratio of an error to its standard deviation: once in 16,000 runs, as it is Student's of 9 degrees of freedom:
4 would be once in 320. True errors of 10 cm and 3 deg have ratios of 10 to 13 after a minute."""
YAW = 3
"""Number of the yaw among what is solved for: the scale of the odometry and the x, y and yaw of the laser."""
PRIOR = 1e-6
"""Information of the prior, so that what no step shows is found to be zero."""
_LEAST_M, LEAST_RAD = 0.05, radians(2.0)
"""Smaller errors are not reported: a ruler and an eye do no better."""
UNKNOWN_M = 0.07
"""Error of the place in x and in y (m) of a laser whose yaw is wrong, where nothing shows it: together 10 cm, as far as
a laser is from the middle of a small robot. Assumed: whoever states a wrong yaw did not measure the place."""


@dataclass(frozen=True, slots=True)
class MountingError:
    """The laser is at `error @ mounting` where `mounting` is stated; standard deviations in m, m, rad.

    Where nearly all turns go to one side, slip in turns may be a part of y: `slip` is the standard deviation (m) of it,
    and of a place that is not wrong beyond doubt nothing is said: its standard deviations are infinite.
    """

    error: Pose2
    sigma: tuple[float, float, float]
    slip: float = 0.0

    @property
    def place_sigma(self) -> float:
        """Standard deviation (m) of the place, by slip, too."""
        return hypot(*self.sigma[:2], self.slip)

    @property
    def is_displaced(self) -> bool:
        """Whether the place is wrong beyond doubt, and by enough to matter."""
        x, y = abs(self.error.x), abs(self.error.y)
        of_x, of_y = (MIN_SIGMAS * sigma for sigma in self.sigma[:2])
        if self.slip:
            return x > max(_LEAST_M, of_x) or y > max(_LEAST_M, hypot(of_y, _SLIP_SIGMAS * self.slip))
        return hypot(x, y) > max(_LEAST_M, hypot(of_x, of_y))

    @property
    def is_turned(self) -> bool:
        """Whether the yaw is wrong beyond doubt, and by enough to matter."""
        return abs(self.error.theta) > max(LEAST_RAD, MIN_SIGMAS * self.sigma[2])

    @property
    def is_significant(self) -> bool:
        """Whether place or yaw are."""
        return self.is_displaced or self.is_turned

    def of_yaw(self) -> MountingError:
        """The same without a place."""
        return MountingError(Pose2(0.0, 0.0, self.error.theta), (inf, inf, self.sigma[2]))

    def pose_errors(self, poses: F64) -> F64:
        """What it makes of poses (n, 3) on a map, as absolute errors (n, 3) in m, m, rad; 0 where not significant.

        Of a laser whose yaw is wrong the place is doubted as well, where no turns to both sides show it.
        """
        errors = np.zeros((len(poses), 3))
        if self.is_displaced:
            c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
            errors[:, 0] = np.abs(c * self.error.x - s * self.error.y)
            errors[:, 1] = np.abs(s * self.error.x + c * self.error.y)
        elif self.is_turned and isinf(self.sigma[0]):
            errors[:, :2] = UNKNOWN_M
        if self.is_turned:
            errors[:, 2] = abs(self.error.theta)
        return errors


class Steps(NamedTuple):
    """Equations of the steps between matches: `rows` (n, 2, 4) times scale, x, y and yaw is `apart` (n, 2; m).

    Each leads to the pose of number `second` (n,). `turned` (n,) is by how much the robot turned (rad).
    """

    rows: F64
    apart: F64
    turned: F64
    second: NDArray[np.intp]


def steps_of_anchors(anchors: Sequence[Anchor]) -> Steps | None:
    """Of the matches of a run with one laser; None where there are too few."""
    if len(anchors) <= _FEWEST:
        return None
    odometry = np.array([anchor.T_odom_base.to_array() for anchor in anchors])
    matched = np.array([anchor.T_map_base.to_array() for anchor in anchors])
    return steps_of_poses(odometry, matched, np.array([anchor.begins for anchor in anchors]))


def steps_of_poses(odometry: F64, matched: F64, begins: NDArray[np.bool_] | None = None) -> Steps | None:
    """By poses (n, 3) of the odometry and of the matches; `begins` (n,): a new track begins there. None as above."""
    step, seen = relative_poses(odometry[:-1], odometry[1:]), relative_poses(matched[:-1], matched[1:])
    usable = np.hypot(step[:, 0], step[:, 1]) < _LONGEST_M
    if begins is not None:
        usable &= ~begins[1:]
    step, seen = step[usable], seen[usable]
    if len(step) < _FEWEST:
        return None
    turned = wrap_angles(seen[:, 2])  # noise of the odometry turns its translation, too: it would show as a place
    # So would a scale of its turns: along an arc half of what is turned too far is in the direction of the step.
    half = np.column_stack((np.zeros((len(step), 2)), 0.5 * wrap_angles(turned - step[:, 2])))
    step = compose_poses(half, step)
    c, s = np.cos(turned), np.sin(turned)
    along = np.stack((step[:, 0], c - 1.0, -s, step[:, 1]), axis=1)
    aside = np.stack((step[:, 1], s, c - 1.0, -step[:, 0]), axis=1)
    return Steps(np.stack((along, aside), axis=1), seen[:, :2] - step[:, :2], turned, np.flatnonzero(usable) + 1)


def mounting_error(steps: Steps) -> MountingError:
    """The one that explains the steps best."""
    turned = steps.turned
    other_side = min(turned[turned > 0.0].sum(), -turned[turned < 0.0].sum())
    is_one_sided = other_side <= _LEAST_OTHER_SIDE * np.abs(turned).sum()
    values, information, vectors = robust_solution(steps.rows, steps.apart)
    without = without_each_part(information, vectors, equal_parts(len(vectors), PARTS))
    sigma = np.sqrt((PARTS - 1) / PARTS * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    x, y, yaw = values[1:].tolist()
    sigmas = (float(sigma[1]), float(sigma[2]), float(sigma[3]))
    found = MountingError(Pose2(x, y, yaw), sigmas, _SLIP_M if is_one_sided else 0.0)
    return found.of_yaw() if is_one_sided and not found.is_displaced else found


def robust_solution(rows: F64, apart: F64) -> tuple[F64, F64, F64]:
    """Values (p,) by robust least squares, and the normal equations (n, p, p) and (n, p) of each step.

    `rows` (n, 2, p) times the values is `apart` (n, 2).
    """
    parameters = rows.shape[2]
    values = np.zeros(parameters)
    for _ in range(5):
        residual = apart - rows @ values
        scale = np.maximum(1.4826 * np.median(np.abs(residual), axis=0), 1e-4)
        weight = 1.0 / scale**2 / (1.0 + ((residual / scale) ** 2).sum(axis=1, keepdims=True) / 4.0)
        weighed = rows * weight[..., None]
        columns = weighed.reshape(-1, parameters).T
        information = columns @ rows.reshape(-1, parameters) + PRIOR * np.eye(parameters)
        values = np.linalg.solve(information, columns @ apart.reshape(-1))
    return values, np.swapaxes(weighed, 1, 2) @ rows, np.einsum("nip,ni->np", weighed, apart)


def equal_parts(n: int, parts: int) -> NDArray[np.intp]:
    """The part (n,) that each step belongs to, of as many of about the same length, in order."""
    return np.arange(n) * parts // n


def without_each_part(information: NDArray[Any], vectors: NDArray[Any], part: NDArray[np.intp]) -> NDArray[Any]:
    """Solutions (parts, p) of normal equations without each part of their rows in turn (jackknife).

    `information` (n, p, p) and `vectors` (n, p), real or complex, are those of each row; `part` (n,) numbers the part
    that it belongs to, -1 none.
    """
    total, sums = information.sum(axis=0) + PRIOR * np.eye(vectors.shape[1]), vectors.sum(axis=0)
    return np.array(
        [
            np.linalg.solve(total - information[part == k].sum(axis=0), sums - vectors[part == k].sum(axis=0))
            for k in range(int(part.max()) + 1)
        ]
    )
