"""An extended Kalman filter over poses: prediction, update, and smoothing backwards over a run.

Offline, the scans to come are known, so the poses are smoothed in two steps. Those at matches by the recursion of
Rauch, Tung and Striebel (AIAA Journal 3(8), 1965): `x_i += C (x_(i+1) - x_(i+1|i))` with `C = P_i F^T P_(i+1|i)^-1`;
that brings what a corridor's end shows to the poses before it. Between two matches the errors of odometry are a random
walk whose ends are known: its mean is the mean of what both ends predict, weighted by the share of the motion, as the
variance grows with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, compose_poses, wrap_angle, wrap_angles

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel
    from hsloc.matching.match import Match

    F64 = NDArray[np.float64]

_MAX_SQUARED = 16.3
"""Squared difference by its covariance, prediction to smoothed pose, up to which it was noise: the 99.9 % quantile
of chi squared with 3 degrees of freedom. Beyond it a wheel slipped."""
_METRES_PER_RADIAN = 0.5
"""Metres that a radian counts for in the share of the motion: about the track width of an indoor robot."""
_NO_NOISE = 1e-10 * np.eye(3)


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


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A match of a track: the pose in the odometry's and in the map's frame, and its covariance (3, 3).

    `count` odometry messages came before. `begins` says that it does not continue the anchor before.
    """

    count: int
    T_odom_base: Pose2
    T_map_base: Pose2
    covariance: F64
    begins: bool


def smooth_matches(anchors: Sequence[Anchor], motion_model: MotionModel) -> F64:
    """The poses (n, 3) of the matches, T_map_base, each smoothed by those of its track that follow."""
    poses = np.array([anchor.T_map_base.to_array() for anchor in anchors]).reshape(-1, 3)
    for k in range(len(anchors) - 2, -1, -1):
        here, following = anchors[k], anchors[k + 1]
        if following.begins:
            continue
        motion = here.T_odom_base.between(following.T_odom_base)
        noise = motion_model.covariance(motion)
        predicted = here.T_map_base @ motion
        variance = predict_covariance(here.covariance, here.T_map_base, motion, noise) + _NO_NOISE
        off = difference(Pose2.from_array(poses[k + 1]), predicted)
        weighted = np.linalg.solve(variance, off)
        if off @ weighted > _MAX_SQUARED:
            continue
        poses[k] += here.covariance @ transition(here.T_map_base, motion).T @ weighted
        poses[k, 2] = wrap_angles(poses[k, 2:])[0]
    return poses


def between_matches(poses: F64, odometry: F64, anchors: Sequence[Anchor], matched: F64) -> F64:
    """The poses (n, 3) of a run, those between two matches of a track replaced by the mean of what both predict.

    `odometry` (n, 3) belongs to the poses, `matched` (m, 3) are the poses at the anchors.
    """
    if len(anchors) < 2:
        return poses
    at_odometry = np.array([anchor.T_odom_base.inverse().to_array() for anchor in anchors])
    T_map_odom = compose_poses(matched, at_odometry)
    counts = np.array([anchor.count for anchor in anchors])
    begins = np.array([anchor.begins for anchor in anchors])
    before = np.searchsorted(counts, np.arange(len(poses)), side="right") - 1
    rows = np.flatnonzero((before >= 0) & (before + 1 < len(anchors)))
    rows = rows[~begins[before[rows] + 1]]
    first, second = before[rows], before[rows] + 1
    steps = np.diff(odometry, axis=0, prepend=odometry[:1])
    moved = np.cumsum(np.hypot(steps[:, 0], steps[:, 1]) + _METRES_PER_RADIAN * np.abs(wrap_angles(steps[:, 2])))
    begin, end = moved[np.maximum(counts[first] - 1, 0)], moved[np.maximum(counts[second] - 1, 0)]
    share = np.clip((moved[rows] - begin) / np.maximum(end - begin, 1e-9), 0.0, 1.0)[:, None]
    ahead = compose_poses(T_map_odom[first], odometry[rows])
    back = compose_poses(T_map_odom[second], odometry[rows])
    off = back - ahead
    off[:, 2] = wrap_angles(off[:, 2])
    smoothed = poses.copy()
    smoothed[rows] = ahead + share * off
    smoothed[rows, 2] = wrap_angles(smoothed[rows, 2])
    return smoothed
