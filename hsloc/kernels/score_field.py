"""Score fields: of a whole map, and of one that grows scan by scan.

A score is exp(-d / sigma), d being the distance to the nearest occupied cell or point.

Of a whole map the exact Euclidean distances are found in two passes (Meijster, Roerdink, Hesselink 2000): first along
the columns, then row by row. Only the column distances of the whole map are kept in memory, 2 bytes a cell where they
fit.

In a map that grows a further point can only raise the field, so it is added by taking the maximum over its
neighbourhood. Nothing is computed twice and no distance transform is needed. All lengths are in cells, as in
hsloc/kernels/fitness.py.
"""

from __future__ import annotations

from math import cos, exp, hypot, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from hsloc.kernels.fitness import pack

if TYPE_CHECKING:
    from numpy.typing import NDArray

    B = NDArray[np.bool_]
    Integers = NDArray[np.uint16] | NDArray[np.int32]
    I64 = NDArray[np.int64]
    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]

_EMPTY = -(1 << 62)
"""A column of cells that no point lies in."""
_STEPS = 64
"""Entries of the decay table per squared cell."""


@njit(cache=True, nogil=True)
def column_distances(occupied: B, far: int, distances: Integers) -> None:
    """Write the distance in cells from each cell of (h, w) to the nearest occupied one of its column.

    It is `far` where the column has none; `far` must be at least h + w, and fit the type of `distances`.
    """
    height, width = occupied.shape
    for u in range(width):
        distances[0, u] = 0 if occupied[0, u] else far
    for v in range(1, height):
        for u in range(width):
            distances[v, u] = 0 if occupied[v, u] else min(distances[v - 1, u] + 1, far)
    for v in range(height - 2, -1, -1):
        for u in range(width):
            distances[v, u] = min(distances[v, u], distances[v + 1, u] + 1)


@njit(cache=True, nogil=True)
def squared_distances(distances: Integers) -> I64:
    """Squared distance in cells to the nearest occupied cell, from rows (k, w) of the column distances."""
    rows, width = distances.shape
    result = np.empty((rows, width), dtype=np.int64)
    apex = np.empty(width, dtype=np.int64)
    begin = np.empty(width, dtype=np.int64)
    for v in range(rows):
        # The lower envelope of the parabolas (u - q)^2 + g(q)^2, from the left: which q is lowest from where on.
        last = 0
        apex[0] = 0
        begin[0] = 0
        for u in range(1, width):
            g = np.int64(distances[v, u])
            while last >= 0:
                q = apex[last]
                at = begin[last]
                if (at - q) ** 2 + np.int64(distances[v, q]) ** 2 > (at - u) ** 2 + g * g:
                    last -= 1
                else:
                    break
            if last < 0:
                last = 0
                apex[0] = u
                begin[0] = 0
                continue
            q = apex[last]
            h = np.int64(distances[v, q])
            start = 1 + (u * u - q * q + g * g - h * h) // (2 * (u - q))
            if start < width:
                last += 1
                apex[last] = u
                begin[last] = start
        for u in range(width - 1, -1, -1):
            q = apex[last]
            h = np.int64(distances[v, q])
            result[v, u] = (u - q) ** 2 + h * h
            if u == begin[last]:
                last -= 1
    return result


@njit(cache=True, nogil=True)
def decay_table(sigma: float, radius: float) -> F32:
    """exp(-sqrt(q / 64) / sigma) for q = 0, 1, ... up to radius^2 * 64: an exponential by look-up."""
    n = int(radius * radius * _STEPS) + 2
    table = np.empty(n, dtype=np.float32)
    for q in range(n):
        table[q] = exp(-sqrt(q / _STEPS) / sigma)
    return table


@njit(cache=True, nogil=True)
def splat(scores: F32, packed: F32, points: F32, table: F32, radius: float, known: float) -> int:
    """Add points (n, 2) to `scores` (h, w) and bring `packed` (h - 1, w - 1, 4) up to date around them.

    `table` is `decay_table(sigma, radius)`; a node farther than `radius` from a point is not touched. A point whose
    nearest node already scores more than `known` is passed over: the map has it. Points outside are
    left out. Returns the number of points added.
    """
    height, width = scores.shape
    reach = int(radius) + 1
    added = 0
    steps = np.float32(_STEPS)
    limit = np.float32(radius * radius)
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        if not (x > reach and y > reach and x < width - 2 - reach and y < height - 2 - reach):
            continue
        iu = int(x + np.float32(0.5))
        iv = int(y + np.float32(0.5))
        if scores[iv, iu] > known:
            continue
        added += 1
        for v in range(iv - reach, iv + reach + 1):
            dy = np.float32(v) - y
            for u in range(iu - reach, iu + reach + 1):
                dx = np.float32(u) - x
                squared = dx * dx + dy * dy
                if squared <= limit:
                    score = table[int(squared * steps)]
                    scores[v, u] = max(scores[v, u], score)
        pack(scores, packed, iv - reach - 1, iv + reach + 1, iu - reach - 1, iu + reach + 1)
    return added


@njit(cache=True, nogil=True)
def thinned_cloud(points: F32, start: I64, poses: F64, max_range: float, cell: float, cloud: F64) -> int:
    """Write the hits of n scans at `poses` (n, 3) to `cloud`, the first in each cell of side `cell`; returns how many.

    Scan k has the `points` start[k] to start[k + 1] (m, 2); those farther than `max_range` from the pose are left out.
    """
    slots = 1024
    while slots < 2 * len(points):
        slots *= 2
    table = np.full((slots, 2), _EMPTY, dtype=np.int64)
    count = 0
    for k in range(len(poses)):
        c = cos(poses[k, 2])
        s = sin(poses[k, 2])
        for i in range(start[k], start[k + 1]):
            px = np.float64(points[i, 0])
            py = np.float64(points[i, 1])
            if not hypot(px, py) < max_range:
                continue
            x = poses[k, 0] + c * px - s * py
            y = poses[k, 1] + s * px + c * py
            u = np.int64(np.floor(x / cell))
            v = np.int64(np.floor(y / cell))
            slot = (u * 73856093 ^ v * 19349663) & (slots - 1)
            while table[slot, 0] != _EMPTY and (table[slot, 0] != u or table[slot, 1] != v):
                slot = (slot + 1) & (slots - 1)
            if table[slot, 0] == _EMPTY:
                table[slot, 0] = u
                table[slot, 1] = v
                cloud[count, 0] = x
                cloud[count, 1] = y
                count += 1
    return count
