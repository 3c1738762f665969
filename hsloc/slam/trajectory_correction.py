"""The events of a log, and the poses of all of them once the keyscans' poses are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.model.pose2 import Pose2, compose_poses, pose_differences, relative_poses, wrap_angles
from hsloc.slam.calibration import OdometryCalibration, apply, calibrate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.known_map import Anchor

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_NOISE_M, _NOISE_SHARE, _LARGEST_NOISE = 0.005, 0.1, 4.0
"""Standard deviation of what the odometry says of a motion: half a centimetre of the keyscans, and a tenth of its way,
as is assumed of odometry; and the multiple of it that noise does not reach."""
_STILL_M = 1e-9
"""Motion (m) that an event counts for in which the odometry counts none: there a push is shared out evenly."""
_FEWEST_STANDING, _SAME = 5, 1e-6
"""Events between two keyscans in which the odometry counts no way (m), for a push: a few messages may be repeated."""
_UNCOUNTED_M = 1e3
"""What each scan counts for before the odometry begins and after it ends: what it disagrees in happened there."""


class EventLog:
    """Odometry of all messages and scans in the order of the log.

    Some scans are keyscans, and some are anchored: their poses are known relative to a keyscan.
    """

    def __init__(self, turn_length: float) -> None:
        self._turn_length = turn_length
        self._poses: list[tuple[float, float, float]] = []
        self._is_scan: list[bool] = []
        self._keys: list[int] = []
        self._anchored: list[int] = []
        self._anchors: list[Anchor] = []

    def add(self, T_odom_base: Pose2, is_scan: bool, is_key: bool = False) -> None:
        """The next event."""
        if is_key:
            self._keys.append(len(self._poses))
        self._poses.append((T_odom_base.x, T_odom_base.y, T_odom_base.theta))
        self._is_scan.append(is_scan)

    def anchor(self, anchor: Anchor) -> None:
        """Anchor the last event, a scan that is not a keyscan."""
        self._anchored.append(len(self._poses) - 1)
        self._anchors.append(anchor)

    def make_key(self, event: int) -> None:
        """Make a scan of before, the event of that number, a keyscan; keyscans must come in order."""
        self._keys.append(event)

    def __len__(self) -> int:
        """How many events there were."""
        return len(self._poses)

    def key_odometry(self) -> F64:
        """Odometry of the keyscans, shape (n, 3)."""
        return np.array([self._poses[k] for k in self._keys]).reshape(-1, 3)

    @property
    def anchored(self) -> int:
        """How many scans were anchored."""
        return len(self._anchored)

    def calibrated(self, key_poses: F64) -> OdometryCalibration:
        """Calibration of the odometry by the final poses of the keyscans."""
        odometry = np.array(self._poses).reshape(-1, 3)
        return calibrate(self._index(), odometry, self._known(), self._known_poses(key_poses))

    def corrected(self, key_poses: F64, calibration: OdometryCalibration | None = None) -> tuple[F64, F64]:
        """Poses in the map of all odometry messages (k, 3) and of all scans (m, 3).

        Each event lies between two keyscans or anchored scans, on the odometry seen from both; what they disagree in is
        shared out along the path: a wheel errs while it turns, not while it stands.
        """
        is_scan = np.array(self._is_scan, dtype=bool)
        if len(self._keys) == 0:
            odometry = np.array(self._poses).reshape(-1, 3)
            return odometry[~is_scan], odometry[is_scan]
        from_before, apart, *_, fraction = self._seen_from_both(key_poses, calibration)
        poses = from_before + fraction[:, None] * apart
        poses[:, 2] = wrap_angles(poses[:, 2])
        return poses[~is_scan], poses[is_scan]

    def covariances(
        self, key_poses: F64, key_covariances: F64, calibration: OdometryCalibration | None = None
    ) -> tuple[F64, F64]:
        """Covariances of all odometry messages (k, 3, 3) and of all scans (m, 3, 3), from those of the keyscans.

        Interpolated along the path, as if the errors of two keyscans were equal, with what the odometry seen from both
        disagrees in: as the middle of a random walk whose ends are known, or, where it is more than noise, as a slip at
        any time between the two. NaN without keyscans.
        """
        is_scan = np.array(self._is_scan, dtype=bool)
        if len(self._keys) == 0:
            unknown = np.full((len(is_scan), 3, 3), np.nan)
            return unknown[~is_scan], unknown[is_scan]
        known = self._known_covariances(key_poses, key_covariances)
        _, apart, before, after, span, fraction = self._seen_from_both(key_poses, calibration)
        part = fraction[:, None, None]
        found = (1.0 - part) * known[before] + part * known[after]
        walk = fraction * (1.0 - fraction)
        slips = np.hypot(apart[:, 0], apart[:, 1]) + self._turn_length * np.abs(apart[:, 2]) > _noise_limit(span)
        weight = np.where(slips, 1.0 / 3.0 - walk, walk)
        weight[self._known()] = 0.0
        found += (weight[:, None] * apart)[:, :, None] * apart[:, None, :]
        return found[~is_scan], found[is_scan]

    def _seen_from_both(
        self, key_poses: F64, calibration: OdometryCalibration | None
    ) -> tuple[F64, F64, I64, I64, F64, F64]:
        """Each event on the odometry seen from the known event before it, and how far from there it is by that after.

        Both are (n, 3). Then the numbers of these two, the length of the path between them and the part of it (n,).
        """
        odometry = np.array(self._poses).reshape(-1, 3)
        if calibration is not None:
            odometry = apply(calibration, self._index(), odometry)
        keys, key_poses = self._known(), self._known_poses(key_poses)
        steps = relative_poses(odometry[:-1], odometry[1:])
        before, after, span, fraction = self._between(steps, keys)
        moved = relative_poses(key_poses[before], key_poses[after])
        counted = relative_poses(odometry[keys[before]], odometry[keys[after]])
        more = np.hypot(moved[:, 0], moved[:, 1]) - np.hypot(counted[:, 0], counted[:, 1])
        pushed, part = _standing(steps, keys[before], keys[after])
        fraction = np.where(pushed & (more > _noise_limit(span)), part, fraction)
        from_before = compose_poses(key_poses[before], relative_poses(odometry[keys[before]], odometry))
        from_after = compose_poses(key_poses[after], relative_poses(odometry[keys[after]], odometry))
        return from_before, pose_differences(from_after, from_before), before, after, span, fraction

    def _known(self) -> I64:
        """Events (n,) whose poses are known: keyscans and anchored scans, in the order of the log."""
        return np.sort(np.array([*self._keys, *self._anchored], dtype=np.int64))

    def _known_poses(self, key_poses: F64) -> F64:
        """Poses (n, 3) of what `_known` lists."""
        rows = [anchor.keyscan for anchor in self._anchors]
        seen_from = np.array([anchor.T_key_scan.to_array() for anchor in self._anchors]).reshape(-1, 3)
        return self._in_order(key_poses, compose_poses(key_poses[rows], seen_from))

    def _known_covariances(self, key_poses: F64, key_covariances: F64) -> F64:
        """Covariances (n, 3, 3) of what `_known` lists: an anchored scan's is propagated from its keyscan's."""
        anchored = [
            predict_covariance(
                key_covariances[anchor.keyscan],
                Pose2.from_array(key_poses[anchor.keyscan]),
                anchor.T_key_scan,
                anchor.covariance,
            )
            for anchor in self._anchors
        ]
        return self._in_order(key_covariances, np.array(anchored).reshape(-1, 3, 3))

    def _in_order(self, of_keys: F64, of_anchored: F64) -> F64:
        """Values of the keyscans and of the anchored scans in the order of the log."""
        values: F64 = np.concatenate((of_keys, of_anchored))[np.argsort([*self._keys, *self._anchored], kind="stable")]
        return values

    def _between(self, steps: F64, keys: I64) -> tuple[I64, I64, F64, F64]:
        """Of each event the keyscans before and after it, the path between them, and the part of it that was driven."""
        lengths = _STILL_M + np.hypot(steps[:, 0], steps[:, 1]) + self._turn_length * np.abs(steps[:, 2])
        counted = np.flatnonzero(~np.array(self._is_scan, dtype=bool))
        if len(counted):
            # The last scan before the first message and the first after the last one are taken at these.
            lengths[: max(counted[0] - 1, 0)] = lengths[counted[-1] + 1 :] = _UNCOUNTED_M
        path_length = np.concatenate(([0.0], np.cumsum(lengths)))
        before = np.clip(np.searchsorted(keys, np.arange(len(path_length)), side="right") - 1, 0, len(keys) - 1)
        after = np.minimum(before + 1, len(keys) - 1)
        span = path_length[keys[after]] - path_length[keys[before]]
        fraction = np.clip((path_length - path_length[keys[before]]) / np.maximum(span, 1e-12), 0.0, 1.0)
        return before, after, span, fraction

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


def _noise_limit(span: F64) -> F64:
    """What two keyscans disagree in (m) with the odometry between them, at most, if that is noise; `span` (m)."""
    return np.asarray(_LARGEST_NOISE * (_NOISE_M + _NOISE_SHARE * span))


def _standing(steps: F64, first: I64, last: I64) -> tuple[NDArray[np.bool_], F64]:
    """Whether the odometry counted no way for a while between two events (n,), and which part of that was over.

    A robot that moved farther than is counted was pushed then; one that moved less slipped while it was counted.
    """
    stood = np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]) < _SAME)))
    before, after = stood[first], stood[last]
    part = np.clip((stood - before) / np.maximum(after - before, 1.0), 0.0, 1.0)
    return after - before >= _FEWEST_STANDING, part
