"""One call from a log to a result: the command line, the service, the benchmarks and the system tests all come here."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

from hsloc.errors import ConfigError
from hsloc.garbage_collection import rarely_collected
from hsloc.kernels.cache import compilation_reported
from hsloc.localisation.odometry_scale import OdometryScale
from hsloc.preprocessing.body_returns import body_beams, body_warnings
from hsloc.preprocessing.odometry import UnusableOdometry
from hsloc.replay.clock_offset import (
    ClockEvidence,
    LateScans,
    SweptScans,
    TurnedLaser,
    clock_offsets,
    offsets_of_mapping,
    open_as_meant,
    require_direction,
    swept_scans,
)
from hsloc.replay.engine import replay
from hsloc.replay.estimators import events_of, make_localiser, make_mapper
from hsloc.replay.map_and_start import (
    ScaleEvidence,
    find_map,
    find_start,
    first_odometry,
    load_state,
    require_data,
    require_map,
)
from hsloc.replay.matched_scans import mean_fitness
from hsloc.replay.pose_covariances import pose_covariances
from hsloc.replay.prepared_events import Preparation, PreparedEvents, Surroundings
from hsloc.replay.progress import Progress, share_of, with_progress
from hsloc.replay.references import read_reference
from hsloc.replay.run_history import RunHistory
from hsloc.request import RunRequest
from hsloc.slam.point_mapper import PointMapper
from hsloc.slam.time_offset import clock_warnings
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from hsloc.localisation.map_scale import MapScale
    from hsloc.localisation.mounting_changes import YawPiece
    from hsloc.localisation.mounting_error import MountingError
    from hsloc.localisation.states import StateRows
    from hsloc.log import Log, LogSummary, Losses, ReadOptions
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.model.estimate import Ambiguity, ScanDiagnostics
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2
    from hsloc.model.trajectory import Trajectory
    from hsloc.replay.engine import Estimator
    from hsloc.replay.progress import Report
    from hsloc.slam.heading_offset import Offset
    from hsloc.slam.mapper import Mapper
    from hsloc.slam.result import MappingResult

    Correction = tuple[MapScale, Pose2] | OdometryScale | None
    """Scale of the map, and the pose from which on it is right; or that of the odometry."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Result:
    """What a run found, and what is needed to repeat it. `seconds` are wall times, the only thing not repeatable.

    `trajectory` has one pose for each odometry message; where there are none, one for each scan. `localised` says
    which of them are believed. `grid` is the map that was used, or, in `mode` "slam", the one that was drawn; then
    `true_grid` is the one that the log carries, if any. `likelihood` is the field that was matched on, of a given map.
    `states` are the states of the poses of a localiser that weighs evidence; `localised` are those in this state,
    `tracked` the poses that were not searched for, whether their scans fit or not.
    `map_scale` is the size of a given map by what the lidar measures, `mounting_error` where the only laser is by the
    odometry, from where it is said to be, `yaw_pieces` when it was turned, `ambiguities` where several places fit.
    `preparation` is what was done with the events of the log. Odometry that counts wrongly is corrected in `odometry`,
    with a warning. With `lidar_only` no odometry of the log was used: a localiser's `odometry` is that of the scans.
    """

    request: RunRequest
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
    states: StateRows | None = None
    tracked: NDArray[np.bool_] | None = None
    map_scale: MapScale | None = None
    given_resolution: float | None = None
    """Side of a cell of the map as it was given (m), where that was wrong and `grid` has another."""
    odometry_scale: OdometryScale | None = None
    """How much more a metre and a radian of `odometry` are, by a localiser on a given map."""
    mounting_error: MountingError | None = None
    yaw_pieces: tuple[YawPiece, ...] = ()
    ambiguities: tuple[Ambiguity, ...] = ()
    preparation: Preparation = field(default_factory=Preparation)
    clock_offsets: Mapping[str, Offset] | None = None
    """Offsets of the scans' stamps that were found and not removed, by topic."""
    corrected_offsets: Mapping[str, Offset] | None = None
    """Those that were found by the matches of the run and removed."""
    reading: ReadOptions | None = None
    """How the log was read, with what was found on the way; None is what the request says."""
    direction_is_right: bool = False
    """Whether the laser looks to where it is stated to by the scans alone; False too where they were not asked."""
    log: Log | None = field(default=None, repr=False)
    """The log as it was opened, to be read once more; None where that would keep unpacked files on the disk."""

    def __repr__(self) -> str:
        scans, share = self.diagnostics, 100.0 * float(self.localised.mean()) if len(self.localised) else 0.0
        used = sum(status in ("matched", "relocalised") for status in scans.status)
        name = " ".join(self.request.names())
        return (
            f"<Result of {name if len(name) < 80 else f'{name[:77]}...'}: {self.mode}, {len(self.trajectory)} poses, "
            f"{self.trajectory.length():.1f} m, {share:.1f} % localised, {used} of {len(scans)} scans matched, "
            f"{len(self.warnings)} warnings, {'no' if self.reference is None else 'with a'} reference>"
        )

    def pose_covariances(self) -> NDArray[np.float64]:
        """Covariance (n, 3, 3) of each pose of `trajectory` over (x, y, theta) in the map frame (m^2, m rad, rad^2).

        Those of the matched scans, propagated by the odometry; NaN where a pose is not localised, and before the first
        match. Of a map that was built: of the solved pose graph, relative to the first pose; NaN without any scan.
        """
        if self.mapping is not None:
            at_scans = self.follows_scans
            return self.mapping.scan_covariances if at_scans else self.mapping.odometry_covariances
        config = self.request.config
        noise = config.localiser.noise() if self.mode == "localise" else config.point_mapper.odometry_noise
        return pose_covariances(self.trajectory, self.localised, self.diagnostics, noise.covariance)

    def clock_evidence(self) -> ClockEvidence:
        """Whether the stamps of scans and odometry agree, by the headings of a localiser's result with odometry."""
        return ClockEvidence.of(self.diagnostics, self.odometry, self.trajectory, self.localised)

    def scale_evidence(self) -> ScaleEvidence:
        """Which scale the map has, by a localiser's result with odometry."""
        return ScaleEvidence.of(self.map_scale, self.diagnostics, self.odometry, self.trajectory)

    @property
    def matcher_name(self) -> str | None:
        """The scan matcher that was used; None for the graph mapper, which has its own."""
        own = self.mode == "slam" and self.request.config.mapper == "graph"
        return None if own else self.request.matcher_name

    @property
    def lidar_only(self) -> bool:
        """Whether no odometry of the log was used."""
        return self.preparation.lidar_only

    @property
    def deskewed(self) -> bool:
        """Whether the beams were moved to where the robot was when each was measured."""
        return self.preparation.deskewed

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
        raise ConfigError(f"{', '.join(options)}: options beside a RunRequest; put them into it")
    if progress is None:
        return _run(request, None)
    report = progress
    with compilation_reported(lambda count: report(Progress("compile", float(count), 0.0, 0))):
        return _run(request, progress)


def _run(request: RunRequest, progress: Report) -> Result:
    """The run; where the scale of the map or of the odometry proves wrong on the way, with that corrected."""
    result = _run_on(request, progress)
    if result.mode != "localise" or result.lidar_only:
        return result
    scale, evidence = result.map_scale, result.scale_evidence()
    if scale is not None and evidence.hints and request.config.localiser.correct_map_scale:
        again = _run_on(request, progress, (scale, evidence.start))
        if again.scale_evidence().is_better(evidence):
            return replace(again, seconds=_sum(result.seconds, again.seconds))
    odometry = result.odometry_scale
    if odometry is not None and odometry.is_significant and not (scale is not None and scale.moves_poses):
        again = _run_on(request, progress, odometry)
        if odometry.is_mended(again.odometry_scale) and again.scale_evidence().fits_as(evidence):
            warnings = (*again.warnings, odometry.warning())
            return replace(again, warnings=warnings, seconds=_sum(result.seconds, again.seconds))
    return result


def _sum(first: Mapping[str, float], second: Mapping[str, float]) -> dict[str, float]:
    return {name: value + second[name] for name, value in first.items()}


def _run_on(request: RunRequest, progress: Report, correction: Correction = None) -> Result:
    """The run, with `correction` on the map of that scale from that pose on if a start is given.

    Once more with what shows on the way: without odometry that is unusable, with other stamps, deskewed.
    """
    try:
        result = _run_with(request, progress, lidar_only=request.no_odometry, correction=correction)
    except UnusableOdometry as error:
        warning = RunWarning(
            WarningCode.ODOMETRY_UNUSABLE,
            f"the odometry is ignored: {error}",
            "repair its source, or name another with --odom-topic",
        )
        return _run_with(request, progress, lidar_only=True, warnings=(warning,))
    except LateScans as late:
        result = _run_with(request, progress, lidar_only=False, time_offset=late.option)
        whole = late.with_rest(result.clock_offsets or {})
        warnings = (*result.warnings, *(warning for _, warning in clock_warnings(whole, removed=late.option)))
        return replace(result, warnings=warnings, corrected_offsets=whole)
    except (SweptScans, TurnedLaser) as found:
        better = _again(found, progress, correction)
        return better or _run_with(request, progress, lidar_only=False, time_offset="", correction=correction)
    is_settled = {WarningCode.CLOCK_OFFSET_APPLIED, WarningCode.CLOCK_SET} & {each.code for each in result.warnings}
    if result.mode != "localise" or result.lidar_only or is_settled or not (evidence := result.clock_evidence()).hints:
        return result
    reading = result.reading or request.reading()
    offsets, option = clock_offsets(request, reading, result.summary, deskew=result.deskewed)
    if option is not None:
        warnings = tuple(warning for _, warning in clock_warnings(offsets, removed=option))
        again = _run_with(
            request, progress, lidar_only=False, warnings=warnings, time_offset=option, correction=correction
        )
        if again.clock_evidence().is_better(evidence):
            certain = {topic: offset for topic, offset in offsets.items() if offset.is_certain}
            return replace(again, seconds=_sum(result.seconds, again.seconds), corrected_offsets=certain)
    elif not result.deskewed:
        shown = swept_scans(request, evidence, offsets, mean_fitness(result.diagnostics.fitness))
        if shown is not None and (better := _again(shown, progress, correction)) is not None:
            return better
    return replace(result, clock_offsets=offsets)


def _again(found: SweptScans | TurnedLaser, progress: Report, correction: Correction) -> Result | None:
    def attempt(request: RunRequest, warning: RunWarning) -> Result:
        result = _run_on(request, progress, correction)
        return replace(result, warnings=(*result.warnings, warning))

    if isinstance(found, SweptScans):
        return found.best(attempt, lambda result: mean_fitness(result.diagnostics.fitness))
    result = attempt(found.request, found.warning)
    return result if found.is_mended(result.mounting_error) else None


def _run_with(
    request: RunRequest,
    progress: Report,
    *,
    lidar_only: bool,
    warnings: tuple[RunWarning, ...] = (),
    time_offset: str | None = None,
    correction: Correction = None,
) -> Result:
    begin = time.perf_counter()
    log, reading, of_log = open_as_meant(request, lidar_only, time_offset)
    lidar_only = lidar_only or log.summary.odom_topic is None
    of_reference: list[RunWarning] = []
    reference = None if request.reference is None else read_reference(request.reference, request.logs, of_reference)
    grid, of_map = find_map(request, log)
    state, of_state = load_state(request)
    warnings = (*warnings, *of_log, *of_map, *of_state, *of_reference)
    # Without odometry the map of a log is used where the user asks for it.
    builds = (
        request.mode == "slam"
        or state is not None
        or request.align_to is not None
        or (request.no_odometry and request.map_path is None)
    )
    localise = request.mode == "localise" or (grid is not None and not builds)
    given_resolution, opened = None, time.perf_counter()
    mapper: Mapper | PointMapper | None = None
    if progress is not None:
        progress(Progress("prepare", 0.0, log.summary.duration_s, 0))
    if localise:
        if request.assert_loop or request.forbid_loop:
            raise ConfigError("loops are stated for a map that is built; add --mode slam, or leave them out")
        start, of_start = find_start(request, log, require_map(grid))
        warnings = (*warnings, *of_start)
        if isinstance(correction, tuple):
            scale_before, first_pose = correction
            given_resolution, grid = require_map(grid).resolution, scale_before.applied(require_map(grid))
            start = None if start is None else scale_before.moved(first_pose)
        likelihood = request.config.make_field(require_map(grid))
        localiser = make_localiser(request, require_map(grid), likelihood, start)
        estimator: Estimator = localiser
    else:
        localiser, likelihood = None, None
        estimator = mapper = make_mapper(request, state, lidar_only)
    first = None if lidar_only else first_odometry(log.events())
    # Turns that were joined of segments are known beam by beam; a whole turn is deskewed if the user asks for it.
    preparation = Preparation(
        lidar_only=lidar_only,
        deskewed=request.read.deskew or (log.summary.segments > 1 and not lidar_only),
        body_beams=body_beams(log.events()),
        odometry_correction=correction if isinstance(correction, OdometryScale) else None,
        first=first,
        is_mapped=not localise,
    )
    warnings = (*warnings, *body_warnings(preparation.body_beams))
    prepared = time.perf_counter()
    history = RunHistory(request.config.localiser.smoothing_model() if localise else None)
    recorded = Surroundings(log.events(), preparation)
    events = PreparedEvents(events_of(request, recorded, lidar_only, localise), preparation, log.summary)
    with rarely_collected():
        reported = with_progress(log, events, history, progress)
        for event, estimate in replay(reported, estimator, deskew=preparation.deskewed, first=first):
            history.add(event, estimate)
    replayed = time.perf_counter()
    require_data(request, log, scans=history.scans > 0, odometry=first is not None or lidar_only)
    seconds = {"open": opened - begin, "prepare": prepared - opened, "replay": replayed - prepared}
    of_steps = log.losses.step_warnings(log.summary)
    mapping, true_grid, offsets, is_right = None, None if localise else grid, None, False
    if isinstance(mapper, PointMapper):
        grid = mapper.grid()
    elif mapper is not None:
        if not lidar_only and not of_steps:
            is_first = time_offset is None
            is_right = is_first and require_direction(request, log, reading, history)
            offsets = offsets_of_mapping(request, log, reading, history, deskew=preparation.deskewed, correct=is_first)
        mapping = mapper.finish(share_of(progress, log.summary.duration_s, history.scans))
        grid = mapping.grid
        seconds["finish"] = time.perf_counter() - replayed
    trajectory, localised = history.trajectory() if mapping is None else history.mapped(mapping)
    scale = None if localiser is None else localiser.map_scale
    if scale is not None and isinstance(correction, tuple):
        scale = replace(scale, corrected=correction[0].value)
    mounting, pieces = history.mounting() if localise or not lidar_only else (None, ())
    states = history.states(scale, mounting, pieces, grid) if localise else None
    tracked, localised = localised, localised if states is None else states.is_localised()
    return Result(
        request=request,
        summary=log.summary,
        input_sha256=log.sha256(),
        trajectory=trajectory,
        localised=localised,
        odometry=history.odometry(),
        reference=history.reference() if reference is None else reference,
        grid=require_map(grid),
        diagnostics=history.diagnostics(mapping),
        losses=log.losses,
        warnings=(*log.summary.warnings, *warnings, *recorded.warnings(), *events.warnings(), *of_steps),
        seconds=seconds,
        mode="localise" if localise else "slam",
        mapping=mapping,
        true_grid=true_grid,
        likelihood=likelihood,
        states=states,
        tracked=tracked,
        map_scale=scale,
        odometry_scale=None if localiser is None else localiser.odometry_scale,
        given_resolution=given_resolution,
        mounting_error=mounting,
        yaw_pieces=pieces if localise else (),
        ambiguities=history.ambiguities(states),
        preparation=preparation,
        clock_offsets=offsets,
        reading=reading,
        direction_is_right=is_right,
        log=None if log.is_unpacked else log,
    )
