"""Spans in which nothing was recorded: the recorder was stopped, and the robot may have been moved."""

from __future__ import annotations

_LONG_S = 10.0
"""Seconds [s] without a message from which on somebody may have pushed or carried the robot to another room. In five
real logs, of Intel, Freiburg, ACES, Seattle and Orebro, the longest is 5.7."""
_UNUSUAL = 20.0
"""And as a multiple of the mean time between messages before it."""


class RecordGaps:
    """State: the stamps of the first and the last message, and the longest gap since it was asked for."""

    def __init__(self) -> None:
        self._first_ns = 0
        self._last_ns = 0
        self._messages = 0
        self._longest_s = 0.0

    def add(self, stamp_ns: int) -> None:
        """Take the stamp of a message."""
        seconds = (stamp_ns - self._last_ns) * 1e-9
        if self._messages == 0:
            self._first_ns = stamp_ns
        elif seconds >= _LONG_S:
            mean = (self._last_ns - self._first_ns) * 1e-9 / max(self._messages - 1, 1)
            if seconds >= _UNUSUAL * mean:
                self._longest_s = max(seconds, self._longest_s)
        self._last_ns = max(stamp_ns, self._last_ns)
        self._messages += 1

    def take(self) -> float:
        """Seconds of the longest gap since this was asked last; 0 if there was none."""
        longest, self._longest_s = self._longest_s, 0.0
        return longest
