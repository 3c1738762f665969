"""The replay engine: events in, estimates out, in one repeatable order.

Pull-based: the next event is read when the estimator is done with the last, so that nothing is ever dropped and the
clock has no say. A scan is paired with the odometry at its own stamp: that of a message with just this stamp if there
is one, else interpolated between the messages before and after, for which the scan waits.
"""

from __future__ import annotations

import gc
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from hsloc.model.events import Odometry, PairedScan, Scan, Truth
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.preprocessing.scans import deskewed, merged_scans

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from hsloc.model.estimate import Estimate
    from hsloc.model.events import Event

_RECENT = 64
"""Odometry messages remembered for pairing; logs with jumping clocks need more than two."""
_WAITING = 64
"""Scans that may wait for odometry; then the last odometry must do."""


class Estimator(Protocol):
    """Localiser or mapper. Law: the same events and seed give the same estimates; the truth never reaches it."""

    def update(self, event: Odometry | PairedScan) -> Estimate:
        """Take the next event; the estimate at its stamp."""
        ...


def replay(
    events: Iterable[Event], estimator: Estimator, *, deskew: bool = False, first: Pose2 | None = None
) -> Iterator[tuple[Odometry | PairedScan | Truth, Estimate | None]]:
    """Each event with what the estimator says to it (None for the truth, which it does not see)."""
    for event in merged_scans(pair(events, deskew=deskew, first=first)):
        yield event, None if isinstance(event, Truth) else estimator.update(event)


def pair(
    events: Iterable[Event], *, deskew: bool = False, first: Pose2 | None = None
) -> Iterator[Odometry | PairedScan | Truth]:
    """Pair the scans with odometry, and deskew them if asked for; other events pass through in their order.

    `first` is the first odometry to come, where it is known: scans long before it are paired with it, else with the
    identity, as those of a log without any odometry are.
    """
    paired = _pair(events, IDENTITY if first is None else first)
    return deskewed(paired) if deskew else paired


def _pair(events: Iterable[Event], first: Pose2) -> Iterator[Odometry | PairedScan | Truth]:
    recent: deque[Odometry] = deque(maxlen=_RECENT)
    waiting: deque[Scan] = deque()
    for event in events:
        if isinstance(event, Truth):
            yield event
        elif isinstance(event, Scan):
            exact = _exact(recent, event.stamp_ns)
            if exact is not None and not waiting:
                yield PairedScan(event, exact)
                continue
            waiting.append(event)
            if len(waiting) > _WAITING:
                yield _paired(waiting.popleft(), recent, None, first)
        else:
            while waiting and _earliest(waiting) < event.stamp_ns:
                yield _paired(waiting.popleft(), recent, event, first)
            recent.append(event)
            yield event
            while waiting and _earliest(waiting) <= event.stamp_ns:
                yield _paired(waiting.popleft(), recent, None, first)
    while waiting:
        yield _paired(waiting.popleft(), recent, None, first)


def _earliest(waiting: deque[Scan]) -> int:
    """Scans keep their order: one with a stamp from the future may not hold up those behind it."""
    return min(scan.stamp_ns for scan in waiting)


def _paired(scan: Scan, recent: deque[Odometry], following: Odometry | None, first: Pose2) -> PairedScan:
    return PairedScan(scan, _at(scan.stamp_ns, recent, following, first))


def _exact(recent: deque[Odometry], stamp_ns: int) -> Pose2 | None:
    for odometry in reversed(recent):
        if odometry.stamp_ns == stamp_ns:
            return odometry.T_odom_base
    return None


def _at(stamp_ns: int, recent: deque[Odometry], following: Odometry | None, first: Pose2) -> Pose2:
    """The odometry at a stamp: exact, else between neighbours in the log that enclose it, else the last one told."""
    exact = _exact(recent, stamp_ns)
    if exact is not None:
        return exact
    after = following
    for before in reversed(recent):
        if after is not None and before.stamp_ns < stamp_ns <= after.stamp_ns:
            fraction = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
            return before.T_odom_base.interpolate(after.T_odom_base, fraction)
        after = before
    if recent and (following is None or following.stamp_ns >= stamp_ns):
        return recent[-1].T_odom_base
    return following.T_odom_base if following is not None else first


_COLLECT_AFTER = 50_000
"""New objects after which the garbage collector looks at the youngest; Python's own limit is 700."""


@contextmanager
def rarely_collected() -> Iterator[None]:
    """Let the garbage collector run rarely while a log streams by: events are many, and none is part of a cycle."""
    before = gc.get_threshold()
    if before[0] > 0:  # 0 is never, as somebody wants it.
        gc.set_threshold(max(before[0], _COLLECT_AFTER), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
