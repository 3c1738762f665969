"""Plan a path through a world without waypoints: round trips that keep clear of the walls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.errors import ConfigError
from hsloc.simulation.rasterise import rasterise

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
