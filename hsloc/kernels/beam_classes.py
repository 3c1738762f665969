"""Where each beam of a scan ends on a map: at a wall, before one, behind one, or where nothing is mapped."""

from __future__ import annotations

from math import ceil, floor, sqrt
from typing import TYPE_CHECKING

from numba import njit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I8 = NDArray[np.int8]

FITS, SHORT, THROUGH, UNMAPPED = 0, 1, 2, 3
"""At a wall; in free space, with no wall before it; behind a wall; on an unknown cell or outside the map."""


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
