"""Where on a whole map a scan fits, and the proof that it fits nowhere else: branch and bound over places and headings.

Unlike a search that samples, the answer is complete: every pose on open ground that is fitter than `bound` lies within
the radius and angle of one of the modes. Coarse squares of places and intervals of headings are ruled out first
(hsloc/kernels/map_search.py), what is left is searched in continuous boxes (hsloc/kernels/branch_and_bound.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, log2, pi, radians
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from hsloc.kernels.branch_and_bound import BoxSearch, maximise
from hsloc.kernels.fitness import fitness_many
from hsloc.kernels.map_search import Clusters, OpenSquares, fit_boxes, sampled_bounds
from hsloc.matching.certificate import lever
from hsloc.matching.harmony_search import low_discrepancy_order
from hsloc.matching.score_pyramid import score_pyramid
from hsloc.model.occupancy_grid import OccupancyGrid
from hsloc.parameters import Angle, Count, Parameters, Positive, Range, Ratio

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_SQUARE = 0.8
"""Side of the squares of places that a search usually begins with [m]: of 0.4, 0.8 and 1.6 m the fastest on floors of
2,000 to 40,000 m2."""
_COARSER = 2
"""Levels that a search may begin coarser, where few objects are seen from far: with 400 posts on 170 x 230 m nearly all
of the work was at the coarsest level."""
_FEW_LEFT = 0.3
"""Part of the boxes that a coarser level must not leave more of: each is eight boxes of the next level."""
_CLUSTER = 0.5
"""Points within this part of a square's side are put together at its level."""
_SEED_POINTS = 80
"""Points of the scan used while a first place is looked for; nothing is concluded from where they do not fit."""
_SEED_STEP = 0.05
"""Fitness by which the demand falls until a first place is found."""
_POLISHED = 30
"""Boxes of the first search whose best pose is worked out."""
_SAMPLE = 100
"""Places at which it is tried which points rule out most."""
_SMALLEST = 0.02
"""Cells by which a box moves points at least."""
_INSIDE = 1e-6
"""Part of a cell by which its corners are moved inwards: a corner on the line between two squares is in neither."""
_PLACES = 200_000
"""Cells that are looked at in one go, which bounds the memory."""
_ROUNDING = 1e-6
"""Of a score in float32."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WholeMapParameters(Parameters):
    """What counts as a place where a scan fits, and how much work may be spent."""

    margin: Ratio = 0.05
    """Fitness below the best within which a pose is another mode."""
    min_fitness: Ratio = 0.6
    """Minimum fitness of a place; where there is none, the scan is not on this map."""
    radius: Positive = 0.3
    """Distance within which poses belong to one mode [m]."""
    angle: Angle = radians(3.0)
    """Rotation within which poses belong to one mode [rad]."""
    epsilon: Annotated[float, Range(1e-6, 1.0)] = 0.005
    """Fitness by which a pose may be fitter than the mode that is returned for it."""
    max_modes: Count = 64
    """Maximum number of modes; where there are more, the result is not complete."""
    max_boxes: Count = 200_000_000
    """Maximum number of boxes of poses that are bounded."""
    max_candidates: Count = 500_000
    """Maximum number of boxes that remain after the coarse levels; each takes 56 bytes."""


@dataclass(frozen=True, slots=True)
class Mode:
    """A place where the scan fits: the fittest pose that was found there."""

    pose: Pose2
    fitness: float


@dataclass(frozen=True, slots=True)
class WholeMapResult:
    """The modes, fittest first, and what is proven of all other poses.

    Every pose on open ground that lies in the radius and angle of no mode has at most the fitness `bound`. Where
    `is_complete`, the bound is the best fitness less the margin, or `min_fitness` where there is no mode: the scan fits
    nowhere on this map. Otherwise the work allowed did not suffice, and `bound` is what was proven so far, at most 1.
    """

    modes: tuple[Mode, ...]
    bound: float
    is_complete: bool
    boxes: int

    @property
    def is_unique(self) -> bool:
        """Whether there is one place, and the proof that there is no other within the margin."""
        return self.is_complete and len(self.modes) == 1


class Places(NamedTuple):
    """Poses (m, 3; cells, rad), the fitness (m,) at each, the boxes that were bounded, and whether these are all.

    Where they are all, any pose that is fitter than the demand lies in a square of the finest level around one of them.
    """

    poses: F64
    fitness: F64
    boxes: int
    is_complete: bool


class WholeMapSearch:
    """Searches one map; what does not depend on the scan is prepared once."""

    def __init__(
        self, grid: OccupancyGrid, field: LikelihoodField, parameters: WholeMapParameters | None = None
    ) -> None:
        self._field = field
        self._parameters = WholeMapParameters() if parameters is None else parameters
        self._pyramid = score_pyramid(field)
        self._usual = max(round(log2(_SQUARE / field.resolution)) - self._pyramid.shift, 1)
        self._coarsest = self._usual + _COARSER
        # A box of the coarsest level has the side of the step or more, and its points lie in more entries than that.
        side = 1 << self._usual
        smallest = self._pyramid.smallest
        first = int(smallest[min(side + 1, len(smallest) - 1)])
        self._by_phase = _by_phase(self._pyramid.tables[first:], side)
        is_open = _open_entries(grid, field, self._pyramid.shift)
        self._open_squares = _open_squares(is_open, self._coarsest)
        self._sample = _places(is_open, _SAMPLE)

    def search(self, points: F64) -> WholeMapResult:
        """The modes of a scan, points (n, 2) in metres seen from the base; of several scans see `join_scans`."""
        if len(points) == 0 or len(self._sample) == 0:
            return WholeMapResult((), 1.0, False, 0)
        p = self._parameters
        scaled = self._field.scale(points[low_discrepancy_order(len(points))])
        best, boxes = self._seed(scaled)
        needed = max(p.min_fitness - p.epsilon, 0.0) if best is None else max(best.fitness - p.margin - p.epsilon, 0.0)
        candidates, more, is_complete = self._candidates(scaled, needed)
        boxes += more
        if not is_complete:
            return WholeMapResult(() if best is None else (best,), 1.0, False, boxes)
        modes, bound, more, is_complete = self._modes(scaled, candidates, best, needed)
        return WholeMapResult(modes, bound, is_complete, boxes + more)

    def places_above(self, points: F64, demand: float, max_boxes: int) -> Places:
        """Where on the map points (n, 2) may be fitter than `demand`: nothing is proven of a single pose."""
        if len(points) == 0 or len(self._sample) == 0:
            return Places(np.empty((0, 3)), np.empty(0), 0, False)
        scaled = self._field.scale(points)
        rows, boxes, is_complete = self._candidates(scaled, demand, max_boxes)
        poses = _poses(rows)
        return Places(poses, fitness_many(self._field.packed, scaled, poses), boxes, is_complete)

    def _seed(self, scaled: NDArray[np.float32]) -> tuple[Mode | None, int]:
        """A fit place, looked for with few points and a demand that falls; None where there is none.

        It need not be the fittest: the demand on all others is derived from it.
        """
        p = self._parameters
        few = scaled[:_SEED_POINTS]
        boxes = 0
        demand = 1.0 - _SEED_STEP
        while True:
            candidates, more, _ = self._candidates(few, demand)
            boxes += more
            if len(candidates):
                fitness = fitness_many(self._field.packed, scaled, _poses(candidates))
                order = np.argsort(-fitness, kind="stable")[:_POLISHED]
                best, _, more, pose = self._maximise(scaled, candidates[order], np.empty((0, 3)), 0.0)
                boxes += more
                if pose is not None and best / len(scaled) >= max(demand - _SEED_STEP, p.min_fitness):
                    return Mode(self._field.from_cells(pose), best / len(scaled)), boxes
            if demand <= p.min_fitness:
                return None, boxes
            demand = max(demand - _SEED_STEP, p.min_fitness)

    def _candidates(
        self, scaled: NDArray[np.float32], needed: float, max_boxes: int | None = None
    ) -> tuple[F64, int, bool]:
        """Boxes (m, 6) in which poses may be fitter than `needed`, most promising first; and whether they are all."""
        p = self._parameters
        needed = (needed - _ROUNDING) * len(scaled)
        half_square = 0.5 * (1 << self._pyramid.shift << self._coarsest)
        turns = ceil(pi * lever(scaled) / half_square)
        half_thetas: F64 = pi / turns / np.exp2(np.arange(self._coarsest, -1, -1, dtype=np.float64))
        clusters = self._clusters(scaled.astype(np.float64), half_thetas, 255.0 * needed)
        rows, boxes, is_complete = fit_boxes(
            self._pyramid,
            self._by_phase,
            clusters,
            self._open_squares,
            half_thetas[: len(clusters.starts) - 1],
            needed,
            p.max_boxes if max_boxes is None else max_boxes,
            p.max_candidates,
        )
        return rows[np.argsort(-rows[:, 6], kind="stable"), :6], int(boxes), bool(is_complete)

    def _clusters(self, points: F64, half_thetas: F64, limit: float) -> Clusters:
        """The points of each level put together, those first that rule out most boxes.

        The levels end with the coarsest that is worth it where boxes have to exceed `limit`.
        """
        levels: list[F64] = []
        for level in range(self._coarsest + 1):
            rows = _cluster(points, _CLUSTER * (1 << self._pyramid.shift << level))
            loss, bounds = sampled_bounds(self._pyramid, rows, self._sample, level, half_thetas[level])
            if level > self._usual and np.mean(bounds > limit) > _FEW_LEFT:
                break
            levels.append(rows[np.argsort(-loss, kind="stable")])
        starts = np.concatenate(((0,), np.cumsum([len(rows) for rows in levels]))).astype(np.int64)
        return Clusters(np.concatenate(levels), starts)

    def _maximise(
        self, scaled: NDArray[np.float32], candidates: F64, places: F64, best: float
    ) -> tuple[float, float, int, F64 | None]:
        """The best sum outside `places`, the sum that none exceeds, the boxes, and the pose if it is fitter."""
        p = self._parameters
        n = len(scaled)
        search = BoxSearch(
            epsilon=p.epsilon * n,
            radius=p.radius / self._field.resolution,
            angle=p.angle,
            lever=lever(scaled),
            smallest=_SMALLEST,
            max_boxes=p.max_boxes,
        )
        pose = np.empty(3)
        found = maximise(self._pyramid, self._field.packed, scaled, candidates, places, search, best, pose)
        return found[0], found[1], found[2], pose if found[3] else None

    def _modes(
        self, scaled: NDArray[np.float32], candidates: F64, seed: Mode | None, needed: float
    ) -> tuple[tuple[Mode, ...], float, int, bool]:
        """Fittest pose after fittest pose, each outside the places of those before, until none is above `needed`."""
        p = self._parameters
        n = len(scaled)
        places = np.empty((0, 3))
        modes: list[Mode] = []
        boxes = 0
        best = 0.0 if seed is None else seed.fitness
        while len(modes) < p.max_modes:
            # The first mode is the fittest pose of the map: it is worked out from the seed's fitness on.
            start = best * n if not modes and seed is not None else needed * n
            total, bound, more, pose = self._maximise(scaled, candidates, places, start)
            boxes += more
            if pose is None and not modes and seed is not None:
                pose, total = self._field.to_cells(seed.pose), best * n
            elif pose is None:
                return self._in_margin(modes), max(bound / n, needed), boxes, bound <= (needed + 2.0 * p.epsilon) * n
            if not modes:
                best = total / n
                needed = max(needed, best - p.margin - p.epsilon)
            modes.append(Mode(self._field.from_cells(pose), total / n))
            places = np.vstack((places, pose))
        return self._in_margin(modes), modes[-1].fitness + p.epsilon, boxes, False

    def _in_margin(self, modes: list[Mode]) -> tuple[Mode, ...]:
        return tuple(sorted(modes, key=lambda mode: -mode.fitness))


def join_scans(scans: Sequence[F64], T_odom_base: Sequence[Pose2]) -> F64:
    """The points of several scans as one, shape (n, 2), in metres seen from the base at the last of them.

    `T_odom_base` are the poses of the base in the frame of the odometry, one for each scan.
    """
    last = T_odom_base[-1]
    return np.concatenate([last.between(pose) @ scan for scan, pose in zip(scans, T_odom_base, strict=True)])


def _poses(rows: F64) -> F64:
    """The poses (m, 3) of boxes, in one piece: the kernel is loaded once for all that call it."""
    return np.ascontiguousarray(rows[:, :3])


def _open_entries(grid: OccupancyGrid, field: LikelihoodField, shift: int) -> NDArray[np.bool_]:
    """Which squares of 2^shift nodes a side, from node [0, 0] of the field on, hold free ground of the grid."""
    step = 1 << shift
    height, width = field.packed.shape[:2]
    is_open = np.zeros((-(-height // step), -(-width // step)), dtype=np.bool_)
    corner = field.T_map_field.between(grid.origin)
    # A cell may touch four squares of nodes, and in a field of this grid it is at most one: its corners suffice.
    steps = ceil(grid.resolution / field.resolution)
    corners = [(dx, dy) for dx in _corners(steps) for dy in _corners(steps)]
    rows = max(_PLACES // max(grid.cells.shape[1], 1), 1)
    for first in range(0, grid.cells.shape[0], rows):
        free = OccupancyGrid(grid.cells[first : first + rows], grid.resolution).free()
        if corner.theta == 0.0 and grid.resolution == field.resolution:
            for dx, dy in corners:
                row = floor(corner.y / field.resolution + dy) + first
                column = floor(corner.x / field.resolution + dx)
                moved = np.pad(free, ((row % step, 0), (column % step, 0)))
                _join(is_open, _halved(moved, step), row // step, column // step)
            continue
        cells = np.argwhere(free)[:, ::-1] + (0, first)
        for offset in corners:
            places = np.asarray((cells + offset) * grid.resolution, dtype=np.float64)
            local = corner @ places / (field.resolution * step)
            u, v = np.floor(local).astype(np.int64).T
            inside = (v >= 0) & (u >= 0) & (v < is_open.shape[0]) & (u < is_open.shape[1])
            is_open[v[inside], u[inside]] = True
    # A cell that is turned may cut across a square that holds none of its corners: the neighbours count as well.
    if corner.theta != 0.0:
        grown = is_open.copy()
        for row, column in ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)):
            _join(grown, is_open, row, column)
        return grown
    return is_open


def _corners(steps: int) -> list[float]:
    return [float(at) for at in np.linspace(_INSIDE, 1.0 - _INSIDE, steps + 1)]


def _join(target: NDArray[np.bool_], source: NDArray[np.bool_], row: int, column: int) -> None:
    """Set in `target` what is set in `source`, whose element [0, 0] lies at [row, column] of it."""
    top, left = max(row, 0), max(column, 0)
    part = source[top - row : target.shape[0] - row, left - column : target.shape[1] - column]
    target[top : top + part.shape[0], left : left + part.shape[1]] |= part


def _places(is_open: NDArray[np.bool_], count: int) -> I64:
    """`count` entries (v, u) among those that are open, spread over them; none if none is."""
    ends = np.cumsum(is_open.sum(axis=1))
    if ends[-1] == 0:
        return np.empty((0, 2), dtype=np.int64)
    chosen = np.random.default_rng(0).integers(ends[-1], size=count)
    rows = np.searchsorted(ends, chosen, side="right")
    columns = [np.flatnonzero(is_open[row])[index - ends[row]] for row, index in zip(rows, chosen, strict=True)]
    return np.column_stack((rows, columns)).astype(np.int64)


def _open_squares(is_open: NDArray[np.bool_], coarsest: int) -> OpenSquares:
    """For each level which squares hold open ground, the coarsest first."""
    levels = [is_open]
    for _ in range(coarsest):
        levels.append(_halved(levels[-1], 2))
    starts = np.zeros(coarsest + 1, dtype=np.int64)
    position = 0
    for level in range(coarsest, -1, -1):
        starts[level] = position
        position += levels[level].size
    flat = np.concatenate([level.ravel() for level in reversed(levels)])
    return OpenSquares(flat, starts, np.array([level.shape[1] for level in levels], dtype=np.int64))


def _halved(values: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    height, width = -(-values.shape[0] // step), -(-values.shape[1] // step)
    padded = np.zeros((height * step, width * step), dtype=np.bool_)
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(height, step, width, step).any(axis=(1, 3)))


def _by_phase(tables: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """The tables in the order of `hsloc.kernels.map_search`: entries that are `side` apart lie side by side."""
    count, height, width = tables.shape
    rows, columns = -(-height // side), -(-width // side)
    by_phase = np.empty((count, side, side, rows, columns), dtype=np.uint8)
    padded = np.zeros((rows * side, columns * side), dtype=np.uint8)
    for table, phases in zip(tables, by_phase, strict=True):
        padded[:height, :width] = table
        phases[:] = padded.reshape(rows, side, columns, side).transpose(1, 3, 0, 2)
    return by_phase


def _cluster(points: F64, side: float) -> F64:
    """Rows (x, y, radius, count): the points in each square of `side` cells, put together."""
    keys = np.floor(points / side).astype(np.int64)
    _, index, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()
    low = np.full((len(counts), 2), np.inf)
    high = np.full((len(counts), 2), -np.inf)
    np.minimum.at(low, index, points)
    np.maximum.at(high, index, points)
    centres = 0.5 * (low + high)
    radii = np.zeros(len(counts))
    np.maximum.at(radii, index, np.hypot(*(points - centres[index]).T))
    return np.column_stack((centres, radii, counts))
