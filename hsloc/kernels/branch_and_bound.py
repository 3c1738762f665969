"""Branch and bound over a lattice of poses, to find whether another pose fits as well.

The scores of a field are pooled: level k holds at each node the maximum over the 2^k x 2^k nodes from it on. The sum of
pooled scores under the points bounds the score of all 2^k x 2^k shifts at once, so that most of the window is
excluded at once (Olson 2009; Hess et al. 2016). On the lattice the answer is exact.
Lengths are in cells of the field, as in hsloc/kernels/fitness.py.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]


class Lattice(NamedTuple):
    """The poses that are searched: the cells of a box, and headings `angle_step` (rad) apart."""

    centre: F64
    """(x, y, theta) of the middle of the box, cells and rad."""
    half_widths: F64
    """Half-widths of the box, cells, cells and rad."""
    angle_step: float


class Excluded(NamedTuple):
    """Poses that do not count: those within `distance` (cells, cells, rad) of `pose`; distance[0] < 0: all count."""

    pose: F64
    distance: F64


@njit(cache=True, nogil=True)
def pool(scores: F32, levels: int) -> F32:
    """Pooled scores, shape (levels + 1, h, w): level k is the maximum of `scores[v : v + 2^k, u : u + 2^k]`."""
    height, width = scores.shape
    pooled = np.zeros((levels + 1, height, width), dtype=np.float32)
    pooled[0] = scores
    for k in range(1, levels + 1):
        step = 1 << (k - 1)
        for v in range(height):
            far_v = v + step
            for u in range(width):
                far_u = u + step
                best = pooled[k - 1, v, u]
                if far_u < width:
                    best = max(best, pooled[k - 1, v, far_u])
                if far_v < height:
                    best = max(best, pooled[k - 1, far_v, u])
                    if far_u < width:
                        best = max(best, pooled[k - 1, far_v, far_u])
                pooled[k, v, u] = best
    return pooled


@njit(cache=True, nogil=True)
def _bound(pooled: F32, level: int, cells: I32, u0: int, v0: int, needed: float) -> float:
    """Sum over the points of the pooled scores, or -1 once it cannot exceed `needed`.

    A block that begins below the field may still reach into it: its corner is moved to the border, which widens
    nothing, for the block pooled there holds all that is left of it.
    """
    n = len(cells)
    size = 1 << level
    height = pooled.shape[1]
    width = pooled.shape[2]
    total = 0.0
    for i in range(n):
        u = cells[i, 0] + u0
        v = cells[i, 1] + v0
        if u > -size and v > -size and u < width and v < height:
            total += np.float64(pooled[level, max(v, 0), max(u, 0)])
        if (i & 15) == 15 and total + (n - 1 - i) <= needed:
            return -1.0
    return total


@njit(cache=True, nogil=True)
def _rotated(points: F32, theta: float, cells: I32) -> None:
    c = cos(theta)
    s = sin(theta)
    for i in range(len(points)):
        cells[i, 0] = int(np.floor(c * points[i, 0] - s * points[i, 1] + 0.5))
        cells[i, 1] = int(np.floor(s * points[i, 0] + c * points[i, 1] + 0.5))


@njit(cache=True, nogil=True)
def best_on_lattice(
    pooled: F32, points: F32, lattice: Lattice, exclude: Excluded, needed: float, max_visits: int, pose: F64
) -> tuple[float, int]:
    """The fittest pose of a lattice that is fitter than `needed` and not excluded.

    Writes `pose` (3,) and returns the fitness, or `needed` if no pose is fitter, and the number of bounds computed; -1
    for the fitness when `max_visits` did not suffice.
    """
    centre = lattice.centre
    half_widths = lattice.half_widths
    angle_step = lattice.angle_step
    excluded = exclude.pose
    exclusion = exclude.distance
    n = max(len(points), 1)
    levels = len(pooled) - 1
    top = 1 << levels
    turns = int(np.ceil(half_widths[2] / angle_step))
    u_low = int(np.floor(centre[0] - half_widths[0] + 0.5))
    u_high = int(np.floor(centre[0] + half_widths[0] + 0.5))
    v_low = int(np.floor(centre[1] - half_widths[1] + 0.5))
    v_high = int(np.floor(centre[1] + half_widths[1] + 0.5))
    across = (u_high - u_low) // top + 1
    up = (v_high - v_low) // top + 1
    cells = np.empty((len(points), 2), dtype=np.int32)
    bounds = np.empty((2 * turns + 1) * across * up, dtype=np.float64)
    best = needed * n
    visits = 0
    index = 0
    for turn in range(-turns, turns + 1):
        _rotated(points, centre[2] + turn * angle_step, cells)
        for b in range(up):
            for a in range(across):
                bounds[index] = _bound(pooled, levels, cells, u_low + a * top, v_low + b * top, best)
                index += 1
    visits += index
    order = np.argsort(-bounds, kind="mergesort")
    stack = np.empty((4 * (levels + 1) + 4, 3), dtype=np.int64)
    for position in range(len(order)):
        index = order[position]
        if bounds[index] <= best:
            break
        turn = index // (across * up) - turns
        theta = centre[2] + turn * angle_step
        _rotated(points, theta, cells)
        away = excluded[2] - theta
        away -= 2.0 * pi * np.round(away / (2.0 * pi))
        same_heading = abs(away) <= exclusion[2]
        rest = index % (across * up)
        stack[0, 0] = levels
        stack[0, 1] = u_low + (rest % across) * top
        stack[0, 2] = v_low + (rest // across) * top
        depth = 1
        while depth > 0:
            depth -= 1
            level = stack[depth, 0]
            u = stack[depth, 1]
            v = stack[depth, 2]
            if u > u_high or v > v_high:
                continue
            visits += 1
            if visits > max_visits:
                return -1.0, visits
            last = (1 << level) - 1
            if (
                same_heading
                and abs(u - excluded[0]) <= exclusion[0]
                and abs(u + last - excluded[0]) <= exclusion[0]
                and abs(v - excluded[1]) <= exclusion[1]
                and abs(v + last - excluded[1]) <= exclusion[1]
            ):
                continue
            total = _bound(pooled, level, cells, u, v, best)
            if total <= best:
                continue
            if level == 0:
                best = total
                pose[0] = u
                pose[1] = v
                pose[2] = theta
                continue
            half = 1 << (level - 1)
            for b in range(2):
                for a in range(2):
                    stack[depth, 0] = level - 1
                    stack[depth, 1] = u + a * half
                    stack[depth, 2] = v + b * half
                    depth += 1
    return best / n, visits
