"""Spans in which nothing was recorded: the recorder was stopped, and the robot may have been moved."""

from __future__ import annotations

_LONG_S = 10.0
"""Seconds [s] without a message from which on somebody may have pushed or carried the robot to another room. In five
real logs, of Intel, Freiburg, ACES, Seattle and Orebro, the longest is 5.7."""
_UNUSUAL = 20.0
"""And as a multiple of the mean time between messages before it."""


class RecordGaps:
    """State: the stamps of the first and the last message, and whether a gap was met since it was asked for."""

    def __init__(self) -> None:
        self._first_ns = 0
        self._last_ns = 0
        self._messages = 0
        self._met = False

    def add(self, stamp_ns: int) -> None:
        """Take the stamp of a message."""
        seconds = (stamp_ns - self._last_ns) * 1e-9
        if self._messages == 0:
            self._first_ns = stamp_ns
        elif seconds >= _LONG_S:
            mean = (self._last_ns - self._first_ns) * 1e-9 / max(self._messages - 1, 1)
            self._met |= seconds >= _UNUSUAL * mean
        self._last_ns = max(stamp_ns, self._last_ns)
        self._messages += 1

    def take(self) -> bool:
        """Whether a gap was met since this was asked last."""
        met, self._met = self._met, False
        return met
