"""Events in a total, repeatable order of time, with a bounded memory.

Logs are written in the order of arrival; estimators want the order of measurement, the header stamps'. Both can
be wrong: stamps of real logs run backwards, jump, or are missing. So each topic has an *effective* stamp that never
runs backwards within the topic (the order of the log is right there), and events are ordered by

    (effective stamp, raised or not, odometry < scan < truth, order of the log)

where *raised* are those whose own stamp had run backwards: they keep their order among each other.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import repeat
from operator import sub
from typing import TYPE_CHECKING, NamedTuple

from hsloc.log.container import AGREEING, STEP_NS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from hsloc.log.summary import Losses
    from hsloc.model import Event

KIND_ODOMETRY, KIND_SCAN, KIND_TRUTH = 0, 1, 2

WINDOW_NS = 2_000_000_000
"""Maximum time (of the log) that an event waits for earlier ones of other topics. Internal: bounds the memory; longer
delays are reported by `hsloc check`."""
JUMP_NS = 10_000_000_000
"""A stamp further than this from the topic's last one (beyond what the log time advanced) is not trusted, unless
the next one agrees with it."""
MAX_PENDING = 20_000
"""Maximum number of events that wait. Internal: bounds the memory."""
_LEAST_KNOWN_NS = 1_000_000_000
"""Least time (of the log) over which messages must have come with a delay for it to be the usual one: a recorder that
has just started may get what was kept for it."""


class StepDetector:
    """Whether the clock of a topic's stamps was set while the recorder's went on.

    A step back is a stamp earlier than the one before, by a delay that grew as much. A step forward is a delay shorter
    than any before: messages may come late, but not early. Either counts once `AGREEING` messages show it.
    """

    __slots__ = ("_candidate", "_last", "_least_ns", "_since_ns")

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None
        self._least_ns = 0
        self._since_ns = 0
        self._candidate: tuple[int, int, int, int] | None = None

    def take(self, stamp_ns: int, log_time_ns: int) -> tuple[int, int] | None:
        """(step in ns, log time of the first message after it) where this message confirms one."""
        last, self._last = self._last, (stamp_ns, log_time_ns)
        delay = log_time_ns - stamp_ns
        if last is None:
            self._least_ns, self._since_ns = delay, log_time_ns
            return None
        before = last[1] - last[0]
        if self._candidate is not None:
            usual, step, at, left = self._candidate
            self._candidate = None
            if abs(delay - (usual - step)) < abs(delay - usual):
                if left:
                    self._candidate = usual, step, at, left - 1
                    return None
                self._least_ns, self._since_ns = delay, at
                return step, at
        step = before - delay
        back = step < -STEP_NS and stamp_ns < last[0] - STEP_NS
        forward = step > STEP_NS and delay < self._least_ns - STEP_NS
        if back or (forward and log_time_ns > last[1] > self._since_ns + _LEAST_KNOWN_NS):
            self._candidate = before, step, log_time_ns, AGREEING - 2
        else:
            self._least_ns = min(self._least_ns, delay)
        return None

    @property
    def has_candidate(self) -> bool:
        """Whether the next messages decide about a step."""
        return self._candidate is not None

    def run_on(self, stamps: Sequence[int], log_times: Sequence[int]) -> None:
        """Take messages at once whose stamps rise by less than `STEP_NS` from each to the next."""
        if self._last is None:
            self._least_ns, self._since_ns = log_times[0] - stamps[0], log_times[0]
        self._least_ns = min(self._least_ns, *map(sub, log_times, stamps))
        self._last = stamps[-1], log_times[-1]


class TopicClock:
    """Effective stamps of one topic.

    `shares_log_clock` says whether header stamps and log times are of one clock, so that a missing stamp can be
    replaced. `offset_ns` is added to every stamp; with `by_log` the log's time is taken in place of each stamp.
    """

    __slots__ = (
        "_last_log_ns",
        "_last_own_ns",
        "_losses",
        "_steps",
        "_suspect",
        "by_log",
        "kind",
        "last_ns",
        "offset_ns",
        "shares_log_clock",
        "topic",
    )

    def __init__(
        self,
        topic: str,
        kind: int,
        losses: Losses,
        shares_log_clock: bool = True,
        offset_ns: int = 0,
        by_log: bool = False,
    ) -> None:
        self.topic = topic
        self.offset_ns = offset_ns
        self.by_log = by_log
        self.kind = kind
        self.shares_log_clock = shares_log_clock
        self.last_ns: int | None = None
        self._last_log_ns = 0
        self._last_own_ns = 0
        self._suspect = False
        self._steps = StepDetector()
        self._losses = losses

    def stamp(self, stamp_ns: int, log_time_ns: int) -> int | None:
        """The stamp to use for a message: its own, the log's where it has none, None where it must be dropped."""
        if self.by_log and log_time_ns > 0:
            return log_time_ns + self.offset_ns
        if stamp_ns != 0 or log_time_ns == 0:
            return stamp_ns + self.offset_ns
        if not self.shares_log_clock:
            self._losses.stamps_zero_dropped[self.topic] += 1
            return None
        self._losses.stamps_zero[self.topic] += 1
        return log_time_ns + self.offset_ns

    def effective(self, stamp_ns: int, log_time_ns: int) -> tuple[int, bool]:
        """(effective stamp, whether it was raised) for the topic's next message."""
        if (step := self._steps.take(stamp_ns, log_time_ns)) is not None:
            self._losses.clock_steps.setdefault(self.topic, []).append(step)
        last = self.last_ns
        if last is not None and stamp_ns < self._last_own_ns:
            self._losses.stamps_backwards[self.topic] += 1
        self._last_own_ns = stamp_ns
        if last is None:
            self.last_ns, self._last_log_ns = stamp_ns, log_time_ns
            return stamp_ns, False
        advance = max(log_time_ns - self._last_log_ns, 0)
        self._last_log_ns = log_time_ns
        if -JUMP_NS <= stamp_ns - last <= JUMP_NS + advance:
            self._suspect = False
            if stamp_ns >= last:
                self.last_ns = stamp_ns
                return stamp_ns, False
            return last, True
        self._losses.stamp_jumps[self.topic] += 1
        if self._suspect:  # Two in a row: the clock was set.
            self._suspect = False
            self.last_ns = stamp_ns
            return stamp_ns, False
        self._suspect = True
        return last, True

    def runs_on(self, stamps: Sequence[int]) -> bool:
        """Whether the topic's next messages are what they should be: `effective` would leave all of them alone."""
        if self._suspect or self._steps.has_candidate:  # The next one decides whether the clock was set.
            return False
        before = stamps[0] if self.last_ns is None else self.last_ns
        steps: list[int] = list(map(sub, stamps, (before, *stamps[:-1])))
        return min(steps) >= 0 and max(steps) <= STEP_NS

    def run_on(self, stamps: Sequence[int], log_times: Sequence[int]) -> None:
        """Take messages of which `runs_on` is true."""
        self._steps.run_on(stamps, log_times)
        self.last_ns = self._last_own_ns = stamps[-1]
        self._last_log_ns = log_times[-1]


class Arrivals(NamedTuple):
    """Events of one topic out of a batch of messages, in the order of the log.

    `places` are the messages' places in the batch, of all topics together; `stamps` the events' own.
    """

    clock: TopicClock
    places: Sequence[int]
    log_times: Sequence[int]
    stamps: Sequence[int]
    events: Sequence[Event]


def one_by_one(arrivals: Iterable[Arrivals]) -> list[tuple[int, TopicClock, int, Event]]:
    """(place, clock, log time, event) of all topics of a batch, in the order of the log."""
    found = [
        (place, run.clock, log_time, event)
        for run in arrivals
        for place, log_time, event in zip(run.places, run.log_times, run.events, strict=True)
    ]
    found.sort(key=lambda item: item[0])
    return found


Keyed = tuple[int, bool, int, int, int, int, "Event"]
"""(effective stamp, raised, kind, number of the message, index in its batch, log time, event): no two are alike before
the event, so that they sort as they are."""


class Reorder:
    """Takes events in the order of the log, gives them in the order of time."""

    def __init__(self, clocks: Sequence[TopicClock], losses: Losses) -> None:
        self._clocks = clocks
        self._losses = losses
        self._pending: list[Keyed] = []
        self._before_resets: list[list[Keyed]] = []
        self._number = 0
        self._released_ns: int | None = None

    def take(self, arrivals: Sequence[Arrivals], size: int) -> None:
        """Take the events of a batch of `size` messages, each clock at most once; topic by topic where all run on."""
        if not all(run.clock.runs_on(run.stamps) for run in arrivals):
            for _, clock, log_time, event in one_by_one(arrivals):
                self.push(clock, event, log_time)
            return
        for clock, places, log_times, stamps, events in arrivals:
            clock.run_on(stamps, log_times)
            numbers = [self._number + place for place in places]
            count = range(len(events))
            self._pending += zip(
                stamps, repeat(False), repeat(clock.kind), numbers, count, log_times, events, strict=False
            )
        self._number += size

    def push(self, clock: TopicClock, event: Event, log_time_ns: int) -> None:
        """Take one event, whatever its stamp."""
        last = clock.last_ns
        effective, raised = clock.effective(event.stamp_ns, log_time_ns)
        if last is not None and effective < last:  # The clock was set back: what waits is of the time before.
            self._before_resets.append(sorted(self._pending))
            self._pending = []
        kind = 0 if raised else clock.kind
        self._pending.append((effective, raised, kind, self._number, 0, log_time_ns, event))
        self._number += 1

    def ready(self) -> Iterator[tuple[int, Event]]:
        """Events that nothing can come before any more, or that waited long enough, with effective stamps."""
        pending = self._pending
        pending.sort()
        cut = self._cut(pending)
        released, self._pending = pending[:cut], pending[cut:]
        yield from self._reset()
        yield from self._released(released)

    def rest(self) -> Iterator[tuple[int, Event]]:
        """Everything that still waits, at the end of the log."""
        released, self._pending = sorted(self._pending), []
        yield from self._reset()
        yield from self._released(released)

    def _reset(self) -> Iterator[tuple[int, Event]]:
        """What was left of the times before a clock was set back, each of which has its own order."""
        before, self._before_resets = self._before_resets, []
        for released in before:
            yield from self._released(released)
            self._released_ns = None

    def _cut(self, pending: list[Keyed]) -> int:
        """How many of the sorted events are ready."""
        stamps = [clock.last_ns for clock in self._clocks]
        known = [stamp for stamp in stamps if stamp is not None]
        cut = bisect_left(pending, (min(known),)) if known and len(known) == len(stamps) else 0
        aged = max((item[5] for item in pending), default=0) - WINDOW_NS
        for index in range(len(pending) - 1, cut - 1, -1):
            if pending[index][5] < aged:
                cut = index + 1
                break
        return max(cut, len(pending) // 2) if len(pending) > MAX_PENDING else cut

    def _released(self, items: list[Keyed]) -> Iterator[tuple[int, Event]]:
        """Sorted events on their way; those with stamps before what is already gone are late."""
        if not items:
            return
        newest = items[-1][0]
        if self._released_ns is not None:
            self._losses.late_messages += bisect_left(items, (self._released_ns,))
            newest = max(newest, self._released_ns)
        self._released_ns = newest
        for item in items:
            yield item[0], item[6]
