"""Deskewing: a lidar that turns while the robot drives measures each beam from another place.

Beam i was measured at `stamp + i * time_increment`; odometry gives the pose of the base at that time. The scan waits
for the odometry of its last beam.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.events import Odometry, PairedScan
from hsloc.model.pose2 import relative_poses
from hsloc.model.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from hsloc.model.events import Scan, Truth

    Paired = Odometry | PairedScan | Truth

_RECENT = 512
"""Odometry messages that are kept. Internal: a fifth of a second at 2.5 kHz, longer than a sweep."""
_WAITING = 16
"""Maximum number of scans that wait for odometry; then the odometry until now is used. Internal: bounds the memory."""
_LONGEST_NS = 2_000_000_000
"""Maximum duration of a sweep. Internal: no lidar turns more slowly, a longer one is an error of the log."""


def deskewed(events: Iterable[Paired]) -> Iterator[Paired]:
    """Events as `hsloc.replay.engine.pair` gives them, each scan with where the base was at each of its beams.

    A scan comes behind the odometry of its last beam; scans keep their order. Without `time_increment` (or with one
    that makes a turn of over two seconds) a scan stays as it is.
    """
    recent: deque[Odometry] = deque(maxlen=_RECENT)
    waiting: deque[PairedScan] = deque()
    for event in events:
        if isinstance(event, PairedScan):
            waiting.append(event)
        else:
            yield event
            if isinstance(event, Odometry):
                recent.append(event)
        while waiting and (len(waiting) > _WAITING or (recent and _is_covered(waiting[0].scan, recent[-1]))):
            yield _moved(waiting.popleft(), recent)
    while waiting:
        yield _moved(waiting.popleft(), recent)


def _sweep_ns(scan: Scan) -> int:
    """Time from the first beam to the last; negative where the last one was first."""
    sweep = (len(scan.ranges) - 1) * scan.time_increment * 1e9
    return round(sweep) if abs(sweep) <= _LONGEST_NS else 0


def _is_covered(scan: Scan, latest: Odometry) -> bool:
    sweep = _sweep_ns(scan)
    return sweep <= 0 or latest.stamp_ns >= scan.stamp_ns + sweep


def _moved(paired: PairedScan, recent: Iterable[Odometry]) -> PairedScan:
    scan = paired.scan
    sweep = _sweep_ns(scan)
    if sweep == 0 or len(scan.ranges) == 0:
        return paired
    first, last = scan.stamp_ns + min(sweep, 0) - _LONGEST_NS, scan.stamp_ns + max(sweep, 0) + _LONGEST_NS
    poses_then = [(o.stamp_ns, o.T_odom_base) for o in recent if first <= o.stamp_ns <= last]
    track = Trajectory.from_pairs([*poses_then, (scan.stamp_ns, paired.T_odom_base)])
    beams = np.arange(len(scan.ranges), dtype=np.float64)
    stamps = scan.stamp_ns + np.round(beams * (scan.time_increment * 1e9)).astype(np.int64)
    poses = track.interpolated(stamps)
    base = np.broadcast_to(paired.T_odom_base.to_array(), poses.shape)
    return replace(paired, scan=replace(scan, T_base_beam=relative_poses(base, poses)))
