"""Upper bounds of the fitness over a continuous box of poses: no pose of the box is fitter than its bound.

A box is (x, y, theta) +- (half_x, half_y, half_theta). While the pose runs through it a point at (rx, ry) from the base
runs through a rectangle: the translation's, widened by the arc of the rotation. Two bounds of what it can score there:

- `pooled_bound`: the greatest node under the rectangle, one node wider for the interpolation, from tables of maxima
  over squares (Olson 2009; Hess et al. 2016; the "cheap bound" of Consolini et al., arXiv:1901.09641). One look-up.
- `slope_bound`: where the rectangle touches few squares of the field, a linear majorant from the range of the slopes
  in them. The linear parts are summed over the points before the worst pose is taken, so that slopes of opposite
  walls cancel, and the bound converges with the square of the box ([Consolini et al.], "relaxation bound").

Lengths are cells of the field, as in hsloc/kernels/fitness.py. That kernel moves points in float32; the rectangles are
widened by its rounding, and the bounds hold for what it computes, not only for real numbers.
"""

from __future__ import annotations

from math import cos, floor, pi, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    U8 = NDArray[np.uint8]
    I64 = NDArray[np.int64]

SMALL = 1.5
"""Greatest motion of a typical point within a box (cells) for which the slopes are used."""
MAX_SQUARES = 4
"""In a row, under one point: beyond that one look-up of the maxima is nearly as good."""
_LOOK = 8
"""Points summed between two looks at whether the box is ruled out already."""
_ROUNDING = 2.0**-21
"""Of a moved point's coordinates in float32, as a part of their size: four roundings of 2^-24 each, doubled."""
_SCORE_ROUNDING = 4e-7
"""Of an interpolated score in float32."""


class Pyramid(NamedTuple):
    """Tables of the field's maxima over squares, in steps of 1 / 255, rounded up.

    `tables[k, v + border, u + border]` is the maximum over the `sizes[k]` x `sizes[k]` entries from (u, v) on; an entry
    is the maximum of 2^shift x 2^shift nodes. `smallest[n]` is the first table that covers n entries.
    """

    tables: U8
    smallest: I64
    border: int
    shift: int


@njit(cache=True, nogil=True)
def largest_score(pyramid: Pyramid, u_low: float, u_high: float, v_low: float, v_high: float) -> int:
    """At least 255 times the greatest interpolated score in a rectangle; outside the field the score is 0."""
    shift = pyramid.shift
    border = pyramid.border
    u0 = floor(u_low) >> shift
    u1 = (floor(u_high) + 1) >> shift
    v0 = floor(v_low) >> shift
    v1 = (floor(v_high) + 1) >> shift
    if u1 < 0 or v1 < 0 or u0 >= pyramid.tables.shape[2] - 2 * border or v0 >= pyramid.tables.shape[1] - 2 * border:
        return 0
    size = max(u1 - u0, v1 - v0) + 1
    if size >= len(pyramid.smallest):
        return 255
    # A square that begins more than the border below the field begins in the border: it covers no less of the field.
    u = np.uint64(max(u0 + border, 0))
    v = np.uint64(max(v0 + border, 0))
    return int(pyramid.tables[np.uint64(pyramid.smallest[size]), v, u])


@njit(cache=True, nogil=True)
def pooled_bound(pyramid: Pyramid, points: F32, box: F64, needed: float) -> float:
    """At least the sum of the scores of `points` at any pose of `box` (6,); -1 once it cannot exceed `needed`.

    `box` is x, y, theta and the three half-widths; half_theta at most pi / 2.
    """
    n = len(points)
    x, y, half_x, half_y = box[0], box[1], box[3], box[4]
    c = cos(box[2])
    s = sin(box[2])
    across = sin(box[5])
    inwards = 0.5 * (1.0 - cos(box[5]))
    size = max(abs(x) + half_x, abs(y) + half_y)
    limit = 255.0 * needed
    total = 0
    start = 0
    while start < n:
        end = min(start + _LOOK, n)
        for i in range(start, end):
            px = np.float64(points[i, 0])
            py = np.float64(points[i, 1])
            rx = c * px - s * py
            ry = s * px + c * py
            rounding = _ROUNDING * (size + abs(px) + abs(py))
            # The arc: across by r sin(phi), inwards by r (1 - cos(phi)).
            reach_u = half_x + abs(ry) * across + abs(rx) * inwards + rounding
            reach_v = half_y + abs(rx) * across + abs(ry) * inwards + rounding
            u = x + rx - rx * inwards
            v = y + ry - ry * inwards
            total += largest_score(pyramid, u - reach_u, u + reach_u, v - reach_v, v + reach_v)
        start = end
        if total + 255 * (n - start) <= limit:
            return -1.0
    return total / 255.0 + n * _SCORE_ROUNDING


@njit(cache=True, nogil=True)
def slope_bound(pyramid: Pyramid, packed: F32, points: F32, box: F64, needed: float) -> tuple[float, float]:
    """As `pooled_bound`, for a small box; and the sum of the scores at its centre (0 where the bound is -1).

    A point whose rectangle touches more than `MAX_SQUARES` squares in a row counts as in `pooled_bound`.
    """
    n = len(points)
    height = packed.shape[0]
    width = packed.shape[1]
    x, y, half_x, half_y = box[0], box[1], box[3], box[4]
    c = cos(box[2])
    s = sin(box[2])
    across = sin(box[5])
    inwards = 1.0 - cos(box[5])
    size = max(abs(x) + half_x, abs(y) + half_y)
    centre_total = 0.0
    flat_total = 0.0
    total = 0.0
    slope_x = 0.0
    slope_y = 0.0
    slope_theta = 0.0
    slope_inwards = 0.0
    start = 0
    while start < n:
        end = min(start + _LOOK, n)
        for i in range(start, end):
            px = np.float64(points[i, 0])
            py = np.float64(points[i, 1])
            rx = c * px - s * py
            ry = s * px + c * py
            rounding = _ROUNDING * (size + abs(px) + abs(py))
            reach_u = half_x + abs(ry) * across + abs(rx) * inwards + rounding
            reach_v = half_y + abs(rx) * across + abs(ry) * inwards + rounding
            u = x + rx
            v = y + ry
            u0 = floor(u - reach_u)
            u1 = floor(u + reach_u)
            v0 = floor(v - reach_v)
            v1 = floor(v + reach_v)
            is_inside = u0 >= 0 and v0 >= 0 and u1 < width and v1 < height
            score = 0.0
            if u >= 0.0 and v >= 0.0 and u < width and v < height:
                iu = int(u)
                iv = int(v)
                fu = u - iu
                fv = v - iv
                score = packed[iv, iu, 0] + fu * packed[iv, iu, 1] + fv * (packed[iv, iu, 2] + fu * packed[iv, iu, 3])
                centre_total += score
            if not is_inside or u1 - u0 >= MAX_SQUARES or v1 - v0 >= MAX_SQUARES:
                top = largest_score(pyramid, u - reach_u, u + reach_u, v - reach_v, v + reach_v) / 255.0
                flat_total += top
                total += top
                continue
            top = 0.0
            u_least = v_least = 1e9
            u_most = v_most = -1e9
            for row in range(v0, v1 + 1):
                v_from = max(v - reach_v - row, 0.0)
                v_to = min(v + reach_v - row, 1.0)
                for column in range(u0, u1 + 1):
                    u_from = max(u - reach_u - column, 0.0)
                    u_to = min(u + reach_u - column, 1.0)
                    node = np.float64(packed[row, column, 0])
                    b = np.float64(packed[row, column, 1])
                    g = np.float64(packed[row, column, 2])
                    d = np.float64(packed[row, column, 3])
                    # Bilinear: greatest in a corner of what the rectangle covers of the square.
                    low_u = node + u_from * b
                    high_u = node + u_to * b
                    low_d = g + u_from * d
                    high_d = g + u_to * d
                    top = max(top, low_u + v_from * low_d, high_u + v_from * high_d)
                    top = max(top, low_u + v_to * low_d, high_u + v_to * high_d)
                    u_least = min(u_least, b + v_from * d, b + v_to * d)
                    u_most = max(u_most, b + v_from * d, b + v_to * d)
                    v_least = min(v_least, low_d, high_d)
                    v_most = max(v_most, low_d, high_d)
            flat_total += top
            slope_u = 0.5 * (u_least + u_most)
            slope_v = 0.5 * (v_least + v_most)
            linear = score + 0.5 * (u_most - u_least) * reach_u + 0.5 * (v_most - v_least) * reach_v
            linear += (abs(slope_u) + abs(slope_v)) * rounding
            if linear < top:
                total += linear
                slope_x += slope_u
                slope_y += slope_v
                slope_theta += slope_v * rx - slope_u * ry
                slope_inwards += slope_u * rx + slope_v * ry
            else:
                total += top
        start = end
        if flat_total + (n - start) <= needed:
            return -1.0, 0.0
    total += abs(slope_x) * half_x + abs(slope_y) * half_y + abs(slope_theta) * across
    total += max(-slope_inwards, 0.0) * inwards
    return min(total, flat_total) + n * _SCORE_ROUNDING, centre_total


@njit(cache=True, nogil=True)
def bound(pyramid: Pyramid, packed: F32, points: F32, box: F64, needed: float, radius: float) -> tuple[float, float]:
    """The bound that is worth its time for the size of the box, and the sum at its centre (-1: not computed).

    `radius` is that of a typical point, in cells.
    """
    if box[5] > 0.5 * pi:
        return np.float64(len(points)), -1.0
    if max(box[3], box[4]) + radius * sin(box[5]) > SMALL:
        return pooled_bound(pyramid, points, box, needed), -1.0
    return slope_bound(pyramid, packed, points, box, needed)
