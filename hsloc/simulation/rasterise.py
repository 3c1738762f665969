"""From line segments to cells, and from cells to line segments."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError
from hsloc.model import OccupancyGrid, Pose2
from hsloc.model.occupancy_grid import FREE, OCCUPIED, UNKNOWN

if TYPE_CHECKING:
    from numpy.typing import NDArray

ON_BORDER = 1e-6
"""A wall this close to a border between cells (as a fraction of a cell) lies on it, and occupies both sides:
any choice of one side would shift the map by half a cell."""

MAX_CELLS = 100_000_000


def crossed_cells(segment: NDArray[np.float64]) -> NDArray[np.int64]:
    """Cells (column, row) that a segment x0 y0 x1 y1 passes through, shape (n, 2), in units of cells.

    Exact: the segment is cut wherever it crosses a line of the grid, and each piece lies in one cell or, where it
    runs along a border, in the cells on both sides.
    """
    start, delta = segment[:2], segment[2:] - segment[:2]
    cuts = [np.array((0.0, 1.0))]
    for axis in (0, 1):
        if delta[axis] != 0.0:
            low, high = sorted((start[axis], start[axis] + delta[axis]))
            lines = np.arange(np.ceil(low), np.floor(high) + 1.0)
            cuts.append((lines - start[axis]) / delta[axis])
    where = np.unique(np.clip(np.concatenate(cuts), 0.0, 1.0))
    middles = np.concatenate(((0.0, 1.0), (where[:-1] + where[1:]) / 2.0))
    points = start + middles[:, None] * delta
    corners = [(dx, dy) for dx in (-ON_BORDER, ON_BORDER) for dy in (-ON_BORDER, ON_BORDER)]
    cells = np.concatenate([np.floor(points + np.array(corner)) for corner in corners]).astype(np.int64)
    return np.unique(cells, axis=0)


def rasterise(
    segments: NDArray[np.float64],
    inside: NDArray[np.float64],
    resolution: float,
    margin: float = 0.5,
) -> OccupancyGrid:
    """The exact map of `segments`, shape (n, 4), in metres.

    Occupied: every cell through which a wall passes. Free: what can be reached from the points `inside`, shape
    (m, 2), without crossing an occupied cell. Unknown: all else. The grid's origin is a multiple of `resolution`.
    Raises ConfigError for a map of too many cells.
    """
    from scipy.ndimage import label

    shapes = np.concatenate((segments[:, :2], segments[:, 2:], inside))
    first = np.floor((shapes.min(axis=0) - margin) / resolution)
    columns, rows = (np.ceil((shapes.max(axis=0) + margin) / resolution) - first).astype(int)
    if rows * columns > MAX_CELLS:
        raise ConfigError(f"map_resolution {resolution} makes a map of {columns} x {rows} cells; choose it coarser")
    cells = np.full((rows, columns), UNKNOWN, dtype=np.int8)
    for segment in segments / resolution - np.tile(first, 2):
        crossed = crossed_cells(segment)
        cells[crossed[:, 1], crossed[:, 0]] = OCCUPIED
    regions, _ = label(cells != OCCUPIED)
    seeds = np.floor(inside / resolution - first).astype(int)
    reached = np.unique(regions[seeds[:, 1], seeds[:, 0]])
    cells[np.isin(regions, reached[reached > 0])] = FREE
    return OccupancyGrid(cells, resolution, Pose2(float(first[0]) * resolution, float(first[1]) * resolution))


def outline(solid: NDArray[np.bool_], xs: NDArray[np.float64], ys: NDArray[np.float64]) -> NDArray[np.float64]:
    """The borders between solid and open cells as segments x0 y0 x1 y1, shape (n, 4), straight runs joined.

    `solid` has shape (len(ys) - 1, len(xs) - 1); `xs` and `ys` are the coordinates of the lines between cells.
    What lies beyond the array is left out.
    """
    segments: list[tuple[float, float, float, float]] = []
    # a border above row j lies between rows j and j + 1; a run goes on while the same side is solid
    for j, border in enumerate(np.diff(solid.astype(np.int8), axis=0)):
        segments += [(xs[a], ys[j + 1], xs[b], ys[j + 1]) for a, b in _runs(border)]
    for i, border in enumerate(np.diff(solid.astype(np.int8), axis=1).T):
        segments += [(xs[i + 1], ys[a], xs[i + 1], ys[b]) for a, b in _runs(border)]
    return np.array(segments, dtype=np.float64).reshape(-1, 4)


def _runs(values: NDArray[np.int8]) -> list[tuple[int, int]]:
    """Half-open index ranges over which `values` is constant and not zero."""
    edges = np.flatnonzero(np.diff(values)) + 1
    bounds = [0, *edges.tolist(), len(values)]
    return [(a, b) for a, b in pairwise(bounds) if a < b and values[a] != 0]
