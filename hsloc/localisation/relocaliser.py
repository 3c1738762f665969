"""The relocaliser: where on the whole map the robot could be, until one hypothesis wins.

The free space is cut into tiles; HIDE searches each of them over all headings, and what it finds becomes a hypothesis.
Each further scan moves the hypotheses with the odometry, matches them again in a small window and adds to their record.
Hypotheses that fall behind are dropped, those that meet are merged. The winner must be ahead of all others by a sum
of fitness that grows over several scans and some way: in a place that exists twice, nobody is sure. The scans
seen until then are matched again, backwards, so that the trajectory can be completed.

(Counting out the points whose beam runs through a wall was tried and made it worse: in the Wean Hall log a fifth of
the beams at the true poses do, for doors are drawn shut.)
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from math import floor, hypot, pi, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.motion import fuse, predict_covariance
from hsloc.matching.harmony_search import HarmonySearch
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2, wrap_angle
from hsloc.parameters import Count, NonNegative, Parameters, Positive, Ratio

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.localisation.motion import OdometryNoise
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Matcher
    from hsloc.model.events import PairedScan
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class RelocaliserParameters(Parameters):
    """How the whole map is searched, and when a hypothesis is accepted."""

    tile: Positive = 1.5
    """Side of a tile of free space that is searched at once [m]."""
    sectors: Count = 4
    """Number of parts in which the headings are searched."""
    budget: Count = 240
    """Number of fitness evaluations in each tile and sector."""
    search_points: Count = 60
    """Maximum number of points of a scan that are used while tiles are searched."""
    hypotheses: Count = 400
    """Maximum number of hypotheses."""
    step_min_d: NonNegative = 0.3
    """Minimum translation between two scans that update the hypotheses [m]; a larger rotation is enough, too."""
    step_min_a: NonNegative = 0.3
    """Minimum rotation between two scans that update the hypotheses [rad]; a larger translation is enough, too."""
    seed_scans: Count = 3
    """Number of scans with which the whole map is searched."""
    min_points: Count = 20
    """Minimum number of hits of a scan that updates the hypotheses."""
    min_scans: Count = 4
    """Minimum number of scans before a hypothesis is accepted."""
    min_fitness: Ratio = 0.35
    """Minimum mean fitness of an accepted hypothesis."""
    min_margin: NonNegative = 1.0
    """Minimum difference between the summed fitness of an accepted hypothesis and that of any other."""
    drop: NonNegative = 2.5
    """Difference to the best summed fitness at which a hypothesis is dropped."""
    restart_below: Ratio = 0.3
    """Mean fitness of the best hypothesis below which the search starts again."""


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What the relocaliser thinks after a scan."""

    pose: Pose2 | None
    covariance: F64 | None
    fitness: float | None
    evaluations: int
    is_sure: bool
    reason: str
    track: tuple[tuple[int, Pose2], ...] = ()
    """Once it is sure: the way since the search began, as (odometry messages before, T_map_odom)."""
    track_is_whole: bool = False
    """Whether the track goes back to the first scan of the search."""


@dataclass(slots=True, eq=False)
class _Hypothesis:
    pose: Pose2
    covariance: F64
    fitness: float
    total: float
    scans: int

    @property
    def mean(self) -> float:
        return self.total / self.scans


_NEAR = 0.5
_NEAR_ANGLE = radians(15.0)
_STEP_WINDOW = (0.25, radians(8.0))
_FITS = 0.5
"""Going backwards, a scan fits with so large a part of the winner's fitness."""
_TRACE_LOST = 5
"""Scans in a row that fit nowhere near, going backwards: before them the robot was elsewhere, or is not known."""
REMEMBERED = 1000
"""Scans of a search that are kept to retrace the way; older ones are forgotten, so that memory is bounded."""


class Relocaliser:
    """Searches the whole map; its state is a list of hypotheses."""

    def __init__(
        self,
        grid: OccupancyGrid,
        likelihood: LikelihoodField,
        matcher: Matcher,
        parameters: RelocaliserParameters,
        noise: OdometryNoise,
        rng: Generator,
    ) -> None:
        self._field = likelihood
        self._matcher = matcher
        self._parameters = parameters
        self._noise = noise
        self._rng = rng
        self._tiles = _tiles(grid, self._parameters.tile)
        self._hypotheses: list[_Hypothesis] = []
        self._T_odom_last: Pose2 | None = None
        self._seen: deque[tuple[int, F64, Pose2]] = deque(maxlen=REMEMBERED)

    def start(self) -> None:
        """Forget everything."""
        self._hypotheses = []
        self._T_odom_last = None
        self._seen.clear()

    def update(self, paired: PairedScan, odometry_count: int) -> Verdict:
        """Take a scan, and how many odometry messages there were until now."""
        p = self._parameters
        T_odom_base = paired.T_odom_base
        motion = Pose2() if self._T_odom_last is None else self._T_odom_last.between(T_odom_base)
        moved = hypot(motion.x, motion.y) >= p.step_min_d or abs(motion.theta) >= p.step_min_a
        if self._hypotheses and not moved:
            return self._verdict(motion, 0, False)
        points = paired.points_base()
        if len(points) < p.min_points:
            return self._verdict(motion, 0, False)
        self._T_odom_last = T_odom_base
        self._seen.append((odometry_count, points, T_odom_base))
        if self._hypotheses and self._hypotheses[0].mean < p.restart_below:
            self._hypotheses = []
        evaluations = self._advance(points, motion)
        scans = self._hypotheses[0].scans if self._hypotheses else 1
        if scans <= p.seed_scans:
            evaluations += self._seed(points, scans)
        self._keep()
        return self._verdict(Pose2(), evaluations, True)

    def _seed(self, points: F64, scans: int) -> int:
        """Search every tile; a pose that is found late is taken for as fit in the scans before."""
        p = self._parameters
        half = 0.6 * p.tile, 0.6 * p.tile, 1.1 * pi / p.sectors
        headings = [wrap_angle(2.0 * pi * sector / p.sectors) for sector in range(p.sectors)]
        windows = [Window(Pose2(x, y, heading), *half) for x, y in self._tiles for heading in headings]
        poses, fitness, evaluations = self._search(points, windows)
        unsure = np.diag(np.square(half))
        self._hypotheses += [
            _Hypothesis(pose, unsure, float(fit), float(fit) * scans, scans)
            for pose, fit in zip(poses, fitness, strict=True)
        ]
        return evaluations

    def _search(self, points: F64, windows: list[Window]) -> tuple[list[Pose2], F64, int]:
        """The fittest pose in each window, how fit, and the evaluations spent."""
        quick = self._quick_matcher()
        if isinstance(quick, HarmonySearch):
            return quick.match_boxes(points, self._field, windows, self._rng)
        found = [quick.match(points, self._field, window, self._rng) for window in windows]
        fitness = np.array([match.fitness for match in found])
        return [match.pose for match in found], fitness, sum(match.evaluations for match in found)

    def _advance(self, points: F64, motion: Pose2) -> int:
        """Move the hypotheses with the odometry and match them again."""
        evaluations = 0
        half, half_angle = _STEP_WINDOW
        spread = 3.0 * np.sqrt(np.diag(self._noise.covariance(motion)))
        half = max(half, float(spread[:2].max()))
        half_angle = max(half_angle, float(spread[2]))
        quick = self._quick_matcher()
        for hypothesis in self._hypotheses:
            window = Window(hypothesis.pose @ motion, half, half, half_angle)
            match = quick.match(points, self._field, window, self._rng)
            evaluations += match.evaluations
            hypothesis.pose = match.pose
            hypothesis.covariance = match.covariance
            hypothesis.fitness = match.fitness
            hypothesis.total += match.fitness
            hypothesis.scans += 1
        return evaluations

    def _keep(self) -> None:
        """Drop the hypotheses that fell behind, merge those that met: of each place the best stays."""
        p = self._parameters
        self._hypotheses.sort(key=lambda h: -h.total)
        taken = _Places()
        kept: list[_Hypothesis] = []
        for hypothesis in self._hypotheses:
            if len(kept) >= p.hypotheses or hypothesis.total < self._hypotheses[0].total - p.drop:
                break
            if taken.add(hypothesis.pose):
                kept.append(hypothesis)
        self._hypotheses = kept

    def _verdict(self, motion: Pose2, evaluations: int, fresh: bool) -> Verdict:
        if not self._hypotheses:
            return Verdict(None, None, None, evaluations, False, "searching the whole map")
        p = self._parameters
        best = self._hypotheses[0]
        lead = best.total - self._hypotheses[1].total if len(self._hypotheses) > 1 else p.drop
        sure = fresh and best.scans >= p.min_scans and best.mean >= p.min_fitness and lead >= p.min_margin
        reason = f"{len(self._hypotheses)} hypotheses, best {best.mean:.2f}, lead {lead:.2f}, {best.scans} scans"
        covariance = best.covariance if sure else None
        fitness = best.fitness if fresh else None
        track, whole = self._retrace(best, motion) if sure else ((), False)
        return Verdict(best.pose @ motion, covariance, fitness, evaluations, sure, reason, track, whole)

    def _retrace(self, winner: _Hypothesis, motion: Pose2) -> tuple[tuple[tuple[int, Pose2], ...], bool]:
        """The scans seen while searching, localised backwards from where the robot is now known to be.

        As far as they fit, and whether that is all of them: where several in a row do not, the trace is lost.
        """
        half, half_angle = _STEP_WINDOW
        pose, covariance = winner.pose @ motion, winner.covariance
        fits = max(self._parameters.min_fitness, _FITS * winner.fitness)
        track: list[tuple[int, Pose2]] = []
        misses = 0
        T_odom_next: Pose2 | None = None
        for count, points, T_odom_base in reversed(self._seen):
            if T_odom_next is not None:
                motion = T_odom_next.between(T_odom_base)
                covariance = predict_covariance(covariance, pose, motion, self._noise.covariance(motion))
                pose = pose @ motion
            T_odom_next = T_odom_base
            match = self._matcher.match(points, self._field, Window(pose, half, half, half_angle), self._rng)
            misses += 1
            if match.fitness >= fits:
                pose, covariance = fuse(pose, covariance, match.pose, match.covariance)
                misses = 0
            track.append((count, pose @ T_odom_base.inverse()))
            if misses == _TRACE_LOST:
                return tuple(reversed(track[:-misses])), False
        return tuple(reversed(track)), len(self._seen) < REMEMBERED

    def _quick_matcher(self) -> HarmonySearch | Matcher:
        """The matcher with a small budget and one restart; a matcher without a budget stays as it is."""
        if isinstance(self._matcher, HarmonySearch):
            return replace(
                self._matcher,
                budget=self._parameters.budget,
                count_improvisations=False,
                restarts=1,
                search_points=self._parameters.search_points,
                polish_iterations=10,
            )
        return self._matcher


class _Places:
    """Poses that differ; sorted into cells, so that the time does not grow with the square of the map."""

    def __init__(self) -> None:
        self._cells: dict[tuple[int, int], list[Pose2]] = {}

    def add(self, pose: Pose2) -> bool:
        """Take a pose, unless one is near already; whether it was taken."""
        u, v = floor(pose.x / _NEAR), floor(pose.y / _NEAR)
        near = (other for du in (-1, 0, 1) for dv in (-1, 0, 1) for other in self._cells.get((u + du, v + dv), ()))
        if any(_same(pose, other) for other in near):
            return False
        self._cells.setdefault((u, v), []).append(pose)
        return True


def _same(first: Pose2, second: Pose2) -> bool:
    return first.distance(second) < _NEAR and abs(wrap_angle(first.theta - second.theta)) < _NEAR_ANGLE


def _tiles(grid: OccupancyGrid, side: float) -> list[tuple[float, float]]:
    """Centres (metres, map frame) of the tiles in which a fair part of the cells is free."""
    free = grid.free()
    step = max(round(side / grid.resolution), 1)
    centres: list[tuple[float, float]] = []
    for row in range(0, free.shape[0], step):
        for column in range(0, free.shape[1], step):
            tile = free[row : row + step, column : column + step]
            if tile.sum() >= 0.04 * step * step:
                middle = grid.origin @ Pose2(
                    (column + tile.shape[1] / 2) * grid.resolution, (row + tile.shape[0] / 2) * grid.resolution, 0.0
                )
                centres.append((middle.x, middle.y))
    return centres
