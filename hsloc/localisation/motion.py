"""The covariances of an extended Kalman filter over poses: prediction and update."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.motion_models import OdometryNoise
from hsloc.model.pose2 import Pose2, wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

__all__ = ["OdometryNoise", "fuse", "predict_covariance"]


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
