"""Branch and bound over poses: whether another pose fits as well, on a lattice and over continuous boxes.

On a lattice the scores of a field are pooled: level k holds at each node the maximum over the 2^k x 2^k nodes from it
on. The sum of pooled scores under the points bounds the score of all 2^k x 2^k shifts at once, so that most of the
window is excluded at once (Olson 2009; Hess et al. 2016). On the lattice the answer is exact.

Over boxes it finds the fittest pose outside some places, and the proof of it. Depth first, the most promising half
first: the memory is a stack of a few hundred boxes, and the order of the work, so also the answer, is the same in each
run. Lengths are in cells of the field, as in hsloc/kernels/fitness.py and hsloc/kernels/box_bounds.py.
"""

from __future__ import annotations

from math import cos, hypot, pi, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from hsloc.kernels.box_bounds import Pyramid, bound
from hsloc.kernels.fitness import score_sum
from hsloc.kernels.levenberg_marquardt import polish

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]

_DEPTH = 512


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


class BoxSearch(NamedTuple):
    """What ends the search; in this module because a kernel's argument types decide whether it can be cached."""

    epsilon: float
    """Sum of scores: a box that cannot be better than the best by more is left."""
    radius: float
    """Of the places left out, in cells."""
    angle: float
    """Of the places left out, in radians: a pose that is within both of one of them does not count."""
    lever: float
    """Radius in cells of a typical point: turns angles into lengths when a box is split."""
    smallest: float
    """A box that moves points by less, in cells, is not split: it stays undecided."""
    max_boxes: int
    """Boxes that may be bounded; what is left then stays undecided."""


@njit(cache=True, nogil=True)
def is_left_out(places: F64, box: F64, radius: float, angle: float) -> bool:
    """Whether the whole box lies within `radius` and `angle` of one of `places` (k, 3)."""
    for k in range(len(places)):
        turn = box[2] - places[k, 2]
        turn -= 2.0 * pi * np.round(turn / (2.0 * pi))
        if abs(turn) + box[5] <= angle:
            x = abs(box[0] - places[k, 0]) + box[3]
            y = abs(box[1] - places[k, 1]) + box[4]
            if hypot(x, y) <= radius:
                return True
    return False


@njit(cache=True, nogil=True)
def _split(box: F64, lever: float, children: F64) -> int:
    """Halve the box where it moves the points most; writes `children` (4, 6) and returns how many."""
    turn = lever * sin(min(box[5], 0.5 * pi))
    wide_x = box[3] >= 0.5 * box[4]
    wide_y = box[4] >= 0.5 * box[3]
    if turn > max(box[3], box[4]):
        for k in range(2):
            children[k] = box
            children[k, 2] += (k - 0.5) * box[5]
            children[k, 5] *= 0.5
        return 2
    count = 0
    for j in range(2 if wide_y else 1):
        for i in range(2 if wide_x else 1):
            children[count] = box
            if wide_x:
                children[count, 0] += (i - 0.5) * box[3]
                children[count, 3] *= 0.5
            if wide_y:
                children[count, 1] += (j - 0.5) * box[4]
                children[count, 4] *= 0.5
            count += 1
    return count


@njit(cache=True, nogil=True)
def _climb(packed: F32, points: F32, places: F64, p: BoxSearch, low: F64, high: F64, pose: F64, start: F64) -> float:
    """Polish from `start` into `pose`; where that ends in a place left out, `pose` is the start."""
    information = np.empty((3, 3), dtype=np.float64)
    point = np.zeros(6, dtype=np.float64)
    pose[:] = start[:3]
    total, _ = polish(packed, points, pose, low, high, 15, information)
    point[:3] = pose
    if is_left_out(places, point, p.radius, p.angle):
        pose[:] = start[:3]
        total = score_sum(packed, points, pose[0], pose[1], pose[2], -2.0)
    return total


@njit(cache=True, nogil=True)
def maximise(
    pyramid: Pyramid,
    packed: F32,
    points: F32,
    roots: F64,
    places: F64,
    search: BoxSearch,
    best: float,
    pose: F64,
) -> tuple[float, float, int, bool]:
    """The fittest pose in the boxes `roots` (m, 6) that is in none of the `places` (k, 3) left out.

    `best` is a sum of scores that is known, `pose` (3,) is overwritten where a fitter pose is found. Returns the best
    sum, the sum that no pose exceeds, the number of boxes bounded, and whether `pose` was written. The second is the
    first and epsilon unless boxes stayed undecided.
    """
    p = search
    stack = np.empty((_DEPTH, 7), dtype=np.float64)
    children = np.empty((4, 6), dtype=np.float64)
    bounds = np.empty(4, dtype=np.float64)
    trial = np.empty(3, dtype=np.float64)
    low = np.empty(3, dtype=np.float64)
    high = np.empty(3, dtype=np.float64)
    boxes = 0
    undecided = -1.0
    is_found = False
    for root in range(len(roots)):
        for j in range(3):
            low[j] = roots[root, j] - roots[root, 3 + j]
            high[j] = roots[root, j] + roots[root, 3 + j]
        stack[0, :6] = roots[root]
        stack[0, 6] = len(points)
        depth = 1
        while depth > 0:
            depth -= 1
            if stack[depth, 6] <= best + p.epsilon:
                continue
            box = stack[depth, :6].copy()
            reach = max(box[3], box[4]) + p.lever * box[5]
            if reach < p.smallest or boxes >= p.max_boxes or depth > _DEPTH - 8:
                undecided = max(undecided, stack[depth, 6])
                continue
            count = _split(box, p.lever, children)
            kept = 0
            for k in range(count):
                child = children[k]
                if is_left_out(places, child, p.radius, p.angle):
                    continue
                boxes += 1
                upper, centre = bound(pyramid, packed, points, child, best + p.epsilon, p.lever)
                if centre > best:
                    point = child.copy()
                    point[3:] = 0.0
                    if not is_left_out(places, point, p.radius, p.angle):
                        total = _climb(packed, points, places, p, low, high, trial, child)
                        if total > best:
                            best = total
                            pose[:] = trial
                            is_found = True
                if upper <= best + p.epsilon:
                    continue
                # Insertion by bound: the greatest is on top of the stack.
                at = kept
                while at > 0 and bounds[at - 1] > upper:
                    bounds[at] = bounds[at - 1]
                    stack[depth + at] = stack[depth + at - 1]
                    at -= 1
                bounds[at] = upper
                stack[depth + at, :6] = child
                stack[depth + at, 6] = upper
                kept += 1
            depth += kept
    return best, max(best + p.epsilon, undecided), boxes, is_found
