"""How uncertain a motion is that odometry tells: the prediction step of the EKF."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, wrap_angle
from hsloc.parameters import NonNegative, Parameters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNoise(Parameters):
    """The odometry motion model of *Probabilistic Robotics* (Thrun, Burgard, Fox; 5.4), names as in AMCL.

    A motion is a turn, a straight line and a turn; their variances are `alpha1 rot^2 + alpha2 trans^2` (both turns)
    and `alpha3 trans^2 + alpha4 (rot1^2 + rot2^2)`. The defaults mean a robot that nobody calibrated: 10 % of the way,
    20 % of a turn. (With 20 % of the way the matches pull the pose from door to door in the corridors of Wean Hall.)
    """

    alpha1: NonNegative = 0.04
    """Variance of a rotation per squared rotation [rad^2 / rad^2]."""
    alpha2: NonNegative = 0.02
    """Variance of a rotation per squared translation [rad^2 / m^2]."""
    alpha3: NonNegative = 0.01
    """Variance of a translation per squared translation [m^2 / m^2]."""
    alpha4: NonNegative = 0.01
    """Variance of a translation per squared rotation [m^2 / rad^2]."""

    def covariance(self, motion: Pose2) -> F64:
        """Covariance (3, 3) of a motion, in the frame in which it began.

        For a robot that drove backwards the first turn is taken from its back, as in AMCL.
        """
        trans = hypot(motion.x, motion.y)
        rot1 = atan2(motion.y, motion.x) if trans > 0.01 else 0.0
        rot2 = wrap_angle(motion.theta - rot1)
        turn1, turn2 = _shortest(rot1), _shortest(rot2)
        var1 = self.alpha1 * turn1**2 + self.alpha2 * trans**2
        var2 = self.alpha1 * turn2**2 + self.alpha2 * trans**2
        var_trans = self.alpha3 * trans**2 + self.alpha4 * (turn1**2 + turn2**2)
        c, s = cos(rot1), sin(rot1)
        jacobian = np.array(((-s * trans, c, 0.0), (c * trans, s, 0.0), (1.0, 0.0, 1.0)))
        covariance: F64 = jacobian @ np.diag((var1, var_trans, var2)) @ jacobian.T
        return covariance


def _shortest(turn: float) -> float:
    """A turn, or what it lacks to half a turn: driving backwards is no turn."""
    return min(abs(turn), abs(pi - abs(turn)))


def predict_covariance(covariance: F64, pose: Pose2, motion: Pose2, motion_covariance: F64) -> F64:
    """Covariance of `pose @ motion` in the map frame: `F P F^T + V M V^T`, all (3, 3)."""
    c, s = cos(pose.theta), sin(pose.theta)
    f = np.array(
        ((1.0, 0.0, -s * motion.x - c * motion.y), (0.0, 1.0, c * motion.x - s * motion.y), (0.0, 0.0, 1.0)),
    )
    v = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    result: F64 = f @ covariance @ f.T + v @ motion_covariance @ v.T
    return result


def fuse(prediction: Pose2, covariance: F64, measured: Pose2, measured_covariance: F64) -> tuple[Pose2, F64]:
    """The EKF's update with a measured pose: `K = P (P + R)^-1`."""
    gain = np.linalg.solve((covariance + measured_covariance).T, covariance.T).T
    innovation = np.array(
        (
            measured.x - prediction.x,
            measured.y - prediction.y,
            wrap_angle(measured.theta - prediction.theta),
        )
    )
    pose = Pose2.from_array(prediction.to_array() + gain @ innovation)
    updated = (np.eye(3) - gain) @ covariance
    return pose, 0.5 * (updated + updated.T)
