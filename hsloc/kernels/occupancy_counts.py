"""Counting, for every cell of a grid, how many beams ended in it and how many passed through it."""

from __future__ import annotations

from math import floor
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    U8 = NDArray[np.uint8]


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
