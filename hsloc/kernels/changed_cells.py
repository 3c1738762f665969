"""Cells of a map that scans saw free, and in which their beams ended: counted by scans, not by beams.

Many beams of one scan meet what is near. Counted by scans, a person who walks past stays one of many who saw the place.
"""

from __future__ import annotations

from math import floor, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    B = NDArray[np.bool_]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    I64 = NDArray[np.int64]
    U16 = NDArray[np.uint16]

ACROSS = 0.34
"""Sine of the angle, 20 deg, from which on a beam leads across a wall: within it, an error of the pose of 5 cm moves
the place where it meets the wall by more than the tolerance."""


@njit(cache=True, nogil=True)
def count_scan(
    number: int, ended: tuple[U16, U16], seen: tuple[U16, U16], origin: F64, ends: F64, is_hit: B, margin: float
) -> None:
    """Count one scan in each of the cells (h, w) in which a beam ended, and in each that it saw: ended or passed in.

    Beams lead from `origin` (2,) to `ends` (n, 2), in cells (cell [v, u] covers [u, u + 1) x [v, v + 1)), and end there
    if `is_hit` (n,). A beam says nothing of the last `margin` cells of its length but the one in which it ends. `ended`
    and `seen` are pairs: the count of scans, and the `number` of the last one, from 1 on.
    """
    height, width = ended[0].shape
    cells = np.empty((2 * (height + width) + 4, 2), dtype=np.int64)
    for i in range(len(ends)):
        passed = _walk(origin, ends[i], margin, height, width, cells)
        u, v = floor(ends[i, 0]), floor(ends[i, 1])
        if is_hit[i] and 0 <= u < width and 0 <= v < height:
            cells[passed, 0], cells[passed, 1] = v, u
            passed += 1
            if ended[1][v, u] != number:
                ended[1][v, u] = number
                ended[0][v, u] += 1
        for k in range(passed):
            v, u = cells[k, 0], cells[k, 1]
            if seen[1][v, u] != number:
                seen[1][v, u] = number
                seen[0][v, u] += 1


@njit(cache=True, nogil=True)
def count_beams(labels: I32, along: F64, origin: F64, ends: F64, margin: float, ended: I64, crossed: I64) -> None:
    """Add the beams that end in each label's cells to `ended` (k,), and those that lead across them to `crossed` (k,).

    `labels` (h, w) are 0 where there is none, else from 1 to k - 1; the others as for `count_scan`. What is long and
    thin has a unit vector in `along` (k, 2), else zeros: a beam that leads along it does not count, for it may miss it
    by the error of its pose.
    """
    height, width = labels.shape
    cells = np.empty((2 * (height + width) + 4, 2), dtype=np.int64)
    for i in range(len(ends)):
        dx, dy = ends[i, 0] - origin[0], ends[i, 1] - origin[1]
        length = sqrt(dx * dx + dy * dy)
        before = 0
        for k in range(_walk(origin, ends[i], margin, height, width, cells)):
            label = labels[cells[k, 0], cells[k, 1]]
            if label != before and label != 0:
                is_thin = along[label, 0] != 0.0 or along[label, 1] != 0.0
                if not is_thin or abs(dx * along[label, 1] - dy * along[label, 0]) >= ACROSS * length:
                    crossed[label] += 1
            before = label
        u, v = floor(ends[i, 0]), floor(ends[i, 1])
        if 0 <= u < width and 0 <= v < height:
            ended[labels[v, u]] += 1


@njit(cache=True, nogil=True)
def _walk(origin: F64, end: F64, margin: float, height: int, width: int, cells: I64) -> int:
    """Write row and column of the cells that a beam passes, but for the last `margin`, in the order of the beam.

    Cells outside are left out. The number of cells is returned (Amanatides and Woo 1987).
    """
    dx, dy = end[0] - origin[0], end[1] - origin[1]
    length = sqrt(dx * dx + dy * dy)
    if length <= margin:
        return 0
    last = 1.0 - margin / length
    u, v = floor(origin[0]), floor(origin[1])
    step_u = 1 if dx > 0.0 else -1
    step_v = 1 if dy > 0.0 else -1
    # Parts of the beam until the next line of the grid, and between two lines.
    part_u = 1.0 / abs(dx) if dx != 0.0 else np.inf
    part_v = 1.0 / abs(dy) if dy != 0.0 else np.inf
    next_u = (u + 1 - origin[0] if dx > 0.0 else origin[0] - u) * part_u if dx != 0.0 else np.inf
    next_v = (v + 1 - origin[1] if dy > 0.0 else origin[1] - v) * part_v if dy != 0.0 else np.inf
    count = 0
    at = 0.0
    while at < last:
        if 0 <= u < width and 0 <= v < height:
            if count == len(cells) - 1:
                return count
            cells[count, 0], cells[count, 1] = v, u
            count += 1
        if next_u < next_v:
            at = next_u
            u += step_u
            next_u += part_u
        else:
            at = next_v
            v += step_v
            next_v += part_v
    return count
