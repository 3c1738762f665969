"""Harmony Search and HIDE over a box of poses, with restarts.

One kernel serves both: HIDE is Harmony Search with a pass of differential evolution over the memory after every
`improvisations_per_pass` improvisations; Harmony Search makes no such pass. Letters and equation numbers are
those of the course report [P] and of Mirkhani et al. [M]; see hsloc/matching for what they mean.

Poses are (x, y, theta), x and y in cells of the packed field (hsloc/kernels/fitness.py).
"""

from __future__ import annotations

from math import exp, log
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from hsloc.kernels.fitness import score_sum
from hsloc.kernels.levenberg_marquardt import polish

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]

STOPPED_BUDGET = 0
STOPPED_AGREEMENT = 1


class SearchParameters(NamedTuple):
    """Parameters of the search; in this module because a kernel's argument types decide whether it can be cached."""

    memory_size: int
    consideration_rate: float
    par_min: float
    par_max: float
    bandwidth_max: tuple[float, float, float]
    """Of each coordinate, in cells, cells and radians."""
    bandwidth_ratio: float
    """What is left of it at the end, as a part."""
    improvisations_per_pass: int
    """HRT; 0: no differential evolution (plain Harmony Search)."""
    attraction: float
    """lambda of the differential evolution: the pull towards the best row."""
    differential_weight: float
    """F of the differential evolution."""
    budget: int
    """NI or NFE of one restart."""
    count_improvisations: bool
    """Whether the budget counts improvisations (the course report's program) or fitness evaluations ([M])."""
    restarts: int
    agreement: int
    """End when this many restarts have found the same best pose."""
    polish_iterations: int
    """Gauss-Newton steps after each restart; 0: none."""


class Box(NamedTuple):
    """The window that is searched: `centre`, the prediction, and `half_widths`, each (3,) in cells, cells and radians.

    For `search_boxes` the centres of many windows, shape (m, 3).
    """

    centre: F64
    half_widths: F64


class Memory(NamedTuple):
    """The harmony memory: `poses` (HMS, 3) and the sums of scores of their points `sums` (HMS,)."""

    poses: F64
    sums: F64


class Found(NamedTuple):
    """What `search` writes: the best `pose` (3,), its `information` (3, 3), see `polish`, and a history.

    `history` takes the best sum of the first restart after each evaluation as far as it is long; empty for none.
    """

    pose: F64
    information: F64
    history: F64


@njit(cache=True, nogil=True)
def _improvise(memory: F64, low: F64, high: F64, par: float, bw: F64, hmcr: float, rng: Generator, new: F64) -> None:
    """A new harmony, coordinate by coordinate ([P] III-B step 2)."""
    for j in range(3):
        if rng.random() < hmcr:
            value = memory[int(rng.random() * len(memory)), j]
            if rng.random() < par:
                value += (2.0 * rng.random() - 1.0) * bw[j]
            # The papers do not treat a pitch that leaves the box: it stays at its border.
            new[j] = min(max(value, low[j]), high[j])
        else:
            new[j] = low[j] + rng.random() * (high[j] - low[j])


@njit(cache=True, nogil=True)
def _least(values: F64) -> int:
    """Index of the first of the least values, without `np.argmin` for the reason of `fitness.median`."""
    least = 0
    for i in range(1, len(values)):
        if values[i] < values[least]:
            least = i
    return least


@njit(cache=True, nogil=True)
def improve_memory(
    packed: F32,
    points: F32,
    box: Box,
    parameters: SearchParameters,
    rng: Generator,
    harmonies: Memory,
    history: F64,
    with_centre: bool,
) -> tuple[int, int]:
    """One run of HS or HIDE: fills the memory `harmonies`.

    Row 0 is the centre, the prediction, if `with_centre`; else it is uniform in the box like the others.
    Returns the index of the best row and the number of fitness evaluations, the initial ones included. `history`
    takes the best sum after each evaluation as far as it is long; pass an empty array for none.
    """
    p = parameters
    hms = p.memory_size
    memory = harmonies.poses
    sums = harmonies.sums
    centre = box.centre
    low = centre - box.half_widths
    high = centre + box.half_widths
    # 1. Harmony memory: row 0 is the prediction, the others are uniform in the box.
    evaluations = 0
    best = 0
    for i in range(hms):
        for j in range(3):
            memory[i, j] = centre[j] if i == 0 and with_centre else low[j] + rng.random() * (high[j] - low[j])
        sums[i] = score_sum(packed, points, memory[i, 0], memory[i, 1], memory[i, 2], -2.0)
        if sums[i] > sums[best]:
            best = i
        if evaluations < len(history):
            history[evaluations] = sums[best]
        evaluations += 1
    worst = _least(sums)

    new = np.empty(3, dtype=np.float64)
    bandwidth = np.empty(3, dtype=np.float64)
    log_ratio = log(p.bandwidth_ratio)
    improvisations = 0
    spent = 0 if p.count_improvisations else evaluations
    while spent < p.budget:
        # 2. to 4. HRT improvisations; plain Harmony Search makes them all in one go.
        in_a_row = p.improvisations_per_pass if p.improvisations_per_pass > 0 else p.budget
        for _ in range(in_a_row):
            if spent >= p.budget:
                break
            improvisations += 1
            progress = min((spent + 1.0) / p.budget, 1.0)
            par = p.par_min + (p.par_max - p.par_min) * progress  # [IHS] eq. 3
            shrunk = exp(log_ratio * progress)  # [IHS] eq. 4
            for j in range(3):
                bandwidth[j] = p.bandwidth_max[j] * shrunk
            _improvise(memory, low, high, par, bandwidth, p.consideration_rate, rng, new)
            total = score_sum(packed, points, new[0], new[1], new[2], sums[worst])
            if total > sums[worst]:
                for j in range(3):  # scalars: a row assigned as a whole takes the compiler a second
                    memory[worst, j] = new[j]
                sums[worst] = total
                if total > sums[best]:
                    best = worst
                worst = _least(sums)
            if evaluations < len(history):
                history[evaluations] = sums[best]
            evaluations += 1
            spent = improvisations if p.count_improvisations else evaluations
        if p.improvisations_per_pass <= 0:
            break
        # HIDE: one pass of DE/rand-to-best/1 over the memory ([M] 5, [DE]); a better row is used at once.
        for i in range(hms):
            if spent >= p.budget:
                break
            r1 = int(rng.random() * hms)
            r2 = int(rng.random() * hms)
            for j in range(3):
                value = (
                    memory[i, j]
                    + p.attraction * (memory[best, j] - memory[i, j])
                    + p.differential_weight * (memory[r1, j] - memory[r2, j])
                )
                new[j] = min(max(value, low[j]), high[j])
            total = score_sum(packed, points, new[0], new[1], new[2], sums[i])
            if total > sums[i]:
                for j in range(3):
                    memory[i, j] = new[j]
                sums[i] = total
                if total > sums[best]:
                    best = i
            if evaluations < len(history):
                history[evaluations] = sums[best]
            evaluations += 1
            if not p.count_improvisations:
                spent = evaluations
        worst = _least(sums)
    return best, evaluations


@njit(cache=True, nogil=True)
def search(
    packed: F32,
    points: F32,
    few_points: F32,
    box: Box,
    parameters: SearchParameters,
    rng: Generator,
    found: Found,
) -> tuple[float, int, int, int]:
    """Search the box with restarts; writes the best pose and its information into `found`.

    The restarts improvise on `few_points` (an even choice of the points, for speed), each ends with a polish on
    these; the pose that is fittest on all `points` wins and is polished on all of them. With `agreement` = k the
    search ends as soon as k restarts have arrived at the same best pose: an easy match stops early, a hard one goes
    on. Only the first restart starts with the prediction, or agreement would be no evidence.
    Returns the fitness on all points, the evaluations, the restarts made and why it stopped.
    """
    p = parameters
    n = max(len(points), 1)
    memory = np.empty((p.memory_size, 3), dtype=np.float64)
    harmonies = Memory(memory, np.empty(p.memory_size, dtype=np.float64))
    pose = found.pose
    information = found.information
    candidate = np.empty(3, dtype=np.float64)
    none = np.empty(0, dtype=np.float64)
    low = box.centre - box.half_widths
    high = box.centre + box.half_widths
    best_total = -1.0
    agreed = 0
    evaluations = 0
    restart = 0
    stopped = STOPPED_BUDGET
    while restart < p.restarts:
        row, spent = improve_memory(
            packed, few_points, box, p, rng, harmonies, found.history if restart == 0 else none, restart == 0
        )
        restart += 1
        evaluations += spent
        for j in range(3):
            candidate[j] = memory[row, j]
        if p.polish_iterations > 0:
            _, spent = polish(packed, few_points, candidate, low, high, p.polish_iterations, information)
            evaluations += spent
        total = score_sum(packed, points, candidate[0], candidate[1], candidate[2], -2.0)
        spent = 1
        evaluations += spent
        same = (
            agreed > 0
            and abs(candidate[0] - pose[0]) < 1.0
            and abs(candidate[1] - pose[1]) < 1.0
            and abs(candidate[2] - pose[2]) < 0.02
        )
        if same:
            agreed += 1
        elif total > best_total:
            agreed = 1
        if total > best_total:
            best_total = total
            for j in range(3):
                pose[j] = candidate[j]
        if p.restarts > 1 and agreed >= p.agreement:
            stopped = STOPPED_AGREEMENT
            break
    if p.polish_iterations > 0:
        best_total, spent = polish(packed, points, pose, low, high, p.polish_iterations, information)
        evaluations += spent
    return best_total / n, evaluations, restart, stopped


@njit(cache=True, nogil=True)
def search_boxes(
    packed: F32,
    points: F32,
    few_points: F32,
    boxes: Box,
    parameters: SearchParameters,
    rng: Generator,
    poses: F64,
    fitness: F64,
) -> int:
    """`search` in many boxes of one size; fills `poses` (m, 3) and `fitness` (m,).

    Returns the evaluations. One call for all: a call from Python costs as much as a short search.
    """
    information = np.zeros((3, 3), dtype=np.float64)
    none = np.empty(0, dtype=np.float64)
    total = 0
    for k in range(len(boxes.centre)):
        box = Box(boxes.centre[k], boxes.half_widths)
        found = Found(poses[k], information, none)
        fitness[k], evaluations, _, _ = search(packed, points, few_points, box, parameters, rng, found)
        total += evaluations
    return total
