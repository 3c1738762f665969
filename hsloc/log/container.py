"""What a log file is to the reader: channels, and raw messages in the order of their log time."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Protocol

import numpy as np

from hsloc.errors import HslocError, LogFormatError
from hsloc.log.no_log import COPY_AGAIN
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.log.summary import Losses, TopicStatistics

RawMessage = tuple[int, int, int, "memoryview | bytes"]
"""(log time in ns, position in the file, id of the channel, payload). Positions are unique in a file."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One stream of messages: the type in ROS 2's spelling, and how payload and schema are encoded.

    `message_encoding` is `cdr`, `ros1`, `json`, `protobuf` ..., `schema_encoding` is `ros2msg`, `ros2idl`,
    `ros1msg` ... or empty where the log holds no definition.
    """

    id: int
    topic: str
    typename: str
    message_encoding: str
    schema_encoding: str = ""
    schema: bytes = b""


def in_runs(messages: Iterator[RawMessage], size: int) -> Iterator[list[RawMessage]]:
    """Messages in lists of `size`; the last may be shorter."""
    while run := list(islice(messages, size)):
        yield run


_HOUR_NS = 3600 * 1_000_000_000


def plausible_times(ordered: Sequence[int] | NDArray[np.uint64]) -> tuple[int, int]:
    """Between which log times (ns) sorted log times of one part of a log are believed.

    The inner nine tenths say how long the part is. A few times that are farther outside than twice that length and an
    hour are wrong: a counter that overflowed, or a clock that was not set.
    """
    cut = len(ordered) // 20
    low, high = int(ordered[cut]), int(ordered[-1 - cut])
    margin = 2 * (high - low) + _HOUR_NS
    return low - margin, min(high + margin, (1 << 63) - 1)


STEP_NS = 1_000_000_000
"""Least step of a clock that is reported. chrony sets a clock that is wrong by more (`makestep 1 3` is its default in
distributions), others it slows down or speeds up; stamps of Intel's log run backwards by up to 0.9 s without one."""
AGREEING = 10
"""Messages in a row that must show a step, where single ones may be wrong."""
_SHARED = 0.5
"""Least part of these messages whose channel goes on."""
_MARGIN_S = 0.1
"""Distance (s) of a cut from times that are there twice: they are stated to a tenth."""


def out_of_line(times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which log times (n,) of one channel in the order of writing (ns) are wrong alone: those around them agree.

    They are earlier, or later, than both of these by more than a clock's step. The first and the last never are.
    """
    found = np.zeros(len(times), dtype=np.bool_)
    before, after = times[1:-1] - times[:-2], times[1:-1] - times[2:]
    found[1:-1] = (np.maximum(before, after) < -STEP_NS) | (np.minimum(before, after) > STEP_NS)
    return found


class RecorderClock:
    """Whether the recorder's own clock was set back: log times, in the order of writing, that step back.

    `AGREEING` messages on either side must show it, most of channels that have some on both: files are also put
    together topic by topic. `has_single_errors` says that log times of single messages are wrong.
    """

    def __init__(self) -> None:
        self.has_single_errors = False
        self._steps: list[tuple[int, int]] = []
        self._first_ns: int | None = None
        self._channels = np.zeros(0, dtype=np.int64)
        self._times = np.zeros(0, dtype=np.int64)

    def take(self, channels: NDArray[np.int64], times: NDArray[np.int64]) -> None:
        """The next messages: their channels (n,) and log times (n,) in ns."""
        if self._first_ns is None and len(times):
            self._first_ns = int(times[0])
        if (np.diff(times) < -STEP_NS).any():
            self.has_single_errors |= any(out_of_line(times[channels == each]).any() for each in np.unique(channels))
        channels, times = np.concatenate((self._channels, channels)), np.concatenate((self._times, times))
        for k in np.flatnonzero(np.diff(times) < -STEP_NS).tolist():
            before, after = slice(k + 1 - AGREEING, k + 1), slice(k + 1, k + 1 + AGREEING)
            if k + 1 < AGREEING or k + 1 + AGREEING > len(times):
                continue
            shared = min(np.isin(channels[a], channels[b]).mean() for a, b in ((before, after), (after, before)))
            if shared >= _SHARED and times[after].max() < times[before].min():
                self._steps.append((int(times[k]), int(times[k + 1])))
        left = 2 * AGREEING - 1
        self._channels, self._times = channels[-left:], times[-left:]

    def warnings(self, path: Path, statistics: Iterable[TopicStatistics]) -> list[RunWarning]:
        """A warning of the first step, with the parts of the log that are in order; `statistics` are of all topics."""
        starts = [each.first_ns for each in statistics if each.first_ns is not None]
        if not self._steps or not starts or self._first_ns is None:
            return []
        last, following = self._steps[0]
        # What came before the step, and what came after it, may have the same times.
        begin, end = max(following, self._first_ns), min(last, int(self._times[-1]))
        margin_s = _MARGIN_S if begin <= end else 0.0
        low, high = ((each - min(starts)) / 1e9 for each in sorted((begin, end)))
        more = f", the first of {len(self._steps)} steps" if len(self._steps) > 1 else ""
        text = (
            f"{path}: the log's times step back by {(last - following) / 1e9:.1f} s{more}: the recorder's clock was "
            "set, and what came before and after is out of order"
        )
        remedy = f"cut the log: --end {low - margin_s:.1f}, or --start {high + margin_s:.1f}, has one of both alone"
        return [RunWarning(WarningCode.CLOCK_SET, text, remedy)]


@contextmanager
def guarded(complaint: str, remedy: str, losses: Losses | None) -> Iterator[None]:
    """One error, `complaint` with its reason and a command as remedy, for all that a reader's library may raise.

    Damage in the middle of reading is a loss, and what came before it stands; at opening, where there are no `losses`
    to count it in, it is a LogFormatError.
    """
    try:
        yield
    except (HslocError, GeneratorExit):
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0][:160]
        line = f"{complaint} ({reason}); {COPY_AGAIN}; if its recorder was stopped hard, {remedy} saves what is whole"
        if losses is None:
            raise LogFormatError(line) from error
        losses.truncated_files += 1
        losses.note(line)


class Container(Protocol):
    """A file, or a folder that is one recording.

    Contract: `runs` yields every readable message of the wanted channels exactly once, in the order of
    (log time, position) as far as a bounded memory allows; what it cannot read it counts in `losses`. It raises
    nothing but LogError. `losses_at_opening` holds what was already lost when the file was opened.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102
    @property
    def format(self) -> str: ...  # noqa: D102
    @property
    def profile(self) -> str: ...  # noqa: D102
    @property
    def channels(self) -> Mapping[int, Channel]: ...  # noqa: D102
    @property
    def statistics(self) -> Mapping[int, TopicStatistics]: ...  # noqa: D102
    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]: ...  # noqa: D102
    @property
    def losses_at_opening(self) -> Losses: ...  # noqa: D102
    @property
    def warnings(self) -> list[RunWarning]: ...  # noqa: D102

    def runs(self, wanted: Collection[int], losses: Losses) -> Iterator[list[RawMessage]]:
        """Messages of the wanted channels, in lists as they come out of the file."""
        ...

    def messages(self, wanted: Collection[int], losses: Losses) -> Iterator[RawMessage]:
        """The same one by one."""
        ...

    def verify(self) -> Losses:
        """Read everything and count what is damaged."""
        ...
