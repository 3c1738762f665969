"""(c) Replay of the office fixture as a multiple of real time, and what the time goes into."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

import hsloc
from hsloc.benchmark.clock import Timing
from hsloc.config import Config
from hsloc.errors import MapError
from hsloc.localisation.localiser import Localiser
from hsloc.log import open_log
from hsloc.replay.engine import replay
from hsloc.replay.map_and_start import find_map
from hsloc.replay.run import run
from hsloc.replay.run_history import RunHistory
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching import LikelihoodField, Match, Matcher, Window
    from hsloc.model import Event


@dataclass(frozen=True, slots=True)
class ReplayTiming:
    """`replay` is the time from the first event to the last; `parts` are the seconds of one run taken to pieces."""

    log: str
    log_seconds: float
    scans: int
    matched: int
    replay: Timing
    whole: Timing
    parts: dict[str, float]

    @property
    def times_real_time(self) -> float:
        """Of the best repeat."""
        return self.log_seconds / self.replay.best

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "log": self.log,
            "log_seconds": self.log_seconds,
            "scans": self.scans,
            "matched": self.matched,
            "replay_s": self.replay.to_dict(),
            "open_prepare_replay_s": self.whole.to_dict(),
            "times_real_time": self.times_real_time,
            "times_real_time_median": self.log_seconds / self.replay.median,
            "times_real_time_with_opening": self.log_seconds / self.whole.best,
            "parts_s": self.parts,
        }


def fixture() -> Path | None:
    """recordings/office.mcap of the checkout, where there is one."""
    path = Path(hsloc.__file__).parents[1] / "recordings" / "office.mcap"
    return path if path.is_file() else None


def time_replay(log: Path, repeats: int) -> ReplayTiming:
    """Replay `log` with the defaults once to warm up, `repeats` times by the clock and once taken to pieces."""
    request = RunRequest(logs=(log,))
    run(request)
    seconds = []
    for _ in range(repeats):
        result = run(request)
        seconds.append(result.seconds)
    diagnostics = result.diagnostics
    return ReplayTiming(
        log=log.name,
        log_seconds=result.summary.duration_s,
        scans=len(diagnostics),
        matched=diagnostics.status.count("matched"),
        replay=Timing.of([one["replay"] for one in seconds]),
        whole=Timing.of([one["open"] + one["prepare"] + one["replay"] for one in seconds]),
        parts=_parts(request),
    )


class _Timed:
    """A matcher with a stopwatch."""

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher
        self.seconds = 0.0

    def match(self, points: NDArray[np.float64], field: LikelihoodField, window: Window, rng: Generator) -> Match:
        begin = perf_counter()
        match = self._matcher.match(points, field, window, rng)
        self.seconds += perf_counter() - begin
        return match


def _parts(request: RunRequest) -> dict[str, float]:
    """Seconds of reading (unpacking and decoding the log), of searching, and of all else."""
    log = open_log(request.logs)
    grid, _ = find_map(request, log)
    if grid is None:
        raise MapError(f"{request.logs[0]}: the log has no /map")
    config = Config()
    field = config.make_field(grid)
    stated = log.initial_pose()
    matcher = _Timed(config.make_matcher())
    rng = np.random.default_rng(0)
    localiser = Localiser.from_parameters(
        grid, field, matcher, config.localiser, rng, None if stated is None else stated[1]
    )
    history = RunHistory()
    reading = 0.0

    def timed(events: Iterator[Event]) -> Iterator[Event]:
        nonlocal reading
        while True:
            begin = perf_counter()
            event = next(events, None)
            reading += perf_counter() - begin
            if event is None:
                return
            yield event

    begin = perf_counter()
    for event, estimate in replay(timed(iter(log.events())), localiser):
        history.add(event, estimate)
    total = perf_counter() - begin
    return {"read": reading, "search": matcher.seconds, "other": total - reading - matcher.seconds}
