"""Fitness of a pose: the mean score of a scan's points on an interpolated field.

All of it in *cells*: node [0, 0] of the field is the origin, one cell is one unit; poses are (x, y, theta) with x and
y in cells, points are float32 of shape (n, 2) in cells, seen from the pose. Between four nodes the score is
bilinear; outside the field it is zero.

The field comes packed: for the square between nodes [v, u] and [v + 1, u + 1], `packed[v, u]` holds the four numbers
a, b, c, d of `score = a + b fu + c fv + d fu fv`, side by side, so that one look-up touches one line of the
cache (3.1 ns a point against 3.7 ns for four nodes of two rows, see benchmarks/).

Arithmetic on points is float32, sums are float64; no fastmath: the same bits with and without the compiler.
"""

from __future__ import annotations

from math import cos, exp, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]

_BLOCK = 16
"""Points summed between two tests whether the pose can still win. Internal: time alone."""
_SLOPE, _MOST_BESIDE, _FEWEST_BESIDE = 0.09, 20, 4
"""Half of the angle (rad) over which a wall's slope is fitted to the ranges: ranges of 2.5 % noise leave 8 deg of error
at one beam a degree; at most so many beams to each side, and at least so many in all."""
_FEWEST_TRIPLES = 10
_EDGE, _LEAST_NOISE_M = 4.0, 0.01
"""Beams that are off by more than so many standard deviations, and these being at least 1 cm, are edges, not noise."""
_NORMAL_QUARTILE = 0.6745
"""Median of the absolute value of a normal variable by its standard deviation."""


@njit(cache=True, nogil=True)
def pack(scores: F32, packed: F32, v0: int, v1: int, u0: int, u1: int) -> None:
    """Write the coefficients of the squares [v0, v1) x [u0, u1) of `scores` (h, w) into `packed` (h-1, w-1, 4)."""
    for v in range(v0, v1):
        for u in range(u0, u1):
            a = scores[v, u]
            b = scores[v, u + 1] - a
            c = scores[v + 1, u] - a
            packed[v, u, 0] = a
            packed[v, u, 1] = b
            packed[v, u, 2] = c
            packed[v, u, 3] = scores[v + 1, u + 1] - scores[v + 1, u] - b


@njit(cache=True, nogil=True)
def score_sum(packed: F32, points: F32, x: float, y: float, theta: float, needed: float) -> float:
    """Sum of the scores of the points at a pose, or -1 as soon as the sum cannot exceed `needed`.

    A score is at most 1, so a candidate whose partial sum plus one for each point to come stays below what it
    must beat is dropped early: the answer of the search is the same, most of its time is saved.
    """
    n = len(points)
    limit_u = np.float32(packed.shape[1])
    limit_v = np.float32(packed.shape[0])
    zero = np.float32(0.0)
    c = np.float32(cos(theta))
    s = np.float32(sin(theta))
    x32 = np.float32(x)
    y32 = np.float32(y)
    total = np.float64(0.0)
    start = 0
    while start < n:
        end = min(start + _BLOCK, n)
        for i in range(start, end):
            u = x32 + c * points[i, 0] - s * points[i, 1]
            v = y32 + s * points[i, 0] + c * points[i, 1]
            if u >= zero and u < limit_u and v >= zero and v < limit_v:
                iu = np.int32(u)
                iv = np.int32(v)
                fu = u - np.float32(iu)
                fv = v - np.float32(iv)
                cell = packed[np.uint32(iv), np.uint32(iu)]
                total += np.float64(cell[0] + fu * cell[1] + fv * (cell[2] + fu * cell[3]))
        start = end
        if total + np.float64(n - start) <= needed:
            return -1.0
    return total


@njit(cache=True, nogil=True)
def fitness_many(packed: F32, points: F32, poses: F64) -> F64:
    """Fitness in [0, 1] of each pose, shape (m,), for poses of shape (m, 3)."""
    result = np.empty(len(poses), dtype=np.float64)
    for k in range(len(poses)):
        result[k] = score_sum(packed, points, poses[k, 0], poses[k, 1], poses[k, 2], -2.0) / max(len(points), 1)
    return result


@njit(cache=True, nogil=True)
def point_scores(packed: F32, points: F32, x: float, y: float, theta: float, scores: F32) -> None:
    """Write the score of each point at a pose into `scores`, shape (n,)."""
    for i in range(len(points)):
        scores[i] = score_sum(packed, points[i : i + 1], x, y, theta, -2.0)


@njit(cache=True, nogil=True)
def median(values: F64) -> float:
    """Median of at least one value. With `np.median` a kernel that is loaded from the cache imports SciPy: 0.1 s."""
    ascending = np.sort(values)
    middle: float = 0.5 * (ascending[(len(values) - 1) // 2] + ascending[len(values) // 2])
    return middle


@njit(cache=True, nogil=True)
def _off_neighbours(ranges: F32, i: int, range_min: float, range_max: float, increment: float) -> float:
    """How far a range is off those beside it (m), scaled to the deviation of one range; -1 if one of them is no hit.

    Inverse ranges of a straight wall are a sinusoid of the bearing, so that `u[i-1] - 2 cos(increment) u[i] + u[i+1]`
    is zero but for the noise.
    """
    before, here, after = np.float64(ranges[i - 1]), np.float64(ranges[i]), np.float64(ranges[i + 1])
    low, high = min(before, here, after), max(before, here, after)
    if not (low >= range_min and high <= range_max and low > 0.0 and before + here + after < np.inf):
        return -1.0
    middle = 2.0 * cos(increment)
    return abs(1.0 / before - middle / here + 1.0 / after) * here * here / sqrt(2.0 + middle * middle)


@njit(cache=True, nogil=True)
def _beams_beside(increment: float) -> int:
    """To each side, over which a wall is straight."""
    return min(max(int(_SLOPE / max(abs(increment), 1e-9)), 2), _MOST_BESIDE)


@njit(cache=True, nogil=True)
def score_with_noise(ranges: F32, range_min: float, range_max: float, increment: float, sigma: float) -> float:
    """Mean of `exp(-distance / sigma)` (m) over the hits of a scan at walls that are where they seem; 1 where unknown.

    How far a hit is off shows its neighbours. Only the part across the wall counts, by the slope of the ranges around
    it. Edges are left aside.
    """
    n = len(ranges)
    beside = _beams_beside(increment)
    stride = max(n // 360, 1)
    off = np.empty(n, dtype=np.float64)
    across = np.empty(n, dtype=np.float64)
    away = np.empty(n, dtype=np.float64)
    count = 0
    for i in range(beside, n - beside, stride):
        found = _off_neighbours(ranges, i, range_min, range_max, increment)
        if found < 0.0:
            continue
        hits, sum_k, sum_kk, sum_r, sum_kr = 0, 0.0, 0.0, 0.0, 0.0
        for k in range(-beside, beside + 1):
            r = np.float64(ranges[i + k])
            if r >= range_min and r <= range_max and r < np.inf:
                hits += 1
                sum_k += k
                sum_kk += k * k
                sum_r += r
                sum_kr += k * r
        if hits < _FEWEST_BESIDE:
            continue
        here = np.float64(ranges[i])
        slope = (sum_kr - sum_k * sum_r / hits) / (sum_kk - sum_k * sum_k / hits) / (abs(increment) * here)
        off[count] = found
        across[count] = 1.0 / sqrt(1.0 + slope * slope)
        away[count] = here
        count += 1
    if count < _FEWEST_TRIPLES:
        return 1.0
    part = median(off[:count] / away[:count]) / _NORMAL_QUARTILE
    total, kept = 0.0, 0
    for i in range(count):
        if off[i] < _EDGE * max(part * away[i], _LEAST_NOISE_M):
            total += exp(-off[i] * across[i] / sigma)
            kept += 1
    return total / kept


@njit(cache=True, nogil=True)
def range_noise(ranges: F32, range_min: float, range_max: float, increment: float, noise: F64) -> None:
    """Write the standard deviation of each range (m), as those around it show it, to `noise` (n,); 0 where unknown.

    Edges are left aside.
    """
    n = len(ranges)
    off = np.zeros(n)
    parts = np.empty(n)
    count = 0
    for i in range(1, n - 1):
        found = _off_neighbours(ranges, i, range_min, range_max, increment)
        if found >= 0.0:
            off[i] = max(found, 1e-9)
            parts[count] = off[i] / np.float64(ranges[i])
            count += 1
    noise[:] = 0.0
    if count < _FEWEST_TRIPLES:
        return
    part = median(parts[:count]) / _NORMAL_QUARTILE
    for i in range(n):
        if off[i] >= _EDGE * max(part * np.float64(ranges[i]), _LEAST_NOISE_M):
            off[i] = 0.0
    beside = _beams_beside(increment)
    squares, known = 0.0, 0
    for i in range(-beside, n):
        if i + beside < n and off[i + beside] > 0.0:
            squares += off[i + beside] ** 2
            known += 1
        if i - beside > 0 and off[i - beside - 1] > 0.0:
            squares -= off[i - beside - 1] ** 2
            known -= 1
        if i >= 0 and known >= _FEWEST_BESIDE:
            noise[i] = sqrt(max(squares, 0.0) / known)


@njit(cache=True, nogil=True)
def normal_equations(
    packed: F32, points: F32, x: float, y: float, theta: float, information: F64, gradient: F64
) -> float:
    """Sum of the scores at a pose, and the Gauss-Newton equations of the residuals `1 - score`.

    Overwrites `information` (3, 3) with the sum of J^T J and `gradient` (3,) with that of J^T (1 - score), J being
    the derivative of a score by (x, y, theta); the step uphill solves `information * step = gradient`.
    """
    limit_u = np.float32(packed.shape[1])
    limit_v = np.float32(packed.shape[0])
    zero = np.float32(0.0)
    one = np.float32(1.0)
    c = np.float32(cos(theta))
    s = np.float32(sin(theta))
    x32 = np.float32(x)
    y32 = np.float32(y)
    total = np.float64(0.0)
    xx = np.float64(0.0)
    xy = np.float64(0.0)
    xt = np.float64(0.0)
    yy = np.float64(0.0)
    yt = np.float64(0.0)
    tt = np.float64(0.0)
    gx = np.float64(0.0)
    gy = np.float64(0.0)
    gt = np.float64(0.0)
    for i in range(len(points)):
        rx = c * points[i, 0] - s * points[i, 1]
        ry = s * points[i, 0] + c * points[i, 1]
        u = x32 + rx
        v = y32 + ry
        if u >= zero and u < limit_u and v >= zero and v < limit_v:
            iu = np.int32(u)
            iv = np.int32(v)
            fu = u - np.float32(iu)
            fv = v - np.float32(iv)
            cell = packed[np.uint32(iv), np.uint32(iu)]
            score = cell[0] + fu * cell[1] + fv * (cell[2] + fu * cell[3])
            jx = cell[1] + fv * cell[3]
            jy = cell[2] + fu * cell[3]
            jt = jy * rx - jx * ry
            residual = one - score
            total += np.float64(score)
            xx += np.float64(jx * jx)
            xy += np.float64(jx * jy)
            xt += np.float64(jx * jt)
            yy += np.float64(jy * jy)
            yt += np.float64(jy * jt)
            tt += np.float64(jt * jt)
            gx += np.float64(jx * residual)
            gy += np.float64(jy * residual)
            gt += np.float64(jt * residual)
    information[0, 0] = xx
    information[0, 1] = information[1, 0] = xy
    information[0, 2] = information[2, 0] = xt
    information[1, 1] = yy
    information[1, 2] = information[2, 1] = yt
    information[2, 2] = tt
    gradient[0] = gx
    gradient[1] = gy
    gradient[2] = gt
    return total
