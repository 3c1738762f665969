"""Where a run begins: the pose that was given, the one the log states if it still holds, or unknown."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.errors import MapError
from hsloc.model.events import Odometry
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hsloc.log import Log
    from hsloc.model.events import Event
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2
    from hsloc.request import RunRequest

_STALE_NS = 1_000_000_000
"""A pose stated longer before the first event says nothing any more: the robot has moved on."""
_FARTHEST = 5.0
"""Greatest path length [m] over which odometry carries a pose stated later back to the first event."""
_OUTSIDE = 5.0
"""A start may lie so far outside the map (m): a robot may look into it from a part that was never drawn."""

_GIVE_START = "give the start with --initial-pose"


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
