"""The odometry of a run as a way, and what its errors add up to between any two of its poses."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.model.pose2 import Pose2, compose_poses, rotated, wrap_angle, wrap_angles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel

    F64 = NDArray[np.float64]

_STEP, _STEP_ANGLE = 0.2, 0.2
"""Motions (m, rad) whose errors are taken for independent."""
_SCALE, _TURN_SCALE = 0.03, 0.04
"""Standard deviations of the scale of the odometry and of that of its turns: those of wheels that are not calibrated,
as in benchmarks/calibration.py."""
_VAGUE = 3.0
"""Standard deviation (m) from which on it is not known where the odometry leads."""


class Errors(NamedTuple):
    """Of the odometry: the variances of its noise by the assumed ones, and the drift of its heading (rad/m)."""

    scale: float
    drift: float


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """The odometry of a run, and what its errors add up to.

    `poses` (n, 3) are T_odom_base. `noise` (n, 3, 3) sums the covariances of the motions so far, each moved to the
    origin of the odometry's frame, so that the sum between two poses is the difference of two rows. `bias` (n, 3, 3)
    are the errors (rows) at a pose, moved to the origin likewise, of wheels that differ, of a scale and of a scale of
    turns, each by 1.
    """

    poses: F64
    noise: F64
    bias: F64

    @staticmethod
    def of(poses: F64, model: MotionModel) -> Way:
        """Of odometry poses (n, 3)."""
        noise = np.zeros((len(poses), 3, 3))
        total = np.zeros((3, 3))
        last, first = Pose2.from_array(poses[0]), 0
        for k, (x, y, theta) in enumerate(poses.tolist()):
            if hypot(x - last.x, y - last.y) < _STEP and abs(wrap_angle(theta - last.theta)) < _STEP_ANGLE:
                continue
            here = Pose2(x, y, theta)
            noise[first:k] = total
            reach = _shift(-here.x, -here.y)
            total = total + reach @ rotated(model.covariance(last.between(here)), last.theta) @ reach.T
            last, first = here, k
        noise[first:] = total
        steps = np.diff(poses, axis=0)
        metres, turns = np.hypot(steps[:, 0], steps[:, 1]), wrap_angles(steps[:, 2])
        middle = 0.5 * (poses[1:, :2] + poses[:-1, :2])
        bias = np.zeros((len(poses), 3, 3))
        for kind, part in ((0, metres), (2, turns)):
            bias[1:, kind] = np.cumsum(np.column_stack((part * middle[:, 1], -part * middle[:, 0], part)), axis=0)
        # A translation by itself does not turn anything: its error is moved to the origin as it is.
        bias[1:, 1, :2] = np.cumsum(steps[:, :2], axis=0)
        return Way(poses, noise, bias)

    def metres(self, messages: NDArray[np.int64]) -> F64:
        """Path length up to the messages (m)."""
        result: F64 = self.bias[messages, 0, 2]
        return result

    def between(self, a: int, b: int, errors: Errors) -> F64:
        """Covariance (3, 3) of pose b by pose a, along the axes of the odometry's frame."""
        a, b = min(a, b), max(a, b)
        shift = _shift(*self.poses[b, :2])
        bias = (self.bias[b] - self.bias[a]) @ shift.T * np.array(((errors.drift,), (_SCALE,), (_TURN_SCALE,)))
        result: F64 = shift @ (errors.scale * (self.noise[b] - self.noise[a])) @ shift.T + bias.T @ bias
        return result

    def known(self, a: int, b: int, errors: Errors) -> float:
        """How much may be said of where the odometry leads from one message to another, in [0, 1]."""
        variance = float(np.trace(self.between(a, b, errors)[:2, :2]))
        return 1.0 / (1.0 + variance / _VAGUE**2)

    def led_to(self, T_map_base: Pose2, a: int, others: NDArray[np.int64]) -> F64:
        """Poses (m, 3) in the map at the messages `others` by the odometry from `T_map_base` at message a."""
        T_map_odom = T_map_base @ Pose2.from_array(self.poses[a]).inverse()
        return compose_poses(T_map_odom.to_array(), self.poses[others])


def _shift(x: float, y: float) -> F64:
    """How an error of x, y and heading at the origin moves a point at x, y (3, 3)."""
    return np.array(((1.0, 0.0, -y), (0.0, 1.0, x), (0.0, 0.0, 1.0)))
