"""What a log file is to the reader: channels, and raw messages in the order of their log time."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Protocol

from hsloc.errors import HslocError, LogFormatError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from hsloc.log.summary import Losses, TopicStatistics
    from hsloc.warnings import RunWarning

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
        line = f"{complaint} ({reason}); if its recorder was stopped hard, {remedy} saves what is whole"
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
