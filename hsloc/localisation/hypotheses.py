"""Hypotheses of where the robot is, the test between two of them, and the search of the whole map for new ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import floor, log, radians
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.whole_map_search import Places, WholeMapParameters, WholeMapSearch
from hsloc.matching.harmony_search import HarmonySearch, low_discrepancy_order
from hsloc.matching.local_refinement import refine
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2, wrap_angle, wrap_angles

if TYPE_CHECKING:
    from collections import deque

    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Match, Matcher
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]

_NEAR = 0.5
_NEAR_ANGLE = radians(15.0)
RECORDED = 300
"""Scans in which a place that is found late is matched backwards, at most: 15 ms."""
_CANDIDATES = 200_000
_HIGHEST, _DEMAND_STEP = 0.9, 0.05
"""Fitness that places have to reach first, and half the step by which it falls until there is one."""
_GROWTH = 1.8
"""Boxes of a search by those of one whose demand is 0.05 higher: 1.6 to 3 on floors of 900 to 40,000 m2."""
_POOR = 0.7
"""Below this fitness there may be a great many other places: those clearly fitter are looked for first."""
_DEMANDS = (0.9, 0.8, 0.7, 0.6, 0.5)
_RIVALS = 20
"""Other places that are refined to find the fittest."""
_REFINED = 2
"""Places that are refined for each that is wanted."""
_REFINE_WINDOW = (0.2, 0.2, radians(6.0))
_BLOCK = 7
"""Scans of a block: two metres at the steps of the search."""
_RESOLUTION = 0.02
"""Standard deviation of the fitness of the same place, matched twice: what blocks differ by at least."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateLimits:
    """How many places are wanted, how fit, and how much work may be spent on them."""

    count: int
    """Maximum number of places."""
    margin: float
    """Fitness below the best within which a place is wanted."""
    min_fitness: float
    """Minimum fitness of a place."""
    points: int
    """Number of points that the whole map is searched with."""
    refined_points: int
    """Number of points that the places are refined with."""
    max_boxes: int
    """Maximum number of boxes of poses that are bounded."""


@dataclass(frozen=True, slots=True)
class Own:
    """A place that others are compared with: its pose and fitness, and how near (m, rad) is no other place."""

    pose: Pose2
    fitness: float
    distance: float
    angle: float
    least: float
    """Ratio to its fitness below which other places make no difference."""


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A pose T_map_base, and how well the scans fit there; `total` sums their fitness over `scans`."""

    pose: Pose2
    covariance: F64
    fitness: float
    total: float
    scans: int
    history: list[float]
    """Fitness in each scan of its record."""
    trail: deque[Pose2]
    """Its pose at the last scans of its record, up to `RECORDED`."""

    def follow(self, match: Match) -> None:
        """A further scan was matched there."""
        self.pose, self.covariance, self.fitness = match.pose, match.covariance, match.fitness
        self.total += match.fitness
        self.scans += 1
        self.history.append(match.fitness)
        self.trail.append(match.pose)

    def was_at(self, pose: Pose2, scans: int) -> bool:
        """Whether it was in this place at the first of the last `scans` scans."""
        return 0 < scans <= len(self.trail) and _same(self.trail[-scans], pose)

    @property
    def mean(self) -> float:
        """Mean fitness over the scans."""
        return self.total / self.scans


def search_text(best: Hypothesis, places: int, lead: float) -> str:
    """How far a search for the pose is; `lead` is the best place's sum of fitness less that of the next one."""
    over = f"fitness {best.mean:.2f} over {best.scans} {'scan' if best.scans == 1 else 'scans'}"
    if places == 1:
        return f"one place possible, with {over}"
    return f"{places} places possible; the best has {over}, in sum {lead:.2f} more than the next"


def fits_better(best: list[float], other: list[float], confidence: float) -> bool:
    """Student's paired t-test, one-sided, over means of blocks of scans.

    Scans that follow each other see the same errors of the map, so that their differences are no independent evidence;
    blocks about two metres long are taken for it. An error of the map in one place makes the blocks differ, and a sum
    that comes from few of them proves nothing.
    """
    n = min(len(best), len(other)) // _BLOCK
    if n < 2:
        return False
    difference = np.array(best[-n * _BLOCK :]) - np.array(other[-n * _BLOCK :])
    means = difference.reshape(n, _BLOCK).mean(axis=1)
    error = np.sqrt((means.var(ddof=1) + _RESOLUTION**2) / n)
    # Student's quantile is larger than that of the normal distribution, so that most pairs need no SciPy: to import its
    # special functions takes as long as two seconds of a log.
    if means.mean() < NormalDist().inv_cdf(confidence) * error:
        return False
    from scipy.special import stdtrit

    return bool(means.mean() >= float(stdtrit(n - 1, confidence)) * error)


class DistinctPoses:
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


def quick_matcher(matcher: Matcher, budget: int, points: int) -> Matcher:
    """The matcher with a small budget and one restart; a matcher without a budget stays as it is."""
    if not isinstance(matcher, HarmonySearch):
        return matcher
    return replace(
        matcher,
        budget=budget,
        count_improvisations=False,
        restarts=1,
        search_points=points,
        polish_iterations=10,
    )


def bounded_search(grid: OccupancyGrid, field: LikelihoodField) -> WholeMapSearch:
    """A search of a map whose memory is bounded: at most 11 MB of candidates."""
    return WholeMapSearch(grid, field, WholeMapParameters(max_candidates=_CANDIDATES))


def likely_places(search: WholeMapSearch, field: LikelihoodField, points: F64, limits: CandidateLimits) -> list[Pose2]:
    """Places of the whole map where points (n, 2) fit, the fittest first.

    All that fit within `limits.margin` of the best are among them as far as the work and the number allow.
    """
    even = points[low_discrepancy_order(len(points))]
    found = _within_margin(search, even[: limits.points], limits)
    if found is None:
        return []
    best = _fittest_of_each_bin(found, field)[: _REFINED * limits.count]
    matches = [refine(even[: limits.refined_points], field, _around(field.from_cells(found.poses[k]))) for k in best]
    taken = DistinctPoses()
    distinct = [
        match.pose
        for match in sorted(matches, key=lambda match: -match.fitness)
        if match.fitness >= limits.min_fitness and taken.add(match.pose)
    ]
    return distinct[: limits.count]


def _within_margin(search: WholeMapSearch, points: F64, limits: CandidateLimits) -> Places | None:
    """The demand falls until there is a place, and then to the margin below the best, or as far as the work allows."""
    demand, left = max(_HIGHEST, limits.min_fitness), limits.max_boxes
    while True:
        found = search.places_above(points, demand, left)
        left -= found.boxes
        if len(found.poses) or not found.is_complete or demand <= limits.min_fitness or _GROWTH * found.boxes > left:
            break
        demand = max(demand - 2.0 * _DEMAND_STEP, limits.min_fitness)
    if len(found.poses) == 0 or not found.is_complete:
        return None
    affordable = demand - _DEMAND_STEP * log(max(left / max(found.boxes, 1), 1.0)) / log(_GROWTH)
    wanted = max(float(found.fitness.max()) - limits.margin, limits.min_fitness, affordable)
    if wanted < demand:
        more = search.places_above(points, wanted, left)
        if more.is_complete:
            return more
    return found


def fittest_other(
    search: WholeMapSearch, field: LikelihoodField, points: F64, own: Own, max_boxes: int
) -> tuple[Pose2 | None, float]:
    """The fittest place for points (n, 2) farther from its own than `own` says, and a fitness that no other exceeds.

    The second is that of the first where there is one; else that down to which the map was searched.
    """
    left, reached = max_boxes, 1.0
    demands = [own.least * own.fitness]
    if own.fitness < _POOR:
        demands = [each for each in _DEMANDS if each > own.fitness] + [own.fitness, *demands]
    for demand in demands:
        found = search.places_above(points, demand, left)
        if not found.is_complete and len(demands) == 1:
            # There are too many as fit as that: are there some as fit as its own?
            found, demand = search.places_above(points, own.fitness, left), own.fitness
        left -= found.boxes
        if not found.is_complete or left <= 0:
            break
        reached = demand
        centre = field.to_cells(own.pose)
        away = np.hypot(*(found.poses[:, :2] - centre[:2]).T) * field.resolution
        turned = np.abs(wrap_angles(found.poses[:, 2] - centre[2]))
        others = np.flatnonzero((away > own.distance) | (turned > own.angle))
        if len(others):
            rest = Places(found.poses[others], found.fitness[others], found.boxes, True)
            best = _fittest_of_each_bin(rest, field)[:_RIVALS]
            matches = [refine(points, field, _around(field.from_cells(rest.poses[k]))) for k in best]
            fittest = max(matches, key=lambda match: match.fitness)
            return fittest.pose, max(fittest.fitness, demand)
    return None, reached


def _around(pose: Pose2) -> Window:
    return Window(pose, *_REFINE_WINDOW)


def _fittest_of_each_bin(found: Places, field: LikelihoodField) -> NDArray[np.int64]:
    """Of the places in each bin of half a metre and 15 deg the fittest; their indices, the fittest first."""
    side = _NEAR / field.resolution
    bins = np.floor(found.poses / (side, side, _NEAR_ANGLE)).astype(np.int64)
    order = np.lexsort((-found.fitness, *bins.T))
    is_first = np.ones(len(order), dtype=np.bool_)
    is_first[1:] = (np.diff(bins[order], axis=0) != 0).any(axis=1)
    best = order[is_first]
    return np.asarray(best[np.argsort(-found.fitness[best], kind="stable")])
