"""Beams of a scan: their hits and misses on a grid of cells, where each ends on a map, and what their walls hold.

What a matched scan says about the pose is the information of point-to-wall distances, 3 x 3. The direction in which a
point is held is the normal of the wall that the *scan* shows, as in Censi (2007), "An accurate closed-form estimate of
ICP's covariance". The gradient of a map's field would not do: along a wall that is oblique to the cells it alternates
from cell to cell, and its square passes for information along the wall (3 % of that across it at 3 deg, 28 % at
35 deg). Nor would each point's own normal: its noise passes for information in the same way.

Points of a wall in one row of cells err together, because the map has it in whole cells: m points of one row have the
covariance `point_variance I + wall_variance 1 1^T`, whose inverse is written out (Sherman and Morrison).
"""

from __future__ import annotations

from math import ceil, cos, floor, sin, sqrt
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
    I64 = NDArray[np.int64]

FITS, SHORT, THROUGH, UNMAPPED = 0, 1, 2, 3
"""At a wall; in free space, with no wall before it; behind a wall; on an unknown cell or outside the map."""

MOST_NEIGHBOURS = 12
"""Points on each side of one that its wall is fitted to, at most."""
SPAN = 0.25
"""A wall is fitted to the points within this distance on each side (m)."""
FEWEST_POINTS = 5
"""Points that a wall is fitted to, at least: fewer have no reliable normal."""
SAME_WALL = 0.97
"""Cosine of the largest angle between a point's normal and the mean normal of its wall: 14 deg."""
DOUBTFUL_WEIGHT = 20.0
"""A wall seen on this many cells counts by half: what is seen on a few cells may be a door or an object."""
_COLUMNS = 1 << 40
"""Rows and columns of cells are distinguished by an offset larger than any map."""


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
def count_seen(
    counts: I32, work: tuple[I32, I32], points: F64, pose: tuple[float, ...], origin: tuple[float, float], side: float
) -> None:
    """Add one to each of the cells of side `side` (m) that a scan saw: a beam passed through it, or ended in it.

    `points` (n, 2) are seen from `pose`: x, y (m), cosine and sine of the heading; the laser is at `origin` (m).
    `work` is two arrays as large as `counts`.
    """
    hits, misses = work
    height, width = counts.shape
    x, y, c, s = pose
    origins, ends = np.empty_like(points), np.empty_like(points)
    u0 = u1 = origin[0] / side
    v0 = v1 = origin[1] / side
    for i in range(len(points)):
        ends[i, 0] = (x + c * points[i, 0] - s * points[i, 1]) / side
        ends[i, 1] = (y + s * points[i, 0] + c * points[i, 1]) / side
        origins[i, 0] = origin[0] / side
        origins[i, 1] = origin[1] / side
        u0, u1 = min(u0, ends[i, 0]), max(u1, ends[i, 0])
        v0, v1 = min(v0, ends[i, 1]), max(v1, ends[i, 1])
    # A scan reaches a small part of a map: only the rectangle around its beams is cleared and counted.
    rows = slice(min(max(floor(v0), 0), height), max(min(floor(v1) + 1, height), 0))
    columns = slice(min(max(floor(u0), 0), width), max(min(floor(u1) + 1, width), 0))
    hits[rows, columns] = 0
    misses[rows, columns] = 0
    trace(hits, misses, origins, ends, np.ones(len(points), dtype=np.uint8))
    for v in range(rows.start, rows.stop):
        for u in range(columns.start, columns.stop):
            if hits[v, u] + misses[v, u] > 0:
                counts[v, u] += 1


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


@njit(cache=True, nogil=True)
def look_up(values: F32, points: F64, pose: F64, cell: float, outside: float, found: F32) -> None:
    """Write the value of the cell that each of the points (n, 2), seen from `pose` (3,), lies in to `found` (n,).

    `values` (h, w) are those of cells of side `cell` (m) from the origin on; points beyond them get `outside`.
    """
    height, width = values.shape
    c = cos(pose[2])
    s = sin(pose[2])
    for i in range(len(points)):
        u = floor((pose[0] + c * points[i, 0] - s * points[i, 1]) / cell)
        v = floor((pose[1] + s * points[i, 0] + c * points[i, 1]) / cell)
        found[i] = values[v, u] if 0 <= u < width and 0 <= v < height else np.float32(outside)


@njit(cache=True, nogil=True)
def wall_normals(points: F64, max_gap: float, noise_variance: float, normals: F64) -> None:
    """Write the unit normal of the wall of each of the points (n, 2), in the order of the beams, into `normals` (n, 2).

    A wall is fitted to each point and its neighbours by total least squares. Neighbours count within `SPAN`, and as
    long as each is within `max_gap` metres, plus a tenth of its distance from the origin, of the next. Then the points
    of a run whose normals agree take their mean. A point without a wall gets (0, 0): too few neighbours are near, or
    they scatter across the line by more than a third of their spread along it, `noise_variance` (m^2) allowed for.
    """
    n = len(points)
    for i in range(n):
        _fit(points, i, max_gap, noise_variance, normals)
    start = 0
    while start < n:
        if normals[start, 0] == 0.0 and normals[start, 1] == 0.0:
            start += 1
            continue
        sx = normals[start, 0]
        sy = normals[start, 1]
        end = start + 1
        while end < n and _near(points, end - 1, end, max_gap):
            dot = normals[end, 0] * sx + normals[end, 1] * sy
            if abs(dot) < SAME_WALL * sqrt(sx * sx + sy * sy):
                break
            sign = 1.0 if dot > 0.0 else -1.0
            sx += sign * normals[end, 0]
            sy += sign * normals[end, 1]
            end += 1
        length = sqrt(sx * sx + sy * sy)
        for k in range(start, end):
            normals[k, 0] = sx / length
            normals[k, 1] = sy / length
        start = end


@njit(cache=True, nogil=True)
def wall_rows(points: F64, normals: F64, pose: F64, cell: float, rows: I64) -> None:
    """Write the row or column of cells that each point's wall lies in into `rows` (n,).

    `points` (n, 2) and `normals` (n, 2) are seen from the base at `pose` (3,), in metres along the axes of the map's
    cells of side `cell` (m). Cell k reaches from k - 0.5 to k + 0.5, for a node
    of the field is the centre of a cell. A wall that faces x more than y lies in a column of cells, any other in a row.
    """
    c = cos(pose[2])
    s = sin(pose[2])
    for i in range(len(points)):
        nx = c * normals[i, 0] - s * normals[i, 1]
        ny = s * normals[i, 0] + c * normals[i, 1]
        if abs(nx) > abs(ny):
            rows[i] = floor((pose[0] + c * points[i, 0] - s * points[i, 1]) / cell + 0.5) + _COLUMNS
        else:
            rows[i] = floor((pose[1] + s * points[i, 0] + c * points[i, 1]) / cell + 0.5)


@njit(cache=True, nogil=True)
def wall_information(
    points: F64,
    normals: F64,
    weights: F64,
    pose: F64,
    cell: float,
    variances: F64,
    rows: I64,
    order: I64,
) -> F64:
    """Information (3, 3) of (x, y, theta) along the axes of the map's cells, in 1/m^2 and 1/rad^2.

    Arguments as for `wall_rows`. `weights` (n,) in [0, 1] say how well each point fits; `variances` (2,) are those of a
    point by itself and of the wall (m^2); `order` (n,) sorts `rows`. Beams closer together than a cell share its error
    and count as a part of one. A row is trusted by the cells that are seen of it, or of the walls that cross it: a wall
    that is oblique to the cells lies in many rows.
    """
    c = cos(pose[2])
    s = sin(pose[2])
    information = np.zeros((3, 3))
    summed = np.zeros(3)
    squares = np.zeros((3, 3))
    j = np.zeros(3)
    weight = 0.0
    extent = 0.0
    count = np.empty(len(points))
    seen = np.empty(len(points))
    _extents(points, normals, weights, cell, count, seen)
    for k in range(len(order)):
        i = order[k]
        if k > 0 and rows[i] != rows[order[k - 1]]:
            _close(summed, squares, weight, extent, variances, information)
            summed[:] = 0.0
            squares[:] = 0.0
            weight = 0.0
            extent = 0.0
        if normals[i, 0] == 0.0 and normals[i, 1] == 0.0:
            continue
        nx = c * normals[i, 0] - s * normals[i, 1]
        ny = s * normals[i, 0] + c * normals[i, 1]
        if (nx if abs(nx) > abs(ny) else ny) < 0.0:
            nx = -nx
            ny = -ny
        rx = c * points[i, 0] - s * points[i, 1]
        ry = s * points[i, 0] + c * points[i, 1]
        j[0] = nx
        j[1] = ny
        j[2] = ny * rx - nx * ry
        w = count[i]
        for a in range(3):
            summed[a] += w * j[a]
            for b in range(3):
                squares[a, b] += w * j[a] * j[b]
        weight += w
        extent += w * seen[i]
    _close(summed, squares, weight, extent, variances, information)
    return information


@njit(cache=True, nogil=True)
def _extents(points: F64, normals: F64, weights: F64, cell: float, count: F64, seen: F64) -> None:
    """Write how many cells each point stands for into `count` (n,), and the cells that its wall shows into `seen`.

    A wall is a run of points that share a normal, as `wall_normals` leaves them.
    """
    n = len(points)
    start = 0
    while start < n:
        end = start
        total = 0.0
        while end < n and normals[end, 0] == normals[start, 0] and normals[end, 1] == normals[start, 1]:
            step = cell
            if end > 0:
                step = sqrt((points[end, 0] - points[end - 1, 0]) ** 2 + (points[end, 1] - points[end - 1, 1]) ** 2)
            count[end] = weights[end] * min(step / cell, 1.0)
            total += count[end]
            end += 1
        seen[start:end] = total
        start = end


@njit(cache=True, nogil=True)
def _fit(points: F64, i: int, max_gap: float, noise_variance: float, normals: F64) -> None:
    """The normal of the line through a point and its neighbours, or (0, 0)."""
    n = len(points)
    normals[i, 0] = 0.0
    normals[i, 1] = 0.0
    low = i
    while low > 0 and i - low < MOST_NEIGHBOURS and _near(points, low - 1, low, max_gap):
        if i - low >= 2 and not _within(points, low - 1, i):
            break
        low -= 1
    high = i
    while high < n - 1 and high - i < MOST_NEIGHBOURS and _near(points, high, high + 1, max_gap):
        if high - i >= 2 and not _within(points, high + 1, i):
            break
        high += 1
    count = high - low + 1
    if count < FEWEST_POINTS:
        return
    mx = 0.0
    my = 0.0
    for k in range(low, high + 1):
        mx += points[k, 0]
        my += points[k, 1]
    mx /= count
    my /= count
    xx = 0.0
    xy = 0.0
    yy = 0.0
    for k in range(low, high + 1):
        dx = points[k, 0] - mx
        dy = points[k, 1] - my
        xx += dx * dx / count
        xy += dx * dy / count
        yy += dy * dy / count
    middle = 0.5 * (xx + yy)
    spread = sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
    across = max(middle - spread - noise_variance, 0.0)
    if spread <= 0.0 or 9.0 * across > middle + spread:
        return
    # The eigenvector of the smaller eigenvalue: the longer of its two forms.
    ax = xy
    ay = middle - spread - xx
    bx = middle - spread - yy
    by = xy
    if ax * ax + ay * ay < bx * bx + by * by:
        ax = bx
        ay = by
    length = sqrt(ax * ax + ay * ay)
    normals[i, 0] = ax / length
    normals[i, 1] = ay / length


@njit(cache=True, nogil=True)
def _near(points: F64, a: int, b: int, max_gap: float) -> bool:
    dx = points[a, 0] - points[b, 0]
    dy = points[a, 1] - points[b, 1]
    gap = max_gap + 0.1 * sqrt(points[a, 0] ** 2 + points[a, 1] ** 2)
    return bool(dx * dx + dy * dy <= gap * gap)


@njit(cache=True, nogil=True)
def _within(points: F64, a: int, b: int) -> bool:
    dx = points[a, 0] - points[b, 0]
    dy = points[a, 1] - points[b, 1]
    return bool(dx * dx + dy * dy <= SPAN * SPAN)


@njit(cache=True, nogil=True)
def _close(summed: F64, squares: F64, weight: float, extent: float, variances: F64, information: F64) -> None:
    """Add a group's information, `(S - v_w / (v_p + v_w W) s s^T) / v_p`; `extent` sums the cells of its walls."""
    if weight <= 0.0:
        return
    shared = variances[1] / (variances[0] + variances[1] * weight)
    shown = max(weight, extent / weight)
    trusted = shown / (shown + DOUBTFUL_WEIGHT)
    for a in range(3):
        for b in range(3):
            information[a, b] += trusted * (squares[a, b] - shared * summed[a] * summed[b]) / variances[0]
