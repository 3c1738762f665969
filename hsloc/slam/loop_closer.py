"""Closing loops: is this place one that was seen before, long ago on the way?

Places are visited in their order. Those seen before that could be near, by a drift that is assumed too large rather
than too small, are searched by HIDE over the whole window in which they could lie. A match is believed if it is fit,
if neither place looks through the walls of the other, and if no other pose in the window comes near to it (branch and
bound, hsloc/kernels/branch_and_bound.py: in a corridor whose every bay looks the same there is one). It becomes an
edge of the pose graph with a covariance and a robust weight, and the graph is solved before the next place is looked
at.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, hypot, radians, sqrt
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.branch_and_bound import best_on_lattice, pool
from hsloc.kernels.point_to_line import pair_terms
from hsloc.matching.harmony_search import low_discrepancy_order
from hsloc.matching.hide import Hide
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2, compose_poses, relative_poses
from hsloc.slam.pose_graph import Edges, solve_edges

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.slam.keyscans import KeyScans
    from hsloc.slam.submaps import Submaps

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopParameters:
    """Where loops are looked for, and when one is believed."""

    submap_length: float = 3.0
    """A place is so much of the way (m)."""
    min_path_length: float = 12.0
    """Places nearer along the way or over loops already closed are let be (m)."""
    search_radius: float = 3.0
    """Places are compared that could lie so near (m)."""
    drift: float = 0.02
    """Assumed standard deviation of the drift, as a part of the way."""
    drift_angle: float = radians(0.3)
    """And of the heading, times the square root of the way in metres (rad)."""
    sigmas: float = 3.0
    """Half-width of the window in these standard deviations."""
    max_candidates: int = 3
    """Old places searched for each place, the nearest ones of different times."""
    resolution: float = 0.1
    """Of the field of a place (m)."""
    sigma: float = 0.2
    """Decay of its score (m)."""
    scan_range: float = 15.0
    """Hits farther away are left out (m)."""
    min_fitness: float = 0.5
    """Of a place's points on the other place's field."""
    max_rival: float = 0.85
    """Another pose may reach at most this part of the fitness."""
    wide: float = 2.0
    """A window with half-widths of more metres is a wide one (m): where so much is possible, more is asked."""
    min_margin: float = 0.11
    """In a wide window the fitness must be so much above that of any other pose."""
    max_conflict: float = 0.1
    """At most this part of the points may lie where the other place looked through."""
    min_paired: float = 0.15
    """At least this part of the points seen by the other place must lie on its walls."""
    sigma_edge: float = 0.05
    """Standard deviation of a loop beside that of its match (m)."""
    sigma_edge_angle: float = radians(0.5)
    """And of its angle (rad)."""
    robust: float = 2.0
    """Scale of Cauchy's weight on chi."""
    hide: Hide = field(
        default_factory=lambda: Hide(restarts=12, agreement=3, budget=600, memory_size=40, search_points=150)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A loop that was searched for: place `second` seen from place `first`, and what was found."""

    first: int
    second: int
    T_first_second: Pose2
    covariance: F64
    fitness: float
    rival: float
    """Fitness of the best other pose in the window, as a part; NaN: not looked for, the match was refused before."""
    conflict: float
    paired: float
    window: tuple[float, float]
    accepted: bool
    reason: str = ""


_CACHED = 48
"""Fields of places kept."""
_COMPARED = 90
"""Points of a scan that are looked up in another."""
_VISITS = 3_000_000
"""Bounds computed for a window before it counts as ambiguous."""
_CONNECTED_WAY = 12.0
"""A place that was found on the whole map is known as well as after so many metres of the way."""
_DISTINCT = (0.8, radians(12.0))
"""A pose farther from the match than this is another one (m, rad)."""


class LoopCloser:
    """State: poses of the places, and the loops found so far."""

    def __init__(
        self,
        places: Submaps,
        scans: KeyScans,
        parameters: LoopParameters,
        rng: Generator,
        banned: frozenset[tuple[int, int]] = frozenset(),
        known: tuple[Loop, ...] = (),
        first: int = 0,
    ) -> None:
        """`banned` pairs are let be, `known` loops believed, and places before `first` visited already."""
        self._places = places
        self._scans = scans
        self._parameters = parameters
        self._rng = rng
        self._banned = banned
        self.poses = places.poses[places.reference].copy()
        self.loops = [loop for loop in known if (loop.first, loop.second) not in banned]
        self._first = first
        self._chosen = scans.chosen(_COMPARED)
        self._fields: dict[int, tuple[LikelihoodField, NDArray[np.float32]]] = {}

    @property
    def accepted(self) -> list[Loop]:
        """The loops that were believed."""
        return [loop for loop in self.loops if loop.accepted]

    def close(self, progress: Callable[[float], None] | None = None) -> None:
        """Visit all places in their order."""
        if self.loops:
            self.solve()
        for place in range(self._first, len(self._places)):
            found = [self._search(old, place, way) for old, way in self._candidates(place)]
            self.loops += found
            if any(loop.accepted for loop in found):
                self.solve()
            if progress is not None:
                progress((place + 1) / len(self._places))

    def connections(self, place: int) -> list[Loop]:
        """What is found between a place of this log and the nearest before `first`, its pose being nearly known."""
        distance = np.hypot(*(self.poses[: self._first, :2] - self.poses[place, :2]).T)
        near = [
            int(old) for old in np.argsort(distance, kind="stable") if distance[old] < self._parameters.search_radius
        ]
        return [self._search(old, place, _CONNECTED_WAY) for old in near[: self._parameters.max_candidates]]

    def edges(self) -> Edges:
        """The accepted loops as edges between the places."""
        loops = self.accepted
        if not loops:
            return Edges.none()
        return Edges(
            np.array([(loop.first, loop.second) for loop in loops], dtype=np.int64),
            np.array([loop.T_first_second.to_array() for loop in loops]),
            np.array([np.linalg.inv(loop.covariance) for loop in loops]),
            np.full(len(loops), self._parameters.robust),
        )

    def solve(self) -> None:
        """Solve the graph of the places: the front end's steps, and the loops with robust weights."""
        places = self._places
        steps = Edges.chain(places.steps, places.covariances, places.doubted)
        self.poses = solve_edges(self.poses, Edges.concatenate([steps, self.edges()]))

    def _candidates(self, place: int) -> list[tuple[int, float]]:
        """Old places that could be near, nearest first, with the way to each over the graph."""
        p = self._parameters
        way = self._ways(place)
        old = np.arange(place)
        distance = np.hypot(*(self.poses[:place, :2] - self.poses[place, :2]).T)
        # Places next to each other are drawn from the same scans: those would match themselves.
        apart = place - old > 3
        could = apart & (way >= p.min_path_length) & (distance <= p.search_radius + p.sigmas * p.drift * way)
        order = np.lexsort((old[could], distance[could]))
        chosen: list[tuple[int, float]] = []
        for candidate in old[could][order]:
            if (int(candidate), place) in self._banned:
                continue
            if all(abs(candidate - other) > 2 for other, _ in chosen):
                chosen.append((int(candidate), float(way[candidate])))
            if len(chosen) == p.max_candidates:
                break
        return chosen

    def _ways(self, place: int) -> F64:
        """Metres from a place to each earlier one along the way and over closed loops, shape (place,)."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra

        loops = self.accepted
        # Where two logs are connected the way may lead over places that are still to be visited.
        last = place if self._first == 0 else len(self._places) - 1
        rows = [*range(last), *(loop.first for loop in loops)]
        columns = [*range(1, last + 1), *(loop.second for loop in loops)]
        lengths = [
            *np.maximum(np.diff(self._places.way[: last + 1]), 1e-3),
            *(max(hypot(loop.T_first_second.x, loop.T_first_second.y), 0.1) for loop in loops),
        ]
        graph = coo_array((lengths, (rows, columns)), shape=(len(self._places), len(self._places)))
        distances: F64 = dijkstra(graph.tocsr(), directed=False, indices=np.array([place]))
        return distances[0, :place]

    def _search(self, old: int, place: int, way: float) -> Loop:
        p = self._parameters
        centre = Pose2.from_array(relative_poses(self.poses[None, old], self.poses[None, place])[0])
        half = p.sigmas * p.drift * way + 0.3
        half_angle = min(p.sigmas * p.drift_angle * sqrt(way) + radians(2.0), np.pi)
        likelihood, pooled = self._field(old)
        points = self._places.cloud(place, 1, self._scans, p.scan_range, 2.0 * p.resolution)
        match = p.hide.match(points, likelihood, Window(centre, half, half, half_angle), self._rng)
        paired, conflict = self._compare(old, place, match.pose)
        rival, reason = float("nan"), ""
        if match.fitness < p.min_fitness:
            reason = f"fitness {match.fitness:.2f} below {p.min_fitness:.2f}"
        elif conflict > p.max_conflict:
            reason = f"{100.0 * conflict:.0f} % of the points lie where the other place saw free space"
        elif paired < p.min_paired:
            reason = f"only {100.0 * paired:.0f} % of the points lie on walls of the other place"
        else:
            rival = self._rival(points, likelihood, pooled, match.pose, centre, half, half_angle)
            if not rival <= p.max_rival:
                reason = f"ambiguous: another pose reaches {100.0 * rival:.0f} % of the fitness"
            elif half > p.wide and match.fitness * (1.0 - rival) < p.min_margin:
                reason = (
                    f"ambiguous in a wide window: fitness {match.fitness:.2f}, another pose {100.0 * rival:.0f} % of it"
                )
        covariance = match.covariance + np.diag((p.sigma_edge**2, p.sigma_edge**2, p.sigma_edge_angle**2))
        return Loop(
            old,
            place,
            match.pose,
            covariance,
            match.fitness,
            rival,
            conflict,
            paired,
            (half, half_angle),
            not reason,
            reason,
        )

    def _field(self, place: int) -> tuple[LikelihoodField, NDArray[np.float32]]:
        found = self._fields.pop(place, None)
        if found is None:
            p = self._parameters
            drawn = self._places.field(place, 1, self._scans, p.scan_range, p.resolution, p.sigma)
            found = (drawn.field, pool(drawn.scores, 5))
        self._fields[place] = found
        if len(self._fields) > _CACHED:
            del self._fields[next(iter(self._fields))]
        return found

    def _rival(
        self,
        points: F64,
        likelihood: LikelihoodField,
        pooled: NDArray[np.float32],
        pose: Pose2,
        centre: Pose2,
        half: float,
        half_angle: float,
    ) -> float:
        """The best lattice pose distinct from `pose`, as a part of the best one near it."""
        p = self._parameters
        few = likelihood.scale(points[low_discrepancy_order(len(points))][: p.hide.search_points])
        step = 2.0 * p.resolution / p.scan_range
        cell = likelihood.resolution
        near = np.array((1.0, 1.0, step))
        nowhere = np.array((-1.0, -1.0, -1.0))
        here, found = likelihood.to_cells(pose), np.empty(3)
        own, _ = best_on_lattice(pooled[:1], few, here, near, step / 2.0, here, nowhere, 0.0, _VISITS, found)
        if own <= 0.0:
            return float("nan")
        needed = 0.7 * own
        box = np.array((ceil(half / cell), ceil(half / cell), half_angle))
        distinct = np.array((_DISTINCT[0] / cell, _DISTINCT[0] / cell, _DISTINCT[1]))
        other, _ = best_on_lattice(
            pooled, few, likelihood.to_cells(centre), box, step, here, distinct, needed, _VISITS, found
        )
        return float("nan") if other < 0.0 else float(other / own)

    def _compare(self, old: int, place: int, pose: Pose2) -> tuple[float, float]:
        """Of the points that either place sees of the other: the part on walls, the part where it looked through."""
        places, s = self._places, self._scans
        first, second = places.members(old, 1), places.members(place, 1)
        T_old = compose_poses(
            np.zeros(3),
            relative_poses(
                places.poses[None, places.reference[old]].repeat(len(first), 0), places.poses[first.start : first.stop]
            ),
        )
        T_new = compose_poses(
            pose.to_array(),
            relative_poses(
                places.poses[None, places.reference[place]].repeat(len(second), 0),
                places.poses[second.start : second.stop],
            ),
        )
        information, gradient, counts, total = np.empty((3, 3)), np.empty(3), np.zeros(5), np.zeros(5)
        for a in range(0, len(first), max(len(first) // 7, 1)):
            for b in range(0, len(second), max(len(second) // 7, 1)):
                for i, j, x, y in (
                    (second[b], first[a], T_new[b], T_old[a]),
                    (first[a], second[b], T_old[a], T_new[b]),
                ):
                    rel = relative_poses(y[None], x[None])[0]
                    pair_terms(
                        i, j, rel[0], rel[1], rel[2], s.points, s.normals, s.centroids, s.start, s.hit_of_beam,
                        s.ranges, s.table_start, s.geometry, *self._chosen, 0.3, 0.1, information, gradient, counts,
                    )  # fmt: skip
                    total += counts
        seen = max(total[2], 1.0)
        return float(total[0] / seen), float(total[1] / seen)
