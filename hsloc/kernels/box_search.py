"""Branch and bound over continuous boxes of poses: the fittest pose outside some places, and the proof of it.

Depth first, the most promising half first: the memory is a stack of a few hundred boxes, and the order of the work, so
also the answer, is the same in each run. Lengths in cells, as in hsloc/kernels/box_bounds.py.
"""

from __future__ import annotations

from math import hypot, pi, sin
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


_DEPTH = 512


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
