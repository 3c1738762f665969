"""The map and the start of a run: as users name them, as the log states them, or unknown.

A map is a results folder, a map.yaml, the map.npz of a mapping run, or in the log. The start is the pose that was
given, the one the log states if it still holds, or unknown.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import log
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import LogError, MapError
from hsloc.maps import map_file, read_map, read_metadata
from hsloc.model.events import Odometry
from hsloc.model.pose2 import Pose2
from hsloc.replay.matched_scans import are_matched, is_lost, mean_fitness
from hsloc.slam.map_state import STATE_FILE, fingerprint, read_state
from hsloc.slam.parameters import Resume
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from hsloc.config import Config
    from hsloc.localisation.map_scale import MapScale
    from hsloc.log import Log, LogSummary
    from hsloc.matching.match import Matcher
    from hsloc.model.estimate import ScanDiagnostics
    from hsloc.model.events import Event
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.trajectory import Trajectory
    from hsloc.request import RunRequest
    from hsloc.slam.map_state import MapState

_MAP_TYPES = ("nav_msgs/msg/OccupancyGrid", "foxglove.Grid")
_HEAD = 4096
_STALE_NS = 1_000_000_000
"""A pose stated longer before the first event says nothing any more: the robot has moved on."""
_FARTHEST = 5.0
"""Greatest path length [m] over which odometry carries a pose stated later back to the first event."""
_OUTSIDE = 5.0
"""A start may lie so far outside the map (m): a robot may look into it from a part that was never drawn."""
_CHORD_M, _SPACING_M = 3.0, 0.5
"""Path length of a chord whose lengths by matches and by odometry are compared, and of two beginnings (m): matches are
off by 1 to 2 cm."""
_FITNESS_NOISE = 0.01
"""Mean fitness of two runs on the same map differs by less: that of a scan scatters by 0.02 (localisation/gates.py)."""
_GIVE_START = "give the start with --initial-pose"


def map_files(path: Path) -> list[Path]:
    """The files that a map consists of: its YAML and its picture, or its map.npz."""
    file = map_file(path)
    return [file] if file.suffix == ".npz" else [file, read_metadata(file).image]


def state_file(path: Path) -> Path:
    """The file meant by --resume: beside map.yaml, or in a folder of results."""
    if path.is_dir():
        return path / STATE_FILE
    return path.with_name(STATE_FILE) if path.suffix == ".yaml" else path


def maps_beside(log: Path) -> list[Path]:
    """Maps of nav2 in the folder of a log, by name: what a user may have meant, but has not said."""
    folder = log if log.is_dir() else log.parent
    try:
        return [path for path in sorted(folder.glob("*.yaml")) if _is_map(path)]
    except OSError:
        return []


def _is_map(path: Path) -> bool:
    with path.open("rb") as stream:
        head = stream.read(_HEAD).decode(errors="replace")
    return all(re.search(rf"^{key}\s*:", head, re.MULTILINE) for key in ("image", "resolution", "origin"))


def unread_maps(summary: LogSummary) -> list[str]:
    """Topics of maps in a log that gave none: not to be decoded, or several without one being /map."""
    topics = [f"{t.topic} ({t.typename})" for t in summary.topics if t.typename in _MAP_TYPES and t.count]
    return topics if len(topics) < 2 else [f"any of {', '.join(topics)}, of which none is /map"]


def load_grid(path: Path) -> tuple[OccupancyGrid, tuple[RunWarning, ...]]:
    """The grid to localise in, and warnings. Raises MapError."""
    file = map_file(path)
    if file.suffix == ".npz":
        return read_state(file).grid, ()
    loaded = read_map(file)
    return loaded.grid, loaded.warnings


def read_saved_map(path: Path) -> MapState:
    """The saved map of a mapping run: its folder of results, or the map.npz in it. Raises MapError."""
    file = state_file(path)
    if not file.exists():
        raise MapError(f"{path}: no {STATE_FILE} there; give the results of a run that built its map")
    return read_state(file)


def resumed(state: MapState, config: Config, matcher: Matcher, begin: Pose2 | None = None) -> Resume:
    """A saved map to go on from, with the field to search it by; `begin` is the first pose in it, if that is known."""
    return Resume(state, config.make_field(state.grid), matcher, config.localiser.relocaliser, begin)


def load_state(request: RunRequest) -> tuple[MapState | None, tuple[RunWarning, ...]]:
    """The saved map that is to be extended, if one is, and warnings. Raises MapError."""
    path = request.resume
    if path is None:
        return None, ()
    file = state_file(path)
    state = read_saved_map(path)
    if state.fingerprint != fingerprint(request.mapping()):
        text = f"{file}: built with other parameters of the mapper; those of this run are used from here on"
        return state, (RunWarning(WarningCode.MAP_PARAMETERS_DIFFER, text),)
    return state, ()


def find_map(request: RunRequest, log: Log) -> tuple[OccupancyGrid | None, tuple[RunWarning, ...]]:
    """The map that is given or that the log carries, and warnings."""
    if request.map_path is not None:
        return load_grid(request.map_path)
    grid = log.map()
    if grid is not None:
        return grid, ()
    unread = unread_maps(log.summary)
    beside = maps_beside(request.logs[0])
    given = str(beside[0]) if beside else "map.yaml"
    what = f"cannot use {unread[0]}" if unread else "the log has no /map"
    if request.mode == "localise":
        raise MapError(f"{request.logs[0]}: {what}; give one with --map {given}")
    if request.mode == "slam" or request.resume is not None or not (unread or beside):
        return None, ()
    remedy = f"to localise on a map give it with --map {given}"
    remedy += "" if not beside[1:] else f" (also there: {', '.join(p.name for p in beside[1:])})"
    return None, (RunWarning(WarningCode.MAP_NOT_USED, f"{what}, so a map is built", remedy),)


def require_map(grid: OccupancyGrid | None) -> OccupancyGrid:
    """The map. Raises MapError where there is none."""
    if grid is None:
        raise MapError("no map to localise in")
    return grid


def find_start(request: RunRequest, log: Log, grid: OccupancyGrid) -> tuple[Pose2 | None, tuple[RunWarning, ...]]:
    """T_map_base at the first event, None if it is unknown; and warnings.

    Raises MapError for a start that is not on the map, and for an unknown one on a map that offers no place.
    """
    warnings: tuple[RunWarning, ...] = ()
    start, stated_by = request.initial_pose, "--initial-pose"
    if start is None and not request.unknown_start:
        start, warnings = _stated(request, log)
        stated_by = f"{request.logs[0]}: the start that the log states"
    if start is None:
        if not grid.free().any():
            raise MapError(
                "the map has no free cell, so an unknown start cannot be searched for; "
                "give --initial-pose, or check free_thresh and negate in the map's YAML"
            )
    elif not _is_on(grid, start):
        x0, y0, x1, y1 = grid.bounds()
        remedy = "correct it" if request.initial_pose is not None else "give the log's map, or --unknown-start"
        raise MapError(
            f"{stated_by}, ({start.x:g}, {start.y:g}), is not on the map, which spans x from {x0:g} to {x1:g} "
            f"and y from {y0:g} to {y1:g}; {remedy}"
        )
    return start, warnings


def first_odometry(events: Iterable[Event]) -> Pose2 | None:
    """T_odom_base of the first odometry message."""
    return next((event.T_odom_base for event in events if isinstance(event, Odometry)), None)


def _stated(request: RunRequest, log: Log) -> tuple[Pose2 | None, tuple[RunWarning, ...]]:
    stated = log.initial_pose()
    if stated is None:
        return None, ()
    stamp_ns, T_map_base = stated
    begin_ns = log.summary.origin_ns + round(max(request.read.start_s or 0.0, 0.0) * 1e9)
    if stamp_ns < begin_ns - _STALE_NS:
        age = (begin_ns - stamp_ns) / 1e9
        text = (
            f"the log states an initial pose {age:.1f} s before the first event; it is not used, the start is unknown"
        )
        return None, (RunWarning(WarningCode.START_STALE, text, _GIVE_START),)
    if stamp_ns <= begin_ns + _STALE_NS:
        return T_map_base, ()
    back = _way_back(log.events(), stamp_ns)
    if back is None:
        late = (stamp_ns - begin_ns) / 1e9
        text = (
            f"the log states an initial pose {late:.1f} s after the first event, after the robot moved; it is not used"
        )
        return None, (RunWarning(WarningCode.START_LATE, text, _GIVE_START),)
    return T_map_base @ back, ()


def _way_back(events: Iterable[Event], stamp_ns: int) -> Pose2 | None:
    """The first odometry seen from that at a stamp; None where the way between is too long, or has no end."""
    first: Pose2 | None = None
    last: Pose2 | None = None
    way = 0.0
    for event in events:
        if not isinstance(event, Odometry):
            continue
        if first is None or last is None:
            first = event.T_odom_base
        else:
            way += last.distance(event.T_odom_base)
        last = event.T_odom_base
        if way > _FARTHEST:
            return None
        if event.stamp_ns >= stamp_ns:
            return last.between(first)
    return None


def _is_on(grid: OccupancyGrid, pose: Pose2) -> bool:
    """Whether a pose lies on the grid, or not far beside it."""
    local = grid.origin.inverse() @ pose
    height, width = grid.cells.shape
    return bool(
        -_OUTSIDE <= local.x <= width * grid.resolution + _OUTSIDE
        and -_OUTSIDE <= local.y <= height * grid.resolution + _OUTSIDE
    )


def require_data(request: RunRequest, log: Log, *, scans: bool, odometry: bool) -> None:
    """Raise LogError where a run had no scans, or no odometry, that could be read."""
    is_cut, lost = request.read.start_s is not None or request.read.end_s is not None, log.losses.as_cause()
    for is_there, name, topic, remedy in (
        (scans, "scan", log.summary.scan_topic, ""),
        (odometry, "odometry", log.summary.odom_topic, "; the scans alone can do: --no-odom"),
    ):
        if not is_there:
            where = "between --start and --end" if is_cut else f"on {topic} that could be read"
            raise LogError(f"{request.logs[0]}: no {name} {where}{lost}{remedy}")


@dataclass(frozen=True, slots=True)
class ScaleEvidence:
    """What the result of a localiser shows of the scale of its map.

    `fitness` is the mean of the matched scans; `by_odometry` is the length of its way by that of the odometry, NaN if
    that is not known; `is_lost` says that most scans found no match. `start` is T_map_base at the first message of the
    odometry, by the first match: a start that is given was weighed against it.
    """

    scale: MapScale | None
    fitness: float
    by_odometry: float
    is_lost: bool
    start: Pose2

    @classmethod
    def of(
        cls, scale: MapScale | None, scans: ScanDiagnostics, odometry: Trajectory, trajectory: Trajectory
    ) -> ScaleEvidence:
        """Of a localiser's result with one pose for each message of the odometry."""
        matched = are_matched(scans.status)
        fitness = mean_fitness(scans.fitness[matched])
        k = 0
        if matched.any():
            first = np.searchsorted(odometry.stamps_ns, scans.stamps_ns[np.argmax(matched)], side="right")
            k = min(int(first), len(odometry) - 1)
        there, odom, begin = (
            Pose2.from_array(pose) for pose in (trajectory.poses[k], odometry.poses[k], odometry.poses[0])
        )
        ratio = _length_ratio(trajectory, odometry)
        return cls(scale, fitness, ratio, is_lost(scans.status), there @ odom.between(begin))

    @property
    def hints(self) -> bool:
        """Whether map and lidar differ beyond doubt, so that it is worth while to replay on a corrected map."""
        scale = self.scale
        return scale is not None and scale.is_significant and (scale.by_fit or not self.is_lost)

    def fits_as(self, before: ScaleEvidence) -> bool:
        """Whether the scans of this run fit as well as those of one before, but for noise."""
        return not self.is_lost and self.fitness > before.fitness - _FITNESS_NOISE

    def is_better(self, before: ScaleEvidence) -> bool:
        """Whether the map was wrong, by this run on the corrected one.

        Its scans fit better than `before`, and nothing is left of the error. Lidar and map alone do not tell which of
        them is wrong, so the odometry has to measure lengths more like the lidar than like the map. Lengths of `before`
        do not show it: scans that fit nowhere put poses up to 0.3 m aside.
        """
        if self.scale is None or before.scale is None or self.scale.is_doubted:
            return False
        if self.is_lost or not self.by_odometry > 0.0:
            return False
        from_lidar = log(self.by_odometry)
        agrees = abs(from_lidar) < abs(from_lidar + log(before.scale.value))
        return agrees and self.fitness > before.fitness


def _length_ratio(trajectory: Trajectory, odometry: Trajectory) -> float:
    """Median of the lengths of chords of a trajectory by those of the odometry; NaN for a robot that hardly moved."""
    steps = np.hypot(*np.diff(odometry.poses[:, :2], axis=0).T)
    way = np.concatenate(((0.0,), np.cumsum(steps)))
    begins = np.arange(0.0, way[-1] - _CHORD_M, _SPACING_M)
    first, last = np.searchsorted(way, begins), np.searchsorted(way, begins + _CHORD_M)
    ours, theirs = (np.hypot(*(each.poses[last] - each.poses[first])[:, :2].T) for each in (trajectory, odometry))
    straight = theirs > 0.5 * _CHORD_M
    return float(np.median(ours[straight] / theirs[straight])) if straight.any() else float("nan")
