"""Worlds from files: a text of segments, the course report's points and waypoints, or a nav2 map.

A map has no waypoints: round trips that keep clear of the walls are planned through it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.errors import ConfigError, no_such
from hsloc.kernels.raycasting import cast_rays
from hsloc.maps import read_map
from hsloc.simulation.built_in import WORLDS, built_in
from hsloc.simulation.rasterise import outline, rasterise
from hsloc.simulation.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid

    Array = NDArray[np.float64]

CLEARANCE = 0.35
"""Minimum distance (m) of the path from every wall."""
GOALS = 8
"""Places that are visited."""
COARSE = 0.15
"""Metres between the places that are considered."""

MAPS = (".yaml", ".yml", ".pgm", ".png", ".bmp")
"""Suffixes of nav2 maps; all else is read as text."""


def plan_round_trip(free: NDArray[np.bool_], grid: OccupancyGrid) -> Array:
    """Waypoints (n, 2) in metres of a closed tour through the `free` cells of `grid`, shape (height, width).

    The places to visit are spread out: each is the one farthest from those before. Between them the path is the
    shortest, where metres near a wall count more. Raises ConfigError where no cell has enough room.
    """
    from scipy.ndimage import distance_transform_edt, label

    room = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * grid.resolution - grid.resolution / 2.0
    stride = max(1, round(COARSE / grid.resolution))
    coarse = room[stride // 2 :: stride, stride // 2 :: stride]
    regions, count = label(coarse >= CLEARANCE)
    if count == 0:
        raise ConfigError(f"world: no free place is {CLEARANCE} m away from every wall; give --waypoints FILE")
    sizes = np.bincount(regions.ravel())[1:]
    rows, columns = np.nonzero(regions == 1 + int(np.argmax(sizes)))
    cells = np.column_stack((columns, rows)) * stride + stride // 2
    points: Array = grid.origin @ np.asarray((cells + 0.5) * grid.resolution, dtype=np.float64)
    paths = _tour(np.column_stack((rows, columns)), coarse[rows, columns], points)
    waypoints = _straightened(paths, cells, room >= CLEARANCE * 0.9)
    return np.asarray(points[waypoints])


def interior(segments: Array, resolution: float = 0.05) -> tuple[NDArray[np.bool_], OccupancyGrid]:
    """The largest space that `segments` (n, 4) enclose, as cells of a grid; where they enclose none, all around."""
    from scipy.ndimage import label

    grid = rasterise(segments, np.empty((0, 2)), resolution, margin=2.0)
    regions, count = label(~grid.occupied())
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    sizes[0] = 0
    outside = int(regions[0, 0])
    if np.count_nonzero(sizes) > 1:
        sizes[outside] = 0
    return regions == int(np.argmax(sizes)), grid


def _tour(nodes: NDArray[np.int64], room: Array, points: Array) -> list[int]:
    """Indices of neighbouring nodes along a closed tour."""
    from scipy.sparse.csgraph import dijkstra

    graph = _graph(nodes, room)
    goals = [int(np.argmax(room))]
    spread = np.hypot(*(points - points[goals[0]]).T)
    while len(goals) < min(GOALS, len(nodes)):
        goals.append(int(np.argmax(spread)))
        spread = np.minimum(spread, np.hypot(*(points - points[goals[-1]]).T))
    costs, previous = dijkstra(graph, indices=goals, return_predecessors=True)
    order, left = [0], list(range(1, len(goals)))
    while left:
        nearest = min(left, key=lambda goal: (costs[order[-1], goals[goal]], goal))
        order.append(nearest)
        left.remove(nearest)
    tour: list[int] = []
    for here, there in zip(order, [*order[1:], order[0]], strict=True):
        leg, node = [], goals[there]
        while node != goals[here]:
            leg.append(node)
            node = int(previous[here, node])
        tour += [goals[here], *leg[:0:-1]]
    return tour


def _graph(nodes: NDArray[np.int64], room: Array) -> Any:
    """Edges between the eight neighbours; a metre costs more, the less room there is."""
    from scipy.sparse import coo_array

    shape = nodes.max(axis=0) + 3
    numbers = np.full(shape, -1)
    numbers[nodes[:, 0] + 1, nodes[:, 1] + 1] = np.arange(len(nodes))
    starts, ends, costs = [], [], []
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = numbers[nodes[:, 0] + 1 + dr, nodes[:, 1] + 1 + dc]
        start = np.flatnonzero(other >= 0)
        starts.append(start)
        ends.append(other[start])
        tight = np.minimum(np.minimum(room[start], room[other[start]]), 1.0)
        costs.append(np.hypot(dr, dc) * (1.0 + 0.5 / tight))
    data = (np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends)))
    half = coo_array(data, shape=(len(nodes), len(nodes))).tocsr()
    return half + half.T


def _straightened(tour: list[int], cells: NDArray[np.int64], clear: NDArray[np.bool_]) -> list[int]:
    """The corners of a tour: as far ahead as one can go straight over `clear` cells, but not over 4 m at a time."""
    kept, at = [tour[0]], 0
    while at < len(tour) - 1:
        ahead = min(at + 25, len(tour) - 1)
        while ahead > at + 1 and not _is_clear(cells[tour[at]], cells[tour[ahead]], clear):
            ahead -= 1
        kept.append(tour[ahead])
        at = ahead
    return kept


def _is_clear(start: NDArray[np.int64], end: NDArray[np.int64], clear: NDArray[np.bool_]) -> bool:
    steps = 2 * int(np.abs(end - start).max()) + 1
    line = np.round(start + np.linspace(0.0, 1.0, steps)[:, None] * (end - start)).astype(int)
    return bool(clear[line[:, 1], line[:, 0]].all())


def load_world(source: str | Path, waypoints: str | Path | None = None) -> World:
    """A built-in world by name, or one from a file.

    The file is a nav2 map (`.yaml`: the borders of its occupied cells become walls), or a text of numbers, a row
    a line, separated by blanks or commas, `#` for comments: four columns are segments x0 y0 x1 y1, two are
    points seen through walls, all in metres. `waypoints` is such a text of two columns, and replaces the world's;
    it is a closed tour where the last point is the first. Without it a tour is planned, but for points.
    Raises ConfigError, or MapError for a map that cannot be read.
    """
    path = Path(source)
    if str(source).replace("_", "-") in WORLDS and not path.is_file():
        world = built_in(str(source))
    elif not path.exists():
        raise ConfigError(f"world {str(source)!r} is neither built in ({', '.join(WORLDS)}) nor a file")
    elif path.suffix.lower() in MAPS:
        world = _from_map(path)
    else:
        world = _from_text(path, is_route_given=waypoints is not None)
    return world if waypoints is None else _with_waypoints(world, Path(waypoints))


def read_rows(path: Path, columns: tuple[int, ...]) -> Array:
    """Numbers of a text file, shape (n, c), c one of `columns`. A first line of words is a heading.

    Raises ConfigError naming file and line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise ConfigError(no_such(path)) from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}); give a file of numbers") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            if rows or number > 1:
                raise ConfigError(f"{path}, line {number}: {line.strip()!r} is not a row of numbers") from None
            continue
        if len(row) not in columns or (rows and len(row) != len(rows[0])):
            wanted = " or ".join(map(str, columns)) if not rows else str(len(rows[0]))
            raise ConfigError(f"{path}, line {number}: {len(row)} numbers, but {wanted} are wanted")
        if not np.isfinite(row).all():
            raise ConfigError(f"{path}, line {number}: {line.strip()!r} has a number that is not finite")
        rows.append(row)
    if not rows:
        raise ConfigError(f"{path}: holds no numbers; give a row x y, or x0 y0 x1 y1, on each line")
    return np.array(rows, dtype=np.float64)


def _from_text(path: Path, is_route_given: bool) -> World:
    rows = read_rows(path, (2, 4))
    if rows.shape[1] == 2:
        if not is_route_given:
            raise ConfigError(f"{path}: a world of points has no walls to plan a way between; give --waypoints FILE")
        return World(path.stem, np.empty((0, 4)), np.zeros((2, 2)), points=rows, start_heading=0.0)
    # with a route given, a planned one would be thrown away
    tour = np.zeros((2, 2)) if is_route_given else plan_round_trip(*interior(rows))
    return World(path.stem, rows, tour, closed=True)


def _from_map(path: Path) -> World:
    loaded = read_map(path)
    grid = loaded.grid
    height, width = grid.cells.shape
    # a rim of open cells, so that occupied cells at the edge of the map have a border as well
    occupied = np.pad(grid.occupied(), 1)
    xs, ys = (np.arange(-1, count + 2) * grid.resolution for count in (width, height))
    corners = outline(occupied, xs, ys).reshape(-1, 2)
    segments = np.asarray(grid.origin @ corners).reshape(-1, 4)
    return World(
        path.stem, segments, plan_round_trip(grid.free(), grid), closed=True, grid=grid, warnings=loaded.warnings
    )


def _with_waypoints(world: World, path: Path) -> World:
    waypoints = read_rows(path, (2,))
    closed = len(waypoints) > 2 and bool((waypoints[0] == waypoints[-1]).all())
    waypoints = waypoints[:-1] if closed else waypoints
    if len(waypoints) < 2:
        raise ConfigError(f"{path}: {len(waypoints)} waypoint; a way needs two at least")
    result = replace(world, waypoints=waypoints, closed=closed)
    legs = result.path()
    delta = np.diff(legs, axis=0)
    lengths = np.hypot(*delta.T)
    if not (lengths > 1e-3).all():
        at = int(np.argmin(lengths))
        raise ConfigError(f"{path}: waypoints {at + 1} and {at + 2} are the same place; leave one out")
    clear = cast_rays(legs[:-1].copy(), delta / lengths[:, None], world.segments, np.empty((0, 3)))
    if (clear < lengths).any():
        leg = int(np.argmax(clear < lengths))
        raise ConfigError(f"{path}: the way from waypoint {leg + 1} to the next runs into a wall; lead it around")
    return result
