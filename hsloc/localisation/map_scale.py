"""Whether the map is larger or smaller than what the lidar measures: a wrong resolution in its YAML, a stretched plan.

Ranges are in metres; cells of the map are so only if its resolution is right. A map that is 2 % too large still fits
every scan, with walls a little behind the points, and poses are wrong by 2 % of their distance from its corner.

Each scan that was matched gives the distances of its points from the walls of the map along the walls' normals. They
are explained by five unknowns: the pose, the scale, and an offset of the range, because a wall is drawn as whole cells,
whose centres lie behind its surface. Pose and offset are eliminated; what is left is the information about the scale.
Odometry plays no part, for its scale is unknown itself.

The same distances, averaged over each row of cells, show how well the walls are drawn: where they lie in the cells.

Where the scale is so wrong that other walls are nearest, scans that do not fit are matched with
their points nearer or farther as well: at the right scale nearly all of them lie on walls.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, hypot, inf, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.beams import wall_normals, wall_rows
from hsloc.kernels.fitness import point_scores
from hsloc.matching.covariance import CORRELATED, MAX_GAP, POINT_SIGMA
from hsloc.matching.local_refinement import refine
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.model.events import PairedScan
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]

_SPACING_M = 2.0
"""Path length between two scans that are used (m): nearer ones see the same walls."""
_BLOCK_M = 6.0
"""Path length of a block (m): what it sees is taken for independent of the others."""
_FEWEST_BLOCKS = 5
"""Blocks below which nothing is said: their scatter is not known."""
_MOST_WALLS = 16
"""Independent walls that the errors of their drawing average over, at most: a building is drawn in one way."""
_LEAST_POINTS = 20
"""Points on walls of a scan that is used, at least."""
_WINDOW = (0.3, 0.3, 0.1)
"""Half-widths (m, m, rad) in which the pose is found again at the scale that is known so far."""
_REACH_M, _LEAST_STEP_M = 0.3, 0.05
"""Walls are looked for within this distance of a point, in steps of a cell, but not of less than the second (m)."""
_ON_WALL = 0.6
"""Score that a point reaches where it is moved onto a wall, at least."""
_ROBUST_M = 0.1
"""Distance from the wall, or noise of the range, at which a point counts by half (m): Cauchy's weight."""
_LARGEST_PRIOR = 0.1
"""Standard deviation of the scale before anything is known; larger ones are not followed by the localiser."""
_MOST_CELLS_OFF = 1.5
"""A point farther from its wall than this many cells shows something else than how the wall is drawn."""
_LEAST_OF_ROW = 5
"""Points of a row of cells whose mean shows where its wall is, at least."""
_PRIOR_WALLS = 10.0
"""Number of rows that the assumption about a wall's place within its cell counts as."""
_LEAST_SIGMA = 0.002
"""Standard deviation of a wall's place, at least (m): no building is drawn better."""
_SIGMAS, _LEAST = 3.0, 0.005
"""A scale is significant if it differs from 1 by this number of standard deviations, and by this much: 5 cm in 10 m."""
_DOUBTED_SIGMAS = 2.0
"""Standard deviations from which on 1 lies outside the 95 % interval: poses are then not taken for right by this much.
"""


_TRIED_STEP = 0.01
_TRIED = _TRIED_STEP * np.arange(-10, 11)
"""Scales less 1 at which scans that do not fit are matched: so near to each other that one leads to the next (10 cm at
10 m), and up to `_LARGEST_PRIOR`."""
_FITS = 0.94
"""Fitness of a scan from which on no other scale is tried. On right maps it is 0.95 and more, on maps of which 30 %
changed 0.68 to 0.80, on those scaled by 1.05 0.5 to 0.8, by 0.97 0.7 to 0.93."""
_FEWEST_TRIED = 2
"""Scans that are tried, at least: a robot that is soon lost matches no more."""
_LEAST_GAIN, _GAIN_SIGMAS = 0.05, 4.0
"""Mean gain of fitness at another scale that is no chance, and standard errors of it. It is 0.1 at 0.97 and 0.17 to
0.44 at 1.05; right maps that changed, with people or of which half is missing fit best at 1 (20 runs)."""
_LEAST_TRIED = 0.025
"""Scales nearer to 1 are left to the distances, whose walls are the right ones then: 1.02 was found in all runs."""
_TRIED_SIGMA = 0.002
"""Standard deviation of the scale that is found by trying, at least: a fifth of a step."""


class _TriedScales:
    """State: the fitness of each scan at each of `_TRIED` scales; that of one that fits counts as the same at all."""

    def __init__(self) -> None:
        self._fitness: list[F64] = []

    def add(self, field: LikelihoodField, points: F64, beams: F64, pose: Pose2, fitness: float, *, fits: bool) -> None:
        """A scan of points (n, 2), with beams (n, 2), matched at `pose`; other scales are tried if it does not fit."""
        found = np.full(len(_TRIED), fitness)
        if not fits:
            middle = len(_TRIED) // 2
            for order in (range(middle, len(_TRIED)), range(middle, -1, -1)):
                here = pose
                for k in order:
                    match = refine(points + beams * _TRIED[k], field, Window(here, *_WINDOW))
                    found[k], here = match.fitness, match.pose
        self._fitness.append(found)

    def scale(self) -> tuple[float, float] | None:
        """The scale less 1 at which the scans fit beyond doubt, and its standard deviation; None if it may be 1."""
        n = len(self._fitness)
        if n < _FEWEST_TRIED:
            return None
        fitness = np.array(self._fitness)
        mean = fitness.mean(axis=0)
        best = int(mean.argmax())
        gain = fitness[:, best] - fitness[:, len(_TRIED) // 2]
        error = float(gain.std(ddof=1)) / sqrt(n)
        if not 0 < best < len(_TRIED) - 1 or gain.mean() < max(_LEAST_GAIN, _GAIN_SIGMAS * error):
            return None
        without = (fitness.sum(axis=0) - fitness) / (n - 1)
        peaks = np.array([_peak(row, best) for row in (mean, *without)])
        scatter = sqrt((n - 1) / n * float(((peaks[1:] - peaks[1:].mean()) ** 2).sum()))
        found = float(peaks[0])
        return (found, hypot(scatter, _TRIED_SIGMA)) if abs(found) >= _LEAST_TRIED else None


def _peak(fitness: F64, best: int) -> float:
    """Where the parabola through the best of `_TRIED` and its neighbours is highest."""
    before, at, after = fitness[best - 1 : best + 2].tolist()
    bend = before - 2.0 * at + after
    offset = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return float(_TRIED[best] + _TRIED_STEP * min(max(offset, -0.5), 0.5))


@dataclass(frozen=True, slots=True)
class MapScale:
    """Length on the map by length as the lidar measures it, its standard deviation, and the map's corner (m).

    Of a map whose cells were made larger or smaller before, `corrected` is by what their side was divided, and `value`
    is what is left. `by_fit` says that scans fit at this scale which do not fit at 1: it is so even where most scans
    found no match.
    """

    value: float
    sigma: float
    corner: tuple[float, float] = (0.0, 0.0)
    corrected: float = 1.0
    by_fit: bool = False

    @property
    def is_significant(self) -> bool:
        """Whether the map is too large or too small beyond doubt, and by enough to matter."""
        return abs(self.value - 1.0) > max(_SIGMAS * self.sigma, _LEAST)

    @property
    def is_doubted(self) -> bool:
        """Whether poses far from the map's corner may be wrong by the scale: it need not be beyond doubt for that."""
        return abs(self.value - 1.0) > max(_DOUBTED_SIGMAS * self.sigma, _LEAST)

    @property
    def of_given_map(self) -> float:
        """The scale of the map as it was given."""
        return self.value * self.corrected

    def applied(self, grid: OccupancyGrid) -> OccupancyGrid:
        """The map with cells of the size that the lidar measures; its corner stays where it is."""
        return replace(grid, resolution=grid.resolution / self.value)

    def moved(self, pose: Pose2) -> Pose2:
        """A pose on the map: that in the same cell of the map of `applied`."""
        x, y = self.corner
        return Pose2(x + (pose.x - x) / self.value, y + (pose.y - y) / self.value, pose.theta)

    @property
    def moves_poses(self) -> bool:
        """Whether poses may be wrong by the scale.

        A resolution that is given is right by itself; one that was corrected is known to a standard deviation only.
        """
        return self.is_doubted or self.corrected != 1.0

    def pose_errors(self, poses: F64) -> F64:
        """Errors (n, 3) of poses (n, 3) that come from the scale (m, m, 0): the cells grow from the corner.

        0 where the scale moves no poses.
        """
        errors = np.zeros((len(poses), 3))
        if self.moves_poses:
            largest = abs(self.value - 1.0) + self.sigma
            errors[:, :2] = largest * np.abs(poses[:, :2] - self.corner)
        return errors


class MapScaleEstimator:
    """State: for each block of the path the information about scale and offset."""

    def __init__(self, likelihood: LikelihoodField, corner: tuple[float, float]) -> None:
        self._field = likelihood
        self._corner = corner
        self._path_length = 0.0
        self._used_at = -inf
        self._information: dict[int, F64] = {}
        self._vector: dict[int, F64] = {}
        self._weight = 0.0
        self._squares = 0.0
        self._wall_squares = 0.0
        self._walls = 0
        self._tried = _TriedScales()

    def move(self, distance: float) -> None:
        """The robot moved on (m)."""
        self._path_length += distance

    def matched(self, paired: PairedScan, pose: Pose2) -> None:
        """A scan was matched at `pose`, T_map_base; it is used if the last one is far enough behind."""
        if self._path_length - self._used_at < _SPACING_M:
            return
        points = np.ascontiguousarray(paired.scan.points_base())
        if len(points) < _LEAST_POINTS:
            return
        laser = paired.scan.T_base_laser
        beams = points - (laser.x, laser.y)
        ranges = np.maximum(np.hypot(beams[:, 0], beams[:, 1]), 1e-6)
        normals = np.empty_like(points)
        wall_normals(points, MAX_GAP, POINT_SIGMA**2, normals)
        on_walls = np.abs(normals).sum(axis=1) > 0.0
        if np.count_nonzero(on_walls) < _LEAST_POINTS:
            return
        self._used_at = self._path_length
        known = self._solve()
        scaled = points + beams * known[0] + beams * (known[1] / ranges)[:, None]
        match = refine(scaled, self._field, Window(pose, *_WINDOW))
        fits = match.fitness >= _FITS and abs(known[0]) < 0.5 * _TRIED_STEP
        self._tried.add(self._field, points, beams, pose, match.fitness, fits=fits)
        pose = match.pose
        scaled, normals = scaled[on_walls], normals[on_walls]
        beams, ranges = beams[on_walls], ranges[on_walls]
        distance, found = self._distances(scaled, normals, pose)
        step = np.hypot(*np.diff(scaled, axis=0, prepend=scaled[:1]).T)
        squares = distance**2 + paired.scan.noise()[on_walls] ** 2
        weight = np.minimum(step / self._field.resolution, 1.0) * found / (1.0 + squares / _ROBUST_M**2)
        self._add_walls(scaled, normals, np.where(found, distance, np.inf), pose)
        across = (normals * beams).sum(axis=1)
        turned = normals[:, 1] * scaled[:, 0] - normals[:, 0] * scaled[:, 1]
        # The range by the map: the noise of the measured one is in the distance, too, and would pass for a scale.
        by = np.column_stack((normals, turned, across + np.where(found, distance, 0.0), across / ranges))
        full, right = by.T @ (weight[:, None] * by), by.T @ (weight * distance)
        # The pose is eliminated; directions that no wall holds say nothing of the scale.
        gain = np.linalg.solve(full[:3, :3] + 1e-3 * np.eye(3), full[:3, 3:])
        information = full[3:, 3:] - full[3:, :3] @ gain
        vector = right[3:] - gain.T @ right[:3] + information @ known
        block = int(self._path_length / _BLOCK_M)
        self._information[block] = self._information.get(block, np.zeros((2, 2))) + information
        self._vector[block] = self._vector.get(block, np.zeros(2)) + vector
        self._weight += float(weight.sum())
        self._squares += float(weight @ distance**2)

    def _distances(self, points: F64, normals: F64, pose: Pose2) -> tuple[F64, NDArray[np.bool_]]:
        """Signed distance (n,) of each point from the nearest wall along its normal (m), and whether there is one."""
        field = self._field
        step = max(field.resolution, _LEAST_STEP_M)
        reach = max(int(_REACH_M / step), 2)
        moves = np.arange(-reach, reach + 1)
        scores = np.empty((len(moves), len(points)), dtype=np.float32)
        x, y, theta = field.to_cells(pose)
        for row, k in zip(scores, moves, strict=True):
            point_scores(field.packed, field.scale(points + k * step * normals), x, y, theta, row)
        inner = scores[1:-1]
        is_peak = (inner >= scores[:-2]) & (inner >= scores[2:]) & (inner > _ON_WALL)
        # The nearest of them: both faces of a wall are drawn in a good map. Of two as near the one that scores more.
        far = np.where(is_peak, np.abs(moves[1:-1])[:, None] - 0.1 * inner, np.inf)
        best = far.argmin(axis=0) + 1
        rows = np.arange(len(points))
        logs = np.log(np.maximum(scores.astype(np.float64), 1e-9))
        # A score is exp(-d / sigma): its logarithms on both sides of a wall show where between the steps it lies.
        between = 0.5 * field.sigma * (logs[best + 1, rows] - logs[best - 1, rows])
        return moves[best] * step + np.clip(between, -step, step), np.isfinite(far.min(axis=0))

    def _add_walls(self, points: F64, normals: F64, distance: F64, pose: Pose2) -> None:
        """How far the walls of the map, row by row of cells, are from where a scan sees them."""
        cell = self._field.resolution
        metres = self._field.to_cells(pose) * (cell, cell, 1.0)
        rows = np.empty(len(points), dtype=np.int64)
        wall_rows(points, normals, metres, cell, rows)
        c, s = cos(metres[2]), sin(metres[2])
        x, y = c * normals[:, 0] - s * normals[:, 1], s * normals[:, 0] + c * normals[:, 1]
        signed = np.where(np.where(np.abs(x) > np.abs(y), x, y) < 0.0, -distance, distance)
        near = np.abs(distance) < _MOST_CELLS_OFF * cell
        _, row, count = np.unique(rows[near], return_inverse=True, return_counts=True)
        mean = np.bincount(row, signed[near]) / count
        scatter = float(((signed[near] - mean[row]) ** 2).sum()) / max(len(row) - len(count), 1)
        seen_well = count >= _LEAST_OF_ROW
        free = int(seen_well.sum()) - 3  # the pose was fitted to them
        if free > 0:
            self._wall_squares += float((mean[seen_well] ** 2 - scatter / count[seen_well]).sum())
            self._walls += free

    @property
    def wall_variance(self) -> float:
        """Variance of the place of a wall on the map (m^2): that within a cell first, then what the scans show."""
        prior = self._field.resolution**2 / 12.0
        found = (_PRIOR_WALLS * prior + self._wall_squares) / (_PRIOR_WALLS + self._walls)
        return max(found, _LEAST_SIGMA**2)

    def _prior(self) -> F64:
        """Information (2, 2) about scale and offset before the first scan, in the unit of the sums."""
        variance = CORRELATED * (self._squares / self._weight if self._weight > 0.0 else POINT_SIGMA**2)
        return np.diag((variance / _LARGEST_PRIOR**2, variance / self._field.resolution**2))

    def _solve(self) -> F64:
        """Scale less 1, and offset (m), of all scans so far."""
        if not self._information:
            return np.zeros(2)
        total = sum(self._information.values(), self._prior())
        return np.asarray(np.linalg.solve(total, sum(self._vector.values(), np.zeros(2))))

    def estimate(self) -> MapScale | None:
        """The scale and its standard deviation; None while too little is seen.

        By the distances from the walls, unless scans fit at another scale, where the nearest walls are others.
        """
        near, tried = self._by_distances(), self._tried.scale()
        if tried is None or (near is not None and abs(near.value - 1.0 - tried[0]) < _TRIED_STEP):
            return near
        return MapScale(1.0 + tried[0], tried[1], self._corner, by_fit=True)

    def _by_distances(self) -> MapScale | None:
        """By the distances of points from walls; None before `_FEWEST_BLOCKS` blocks of path were seen.

        Two errors: the scatter of the blocks (jackknife), and that of how walls are drawn, which is the same wherever
        a wall is seen: how far walls are from their place, by the spread of the ranges that distinguishes scale from
        offset.
        """
        n = len(self._information)
        if n < _FEWEST_BLOCKS:
            return None
        information, vector = np.array(list(self._information.values())), np.array(list(self._vector.values()))
        total, sums = information.sum(axis=0) + self._prior(), vector.sum(axis=0)
        value = np.linalg.solve(total, sums)[0]
        without = np.linalg.solve(total - information, (sums - vector)[:, :, None])[:, 0, 0]
        scatter = sqrt((n - 1) / n * float(((without - without.mean()) ** 2).sum()))
        left = total[0, 0] - total[0, 1] ** 2 / total[1, 1]
        spread = sqrt(max(float(left), 1e-12) / max(self._weight, 1e-12))
        drawn = sqrt(self.wall_variance) / spread / sqrt(min(n, _MOST_WALLS))
        return MapScale(1.0 + float(value), hypot(scatter, drawn), self._corner)
