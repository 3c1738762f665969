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
from typing import TYPE_CHECKING, NamedTuple

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
    U8 = NDArray[np.uint8]

_EMPTY = -(1 << 62)
"""A column of cells that no point lies in."""
_STEPS = 64
"""Entries of the decay table per squared cell."""
_BLOCK = 16
"""Cells along a block. Internal: time."""
_RINGS = 64
"""Rings of cells that are looked at before blocks. Internal: time."""


@njit(cache=True, nogil=True)
def column_distances(occupied: B, margin: int, far: int, distances: Integers) -> None:
    """Write the distance in cells from each cell of (h, w) to the nearest occupied one of its column.

    `occupied` is (h - 2 margin, w - 2 margin): the `margin` cells on each side are free. The distance is `far` where
    the column has no occupied cell; `far` must be at least h + w, and fit the type of `distances`.
    """
    height, width = distances.shape
    rows, columns = occupied.shape
    for u in range(width):
        distances[0, u] = far
        if margin == 0 and occupied[0, u]:
            distances[0, u] = 0
    for v in range(1, height):
        is_within = margin <= v < rows + margin
        for u in range(width):
            if is_within and margin <= u < columns + margin and occupied[v - margin, u - margin]:
                distances[v, u] = 0
            else:
                distances[v, u] = min(distances[v - 1, u] + 1, far)
    for v in range(height - 2, -1, -1):
        for u in range(width):
            distances[v, u] = min(distances[v, u], distances[v + 1, u] + 1)


@njit(cache=True, nogil=True)
def wall_distances(occupied: B, points: F64, distances: F64) -> None:
    """Write the distance in cells from each point (n, 2) to the nearest centre of an occupied cell to `distances` (n,).

    Points are (column, row), whole numbers being the centres of cells. Infinite where no cell is occupied.
    """
    height, width = occupied.shape
    # Far from walls whole blocks of cells are passed over: rings of cells alone grow with the square of the distance.
    blocks = np.zeros((0, 0), dtype=np.bool_)
    for k in range(len(points)):
        x = points[k, 0]
        y = points[k, 1]
        # Square rings around the cell of the grid that is nearest to the point.
        u = int(min(max(np.floor(x + 0.5), 0.0), width - 1.0))
        v = int(min(max(np.floor(y + 0.5), 0.0), height - 1.0))
        best = np.inf
        for ring in range(min(max(u, width - 1 - u, v, height - 1 - v), _RINGS) + 1):
            # No centre in the ring is nearer than this.
            if ring - 0.5 > best:
                break
            for row in range(max(v - ring, 0), min(v + ring, height - 1) + 1):
                step = 1 if abs(row - v) == ring else max(2 * ring, 1)
                for column in range(u - ring, u + ring + 1, step):
                    if 0 <= column < width and occupied[row, column]:
                        best = min(best, hypot(column - x, row - y))
        if best > _RINGS + 0.5:
            if blocks.size == 0:
                blocks = _occupied_blocks(occupied)
            best = _among_blocks(occupied, blocks, x, y, best)
        distances[k] = best


@njit(cache=True, nogil=True)
def _occupied_blocks(occupied: B) -> B:
    """Which blocks of `_BLOCK` by `_BLOCK` cells have an occupied one."""
    height, width = occupied.shape
    blocks = np.zeros(((height + _BLOCK - 1) // _BLOCK, (width + _BLOCK - 1) // _BLOCK), dtype=np.bool_)
    for row in range(height):
        for column in range(width):
            if occupied[row, column]:
                blocks[row // _BLOCK, column // _BLOCK] = True
    return blocks


@njit(cache=True, nogil=True)
def _among_blocks(occupied: B, blocks: B, x: float, y: float, best: float) -> float:
    """The smaller of `best` and the distance from (x, y) to the nearest centre of an occupied cell, by blocks."""
    height, width = occupied.shape
    rows, columns = blocks.shape
    for i in range(rows):
        below = max(i * _BLOCK - y, y - (min((i + 1) * _BLOCK, height) - 1), 0.0)
        if below >= best:
            continue
        for j in range(columns):
            beside = max(j * _BLOCK - x, x - (min((j + 1) * _BLOCK, width) - 1), 0.0)
            if not blocks[i, j] or hypot(below, beside) >= best:
                continue
            for row in range(i * _BLOCK, min((i + 1) * _BLOCK, height)):
                for column in range(j * _BLOCK, min((j + 1) * _BLOCK, width)):
                    if occupied[row, column]:
                        best = min(best, hypot(column - x, row - y))
    return best


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
    """exp(-sqrt(q / 64) / sigma) for q = 0, 1, ... up to radius^2 * 64, then a zero: an exponential by look-up."""
    n = int(radius * radius * _STEPS) + 2
    table = np.zeros(n + 1, dtype=np.float32)
    for q in range(n):
        table[q] = exp(-sqrt(q / _STEPS) / sigma)
    return table


@njit(cache=True, nogil=True)
def bounds(points: F64) -> tuple[float, float, float, float]:
    """Least x and y, and largest x and y of points (n, 2), n at least 1."""
    low_x = high_x = points[0, 0]
    low_y = high_y = points[0, 1]
    for i in range(1, len(points)):
        low_x = min(low_x, points[i, 0])
        high_x = max(high_x, points[i, 0])
        low_y = min(low_y, points[i, 1])
        high_y = max(high_y, points[i, 1])
    return low_x, low_y, high_x, high_y


class GrowingField(NamedTuple):
    """Scores on the nodes of a map that grows; in this module because its type decides whether a kernel is cached."""

    scores: F32
    """Shape (h, w)."""
    stale: U8
    """Which tiles of 8 x 8 nodes changed since they were packed; node [v, u] lies in [(v + v0) // 8, (u + u0) // 8]."""
    corner: I64
    """Node [0, 0], counted in nodes from the origin of the map, (u, v): `u0` and `v0` are its remainders by 8."""
    resolution: float
    """Distance of two nodes [m]."""


@njit(cache=True, nogil=True)
def splat(field: GrowingField, points: F64, table: F32, radius: float, known: float) -> int:
    """Add points (n, 2), in metres in the map, to the scores.

    `table` is `decay_table(sigma, radius)`; a node farther than `radius` from a point is not touched. A point whose
    nearest node already scores more than `known` is passed over: the map has it. Points outside are
    left out. Returns the number of points added.
    """
    scores = field.scores
    stale = field.stale
    height, width = scores.shape
    u0 = field.corner[0] % 8
    v0 = field.corner[1] % 8
    reach = int(radius) + 1
    added = 0
    steps = np.float32(_STEPS)
    limit = np.float32(radius * radius)
    beyond = np.int32(len(table) - 1)
    width_of_row = 2 * reach + 1
    squared_dx = np.empty(width_of_row, dtype=np.float32)
    for i in range(len(points)):
        x = np.float32(points[i, 0] / field.resolution - field.corner[0])
        y = np.float32(points[i, 1] / field.resolution - field.corner[1])
        if not (x > reach and y > reach and x < width - 2 - reach and y < height - 2 - reach):
            continue
        iu = int(x + np.float32(0.5))
        iv = int(y + np.float32(0.5))
        if scores[iv, iu] > known:
            continue
        added += 1
        for k in range(width_of_row):
            dx = np.float32(iu - reach + k) - x
            squared_dx[k] = dx * dx
        for v in range(iv - reach, iv + reach + 1):
            dy = np.float32(v) - y
            squared_dy = dy * dy
            row = scores[v, iu - reach : iu + reach + 1]
            # Without a branch: the compiler makes vector instructions of it.
            for k in range(width_of_row):
                squared = squared_dx[k] + squared_dy
                at = np.int32(squared * steps) if squared <= limit else beyond
                row[k] = max(row[k], table[np.uint32(at)])
        for v in range((iv - reach + v0) >> 3, ((iv + reach + v0) >> 3) + 1):
            for u in range((iu - reach + u0) >> 3, ((iu + reach + u0) >> 3) + 1):
                stale[v, u] = 1
    return added


@njit(cache=True, nogil=True)
def pack_stale(field: GrowingField, packed: F32) -> None:
    """Bring `packed` (h - 1, w - 1, 4) up to date where the scores have changed."""
    height, width = field.scores.shape
    u0 = field.corner[0] % 8
    v0 = field.corner[1] % 8
    rows, columns = field.stale.shape
    for v in range(rows):
        for u in range(columns):
            if field.stale[v, u]:
                field.stale[v, u] = 0
                # The squares that have one of the tile's nodes as a corner.
                low_v = max(8 * v - v0 - 1, 0)
                low_u = max(8 * u - u0 - 1, 0)
                high_v = min(8 * v - v0 + 8, height - 1)
                high_u = min(8 * u - u0 + 8, width - 1)
                pack(field.scores, packed, low_v, high_v, low_u, high_u)


@njit(cache=True, nogil=True)
def mean_score(field: GrowingField, points: F64, pose: F64) -> float:
    """The `fitness` of points (n, 2), in metres, at a pose (x, y in nodes of the field, theta), without packing it."""
    scores = field.scores
    height, width = scores.shape
    limit_u = np.float32(width - 1)
    limit_v = np.float32(height - 1)
    zero = np.float32(0.0)
    c = np.float32(cos(pose[2]))
    s = np.float32(sin(pose[2]))
    x32 = np.float32(pose[0])
    y32 = np.float32(pose[1])
    total = np.float64(0.0)
    for i in range(len(points)):
        px = np.float32(points[i, 0] / field.resolution)
        py = np.float32(points[i, 1] / field.resolution)
        u = x32 + c * px - s * py
        v = y32 + s * px + c * py
        if u >= zero and u < limit_u and v >= zero and v < limit_v:
            iu = np.int32(u)
            iv = np.int32(v)
            fu = u - np.float32(iu)
            fv = v - np.float32(iv)
            a = scores[iv, iu]
            b = scores[iv, iu + 1] - a
            d = scores[iv + 1, iu + 1] - scores[iv + 1, iu] - b
            total += np.float64(a + fu * b + fv * ((scores[iv + 1, iu] - a) + fu * d))
    return total / max(len(points), 1)


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
