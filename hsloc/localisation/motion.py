"""The covariances of an extended Kalman filter over poses: prediction and update."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.motion_models import OdometryNoise
from hsloc.model.pose2 import Pose2, wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.match import Match

    F64 = NDArray[np.float64]

__all__ = ["OdometryNoise", "fuse", "predict_covariance"]


def transition(pose: Pose2, motion: Pose2) -> F64:
    """`F` (3, 3) of the prediction: how an error of `pose` in the map frame moves `pose @ motion`."""
    c, s = cos(pose.theta), sin(pose.theta)
    return np.array(
        ((1.0, 0.0, -s * motion.x - c * motion.y), (0.0, 1.0, c * motion.x - s * motion.y), (0.0, 0.0, 1.0)),
    )


def predict_covariance(covariance: F64, pose: Pose2, motion: Pose2, motion_covariance: F64) -> F64:
    """Covariance of `pose @ motion` in the map frame: `F P F^T + V M V^T`, all (3, 3)."""
    c, s = cos(pose.theta), sin(pose.theta)
    f = transition(pose, motion)
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


def update_with_information(prediction: Pose2, covariance: F64, measured: Pose2, information: F64) -> tuple[Pose2, F64]:
    """The EKF's update with a measured pose of which `information` (3, 3) is known: `K = (I + P L)^-1 P L`.

    Where the information is zero the prediction stays as it is, and so does its variance.
    """
    updated = np.linalg.solve(np.eye(3) + covariance @ information, covariance)
    updated = 0.5 * (updated + updated.T)
    pose = Pose2.from_array(prediction.to_array() + updated @ information @ difference(measured, prediction))
    return pose, updated


def fuse_match(prediction: Pose2, covariance: F64, match: Match, information: F64 | None) -> tuple[Pose2, F64]:
    """The EKF's update with a match: by the information of its walls, or by its covariance where that is not known."""
    if information is None:
        return fuse(prediction, covariance, match.pose, match.covariance)
    return update_with_information(prediction, covariance, match.pose, information)


def normalised_innovation(prediction: Pose2, covariance: F64, measured: Pose2, information: F64) -> tuple[float, float]:
    """Squared innovation by its expected covariance, and its degrees of freedom.

    Directions that are not measured count for none.

    With `P` the covariance of the prediction and `L` the information of the measurement the innovation's covariance is
    `P + L^-1`, its inverse `L (I + P L)^-1`, and the degrees of freedom are the trace of the gain.
    """
    gain = np.linalg.solve(np.eye(3) + covariance @ information, covariance @ information)
    weight = information @ np.linalg.inv(np.eye(3) + covariance @ information)
    innovation = difference(measured, prediction)
    return float(innovation @ weight @ innovation), float(np.trace(gain))


def difference(pose: Pose2, other: Pose2) -> F64:
    """x, y and theta (wrapped) of a pose less those of another, shape (3,)."""
    return np.array((pose.x - other.x, pose.y - other.y, wrap_angle(pose.theta - other.theta)))
