"""Exact Euclidean distances to the occupied cells of a grid, in two passes (Meijster, Roerdink, Hesselink 2000).

First along the columns, then row by row: of the whole map only the column distances are kept in memory, 2 bytes a
cell where they fit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    B = NDArray[np.bool_]
    Integers = NDArray[np.uint16] | NDArray[np.int32]
    I64 = NDArray[np.int64]


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
