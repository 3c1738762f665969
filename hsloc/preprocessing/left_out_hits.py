"""Hits that show nothing of the surroundings: those of rain, dust or a bad receiver."""

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

    from hsloc.model.events import Event

_MOST_ISOLATED = 0.05
"""Part of the hits of a scan, and of half of those before it, from which on isolated ones are left out: more than thin
things are. Of five real logs the median is 1 to 3 %, and 8 to 9 % where a tenth of the ranges is shortened."""
_RECENT_SCANS, _LEAST_SCANS = 1001, 10
"""Scans of a laser, at most and at least, of which half must have as many. Rain and bad receivers last for minutes; a
robot that waits among thin things has half a minute of them, and needs these to know where it is."""


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
