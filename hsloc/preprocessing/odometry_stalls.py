"""Odometry that stalls: a driver or a network hangs while the robot drives on, and then the odometry catches up.

Meanwhile the same pose is repeated, and then it jumps to where it would have been; or the messages are late, and come
at once with the stamps of then. Passed on, that says that the robot stood and jumped, which looks as if the odometry
had been reset. Messages that are only missing need nothing: between the others is interpolated.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from math import hypot
from statistics import median
from typing import TYPE_CHECKING

from hsloc.log import MAX_SPEED
from hsloc.model.events import Odometry, Scan
from hsloc.model.pose2 import wrap_angle
from hsloc.preprocessing.interpolation import Interpolations
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from hsloc.model.events import Event
    from hsloc.model.pose2 import Pose2

_STALL_S, _LONGEST_S = 0.2, 10.0
"""Shortest stall (s): a base that counts more slowly than it publishes repeats poses, too; and longest: before that
`OdometryWatch` finds the odometry frozen, but where walls are too far away for the scans to change."""
_SAME = 1e-6
"""Poses that differ by no more than this (m, rad) are the same one again; a sensor at rest has more noise."""
_STALL_M, _STALL_RAD = 0.1, 0.1
"""Smallest jump (m, rad) after a stall: less moves no map ..."""
_HARDEST, _HARDEST_TURN = 10.0, 30.0
"""... and more than a robot does with these accelerations (m/s^2, rad/s^2), the first that of tyres that just hold."""
_USUAL, _USUAL_TURN = 2.5, 5.0
"""Accelerations (m/s^2, rad/s^2) of ordinary robots, with which the motion over the whole stall must be possible. Of
the 193 times that odometry of real logs was at rest for `_STALL_S` or longer none ends with a fifth of a jump."""
_MOVES_M_S, _MOVES_RAD_S, _FASTEST_RAD_S = 0.05, 0.05, 10.0
"""Speeds (m/s, rad/s) from which on a robot moves, as odometry is reset while it stands; and fastest turn."""
_BURST = 0.5
"""Messages that follow each other within this part of their usual interval come at once."""
_FEWEST_SCANS = 2
"""Scans during a stall that are on time. Where there are none, all that is recorded is late, as on Intel's log."""
_INTERVALS = 9
"""Intervals that say what is usual."""
_MOST_HELD = 5000
"""Events that are held back, at most: of a base at 200 Hz and several lidars in 10 s there are fewer."""


class UnstalledOdometry:
    """Events whose odometry moves on while it stalls. To be gone through once; then `warnings` gives what was found.

    A pose that is repeated is no measurement: it is replaced by one between the poses before and after. Events are held
    back while the odometry stands still, for at most `_LONGEST_S`; they keep their order. A robot that is at rest makes
    no jump, and odometry that is reset is at zero then.
    """

    def __init__(self, events: Iterable[Event], topic: str | None = None) -> None:
        self._late = _LateOdometry(events)
        self._topic = topic
        self._interpolations = Interpolations()
        self._start_ns = 0
        self._found: list[tuple[int, int]] = []
        self._last: Odometry | None = None
        """The first message of those that are the same."""
        self._repeated: Odometry | None = None
        """The last one of them, while they are held back."""
        self._before: Odometry | None = None
        """The one that moved on before that."""
        self._held: list[Event] = []
        self._jump: Odometry | None = None
        """The message after them, while it is not known whether the robot moves after it."""
        self._is_at_rest = False
        """Whether the same pose lasts for longer than a stall."""

    def __iter__(self) -> Iterator[Event]:
        for event in self._late:
            if isinstance(event, Odometry):
                yield from self._take(event)
            elif self._held:
                self._held.append(event)
                if self._is_long(event.stamp_ns):
                    yield from self._released()
            else:
                yield event
        yield from self._held

    def _take(self, event: Odometry) -> Iterator[Event]:
        """The events that can be passed on, now that this one came."""
        if self._jump is not None:
            jump = self._jump
            yield from self._filled(jump) if _moves(_speeds(jump, event)) else self._held
            self._follow(jump)
        last, repeated = self._last, self._repeated
        if last is not None and _is_same(last.T_odom_base, event.T_odom_base):
            if self._is_at_rest:
                yield event
                return
            self._repeated = event
            self._held.append(event)
            if self._is_long(event.stamp_ns):
                yield from self._released()
            return
        if last is not None and repeated is not None and self._is_stall(last, repeated, event):
            self._held.append(event)
            if not _moves(self._speeds):  # Was it set elsewhere while the robot stands? The next message shows that.
                self._jump = event
                return
            yield from self._filled(event)
        else:
            yield from self._held
            yield event
        self._follow(event)

    def _follow(self, event: Odometry) -> None:
        """A message that moved on, and was passed on."""
        if self._last is None:
            self._start_ns = event.stamp_ns
        else:
            self._before = self._last
        self._interpolations.follow(event)
        self._last, self._held, self._repeated, self._jump, self._is_at_rest = event, [], None, None, False

    @property
    def _speeds(self) -> tuple[float, float]:
        """Those with which the odometry came to the last message that moved on (m/s, rad/s); only stalls need them."""
        return _speeds(self._before, self._last)

    def _is_stall(self, last: Odometry, repeated: Odometry, event: Odometry) -> bool:
        """Whether the odometry jumps to `event` by what a robot drives since `last`, and not since `repeated`."""
        if (
            repeated.stamp_ns - last.stamp_ns < _STALL_S * 1e9
            or hypot(event.T_odom_base.x, event.T_odom_base.y) < _STALL_M
        ):
            return False
        return _is_impossible(repeated, event, (0.0, 0.0)) and _is_possible(last, event, self._speeds)

    def _is_long(self, stamp_ns: int) -> bool:
        """Whether what is held back is more than a stall."""
        since_ns = stamp_ns if self._last is None else self._last.stamp_ns
        return stamp_ns - since_ns > _LONGEST_S * 1e9 or len(self._held) > _MOST_HELD

    def _released(self) -> list[Event]:
        """All that was held back, as it is; nothing more is until the odometry moves."""
        held = self._held
        if self._jump is not None:
            self._follow(self._jump)
        self._held, self._repeated, self._is_at_rest = [], None, True
        return held

    def _filled(self, after: Odometry) -> Iterator[Event]:
        """What was held back, with odometry on the way to the message after the stall."""
        last = self._last or after
        whole_ns = after.stamp_ns - last.stamp_ns
        self._found.append((last.stamp_ns, whole_ns))
        interpolation = self._interpolations.between(last, after)
        for event in self._held:
            if isinstance(event, Odometry) and event is not after:
                part = min(max((event.stamp_ns - last.stamp_ns) / whole_ns, 0.0), 1.0)
                pose = last.T_odom_base.interpolate(after.T_odom_base, part)
                event = replace(event, T_odom_base=pose, interpolation=interpolation)
            yield event

    def warnings(self) -> tuple[RunWarning, ...]:
        """A warning if there were stalls."""
        found = sorted((*self._found, *self._late.found))
        if not found:
            return ()
        at_ns, longest_ns = max(found, key=lambda stall: stall[1])
        return (
            RunWarning(
                WarningCode.ODOMETRY_STALLS,
                f"odometry ({self._topic}) stalls while the robot drives on, and then catches up ({len(found)} times, "
                f"the longest for {longest_ns / 1e9:.2f} s at {(at_ns - self._start_ns) / 1e9:.3f} s): poses between "
                "are interpolated",
                "look for a driver or a network that hangs",
            ),
        )


class _LateOdometry:
    """Events whose odometry is spread over the time before it, where late messages came at once and were stamped then.

    `found` are stamp and duration (ns) of the stalls.
    """

    def __init__(self, events: Iterable[Event]) -> None:
        self.found: list[tuple[int, int]] = []
        self._events = events
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)
        self._latest: Odometry | None = None
        self._step: tuple[Odometry | None, Odometry | None] = None, None
        """The last two messages that came in time."""
        self._scans = 0
        self._before: Odometry | None = None
        """The last message before the gap, while what comes after it is held back."""
        self._held: list[Event] = []

    def __iter__(self) -> Iterator[Event]:
        for event in self._events:
            if isinstance(event, Odometry):
                yield from self._take(event)
            elif self._latest is not None and self._held:
                self._held.append(event)
                if event.stamp_ns - self._latest.stamp_ns > _LONGEST_S * 1e9 or len(self._held) > _MOST_HELD:
                    yield from self._released()
            else:
                self._scans += isinstance(event, Scan)
                yield event
        yield from self._released()

    def _take(self, event: Odometry) -> Iterator[Event]:
        """The events that can be passed on, now that this one came."""
        latest, self._latest = self._latest, event
        if latest is not None:
            interval = event.stamp_ns - latest.stamp_ns
            if self._held and 0 <= interval < _BURST * median(self._intervals) and len(self._held) < _MOST_HELD:
                self._held.append(event)
                return
            yield from self._released()
            scans, self._scans = self._scans, 0
            is_gap = interval > _STALL_S * 1e9 and scans >= _FEWEST_SCANS and len(self._intervals) == _INTERVALS
            if is_gap and interval > median(self._intervals) / _BURST:
                self._before = latest
                self._held.append(event)
                return
            self._intervals.append(interval)
            self._step = latest, event
        yield event

    def _released(self) -> list[Event]:
        """What was held back, with other stamps if it came too fast for a robot."""
        held, self._held, before = self._held, [], self._before
        burst = [event for event in held if isinstance(event, Odometry)]
        if before is None or len(burst) < 2:
            return held
        first, last = burst[0], burst[-1]
        speeds = _speeds(*self._step)
        if not (_is_impossible(first, last, speeds) and _is_possible(before, last, speeds)):
            return held
        whole_ns = last.stamp_ns - before.stamp_ns
        self.found.append((before.stamp_ns, whole_ns))
        stamps = iter(before.stamp_ns + whole_ns * k // len(burst) for k in range(1, len(burst) + 1))
        return [replace(event, stamp_ns=next(stamps)) if isinstance(event, Odometry) else event for event in held]


def _is_same(a: Pose2, b: Pose2) -> bool:
    return abs(a.x - b.x) <= _SAME and abs(a.y - b.y) <= _SAME and abs(a.theta - b.theta) <= _SAME


def _step(before: Odometry, after: Odometry) -> tuple[float, float, float]:
    """Way (m), turn (rad) and time (s) from message to message."""
    a, b = before.T_odom_base, after.T_odom_base
    return hypot(b.x - a.x, b.y - a.y), abs(wrap_angle(b.theta - a.theta)), (after.stamp_ns - before.stamp_ns) / 1e9


def _speeds(before: Odometry | None, after: Odometry | None) -> tuple[float, float]:
    """In m/s and rad/s; 0 where no time passed, and where there is no message."""
    if before is None or after is None:
        return 0.0, 0.0
    way, turn, seconds = _step(before, after)
    return (way / seconds, turn / seconds) if seconds > 0.0 else (0.0, 0.0)


def _moves(speeds: tuple[float, float]) -> bool:
    return _are_possible(speeds) and (speeds[0] > _MOVES_M_S or speeds[1] > _MOVES_RAD_S)


def _are_possible(speeds: tuple[float, float]) -> bool:
    """Whether robots move so fast; what comes in millimetres does not."""
    return speeds[0] <= MAX_SPEED and speeds[1] <= _FASTEST_RAD_S


def _is_impossible(before: Odometry, after: Odometry, speeds: tuple[float, float]) -> bool:
    """Whether no robot with these speeds (m/s, rad/s) moves from message to message."""
    way, turn, seconds = _step(before, after)
    longest, widest = _reached(seconds, speeds, (_HARDEST, _HARDEST_TURN))
    return seconds >= 0.0 and (way > max(_STALL_M, longest) or turn > max(_STALL_RAD, widest))


def _is_possible(before: Odometry, after: Odometry, speeds: tuple[float, float]) -> bool:
    """Whether ordinary robots with these speeds (m/s, rad/s) move from message to message."""
    way, turn, seconds = _step(before, after)
    longest, widest = _reached(seconds, speeds, (_USUAL, _USUAL_TURN))
    return _are_possible(speeds) and way <= longest and turn <= widest


def _reached(seconds: float, speeds: tuple[float, float], accelerations: tuple[float, float]) -> tuple[float, float]:
    """Way (m) and turn (rad) in a time at most."""
    (speed, rate), (acceleration, of_turn) = speeds, accelerations
    return (speed + 0.5 * acceleration * seconds) * seconds, (rate + 0.5 * of_turn * seconds) * seconds
