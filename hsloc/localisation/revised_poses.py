"""The poses before a relocalisation, by the scans that were matched backwards from it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.interpolated_odometry import AtStamp
from hsloc.localisation.kalman_filter import (
    MAX_SQUARED,
    Anchor,
    SmoothedMatches,
    difference,
    is_far,
    predict_covariance,
)
from hsloc.model.pose2 import Pose2, compose_poses, rotated

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel
    from hsloc.model.estimate import Revised
    from hsloc.model.trajectory import Trajectory

    F64 = NDArray[np.float64]


def composed(poses: F64, odometry: F64, revision: Sequence[Revised], end: int) -> F64:
    """Poses (n, 3) of which those up to the `end`-th are the odometry (n, 3) at each revised place."""
    found = poses.copy()
    bounds = [each.odometry_count for each in revision[1:]] + [end]
    for each, last in zip(revision, bounds, strict=True):
        rows = slice(each.odometry_count, last)
        found[rows] = compose_poses(each.T_map_odom.to_array(), odometry[rows])
    return found


def revised_matches(
    revision: Sequence[Revised], found: Anchor, noise_scale: float, odometry: Trajectory, motion_model: MotionModel
) -> tuple[list[Anchor], SmoothedMatches]:
    """The matches of a revision, and `found`, that of the relocalisation, as anchors of one track.

    They were fused with the odometry backwards, and stay where they are. The odometry is `noise_scale` times as noisy
    as assumed (variances).
    """
    anchors: list[Anchor] = []
    for each in revision:
        if each.covariance is None or each.odometry_count >= found.count:
            continue
        row = max(each.odometry_count - 1, 0)
        T_odom_base = Pose2.from_array(odometry.poses[row])
        place, at = each.T_map_odom @ T_odom_base, AtStamp(int(odometry.stamps_ns[row]))
        anchors.append(
            Anchor(each.odometry_count, T_odom_base, place, each.covariance, not anchors, noise_scale, at=at)
        )
    anchors.append(replace(found, begins=not anchors))
    variances, slips = np.zeros((2, len(anchors), 3))
    for k in range(1, len(anchors)):
        before, after = anchors[k - 1], anchors[k]
        motion = before.T_odom_base.between(after.T_odom_base)
        noise = noise_scale * motion_model.covariance(motion)
        variances[k] = np.diag(rotated(noise, before.T_map_base.theta))
        off = difference(after.T_map_base, before.T_map_base @ motion)
        covariance = predict_covariance(before.covariance, before.T_map_base, motion, noise) + after.covariance
        if is_far(off) and off @ np.linalg.solve(covariance + 1e-10 * np.eye(3), off) > MAX_SQUARED:
            slips[k] = np.maximum(off**2 - np.diag(covariance), 0.0)
    poses = np.array([anchor.T_map_base.to_array() for anchor in anchors])
    return anchors, SmoothedMatches(poses, np.array([anchor.covariance for anchor in anchors]), variances, slips)
