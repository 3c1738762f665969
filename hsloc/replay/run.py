"""One call from a log to a result: the command line, the service, the benchmarks and the system tests all come here."""

from __future__ import annotations

import signal
import time
from contextlib import contextmanager
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.config import preset
from hsloc.errors import ConfigError, LogError, MapError
from hsloc.kernels.cache import compilation_reported
from hsloc.log import LogSummary, Losses, open_log
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.matching.window import Window
from hsloc.model.events import Odometry, Scan
from hsloc.model.pose2 import IDENTITY
from hsloc.model.trajectory import Trajectory
from hsloc.preprocessing.odometry_resets import ContinuousOdometry
from hsloc.preprocessing.odometry_watch import OdometryWatch, UnusableOdometry
from hsloc.replay.engine import replay
from hsloc.replay.garbage import seldom_collected
from hsloc.replay.initial_pose import find_start, first_odometry
from hsloc.replay.map_sources import load_grid, load_state, maps_beside, unread_maps
from hsloc.replay.references import read_reference
from hsloc.replay.run_history import RunHistory
from hsloc.request import RunRequest
from hsloc.slam.laser_odometry import with_laser_odometry
from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import Resume
from hsloc.slam.point_mapper import PointMapper
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from hsloc.log import Log
    from hsloc.matching.match import Matcher
    from hsloc.model.estimate import ScanDiagnostics
    from hsloc.model.events import Event
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2
    from hsloc.replay.engine import Estimator
    from hsloc.slam.map_state import MapState
    from hsloc.slam.result import MappingResult


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is: the phase in a word, seconds of the log done and in all, and the scans so far.

    In the phase "compile", `done_s` is the number of kernels compiled; how many there will be is not known.
    """

    phase: str
    done_s: float
    total_s: float
    scans: int


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a run found, and what is needed to repeat it. `seconds` are wall times, the only thing not repeatable.

    `trajectory` has one pose for each odometry message; where there are none, one for each scan. `localised` says
    which of them are believed. `grid` is the map that was used, or, in `mode` "slam", the one that was drawn; then
    `true_grid` is the one that the log carries, if any. `likelihood` is the field that was matched on, of a given map.
    With `lidar_only` the log's odometry was not used: a localiser's `odometry` is then that of the scans. `deskewed`
    says whether the beams were moved to where the robot was when each was measured.
    """

    spec: RunRequest
    summary: LogSummary
    input_sha256: str
    trajectory: Trajectory
    localised: NDArray[np.bool_]
    odometry: Trajectory
    reference: Trajectory | None
    grid: OccupancyGrid
    diagnostics: ScanDiagnostics
    losses: Losses
    warnings: tuple[RunWarning, ...]
    seconds: dict[str, float]
    mode: str = "localise"
    mapping: MappingResult | None = None
    true_grid: OccupancyGrid | None = None
    likelihood: LikelihoodField | None = None
    lidar_only: bool = False
    deskewed: bool = False

    @property
    def matcher_name(self) -> str | None:
        """The scan matcher that was used; None for the graph mapper, which has its own."""
        own = self.mode == "slam" and self.spec.config.mapper == "graph"
        return None if own else self.spec.matcher_name

    @property
    def follows_scans(self) -> bool:
        """Whether the trajectory has a pose for each scan, for want of odometry."""
        return len(self.odometry) == 0


def run(
    request: RunRequest | str | PathLike[str] | Sequence[str | PathLike[str]],
    progress: Callable[[Progress], None] | None = None,
    **options: Any,
) -> Result:
    """Replay a log through the localiser or the mapper.

    `request` is a RunRequest, or the log, or the parts of one log; then `options` are those of `hsloc.options` by
    their names, as in `run("run.mcap", map="map.yaml", matcher="icp", seed=3)`. `matcher` may be an object with the
    method of `hsloc.Matcher`. Raises an `HslocError` for a log, map or option that cannot be used.
    """
    if not isinstance(request, RunRequest):
        logs = [request] if isinstance(request, str | PathLike) else request
        request = RunRequest.from_values(logs, options)
    elif options:
        raise ConfigError(f"a RunRequest says it all; put {', '.join(options)} into it")
    if progress is None:
        return _run(request, None)
    report = progress
    with compilation_reported(lambda count: report(Progress("compile", float(count), 0.0, 0))):
        return _run(request, progress)


def _run(spec: RunRequest, progress: Callable[[Progress], None] | None) -> Result:
    """The run; without the odometry of the log where that proves unusable on the way."""
    try:
        return _run_with(spec, progress, lidar_only=spec.no_odometry)
    except UnusableOdometry as error:
        warning = RunWarning(
            WarningCode.ODOMETRY_UNUSABLE,
            f"the odometry is ignored: {error}",
            "repair its source, or name another with --odom-topic",
        )
        return _run_with(spec, progress, lidar_only=True, warnings=(warning,))


def _run_with(
    spec: RunRequest,
    progress: Callable[[Progress], None] | None,
    *,
    lidar_only: bool,
    warnings: tuple[RunWarning, ...] = (),
) -> Result:
    begin = time.perf_counter()
    log = open_log(spec.logs, spec.reading())
    of_reference: list[RunWarning] = []
    reference = None if spec.reference is None else read_reference(spec.reference, spec.logs, of_reference)
    grid, of_map = find_map(spec, log)
    state, of_state = load_state(spec)
    warnings = (*warnings, *of_map, *of_state, *of_reference)
    # Without odometry the map of a log is used where the user asks for it.
    builds = spec.mode == "slam" or state is not None or (spec.no_odometry and spec.map_path is None)
    localise = spec.mode == "localise" or (grid is not None and not builds)
    opened = time.perf_counter()
    if progress is not None:
        progress(Progress("prepare", 0.0, log.summary.duration_s, 0))
    if localise:
        start, of_start = find_start(spec, log, require_map(grid))
        warnings = (*warnings, *of_start)
        likelihood = LikelihoodField.from_grid(
            require_map(grid), spec.config.likelihood_field.sigma, spec.config.likelihood_field.margin
        )
        estimator: Estimator = _localiser(spec, require_map(grid), likelihood, start)
    else:
        require_matcher(spec)
        likelihood, estimator = None, _mapper(spec, state, lidar_only)
    first = None if lidar_only else first_odometry(log.events())
    prepared = time.perf_counter()
    history, events = RunHistory(), ContinuousOdometry(_events(spec, log, lidar_only, localise), log.summary.odom_topic)
    # Turns that were joined of segments are known beam by beam; a whole turn is deskewed if the user asks for it.
    deskew = spec.read.deskew or (log.summary.segments > 1 and not lidar_only)
    with seldom_collected():
        for event, estimate in replay(_reported(log, events, history, progress), estimator, deskew=deskew, first=first):
            history.add(event, estimate)
    replayed = time.perf_counter()
    if history.scans == 0:
        where = "between --start and --end" if _cut(spec) else f"on {log.summary.scan_topic} that could be read"
        lost = "".join(f": {line}" for line in ["; ".join(log.losses.lines())] if line)
        raise LogError(f"{spec.logs[0]}: no scan {where}{lost}")
    if first is None and not lidar_only:
        where = "between --start and --end" if _cut(spec) else f"on {log.summary.odom_topic} that could be read"
        raise LogError(f"{spec.logs[0]}: no odometry {where}")
    seconds = {"open": opened - begin, "prepare": prepared - opened, "replay": replayed - prepared}
    mapping, true_grid = None, None if localise else grid
    if isinstance(estimator, Mapper):
        mapping = estimator.finish(_share(progress, log.summary.duration_s, history.scans))
        grid = mapping.grid
        seconds["finish"] = time.perf_counter() - replayed
    elif isinstance(estimator, PointMapper):
        grid = estimator.grid()
    trajectory, localised = history.trajectory() if mapping is None else _mapped(history, mapping)
    return Result(
        spec=spec,
        summary=log.summary,
        input_sha256=log.sha256(),
        trajectory=trajectory,
        localised=localised,
        odometry=history.odometry(),
        reference=history.reference() if reference is None else reference,
        grid=require_map(grid),
        diagnostics=history.diagnostics(),
        losses=log.losses,
        warnings=(*log.summary.warnings, *warnings, *events.warnings()),
        seconds=seconds,
        mode="localise" if localise else "slam",
        mapping=mapping,
        true_grid=true_grid,
        likelihood=likelihood,
        lidar_only=lidar_only,
        deskewed=deskew,
    )


def _mapped(history: RunHistory, mapping: MappingResult) -> tuple[Trajectory, NDArray[np.bool_]]:
    """The trajectory as it is known at the end: at the odometry messages, or at the scans if there are none."""
    stamps = history.odometry().stamps_ns
    poses = mapping.odometry_poses
    if len(stamps) == 0:
        stamps, poses = history.diagnostics().stamps_ns, mapping.scan_poses
    return Trajectory(stamps, poses), np.ones(len(stamps), dtype=np.bool_)


def _events(spec: RunRequest, log: Log, lidar_only: bool, localise: bool) -> Iterable[Event]:
    """The events of the log; its odometry watched, or left out, or replaced for a localiser by that of the scans."""
    if not lidar_only:
        # The point mapper cannot do without odometry, whatever that is like.
        return log.events() if spec.config.mapper == "point" and not localise else OdometryWatch(log.events())
    if localise:
        rng = np.random.default_rng((spec.seed, 1))
        return with_laser_odometry(log.events(), spec.config.graph_mapper.front_end, rng)
    return (event for event in log.events() if not isinstance(event, Odometry))


def _share(progress: Callable[[Progress], None] | None, total: float, scans: int) -> Callable[[float], None] | None:
    if progress is None:
        return None
    return lambda share: progress(Progress("refine", share * total, total, scans))


def find_map(spec: RunRequest, log: Log) -> tuple[OccupancyGrid | None, tuple[RunWarning, ...]]:
    """The map that is given or that the log carries, and warnings."""
    if spec.map_path is not None:
        return load_grid(spec.map_path)
    grid = log.map()
    if grid is not None:
        return grid, ()
    unread = unread_maps(log.summary)
    beside = maps_beside(spec.logs[0])
    given = str(beside[0]) if beside else "map.yaml"
    what = f"cannot use {unread[0]}" if unread else "the log has no /map"
    if spec.mode == "localise":
        raise MapError(f"{spec.logs[0]}: {what}; give one with --map {given}")
    if spec.mode == "slam" or spec.resume is not None or not (unread or beside):
        return None, ()
    remedy = f"to localise on a map give it with --map {given}"
    remedy += "" if not beside[1:] else f" (also there: {', '.join(p.name for p in beside[1:])})"
    return None, (RunWarning(WarningCode.MAP_NOT_USED, f"{what}, so a map is built", remedy),)


def require_map(grid: OccupancyGrid | None) -> OccupancyGrid:
    """The map. Raises MapError where there is none."""
    if grid is None:
        raise MapError("no map to localise in")
    return grid


def require_matcher(spec: RunRequest) -> None:
    """Raise ConfigError for a matcher that was asked for and that the graph mapper would not use."""
    if spec.config.mapper == "graph" and spec.matcher_name != preset(spec.preset).matcher:
        raise ConfigError(
            f"the graph mapper has a matcher of its own and would not use {spec.matcher_name}; leave out --matcher, "
            "or use --mapper point"
        )


def _mapper(spec: RunRequest, state: MapState | None, lidar_only: bool) -> Mapper | PointMapper:
    if spec.config.mapper == "point":
        if lidar_only:
            raise ConfigError("the point mapper predicts with odometry; leave out --no-odom, or use --mapper graph")
        start = IDENTITY if spec.initial_pose is None else spec.initial_pose
        return PointMapper(spec.matcher, spec.config.point_mapper, np.random.default_rng(spec.seed), start)
    config = spec.config
    resume = None
    if state is not None:
        field = LikelihoodField.from_grid(state.grid, config.likelihood_field.sigma, config.likelihood_field.margin)
        begin = None if spec.unknown_start else spec.initial_pose
        resume = Resume(state, field, spec.matcher, config.localiser.relocaliser, begin)
    return Mapper(
        replace(spec.config.graph_mapper, use_odometry=not lidar_only), np.random.default_rng(spec.seed), resume
    )


def _localiser(spec: RunRequest, grid: OccupancyGrid, likelihood: LikelihoodField, start: Pose2 | None) -> Estimator:
    from hsloc.localisation.localiser import Localiser

    rng = np.random.default_rng(spec.seed)
    _warm_up(spec.matcher, likelihood)
    return Localiser(grid, likelihood, spec.matcher, spec.config.localiser, rng, start)


def _warm_up(matcher: Matcher, likelihood: LikelihoodField) -> None:
    """Have the kernels compiled (once after an installation, up to a minute) before the clock of the replay starts."""
    points = np.zeros((1, 2))
    window = Window(likelihood.T_map_field, 0.1, 0.1, 0.1)
    with interrupts_held_back():
        matcher.match(points, likelihood, window, np.random.default_rng(0))


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Hold back Ctrl-C until the end: a compiler that is interrupted may take the process with it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _cut(spec: RunRequest) -> bool:
    return spec.read.start_s is not None or spec.read.end_s is not None


def _reported(
    log: Log, events: Iterable[Event], history: RunHistory, progress: Callable[[Progress], None] | None
) -> Iterator[Event]:
    """The events, telling now and then how far they are."""
    if progress is None:
        yield from events
        return
    total = log.summary.duration_s
    origin = log.summary.origin_ns
    for event in events:
        yield event
        if isinstance(event, Scan):
            progress(Progress("replay", max((event.stamp_ns - origin) / 1e9, 0.0), total, history.scans))
