"""How uncertain each pose of a trajectory is that follows matched scans."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.kalman_filter import predict_covariances
from hsloc.model.pose2 import Pose2, relative_poses

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.model.estimate import ScanDiagnostics
    from hsloc.model.trajectory import Trajectory

    F64 = NDArray[np.float64]


def pose_covariances(
    trajectory: Trajectory,
    localised: NDArray[np.bool_],
    scans: ScanDiagnostics,
    motion_covariance: Callable[[Pose2], F64],
) -> F64:
    """Covariance (n, 3, 3) of each pose over (x, y, theta) in the map frame (m^2, m rad, rad^2).

    That of the last scan before it whose covariance is known, propagated over the motion since, whose own covariance
    is `motion_covariance`. NaN before the first such scan, and where the pose is not localised.
    """
    found = np.full((len(trajectory), 3, 3), np.nan)
    known = np.flatnonzero(np.isfinite(scans.covariance[:, 0, 0]))
    # Stamps may repeat and run backwards, where the log's do: a scan counts from its stamp on, in the order of time.
    order = known[np.argsort(scans.stamps_ns[known], kind="stable")]
    last = np.searchsorted(scans.stamps_ns[order], trajectory.stamps_ns, side="right") - 1
    rows = np.flatnonzero(localised & (last >= 0))
    if not len(rows):
        return found
    scan, first, of = np.unique(order[last[rows]], return_index=True, return_inverse=True)
    poses = trajectory.poses[rows]
    # The pose of the scan is not in the result: that of the first message after it is the nearest.
    anchors = poses[first][of]
    motions = relative_poses(anchors, poses)
    noise = np.array([motion_covariance(Pose2(*motion)) for motion in motions.tolist()])
    found[rows] = predict_covariances(scans.covariance[scan][of], anchors[:, 2], motions, noise)
    return found
