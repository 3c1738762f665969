"""Is this place the one that was seen before? Two submaps are searched for the pose at which they are one place.

HIDE searches the window in which the second could lie, seen from the first; the scans of both are then registered
point to line. The pose is believed if neither place looks through the walls of the other, and if no other pose in the
window comes near to it (branch and bound, hsloc/kernels/branch_and_bound.py: in a corridor whose every bay looks the
same there is one). Only points count that both places could see: two half-plane views in opposite directions share few.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import ceil, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.branch_and_bound import Excluded, Lattice, best_on_lattice, pool
from hsloc.kernels.registration import Prior, RegistrationParameters, Scene, register
from hsloc.matching.harmony_search import low_discrepancy_order
from hsloc.matching.hide import Hide
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.parameters import Angle, Count, NonNegative, Parameters, Positive, Ratio

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.slam.keyscans import KeyScans
    from hsloc.slam.submaps import Submaps

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]


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
    min_fitness: Ratio = 0.25
    """Minimum fitness of a submap's points on the other submap's field."""
    high_fitness: Ratio = 0.5
    """Fitness from which on `max_rival` is the limit, below it `max_rival_low`."""
    max_rival: Ratio = 0.85
    """Maximum fitness of any other pose in the window as a ratio to that of the match."""
    max_rival_low: Ratio = 0.8
    """The same limit for a match of low fitness, where one submap has seen much that the other has not."""
    wide: NonNegative = 2.0
    """Half-width above which a window counts as wide [m], so that `min_margin` applies."""
    min_margin: Ratio = 0.11
    """Minimum difference in a wide window between the fitness of the match and that of any other pose."""
    min_consistency: Ratio = 0.9
    """Minimum ratio of points on walls of the other submap to those on its walls or where it saw free space."""
    min_paired: Ratio = 0.1
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
    is_ambiguous: bool = False
    """Whether it was refused for another pose that fits about as well, and for nothing else."""
    centre: Pose2 | None = None
    """The middle of the window, where it was refused for looking through walls that others may bear out."""

    @property
    def looks_through(self) -> bool:
        """Whether it was refused for looking through walls, by far fewer points than lie on walls, and nothing else."""
        return self.centre is not None


_CACHED = 48
"""Fields of places kept."""
_COMPARED_HITS = 90
"""Hits of a scan that are compared, about."""
_COMPARED_SCANS = 5
"""Scans of each place that are registered."""
_REGISTRATION = RegistrationParameters((0.5, 0.4, 0.3), 0.33, 1.0 / (0.02**2 * 20.0 * _COMPARED_SCANS), np.inf, 5)
"""Wider gates than from scan to scan: within a place the front end has drifted. Each wall is seen by all scans of a
place, so that their points count once."""
_CORROBORATED = 0.6
"""Consistency from which on a loop may be borne out by others: that of second visits of which a map says nothing."""
_VISITS = 3_000_000
"""Bounds computed for a window before it counts as ambiguous."""


class LoopMatcher:
    """Compares places two by two; keeps the fields of those compared last."""

    def __init__(self, places: Submaps, scans: KeyScans, parameters: LoopParameters, rng: Generator) -> None:
        self._places = places
        self._scans = scans
        self._parameters = parameters
        self._rng = rng
        self._arrays = scans.arrays(_COMPARED_HITS)
        self._fields: dict[int, tuple[LikelihoodField, F32]] = {}
        self._last_cloud: tuple[int, F64] = (-1, np.zeros((0, 2)))

    def search(self, first: int, second: int, centre: Pose2, window: tuple[float, float]) -> Loop:
        """Search the pose of place `second` seen from `first` in `centre` +- `window` (m, rad)."""
        loop = self._judged(first, second, centre, centre, window)
        # What is accepted where it was predicted has no rival, and after `_is_best_near` nothing fitter near it: HIDE
        # would find nothing else.
        if loop.accepted and self._is_best_near(loop):
            return loop
        p = self._parameters
        half, half_angle = window
        (start,), _, _ = p.hide.match_boxes(
            self._cloud(second), self._field(first)[0], [Window(centre, half, half, half_angle)], self._rng
        )
        return self._judged(first, second, start, centre, window)

    def _judged(self, first: int, second: int, start: Pose2, centre: Pose2, window: tuple[float, float]) -> Loop:
        """The loop that is found from the pose `start` on, and whether it is accepted."""
        p = self._parameters
        half, half_angle = window
        prior = np.diag((1.0 / half**2, 1.0 / half**2, 1.0 / half_angle**2)) * p.sigmas**2
        pose, information, paired, conflict = self._registered(first, second, start, centre, prior)
        if start.distance(pose) > p.distinct_distance:
            pose = start
        fitness = self._field(first)[0].fitness(self._cloud(second), pose)
        consistency = paired / (paired + conflict) if paired > 0.0 else 0.0
        rival, reason, kept = float("nan"), "", None
        if fitness < p.min_fitness:
            reason = f"fitness {fitness:.2f} below {p.min_fitness:.2f}"
        elif paired < p.min_paired:
            reason = f"only {100.0 * paired:.0f} % of the points lie on walls of the other place"
        elif consistency < p.min_consistency:
            reason = f"{100.0 * conflict:.0f} % of the points lie where the other place saw free space"
            kept = centre if consistency >= _CORROBORATED else None
        else:
            rival = self._rival(first, second, pose, centre, window)
            reason = self._ambiguity(fitness, rival, half)
        edge = np.diag((p.sigma_edge**2, p.sigma_edge**2, p.sigma_edge_angle**2))
        covariance: F64 = np.asarray(np.linalg.inv(information + prior), dtype=np.float64) + edge
        # Another pose is looked for only where nothing else speaks against the loop.
        is_ambiguous = bool(reason) and rival == rival
        return Loop(
            first, second, pose, covariance, fitness, rival, conflict, paired, window, not reason, reason, is_ambiguous,
            kept,
        )  # fmt: skip

    def corroborated(self, loop: Loop) -> Loop:
        """A loop that only looks through walls, and that others bear out: accepted if no other pose comes near to it.

        In a wide window a single place asks for a margin; here others lead to the same pose.
        """
        assert loop.centre is not None
        rival = self._rival(loop.first, loop.second, loop.T_first_second, loop.centre, loop.window)
        reason = self._ambiguity(loop.fitness, rival, 0.0)
        return replace(loop, rival=rival, accepted=not reason, reason=reason, is_ambiguous=bool(reason), centre=None)

    def _ambiguity(self, fitness: float, rival: float, half: float) -> str:
        """Why a loop is refused for another pose in a window of that half-width (m); empty if it is not."""
        p = self._parameters
        limit = p.max_rival if fitness >= p.high_fitness else p.max_rival_low
        if not rival <= limit:
            return f"ambiguous: another pose reaches {100.0 * rival:.0f} % of the fitness"
        if half > p.wide and fitness * (1.0 - rival) < p.min_margin:
            return f"ambiguous in a wide window: fitness {fitness:.2f}, another pose {100.0 * rival:.0f} % of it"
        return ""

    def _registered(
        self, first: int, second: int, start: Pose2, centre: Pose2, prior: F64
    ) -> tuple[Pose2, F64, float, float]:
        """The pose point to line, the information (3, 3), and the parts of the points paired and in conflict."""
        old, new = self._members(first), self._members(second)
        poses = self._places.poses
        reference = self._places.reference
        seen_from = [
            relative_poses(poses[None, reference[k]].repeat(len(m), 0), poses[m])
            for k, m in ((first, old), (second, new))
        ]
        pose, information, counts = start.to_array(), np.zeros((3, 3)), np.zeros(5)
        scene = Scene(len(old), np.concatenate(seen_from), np.concatenate((old, new)), self._arrays)
        register(pose, scene, Prior(centre.to_array(), prior), _REGISTRATION, information, counts)
        seen = max(float(counts[2]), 1.0)
        return Pose2.from_array(pose), information, float(counts[0]) / seen, float(counts[1]) / seen

    def _members(self, place: int) -> NDArray[np.int64]:
        members = self._places.members(place, 1)
        return np.unique(np.linspace(members.start, members.stop - 1, _COMPARED_SCANS).astype(np.int64))

    def _cloud(self, place: int) -> F64:
        """Hits (n, 2) of a place in its frame; a place is searched for in several others in a row."""
        if self._last_cloud[0] != place:
            p = self._parameters
            cloud = self._places.cloud(place, 1, self._scans, p.scan_range, 2.0 * p.resolution)
            self._last_cloud = (place, cloud)
        return self._last_cloud[1]

    def _field(self, place: int) -> tuple[LikelihoodField, F32]:
        found = self._fields.pop(place, None)
        if found is None:
            p = self._parameters
            local = self._places.field(place, 1, self._scans, p.scan_range, p.resolution, p.sigma)
            found = (local.field, pool(local.scores, 5))
        self._fields[place] = found
        if len(self._fields) > _CACHED:
            del self._fields[next(iter(self._fields))]
        return found

    def _is_best_near(self, loop: Loop) -> bool:
        """Whether no pose of the lattice within the distance of a rival is fitter than that of a loop."""
        p = self._parameters
        likelihood, pooled = self._field(loop.first)
        few = self._few(self._cloud(loop.second), likelihood)
        here = likelihood.to_cells(loop.T_first_second)
        own, step = self._fitness_at(here, few, pooled), 2.0 * p.resolution / p.scan_range
        distinct = p.distinct_distance / likelihood.resolution
        lattice = Lattice(here, np.array((distinct, distinct, p.distinct_angle)), step)
        around = Excluded(here, np.array((1.0, 1.0, step)))
        fittest, _ = best_on_lattice(pooled, few, lattice, around, own, _VISITS, np.empty(3))
        # Where nothing is fitter `own` comes back; if it does not to the last bit, HIDE is asked once more.
        return fittest == own

    def _few(self, points: F64, likelihood: LikelihoodField) -> F32:
        """Some of the points, in cells."""
        return likelihood.scale(points[low_discrepancy_order(len(points))][: self._parameters.hide.search_points])

    def _fitness_at(self, here: F64, few: F32, pooled: F32) -> float:
        """Fitness of the best lattice pose within a step of a pose `here` (3,) in cells."""
        p = self._parameters
        step = 2.0 * p.resolution / p.scan_range
        finer = Lattice(here, np.array((1.0, 1.0, step)), step / 2.0)
        nowhere = Excluded(here, np.array((-1.0, -1.0, -1.0)))
        own, _ = best_on_lattice(pooled[:1], few, finer, nowhere, 0.0, _VISITS, np.empty(3))
        return float(own)

    def _rival(self, first: int, second: int, pose: Pose2, centre: Pose2, window: tuple[float, float]) -> float:
        """The best lattice pose in the window distinct from `pose`, as a part of the best one near it."""
        p = self._parameters
        half, half_angle = window
        points, (likelihood, pooled) = self._cloud(second), self._field(first)
        few, here, step = self._few(points, likelihood), likelihood.to_cells(pose), 2.0 * p.resolution / p.scan_range
        cell, own = likelihood.resolution, self._fitness_at(here, few, pooled)
        if own <= 0.0:
            return float("nan")
        needed = 0.7 * own
        box = np.array((ceil(half / cell), ceil(half / cell), half_angle))
        distinct = np.array((p.distinct_distance / cell, p.distinct_distance / cell, p.distinct_angle))
        lattice = Lattice(likelihood.to_cells(centre), box, step)
        other, _ = best_on_lattice(pooled, few, lattice, Excluded(here, distinct), needed, _VISITS, np.empty(3))
        return float("nan") if other < 0.0 else float(other / own)
