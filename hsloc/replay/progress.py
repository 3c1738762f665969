"""How far a run is, for whoever waits for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from hsloc.log import Log
    from hsloc.model.events import Event
    from hsloc.replay.run_history import RunHistory

    Report = Callable[["Progress"], None] | None


COMPILING = "compiling the search kernels, once on this machine, about 20 s"
"""The phase "compile" in words; other phases say how far they are."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is: the phase in a word, seconds of the log done and in all, and the scans so far.

    In the phase "compile", `done_s` is the number of kernels compiled; how many there will be is not known.
    """

    phase: str
    done_s: float
    total_s: float
    scans: int


def share_of(progress: Report, total: float, scans: int) -> Callable[[float], None] | None:
    """What a part of a run that knows its share alone reports to; `total` are the seconds of the log."""
    if progress is None:
        return None
    return lambda share: progress(Progress("refine", share * total, total, scans))


def with_progress(log: Log, events: Iterable[Event], history: RunHistory, progress: Report) -> Iterator[Event]:
    """The events, telling now and then how far they are."""
    from hsloc.model.events import Scan  # Here: the service needs the words above alone, and no NumPy.

    if progress is None:
        yield from events
        return
    total, origin = log.summary.duration_s, log.summary.origin_ns
    for event in events:
        yield event
        if isinstance(event, Scan):
            progress(Progress("replay", max((event.stamp_ns - origin) / 1e9, 0.0), total, history.scans))
