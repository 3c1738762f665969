"""Beams on a grid of cells: counting their hits and misses, and where each of them ends on a map."""

from __future__ import annotations

from math import ceil, floor, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    U8 = NDArray[np.uint8]
    F32 = NDArray[np.float32]
    I8 = NDArray[np.int8]

FITS, SHORT, THROUGH, UNMAPPED = 0, 1, 2, 3
"""At a wall; in free space, with no wall before it; behind a wall; on an unknown cell or outside the map."""


@njit(cache=True, nogil=True)
def trace(hits: I32, misses: I32, origins: F64, ends: F64, is_hit: U8) -> None:
    """Add beams from `origins` to `ends` (n, 2), in cells (cell [v, u] covers [u, u + 1) x [v, v + 1)).

    The cell of the end counts a hit if `is_hit`, all cells before it a miss each, visited in the order of the
    beam (Amanatides and Woo 1987). A beam without a hit counts misses up to the cell before its end. Cells outside
    are left out; a beam in whose own cell the laser stands counts its hit alone.
    """
    height, width = hits.shape
    for i in range(len(origins)):
        x0 = origins[i, 0]
        y0 = origins[i, 1]
        dx = ends[i, 0] - x0
        dy = ends[i, 1] - y0
        u = floor(x0)
        v = floor(y0)
        u1 = floor(ends[i, 0])
        v1 = floor(ends[i, 1])
        step_u = 1 if dx > 0.0 else -1
        step_v = 1 if dy > 0.0 else -1
        # Parts of the beam until the next line of the grid, and between two lines.
        part_u = 1.0 / abs(dx) if dx != 0.0 else np.inf
        part_v = 1.0 / abs(dy) if dy != 0.0 else np.inf
        next_u = (u + 1 - x0 if dx > 0.0 else x0 - u) * part_u if dx != 0.0 else np.inf
        next_v = (v + 1 - y0 if dy > 0.0 else y0 - v) * part_v if dy != 0.0 else np.inf
        for _ in range(abs(u1 - u) + abs(v1 - v)):
            if 0 <= u < width and 0 <= v < height:
                misses[v, u] += 1
            if next_u < next_v:
                u += step_u
                next_u += part_u
            else:
                v += step_v
                next_v += part_v
        if is_hit[i] and 0 <= u1 < width and 0 <= v1 < height:
            hits[v1, u1] += 1


@njit(cache=True, nogil=True)
def classify_beams(
    cells: I8,
    ends: F64,
    origin: F64,
    scores: F32,
    fits: float,
    margin: float,
    occupied: int,
    classes: I8,
) -> None:
    """Write the class of each beam into `classes` (n,).

    `cells` (h, w) are those of an occupancy grid; `ends` (n, 2) and the `origin` (2,) of the beams are in cells, cell
    [row, column] reaching from (column, row) to (column + 1, row + 1). A beam whose score reaches `fits` ends at a
    wall. Of any other the cells up to `margin` cells before its end are looked at, one step a cell: where one is
    `occupied` or more, the beam went through a wall.
    """
    height = cells.shape[0]
    width = cells.shape[1]
    for i in range(len(ends)):
        if scores[i] >= fits:
            classes[i] = FITS
            continue
        dx = ends[i, 0] - origin[0]
        dy = ends[i, 1] - origin[1]
        length = sqrt(dx * dx + dy * dy)
        reach = length - margin
        steps = ceil(reach) if reach > 0.0 else 0
        through = False
        for k in range(steps):
            part = k / length
            u = floor(origin[0] + part * dx)
            v = floor(origin[1] + part * dy)
            if u >= 0 and v >= 0 and u < width and v < height and cells[v, u] >= occupied:
                through = True
                break
        u = floor(ends[i, 0])
        v = floor(ends[i, 1])
        known = u >= 0 and v >= 0 and u < width and v < height and cells[v, u] >= 0
        if through:
            classes[i] = THROUGH
        elif known:
            classes[i] = SHORT
        else:
            classes[i] = UNMAPPED
