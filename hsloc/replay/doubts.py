"""What makes a finished run doubtful as a whole: scans that found no place, and odometry that jumps."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from hsloc.log.check_topics import MAX_SPEED

if TYPE_CHECKING:
    from hsloc.model.trajectory import Trajectory
    from hsloc.replay.run import Result

_MOST = 0.5
"""Of the scans; where more than this part found no place, what the others say is not to be taken on trust."""
_LEAST_JUMP, _LONGEST_S = 0.5, 1.0
"""A step of odometry is a jump as `hsloc check` tells it: farther than this (m), within this time (s), and too fast."""


def doubts(result: Result) -> list[str]:
    """A line for each doubt, with what to do about it."""
    return [*_unplaced(result), *_jumps(result.odometry, result.summary.odom_topic)]


def _unplaced(result: Result) -> list[str]:
    """On a given map: most scans were refused or left the pose open. A pose found once may then be a chance fit."""
    if result.mode != "localise":
        return []
    status = Counter(result.diagnostics.status)
    without, scans = status["searching"] + status["rejected"], len(result.diagnostics)
    if without <= _MOST * scans:
        return []
    share = 100.0 * float(result.localised.mean()) if len(result.localised) else 0.0
    told = "every pose is a guess" if share == 0.0 else f"the {share:.0f} % of the poses told as localised may be wrong"
    line = (
        f"{without} of {scans} scans found no place on the map, so {told}: check map, mounting (--laser-pose) and "
        "odometry (hsloc check), or give the start (--initial-pose)"
    )
    return [line]


def _jumps(odometry: Trajectory, topic: str | None) -> list[str]:
    """Odometry that was reset while the log ran: at the jump, and where no scan mends it, poses are wrong."""
    seconds = np.diff(odometry.stamps_ns) / 1e9
    way = np.hypot(*np.diff(odometry.poses[:, :2], axis=0).T)
    jumps = (seconds > 0.0) & (seconds < _LONGEST_S) & (way > np.maximum(MAX_SPEED * seconds, _LEAST_JUMP))
    if not jumps.any():
        return []
    first = int(np.argmax(jumps))
    at = (int(odometry.stamps_ns[first + 1]) - int(odometry.stamps_ns[0])) / 1e9
    line = (
        f"odometry ({topic}) jumps ({int(jumps.sum())} times, first by {way[first]:.2f} m at {at:.3f} s): poses there "
        "may be wrong; was it reset, or do two publishers share the topic?"
    )
    return [line]
