"""One call from a log to a result: the command line, the service, the benchmarks and the system tests all come here."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hsloc.config import Config
from hsloc.errors import LogError, MapError
from hsloc.log.reader import open_log
from hsloc.log.summary import LogSummary, Losses, ReadOptions
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.matching.window import Window
from hsloc.model.events import PairedScan, Scan
from hsloc.replay.engine import replay
from hsloc.replay.recording import Recording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.log.reader import Log
    from hsloc.matching.match import Matcher
    from hsloc.model.estimate import ScanDiagnostics
    from hsloc.model.events import Event
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2
    from hsloc.model.trajectory import Trajectory
    from hsloc.replay.engine import Estimator


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSpec:
    """What to run. The same spec on the same files gives the same result, bit for bit.

    Without `map_path` the map is the log's own. The start is `initial_pose`, else the one the log states, else unknown;
    with `unknown_start` it is unknown whatever the log states. `labels` are the names of the logs in reports, where the
    files' own names say nothing.
    """

    logs: tuple[Path, ...]
    map_path: Path | None = None
    config: Config = field(default_factory=Config)
    read: ReadOptions = field(default_factory=ReadOptions)
    initial_pose: Pose2 | None = None
    unknown_start: bool = False
    seed: int = 0
    preset: str = "default"
    labels: tuple[str, ...] = ()

    def names(self) -> tuple[str, ...]:
        """What to call the logs in reports."""
        return self.labels or tuple(path.name for path in self.logs)


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is: the phase in a word, seconds of the log done and in all, and the scans so far."""

    phase: str
    done_s: float
    total_s: float
    scans: int


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a run found, and what is needed to repeat it. `seconds` are wall times, the only thing not repeatable."""

    spec: RunSpec
    summary: LogSummary
    input_sha256: str
    trajectory: Trajectory
    localised: NDArray[np.bool_]
    odometry: Trajectory
    reference: Trajectory | None
    grid: OccupancyGrid
    diagnostics: ScanDiagnostics
    losses: Losses
    warnings: tuple[str, ...]
    seconds: dict[str, float]


def run(spec: RunSpec, progress: Callable[[Progress], None] | None = None) -> Result:
    """Replay a log through the localiser.

    Raises an `HslocError` for a log, map or configuration that cannot be used.
    """
    begin = time.perf_counter()
    log = open_log(spec.logs, spec.read)
    grid, warnings = find_map(spec, log)
    opened = time.perf_counter()
    if progress is not None:
        progress(Progress("prepare", 0.0, log.summary.duration_s, 0))
    estimator = _localiser(spec, log, grid)
    prepared = time.perf_counter()
    recording = Recording()
    for event, estimate in replay(_reported(log, log.events(), recording, progress), estimator):
        recording.add(event, estimate)
    replayed = time.perf_counter()
    if recording.scans == 0:
        raise LogError(
            f"{spec.logs[0]}: no scan between --start and --end" if _cut(spec) else f"{spec.logs[0]}: no scan"
        )
    trajectory, localised = recording.trajectory()
    return Result(
        spec=spec,
        summary=log.summary,
        input_sha256=log.sha256(),
        trajectory=trajectory,
        localised=localised,
        odometry=recording.odometry(),
        reference=recording.reference(),
        grid=grid,
        diagnostics=recording.diagnostics(),
        losses=log.losses,
        warnings=(*log.summary.warnings, *warnings),
        seconds={"open": opened - begin, "prepare": prepared - opened, "replay": replayed - prepared},
    )


def find_map(spec: RunSpec, log: Log) -> tuple[OccupancyGrid, tuple[str, ...]]:
    """The map to localise in, and what there is to warn of."""
    if spec.map_path is not None:
        from hsloc.maps import read_map

        loaded = read_map(spec.map_path)
        return loaded.grid, loaded.warnings
    grid = log.map()
    if grid is None:
        raise MapError(f"{spec.logs[0]}: the log has no /map; give one with --map map.yaml")
    return grid, ()


def _localiser(spec: RunSpec, log: Log, grid: OccupancyGrid) -> Estimator:
    from hsloc.localisation.localiser import Localiser

    config = spec.config
    likelihood = LikelihoodField.from_grid(grid, config.likelihood_field.sigma, config.likelihood_field.margin)
    start = spec.initial_pose
    if start is None and not spec.unknown_start:
        stated = log.initial_pose()
        start = None if stated is None else stated[1]
    rng = np.random.default_rng(spec.seed)
    _warm_up(config.make_matcher(), likelihood)
    return Localiser(grid, likelihood, config.make_matcher(), config.localiser, rng, start)


def _warm_up(matcher: Matcher, likelihood: LikelihoodField) -> None:
    """Have the kernels compiled (once after an installation, ten seconds) before the clock of the replay starts."""
    points = np.zeros((1, 2))
    window = Window(likelihood.T_map_field, 0.1, 0.1, 0.1)
    matcher.match(points, likelihood, window, np.random.default_rng(0))


def _cut(spec: RunSpec) -> bool:
    return spec.read.start_s is not None or spec.read.end_s is not None


def _reported(
    log: Log, events: Iterable[Event], recording: Recording, progress: Callable[[Progress], None] | None
) -> Iterator[Event]:
    """The events, telling now and then how far they are."""
    if progress is None:
        yield from events
        return
    total = log.summary.duration_s
    origin = log.summary.origin_ns
    for event in events:
        yield event
        if isinstance(event, (Scan, PairedScan)):
            progress(Progress("replay", max((event.stamp_ns - origin) / 1e9, 0.0), total, recording.scans))
