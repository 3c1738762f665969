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

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]

_BLOCK = 16
"""Points summed between two tests whether the pose can still win. Internal: time alone."""


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
