"""All headings and places of a map against one scan, by branch and bound: the boxes of poses that can be fit enough.

The headings are halved depth first, the places breadth first: for one interval of headings the scan is turned once, and
each point becomes a rectangle of whole entries that is moved over all boxes of places that are left, one look-up each
(Hess et al. 2016, with intervals of headings in place of single ones). At coarse levels near points are put together.
Places are squares of 2^level entries of the pyramid (hsloc/kernels/box_bounds.py).
"""

from __future__ import annotations

from math import cos, floor, pi, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.kernels.box_bounds import Pyramid

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    I64 = NDArray[np.int64]
    U8 = NDArray[np.uint8]
    B = NDArray[np.bool_]

_LOOK = 8
_MARGIN = 0.02
"""Cells by which a rectangle is widened for the rounding of float32 on maps of up to 4 x 10^4 cells a side."""


class Clusters(NamedTuple):
    """Points put together for each level, those of level k in rows `starts[k]` to `starts[k + 1]`."""

    rows: F64
    """x, y, radius in cells, and how many points."""
    starts: I64


class OpenSquares(NamedTuple):
    """Which squares hold a place that counts: (x, y) of level k in `cells[starts[k] + y * widths[k] + x]`."""

    cells: B
    starts: I64
    widths: I64


class LookUps(NamedTuple):
    """Room for the look-ups of one bound."""

    entries: I64
    weights: I64
    rest: I64
    offsets: I32


@njit(cache=True, nogil=True)
def _turned(
    rows: F64, theta: float, half_theta: float, extent: float, pyramid: Pyramid, look_ups: LookUps
) -> tuple[int, int, int, int, int]:
    """Look-ups for boxes of places of side `extent` (cells), by their first entry (y, x).

    Cluster i looks up the flat table at `entries[i] + y * width + x`; `rest[i]` is 255 times the points from the i-th
    look-up on. A cluster that no table is large enough for needs none: it always counts in full.
    Returns the number of look-ups, and the range y_low, y_high, x_low, x_high for which all lie in the tables.
    """
    entries, weights, rest, offsets = look_ups
    height = pyramid.tables.shape[1]
    width = pyramid.tables.shape[2]
    step = 1 << pyramid.shift
    c = cos(theta)
    s = sin(theta)
    across = sin(half_theta)
    inwards = 0.5 * (1.0 - cos(half_theta))
    y_low = x_low = -(1 << 30)
    y_high = x_high = 1 << 30
    kept = 0
    full = 0
    for i in range(len(rows)):
        rx = c * rows[i, 0] - s * rows[i, 1]
        ry = s * rows[i, 0] + c * rows[i, 1]
        reach_u = abs(ry) * across + abs(rx) * inwards + rows[i, 2] + _MARGIN
        reach_v = abs(rx) * across + abs(ry) * inwards + rows[i, 2] + _MARGIN
        u = rx - rx * inwards
        v = ry - ry * inwards
        u0 = floor((u - reach_u) / step)
        v0 = floor((v - reach_v) / step)
        u1 = floor((floor(u + reach_u + extent) + 1.0) / step)
        v1 = floor((floor(v + reach_v + extent) + 1.0) / step)
        size = max(u1 - u0, v1 - v0) + 1
        weight = int(rows[i, 3])
        if size >= len(pyramid.smallest):
            full += 255 * weight
            continue
        u0 += pyramid.border
        v0 += pyramid.border
        offsets[kept, 0] = pyramid.smallest[size]
        offsets[kept, 1] = v0
        offsets[kept, 2] = u0
        entries[kept] = (pyramid.smallest[size] * height + v0) * width + u0
        weights[kept] = weight
        y_low = max(y_low, -v0)
        y_high = min(y_high, height - 1 - v0)
        x_low = max(x_low, -u0)
        x_high = min(x_high, width - 1 - u0)
        kept += 1
    rest[kept] = full
    for i in range(kept - 1, -1, -1):
        rest[i] = rest[i + 1] + 255 * weights[i]
    return kept, y_low, y_high, x_low, x_high


@njit(cache=True, nogil=True)
def _steps(flat: U8, entries: I64, weights: I64, rest: I64, n: int, at: int, limit: int) -> int:
    """255 times the bound of one box of places, or -1 once it cannot exceed `limit`."""
    total = 0
    start = 0
    while start < n:
        end = min(start + _LOOK, n)
        for i in range(start, end):
            total += weights[i] * np.int64(flat[np.uint64(entries[i] + at)])
        start = end
        if total + rest[start] <= limit:
            return -1
    return int(total + rest[n])


@njit(cache=True, nogil=True)
def _steps_at_border(tables: U8, offsets: I32, weights: I64, rest: I64, n: int, y: int, x: int, limit: int) -> int:
    """As `_steps`, where some look-ups lie outside the tables: there the score is 0."""
    total = rest[n]
    for i in range(n):
        v = offsets[i, 1] + y
        u = offsets[i, 2] + x
        if 0 <= v < tables.shape[1] and 0 <= u < tables.shape[2]:
            total += weights[i] * np.int64(tables[offsets[i, 0], v, u])
    return total if total > limit else -1


@njit(cache=True, nogil=True)
def _add(totals: I32, row: U8, stride: int, weight: int) -> None:
    if stride == 1:  # by itself, so that a processor adds many at once
        for x in range(len(totals)):
            totals[x] += np.int32(weight) * np.int32(row[x])
        return
    for x in range(len(totals)):
        totals[x] += np.int32(weight) * np.int32(row[x * stride])


@njit(cache=True, nogil=True)
def _bound_row(by_phase: U8, skipped: int, offsets: I32, weights: I64, n: int, y: int, side: int, totals: I32) -> None:
    """255 times the bounds of a whole row of boxes of places of `side` entries.

    `by_phase[k, p, q, j, i]` is entry (j step + p, i step + q) of table k + `skipped`, and `side` is a multiple of the
    step: boxes side by side look up neighbours in memory, or those `stride` apart.
    """
    step = by_phase.shape[1]
    rows = by_phase.shape[3]
    columns = by_phase.shape[4]
    stride = side // step
    for i in range(n):
        v = offsets[i, 1] + y * side
        u = offsets[i, 2]
        row = v // step
        column = u // step
        if row < 0 or row >= rows:
            continue
        begin = max(0, -(column // stride))
        end = min(len(totals), -((column - columns) // stride))
        if begin < end:
            _add(
                totals[begin:end],
                by_phase[offsets[i, 0] - skipped, v - row * step, u - column * step, row, column + begin * stride :],
                stride,
                weights[i],
            )


@njit(cache=True, nogil=True)
def _grown(array: I32, count: int) -> I32:
    if count < len(array):
        return array
    larger = np.empty((2 * len(array), array.shape[1]), dtype=array.dtype)
    larger[:count] = array[:count]
    return larger


@njit(cache=True, nogil=True)
def fit_boxes(
    pyramid: Pyramid,
    by_phase: U8,
    clusters: Clusters,
    open_squares: OpenSquares,
    half_thetas: F64,
    needed: float,
    max_boxes: int,
    max_results: int,
) -> tuple[F64, int, bool]:
    """The boxes of the finest level whose bound exceeds `needed` (a sum of scores).

    `half_thetas[k]` is half the interval of headings at level k, that of the coarsest level divides the turn.
    `by_phase` are the last of the tables, those of squares that are larger than its step; the coarsest level needs no
    others.
    Returns rows (x, y, theta, half, half, half_theta, bound) in cells, the boxes bounded, and whether it came to its
    end within `max_boxes` and `max_results`.
    """
    is_open, open_starts, open_widths = open_squares
    coarsest = len(half_thetas) - 1
    step = 1 << pyramid.shift
    skipped = len(pyramid.tables) - len(by_phase)
    limit = floor(255.0 * needed)
    largest = 0
    for k in range(coarsest + 1):
        largest = max(largest, clusters.starts[k + 1] - clusters.starts[k])
    entries = np.empty(largest, dtype=np.int64)
    weights = np.empty(largest, dtype=np.int64)
    rest = np.empty(largest + 1, dtype=np.int64)
    offsets = np.empty((largest, 3), dtype=np.int32)
    look_ups = LookUps(entries, weights, rest, offsets)
    flat = pyramid.tables.reshape(-1)
    table_width = pyramid.tables.shape[2]
    results = np.empty((256, 7), dtype=np.float64)
    found = 0
    boxes = 0
    # One list of squares for each level; `first[k]` is where the list of level k begins in the common stack.
    squares = np.empty((4096, 2), dtype=np.int32)
    first = np.zeros(coarsest + 3, dtype=np.int64)
    turn = np.zeros(coarsest + 1, dtype=np.int64)
    totals = np.empty(open_widths[coarsest], dtype=np.int32)
    coarsest_height = (open_starts[coarsest - 1] - open_starts[coarsest]) // open_widths[coarsest]
    turns = round(pi / half_thetas[coarsest])
    for top in range(turns):
        level = coarsest
        turn[level] = top
        first[level + 1] = 0
        first[level] = 0
        while level <= coarsest:
            # Bound the squares of this level for this interval of headings.
            theta = -pi + (2.0 * turn[level] + 1.0) * half_thetas[level]
            rows = clusters.rows[clusters.starts[level] : clusters.starts[level + 1]]
            extent = float(step << level)
            n, y_low, y_high, x_low, x_high = _turned(rows, theta, half_thetas[level], extent, pyramid, look_ups)
            width = open_widths[level]
            end = open_starts[level - 1] if level > 0 else len(is_open)
            count = first[level]
            if level == coarsest:
                for y in range(coarsest_height):
                    totals[:] = rest[n]
                    _bound_row(by_phase, skipped, offsets, weights, n, y, 1 << level, totals)
                    boxes += width
                    for x in range(width):
                        if totals[x] > limit and is_open[open_starts[level] + y * width + x]:
                            squares = _grown(squares, count)
                            squares[count, 0] = y
                            squares[count, 1] = x
                            count += 1
            for index in range(first[level + 1], first[level]):
                for k in range(4):
                    y = squares[index, 0] * 2 + (k >> 1)
                    x = squares[index, 1] * 2 + (k & 1)
                    if x >= width:
                        continue
                    at = open_starts[level] + y * width + x
                    if at >= end or not is_open[at]:
                        continue
                    boxes += 1
                    v = y << level
                    u = x << level
                    if y_low <= v <= y_high and x_low <= u <= x_high:
                        total = _steps(flat, entries, weights, rest, n, v * table_width + u, limit)
                    else:
                        total = _steps_at_border(pyramid.tables, offsets, weights, rest, n, v, u, limit)
                    if total <= limit:
                        continue
                    if level > 0:
                        squares = _grown(squares, count)
                        squares[count, 0] = y
                        squares[count, 1] = x
                        count += 1
                        continue
                    if found == len(results):
                        if found >= max_results:
                            return results, boxes, False
                        larger = np.empty((2 * found, 7), dtype=np.float64)
                        larger[:found] = results
                        results = larger
                    results[found, 0] = (x + 0.5) * step
                    results[found, 1] = (y + 0.5) * step
                    results[found, 2] = theta
                    results[found, 3] = results[found, 4] = 0.5 * step
                    results[found, 5] = half_thetas[0]
                    results[found, 6] = total / 255.0
                    found += 1
            if boxes > max_boxes:
                return results[:found], boxes, False
            if level > 0 and count > first[level]:
                level -= 1
                turn[level] = 2 * turn[level + 1]
                first[level] = count
                continue
            # Up until an interval has a second half.
            while level <= coarsest and (level == coarsest or turn[level] % 2 == 1):
                level += 1
            if level <= coarsest:
                turn[level] += 1
    return results[:found], boxes, True


@njit(cache=True, nogil=True)
def sampled_bounds(pyramid: Pyramid, rows: F64, places: I64, level: int, half_theta: float) -> tuple[F64, I64]:
    """For each cluster by how much it lowers the bound of a box on the average, and 255 times the bounds.

    The boxes are k that hold the entries `places` (k, 2; v, u), with all headings. Clusters that lower the bound most
    are looked up first, so that most boxes are ruled out after a few look-ups.
    """
    step = 1 << pyramid.shift
    extent = float(step << level)
    n = len(rows)
    loss = np.zeros(n, dtype=np.float64)
    bounds = np.zeros(len(places), dtype=np.int64)
    entries = np.empty(n, dtype=np.int64)
    weights = np.empty(n, dtype=np.int64)
    rest = np.empty(n + 1, dtype=np.int64)
    offsets = np.empty((n, 3), dtype=np.int32)
    look_ups = LookUps(entries, weights, rest, offsets)
    for k in range(len(places)):
        theta = 2.0 * pi * ((k * 0.6180339887498949) % 1.0)
        y = places[k, 0] >> level << level
        x = places[k, 1] >> level << level
        for i in range(n):
            kept, _, _, _, _ = _turned(rows[i : i + 1], theta, half_theta, extent, pyramid, look_ups)
            bound = rest[0]
            if kept == 1:
                bound = _steps_at_border(pyramid.tables, offsets, weights, rest, 1, y, x, -1)
                loss[i] += rest[0] - bound
            bounds[k] += bound
    return loss, bounds
