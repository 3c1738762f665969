"""The covariances of matched scans, carried by the odometry to the poses of the trajectory after them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.motion import predict_covariance
from hsloc.model.pose2 import Pose2

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
    anchors: dict[int, Pose2] = {}
    for row in np.flatnonzero(localised & (last >= 0)).tolist():
        scan = int(order[last[row]])
        pose = Pose2.from_array(trajectory.poses[row])
        # The pose of the scan is not in the result: that of the first message after it is the nearest.
        anchor = anchors.setdefault(scan, pose)
        motion = anchor.between(pose)
        found[row] = predict_covariance(scans.covariance[scan], anchor, motion, motion_covariance(motion))
    return found
