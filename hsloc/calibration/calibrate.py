"""From a log to its calibration: passes over the log until its scans are deskewed by what they say themselves.

What the odometry is compared with is the laser's own path through the log, from its scans alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.calibration.estimator import Track, Undetermined, estimate
from hsloc.errors import LogError, TopicError
from hsloc.localisation.localiser import Localiser
from hsloc.log import open_log
from hsloc.model.calibration import Calibration, LidarCalibration, corrected_odometry
from hsloc.model.estimate import Status
from hsloc.model.events import Odometry, PairedScan, Scan
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.options import AUTO
from hsloc.preprocessing.odometry import ContinuousOdometry
from hsloc.preprocessing.scans import half_sweep_ns, pair
from hsloc.replay.clock_offset import open_as_meant
from hsloc.replay.engine import replay
from hsloc.replay.map_and_start import find_start, load_grid
from hsloc.slam.laser_odometry import with_laser_odometry
from hsloc.slam.mapper import Mapper

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.calibration.estimator import Estimate
    from hsloc.config import Config
    from hsloc.log import Log, LogSummary
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.model.events import Event
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.request import RunRequest
    from hsloc.warnings import RunWarning

    Poses = tuple[NDArray[np.int64], NDArray[np.float64]]
    """Stamps (n,) in nanoseconds and poses (n, 3)."""


_MOST_PASSES = 6
"""Passes over a log; each one deskews by the estimate of the one before."""
_SETTLED = 0.25
"""Change of each value in standard deviations with which the passes end. Internal: it is then lost in the noise."""
_WORSE = 1.2
"""Ratio of what is left of the steps, from which on a pass made it worse. Internal: beyond its variation by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class LogCalibration:
    """What a log says of one lidar and the odometry.

    `time_offset_s` is to be added to the stamps of `topic`. `nominal` is the mounting that the log states, which holds
    where `estimate` determines none. `passes` is how often the log was read.
    """

    topic: str
    estimate: Estimate
    time_offset_s: float
    nominal: Pose2
    summary: LogSummary
    passes: int
    warnings: tuple[RunWarning, ...] = ()
    """Of the log and the map."""
    wheels: tuple[float, float] | None = None
    """Radius and track (m) that were assumed, where the odometry is that of wheels."""

    def calibration(self) -> Calibration:
        """What replaces the log's values; what is not determined keeps its value."""
        found = self.estimate
        mounting = found.T_base_laser if found.determined[3:6].any() else None
        offset = self.time_offset_s if found.determined[6] else 0.0
        return Calibration(found.correction, ((self.topic, LidarCalibration(mounting, offset)),))


def calibrate(request: RunRequest, progress: Callable[[int, float], None] | None = None) -> LogCalibration:
    """Calibrate the odometry and the lidar of a log, the one of `scan_topic` where it has several.

    With a `map_path` the scans are localised on that map, else they are mapped. `progress` is called with the pass,
    from 1, and the part of it that is done. Raises LogError where the log does not hold what is compared, TopicError
    as `open_log`, MapError for a map or a start that cannot be used.
    """
    paths, options = request.logs, request.reading()
    first, chosen, of_log = open_as_meant(request, lidar_only=True)
    options = replace(chosen, time_offset=options.time_offset)
    summary = first.summary
    topics = (summary.scan_topic or "").split(",")
    if len(topics) > 1:
        raise TopicError(
            f"{paths[0]}: several lidars ({', '.join(topics)}); they are calibrated one at a time, as with "
            f"--scan-topic {topics[0]}"
        )
    topic = topics[0].partition(" + ")[0]
    # As if the laser stood at the origin of the base: what is mapped then is its own path.
    at_origin = Calibration(lidars=((topic, LidarCalibration(IDENTITY)),))
    given = None if options.time_offset == AUTO else options.time_offset
    reading = replace(options, calibration=at_origin, laser_pose=None)
    begin, span = summary.start_ns, max(summary.end_ns - summary.start_ns, 1)
    nominal = options.laser_pose or summary.T_base_laser
    on_map, of_map = _given_map(request, first, nominal)
    found: Estimate | None = None
    offset_s = 0.0
    for number in range(1, _MOST_PASSES + 1):

        def report(stamp_ns: int, number: int = number) -> None:
            if progress is not None:
                progress(number, min(max((stamp_ns - begin) / span, 0.0), 1.0))

        items = [] if given is None else [given]
        if found is not None:
            items.append(f"{topic}={offset_s!r}")
        log = open_log(paths, replace(reading, time_offset=",".join(items) or None))
        try:
            seen = tracks(log.events(), request.config, found, report, on_map)
            now = estimate(seen.laser, seen.odometry, nominal)
        except Undetermined as error:
            raise LogError(f"{paths[0]}: nothing can be calibrated: {error}") from None
        if found is not None and now.residual_rad > _WORSE * found.residual_rad:
            # The times of the beams are wrong: deskewed by them, scans fit less well than as they are.
            now, number = found, number - 1
            break
        settled = found is not None and _is_settled(found, now)
        found = now
        offset_s -= float(now.values[6])
        if settled or not seen.is_swept:
            break
    warnings = (*summary.warnings, *of_log, *of_map)
    return LogCalibration(topic, now, offset_s, nominal, summary, number, warnings, options.wheel_size())


def _given_map(request: RunRequest, log: Log, nominal: Pose2) -> tuple[GivenMap | None, tuple[RunWarning, ...]]:
    """The map that was named, if one was, where the laser begins on it, and warnings."""
    if request.map_path is None:
        return None, ()
    grid, of_grid = load_grid(request.map_path)
    start, of_start = find_start(request, log, grid)
    likelihood = request.config.make_field(grid)
    return GivenMap(grid, likelihood, None if start is None else start @ nominal), (*of_grid, *of_start)


def _is_settled(before: Estimate, now: Estimate) -> bool:
    """Whether a pass changed nothing that counts; each pass finds what is left of the time offset."""
    change = np.abs(now.values - before.values)
    change[6] = abs(now.values[6])
    return bool(np.all(change[now.determined] <= _SETTLED * now.sigmas[now.determined]))


@dataclass(frozen=True, slots=True, eq=False)
class GivenMap:
    """A map in which the laser is localised, its field, and where the laser is at the first event; None if unknown."""

    grid: OccupancyGrid
    likelihood: LikelihoodField
    T_map_laser: Pose2 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """The laser's poses in a map, and the odometry as the log has it.

    The laser's stamps are those of the middle of each sweep, or, of deskewed scans, of the first beam. `is_swept` says
    whether the beams of a scan have times of their own.
    """

    laser: Track
    odometry: Track
    is_swept: bool


def tracks(
    events: Iterable[Event],
    config: Config,
    known: Estimate | None = None,
    progress: Callable[[int], None] | None = None,
    given: GivenMap | None = None,
) -> Tracks:
    """Map a log without its odometry, or localise its scans in a map, in the frame of the laser.

    The scans of `events` must be mounted at the origin. `known` is a calibration by which scans are deskewed; its time
    offset is part of the stamps already. `progress` is called with stamps (ns). Raises Undetermined where there is
    nothing to compare.
    """
    odometry: list[tuple[int, float, float, float]] = []
    is_swept = False
    middles: dict[int, int] = {}

    def scans() -> Iterator[PairedScan]:
        nonlocal is_swept
        for event in _paired(_noted(events, odometry), known):
            scan = event.scan
            is_swept |= scan.time_increment != 0.0
            middles[scan.stamp_ns] = scan.stamp_ns + (0 if scan.T_base_beam is not None else half_sweep_ns(scan))
            yield event
            if progress is not None:
                progress(scan.stamp_ns)

    at, poses = _mapped(scans(), config) if given is None else _localised(scans(), config, given)
    if len(odometry) < 2:
        raise Undetermined("there is no odometry")
    if len(poses) < 2:
        raise Undetermined("the scans show no motion" if given is None else "the scans do not fit the map")
    stamps = np.array([middles[stamp] for stamp in at.tolist()], dtype=np.int64)
    return Tracks(
        Track.of(stamps, poses),
        Track.of(np.array([row[0] for row in odometry], dtype=np.int64), np.array([row[1:] for row in odometry])),
        is_swept,
    )


def _mapped(scans: Iterable[PairedScan], config: Config) -> Poses:
    """The keyscans of a map that is built of the scans alone."""
    mapper = Mapper(replace(config.graph_mapper, use_odometry=False), np.random.default_rng(0))
    for event in scans:
        mapper.update(event)
    found = mapper.finish()
    return found.keyscan_stamps_ns, found.keyscan_poses


def _localised(scans: Iterable[PairedScan], config: Config, given: GivenMap) -> Poses:
    """The scans that were matched with the map, predicted from scan to scan."""
    localiser = Localiser.from_parameters(
        given.grid,
        given.likelihood,
        config.make_matcher(),
        config.localiser,
        np.random.default_rng(0),
        given.T_map_laser,
    )
    moving = with_laser_odometry(
        (event.scan for event in scans), config.graph_mapper.front_end, np.random.default_rng(1)
    )
    rows = [
        (estimate.stamp_ns, *estimate.T_map_base.to_array())
        for event, estimate in replay(moving, localiser)
        if isinstance(event, PairedScan) and estimate is not None and estimate.status is Status.MATCHED
    ]
    return np.array([row[0] for row in rows], dtype=np.int64), np.array([row[1:] for row in rows]).reshape(-1, 3)


def _noted(events: Iterable[Event], odometry: list[tuple[int, float, float, float]]) -> Iterator[Event]:
    """Scans and odometry, the latter kept in `odometry`."""
    for event in ContinuousOdometry(events):
        if isinstance(event, Odometry):
            pose = event.T_odom_base
            odometry.append((event.stamp_ns, pose.x, pose.y, pose.theta))
            yield event
        elif isinstance(event, Scan):
            yield event


def _paired(events: Iterable[Event], known: Estimate | None) -> Iterator[PairedScan]:
    """The scans, in the frame of the laser as their base; deskewed by what is known of the motion."""
    if known is None:
        yield from (PairedScan(event, IDENTITY) for event in events if isinstance(event, Scan))
        return
    mounting = known.T_base_laser
    of_laser = (
        replace(event, T_odom_base=event.T_odom_base @ mounting) if isinstance(event, Odometry) else event
        for event in corrected_odometry(events, known.correction)
    )
    yield from (event for event in pair(of_laser, deskew=True) if isinstance(event, PairedScan))
