"""What makes a finished run doubtful as a whole: scans that found no place."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hsloc.replay.run import Result

_MOST = 0.5
"""Of the scans; where more than this part found no place, what the others say is not to be taken on trust."""


def doubts(result: Result) -> list[str]:
    """A line for each doubt, with what to do about it."""
    return _unplaced(result)


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
