"""The events of a log, and the poses of all of them once the keyscans' poses are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, compose_poses, relative_poses, wrap_angles
from hsloc.slam.calibration import OdometryCalibration, apply, calibrate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


class EventLog:
    """Odometry of all messages and scans in the order of the log; some scans are keyscans."""

    def __init__(self, turn_length: float) -> None:
        self._turn_length = turn_length
        self._poses: list[tuple[float, float, float]] = []
        self._is_scan: list[bool] = []
        self._keys: list[int] = []

    def add(self, T_odom_base: Pose2, is_scan: bool, is_key: bool = False) -> None:
        """The next event."""
        if is_key:
            self._keys.append(len(self._poses))
        self._poses.append((T_odom_base.x, T_odom_base.y, T_odom_base.theta))
        self._is_scan.append(is_scan)

    def make_key(self, event: int) -> None:
        """Make a scan of before, the event of that number, a keyscan; keyscans must come in order."""
        self._keys.append(event)

    def __len__(self) -> int:
        """How many events there were."""
        return len(self._poses)

    def key_odometry(self) -> F64:
        """Odometry of the keyscans, shape (n, 3)."""
        return np.array([self._poses[k] for k in self._keys]).reshape(-1, 3)

    def calibrated(self, key_poses: F64) -> OdometryCalibration:
        """Calibration of the odometry by the final poses of the keyscans."""
        return calibrate(
            self._index(), np.array(self._poses).reshape(-1, 3), np.array(self._keys, dtype=int), key_poses
        )

    def corrected(self, key_poses: F64, calibration: OdometryCalibration | None = None) -> tuple[F64, F64]:
        """Poses in the map of all odometry messages (k, 3) and of all scans (m, 3).

        Each event lies between two keyscans, on the odometry seen from both; what they disagree in is shared out
        along the path: a wheel errs while it turns, not while it stands.
        """
        odometry = np.array(self._poses).reshape(-1, 3)
        is_scan = np.array(self._is_scan, dtype=bool)
        if len(self._keys) == 0:
            return odometry[~is_scan], odometry[is_scan]
        if calibration is not None:
            odometry = apply(calibration, self._index(), odometry)
        keys = np.array(self._keys, dtype=np.int64)
        before, after, fraction = self._between(odometry, keys)
        from_before = compose_poses(key_poses[before], relative_poses(odometry[keys[before]], odometry))
        from_after = compose_poses(key_poses[after], relative_poses(odometry[keys[after]], odometry))
        apart = from_after - from_before
        apart[:, 2] = wrap_angles(apart[:, 2])
        poses = from_before + fraction[:, None] * apart
        poses[:, 2] = wrap_angles(poses[:, 2])
        return poses[~is_scan], poses[is_scan]

    def covariances(self, key_covariances: F64) -> tuple[F64, F64]:
        """Covariances of all odometry messages (k, 3, 3) and of all scans (m, 3, 3), from those of the keyscans.

        Interpolated along the path, as if the errors of two keyscans were equal: never too small. NaN without keyscans.
        """
        is_scan = np.array(self._is_scan, dtype=bool)
        if len(self._keys) == 0:
            unknown = np.full((len(is_scan), 3, 3), np.nan)
            return unknown[~is_scan], unknown[is_scan]
        before, after, fraction = self._between(np.array(self._poses).reshape(-1, 3), np.array(self._keys))
        part = fraction[:, None, None]
        found = (1.0 - part) * key_covariances[before] + part * key_covariances[after]
        return found[~is_scan], found[is_scan]

    def _between(self, odometry: F64, keys: I64) -> tuple[I64, I64, F64]:
        """Of each event the keyscans before and after it, and the part of the path between them that was driven."""
        steps = relative_poses(odometry[:-1], odometry[1:])
        lengths = np.hypot(steps[:, 0], steps[:, 1]) + self._turn_length * np.abs(steps[:, 2])
        path_length = np.concatenate(([0.0], np.cumsum(lengths)))
        before = np.clip(np.searchsorted(keys, np.arange(len(odometry)), side="right") - 1, 0, len(keys) - 1)
        after = np.minimum(before + 1, len(keys) - 1)
        span = path_length[keys[after]] - path_length[keys[before]]
        fraction = np.clip((path_length - path_length[keys[before]]) / np.maximum(span, 1e-12), 0.0, 1.0)
        return before, after, fraction

    def _index(self) -> F64:
        """For each event the number of odometry messages before it, a scan between two messages being half-way."""
        poses, is_scan = np.array(self._poses).reshape(-1, 3), np.array(self._is_scan, dtype=bool)
        last = np.maximum.accumulate(np.where(is_scan, -1, np.arange(len(is_scan))))
        between = is_scan & (last >= 0) & (poses != poses[np.maximum(last, 0)]).any(axis=1)
        index: F64 = np.cumsum(~is_scan) + 0.5 * between
        return np.asarray(np.maximum.accumulate(index), dtype=np.float64)

    def odometry(self) -> F64:
        """Odometry messages of the log, shape (k, 3)."""
        poses: F64 = np.array(self._poses).reshape(-1, 3)[~np.array(self._is_scan, dtype=bool)]
        return poses
