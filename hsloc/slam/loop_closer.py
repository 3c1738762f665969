"""Loop closing: submaps that were visited before.

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

from hsloc.kernels.branch_and_bound import Excluded, Lattice, best_on_lattice, pool
from hsloc.kernels.point_to_line import Term, pair_terms
from hsloc.matching.harmony_search import low_discrepancy_order
from hsloc.matching.hide import Hide
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2, compose_poses, relative_poses
from hsloc.parameters import Angle, Count, NonNegative, Parameters, Positive, Ratio
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
class LoopParameters(Parameters):
    """Where loops are searched for, and when one is accepted."""

    submap_length: Positive = 3.0
    """Path length of a submap [m]."""
    min_path_length: NonNegative = 12.0
    """Minimum path length between two submaps that are compared [m], measured over accepted loops as well."""
    search_radius: NonNegative = 3.0
    """Distance between two submaps up to which they are compared [m], to which the assumed drift is added."""
    drift: NonNegative = 0.02
    """Assumed standard deviation of the drift in position per path length."""
    drift_angle: NonNegative = radians(0.3)
    """Assumed standard deviation of the drift in heading after 1 m [rad]; it grows with the root of the path length."""
    sigmas: Positive = 3.0
    """Half-width of the search window in standard deviations of the drift."""
    max_candidates: Count = 3
    """Maximum number of earlier submaps that are searched for each submap, the nearest ones of different times."""
    resolution: Positive = 0.1
    """Distance of two nodes of a submap's likelihood field [m]."""
    sigma: Positive = 0.2
    """Decay length of a point's score with its distance from a wall of the submap [m]."""
    scan_range: Positive = 15.0
    """Maximum range of the hits that are compared [m]."""
    min_fitness: Ratio = 0.5
    """Minimum fitness of a submap's points on the other submap's field."""
    max_rival: Ratio = 0.85
    """Maximum fitness of any other pose in the window as a ratio to that of the match."""
    wide: NonNegative = 2.0
    """Half-width above which a window counts as wide [m], so that `min_margin` applies."""
    min_margin: Ratio = 0.11
    """Minimum difference in a wide window between the fitness of the match and that of any other pose."""
    max_conflict: Ratio = 0.1
    """Maximum ratio of points that lie where the other submap saw free space."""
    min_paired: Ratio = 0.15
    """Minimum ratio of points in the other submap's view that lie on its walls."""
    sigma_edge: Positive = 0.05
    """Standard deviation of a loop edge in x and y in addition to that of its match [m]."""
    sigma_edge_angle: Positive = radians(0.5)
    """Standard deviation of a loop edge in heading in addition to that of its match [rad]."""
    distinct_distance: Positive = 0.8
    """Distance from the match beyond which another pose is a rival [m]."""
    distinct_angle: Angle = radians(12.0)
    """Difference in heading from the match beyond which another pose is a rival [rad]."""
    max_edge_chi: Positive = 6.0
    """Maximum residual of a loop edge in the solved graph, in standard deviations; a loop with more is removed."""
    refused_path_length: NonNegative = 5.0
    """Path length that a refused match counts as when loops are searched for [m], as it may hide a slip."""
    robust: Positive = 2.0
    """Scale of the Cauchy weight of a loop edge, in standard deviations of its residual."""
    hide: Hide = field(
        default_factory=lambda: Hide(restarts=12, agreement=3, budget=600, memory_size=40, search_points=150)
    )
    """Search of the window of a loop."""


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
"""Likelihood fields of submaps that are kept. Internal: memory against time, the results are the same."""
_COMPARED = 90
"""Points of a scan that are looked up in another one. Internal: a sample that fixes ratios to some percent."""
_VISITS = 3_000_000
"""Bounds computed for a window before it counts as ambiguous. Internal: bounds the time of one search to seconds."""
_CONNECTED_PATH_LENGTH = 12.0
"""Path length (m) after which a pose is as uncertain as one that the global search found. Internal: it only sizes the
window of the first loops of a map that is extended, which are checked as all loops are."""
_PAIR_GATE, _PAIR_SCALE = 0.3, 0.1
"""Gate and scale (m) of the points of two submaps that are compared. Internal: a submap drifts by centimetres, so that
a tighter gate refuses right loops, while `max_conflict` and `min_paired` are what is to be set."""


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
        """`banned` pairs are left out, `known` loops accepted, and submaps before `first` visited already."""
        self._places = places
        self._scans = scans
        self._parameters = parameters
        self._rng = rng
        self._banned = banned
        self.poses = places.poses[places.reference].copy()
        self.loops = [loop for loop in known if (loop.first, loop.second) not in banned]
        self._first = first
        self._arrays = scans.arrays(_COMPARED)
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
            found = [self._search(old, place, path_length) for old, path_length in self._candidates(place)]
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
        return [self._search(old, place, _CONNECTED_PATH_LENGTH) for old in near[: self._parameters.max_candidates]]

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
        steps = Edges.chain(places.steps, places.covariances, places.uncertain)
        self.poses = solve_edges(self.poses, Edges.concatenate([steps, self.edges()]))

    def _candidates(self, place: int) -> list[tuple[int, float]]:
        """Old places that could be near, nearest first, with the path length to each over the graph."""
        p = self._parameters
        path_length = self._path_lengths(place)
        old = np.arange(place)
        distance = np.hypot(*(self.poses[:place, :2] - self.poses[place, :2]).T)
        # Submaps next to each other contain the same scans: those would match themselves.
        apart = place - old > 3
        could = (
            apart
            & (path_length >= p.min_path_length)
            & (distance <= p.search_radius + p.sigmas * p.drift * path_length)
        )
        order = np.lexsort((old[could], distance[could]))
        chosen: list[tuple[int, float]] = []
        for candidate in old[could][order]:
            if (int(candidate), place) in self._banned:
                continue
            if all(abs(candidate - other) > 2 for other, _ in chosen):
                chosen.append((int(candidate), float(path_length[candidate])))
            if len(chosen) == p.max_candidates:
                break
        return chosen

    def _path_lengths(self, place: int) -> F64:
        """Metres from a submap to each earlier one along the path and over closed loops, shape (place,)."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra

        loops = self.accepted
        # Where two logs are connected the path may lead over submaps that are still to be visited.
        last = place if self._first == 0 else len(self._places) - 1
        rows = [*range(last), *(loop.first for loop in loops)]
        columns = [*range(1, last + 1), *(loop.second for loop in loops)]
        lengths = [
            *np.maximum(np.diff(self._places.path_length[: last + 1]), 1e-3),
            *(max(hypot(loop.T_first_second.x, loop.T_first_second.y), 0.1) for loop in loops),
        ]
        graph = coo_array((lengths, (rows, columns)), shape=(len(self._places), len(self._places)))
        distances: F64 = dijkstra(graph.tocsr(), directed=False, indices=np.array([place]))
        return distances[0, :place]

    def _search(self, old: int, place: int, path_length: float) -> Loop:
        p = self._parameters
        centre = Pose2.from_array(relative_poses(self.poses[None, old], self.poses[None, place])[0])
        half = p.sigmas * p.drift * path_length + 0.3
        half_angle = min(p.sigmas * p.drift_angle * sqrt(path_length) + radians(2.0), np.pi)
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
            local = self._places.field(place, 1, self._scans, p.scan_range, p.resolution, p.sigma)
            found = (local.field, pool(local.scores, 5))
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
        finer = Lattice(here, near, step / 2.0)
        own, _ = best_on_lattice(pooled[:1], few, finer, Excluded(here, nowhere), 0.0, _VISITS, found)
        if own <= 0.0:
            return float("nan")
        needed = 0.7 * own
        box = np.array((ceil(half / cell), ceil(half / cell), half_angle))
        distinct = np.array((p.distinct_distance / cell, p.distinct_distance / cell, p.distinct_angle))
        lattice = Lattice(likelihood.to_cells(centre), box, step)
        other, _ = best_on_lattice(pooled, few, lattice, Excluded(here, distinct), needed, _VISITS, found)
        return float("nan") if other < 0.0 else float(other / own)

    def _compare(self, old: int, place: int, pose: Pose2) -> tuple[float, float]:
        """Of the points that either place sees of the other: the part on walls, the part where it looked through."""
        places = self._places
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
        term, counts, total = Term(np.empty((3, 3)), np.empty(3)), np.zeros(5), np.zeros(5)
        for a in range(0, len(first), max(len(first) // 7, 1)):
            for b in range(0, len(second), max(len(second) // 7, 1)):
                for i, j, x, y in (
                    (second[b], first[a], T_new[b], T_old[a]),
                    (first[a], second[b], T_old[a], T_new[b]),
                ):
                    rel = relative_poses(y[None], x[None])[0]
                    pair_terms(i, j, rel, self._arrays, _PAIR_GATE, _PAIR_SCALE, term, counts)
                    total += counts
        seen = max(total[2], 1.0)
        return float(total[0] / seen), float(total[1] / seen)
