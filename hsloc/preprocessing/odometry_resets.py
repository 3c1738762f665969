"""Odometry that begins anew in the middle of a log: a driver that was started again, a frame that was reset.

The robot did not move by it, so the new odometry goes on where the old one ended, for whoever estimates with it and in
the results. Odometry that jumps all the time has another fault, and is passed on as it is.
"""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

from hsloc.log import LEAST_JUMP, LONGEST_JUMP_S, MAX_SPEED
from hsloc.model.events import Odometry
from hsloc.model.pose2 import Pose2, wrap_angle
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from hsloc.model.events import Event

_LEAST_TURN, _MAX_TURN = 0.8, 10.0
"""A step is a jump as `hsloc check` tells it, or if it turns by more than this (rad), and faster than this (rad/s)."""
_MOST = 20
"""So many jumps are mended; after more of them the odometry is taken for broken."""


class ContinuousOdometry:
    """Events whose odometry goes on where it jumped. To be gone through once; then `warnings` gives what was found."""

    def __init__(self, events: Iterable[Event], topic: str | None = None) -> None:
        self._events = events
        self._topic = topic
        self._start_ns = 0
        self._first = (0.0, 0.0)
        self._jumps = 0

    def __iter__(self) -> Iterator[Event]:
        before: Odometry | None = None
        T_joined_odom: Pose2 | None = None
        for event in self._events:
            if not isinstance(event, Odometry):
                yield event
                continue
            if before is None:
                self._start_ns = event.stamp_ns
            elif self._has_jumped(before, event) and self._jumps <= _MOST:
                place = before.T_odom_base if T_joined_odom is None else T_joined_odom @ before.T_odom_base
                T_joined_odom = place @ event.T_odom_base.inverse()
            before = event
            yield (
                event
                if T_joined_odom is None
                else Odometry(event.stamp_ns, T_joined_odom @ event.T_odom_base, event.covariance)
            )

    def _has_jumped(self, before: Odometry, after: Odometry) -> bool:
        a, b = before.T_odom_base, after.T_odom_base
        way, turn = hypot(b.x - a.x, b.y - a.y), abs(b.theta - a.theta)
        if way <= LEAST_JUMP and turn <= _LEAST_TURN:
            return False
        seconds, turn = (after.stamp_ns - before.stamp_ns) / 1e9, abs(wrap_angle(turn))
        fast = way > max(MAX_SPEED * seconds, LEAST_JUMP) or turn > max(_MAX_TURN * seconds, _LEAST_TURN)
        if not (fast and 0.0 < seconds < LONGEST_JUMP_S):
            return False
        self._jumps += 1
        if self._jumps == 1:
            self._first = (way, (after.stamp_ns - self._start_ns) / 1e9)
        return True

    def warnings(self) -> tuple[RunWarning, ...]:
        """A warning if there were jumps."""
        if self._jumps == 0:
            return ()
        way, at = self._first
        corrected = self._jumps <= _MOST
        what = (
            "it is continued from the pose before each jump"
            if corrected
            else "too often to be corrected: poses may be wrong"
        )
        return (
            RunWarning(
                WarningCode.ODOMETRY_RESET if corrected else WarningCode.ODOMETRY_JUMPS,
                f"odometry ({self._topic}) jumps ({self._jumps} times, first by {way:.2f} m at {at:.3f} s); {what}",
                "check whether it was reset, or whether two publishers share the topic",
            ),
        )
