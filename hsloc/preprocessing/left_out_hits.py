"""Hits that show nothing of the surroundings: those of the robot's own body, of rain, dust or a bad receiver."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.surfels import drop_isolated
from hsloc.model.events import Scan

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.model.events import Event

_MOST_ISOLATED = 0.05
"""Part of the hits of a scan, and of half of those before it, from which on isolated ones are left out: more than thin
things are. Of five real logs the median is 1 to 3 %, and 8 to 9 % where a tenth of the ranges is shortened."""
_RECENT_SCANS, _LEAST_SCANS = 1001, 10
"""Scans of a laser, at most and at least, of which half must have as many. Rain and bad receivers last for minutes; a
robot that waits among thin things has half a minute of them, and needs these to know where it is."""
_BODY_M = 0.5
"""Range (m) up to which the robot may see itself: its own posts and covers, seen from a lidar at its edge. Assumed."""
_SAME_M = 0.03
"""Change (m) of a range up to which it is the same: three times the noise of low-cost lidars at such ranges."""
_MOST_BODY = 0.6
"""Part of the hits that may be those of the body. With more of them the robot may stand between walls, or in a dock."""


def without_body(events: Iterable[Event]) -> Iterator[Event]:
    """The events; hits of a laser nearer than half a metre are left out as long as they are as in its first scan.

    Walls that near do not stay for long as the robot moves, its body does; a scan that ends at it fits best beside
    a wall. Until the robot moves a near wall is left out, too: the others show where it is.
    """
    bodies: dict[str, NDArray[np.float32]] = {}
    for event in events:
        if isinstance(event, Scan):
            ranges, first = event.ranges, bodies.get(event.frame_id)
            if first is None or len(first) != len(ranges):
                bodies[event.frame_id] = first = np.where(event.hits() & (ranges < _BODY_M), ranges, np.float32(np.nan))
            if np.isfinite(first).any():
                with np.errstate(invalid="ignore"):
                    off = np.abs(ranges - first)
                    first[np.isfinite(off) & (off > _SAME_M)] = np.nan
                    body = off <= _SAME_M
                if 0 < body.sum() <= _MOST_BODY * event.hits().sum():
                    yield replace(event, ranges=np.where(body, np.float32(np.nan), ranges))
                    continue
        yield event


def without_isolated(events: Iterable[Event]) -> Iterator[Event]:
    """The events; where many hits of a laser are isolated, scan after scan, without these: rain, dust, a bad receiver.

    They lie in free space, and make places look unlike themselves. Few are thin things, as legs of a chair, and stay.
    """
    recent: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_RECENT_SCANS))
    for event in events:
        if isinstance(event, Scan):
            kept = np.empty(len(event.ranges), dtype=np.float32)
            limits = np.array((event.range_min, event.range_max)).astype(np.float32)
            hits, isolated = drop_isolated(event.ranges, limits, abs(event.angle_increment), kept)
            shares = recent[event.frame_id]
            shares.append(isolated / max(hits, 1))
            if len(shares) >= _LEAST_SCANS and shares[-1] > _MOST_ISOLATED and median(shares) > _MOST_ISOLATED:
                yield replace(event, ranges=kept)
                continue
        yield event
