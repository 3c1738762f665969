"""Whether a place is the right one: what the map explains of a scan there, and whether another place fits as well.

Two questions that the fitness alone does not answer. A crowd hides the walls and lowers the fitness of the right place;
a wrong place keeps more than half of it. But in a crowd beams end *before* the walls, in a wrong place as many end
behind them or where nothing is mapped. And on a wrong map, or off the map, the best place is one of many that fit
alike: the fittest other place on the whole map, divided by this one, is then about 1, where the right place of a map
with some character leaves all others behind. One scan is not enough for that (half of them have a look-alike at 180
deg), so the scans of the last metres are joined by the poses of the track.

Rooms that are nearly symmetric fit on a mirrored map, too, and then nothing else does. There the mirrored scans fit
better than the scans: at the robot's own place, seen in the mirror.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.kernels.beams import SHORT, THROUGH, UNMAPPED, classify_beams
from hsloc.kernels.fitness import point_scores, score_with_noise
from hsloc.localisation.hypotheses import Own, bounded_search, fittest_other
from hsloc.matching.harmony_search import low_discrepancy_order
from hsloc.matching.local_refinement import refine
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2
from hsloc.parameters import Angle, Count, NonNegative, Parameters, Positive

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.localisation.whole_map_search import WholeMapSearch
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.model.events import PairedScan, Scan
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceCheckParameters(Parameters):
    """How a place is compared with all others on the map."""

    interval: NonNegative = 8.0
    """Path length between two comparisons with the whole map [m], up to 4 times while they say the same; 0: none."""
    length: Positive = 6.0
    """Path length over which scans are joined for a comparison [m]."""
    scans: Count = 8
    """Number of scans that are joined."""
    points: Count = 8
    """Number of points taken of each scan."""
    max_boxes: Count = 20_000_000
    """Maximum number of boxes of poses in one comparison; a million take about 0.1 s."""
    own_distance: Positive = 1.0
    """Places nearer than this, and within `own_angle`, are the same place [m]."""
    own_angle: Angle = 0.5
    """Headings nearer than this, within `own_distance`, are the same place [rad]."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """What the map explains of a scan at a pose.

    `fitness` is the mean score over the beams that neither end at an object in free space nor where nothing is mapped,
    what the noise of the lidar takes from it being given back;
    `short`, `through` and `unmapped` are the shares of all beams that end before a wall, behind one, or there. `ends`
    (n, 2) is where in the map those end that end before a wall.
    """

    fitness: float
    short: float
    through: float
    unmapped: float
    ends: F64 = field(default_factory=lambda: np.empty((0, 2)), compare=False)


_FITS = 0.3
"""A point scores this much within about 1.2 sigma of a wall."""
_MARGIN_M = 0.1
"""A wall this near before a beam's end is the one that it ends at (m)."""
USUAL_EXPLAINED = 0.93
"""Explained fitness at right places of a good map; the usual one of a run is not taken for higher."""
_USUAL_SCORE, _LEAST_SCORE = 0.96, 0.5
"""What a noise of 1 cm leaves of the score of a hit (sigma 0.2 m), which is part of all figures of usual fitness. Of
lidars that are noisier the rest is given back; down to the second, 25 cm, beyond which hits say little. The scans alone
show it: in Intel, Freiburg 079, Orebro, Seattle and Wean 0.97 to 0.98, in ACES 0.93, with 2.5 % of the range 0.7."""
_NEEDED = 0.85
"""Other places below this part of the own fitness are not looked for: they make no difference."""
MIRRORED_NEEDED = 0.97
"""The same for the mirrored scans: where they fit less well than this, the map is not mirrored."""
_AS_USUAL = 0.9
"""Explained fitness by the usual one from which on a scan fits but for what hides the walls: wrong places reach 0.9 at
most, right ones in rings of corridors of which 30 % had changed had 0.91 to 0.99 (benchmarks/confusion.py, seed 72)."""
_MOST_HIDDEN = 0.6
"""Share of beams that something may hide: with fewer left, they fit somewhere by chance. Assumed."""
_MOST_ASTRAY = 0.05
"""Share of beams that may end behind walls and where nothing is mapped: a door that is open, a window."""
_BESIDE, _THERE_M, _FEWEST_ENDS = 0.02, 0.15, 5
"""A beam that points at something within the first (rad) ends there if it does so within the second (m), and something
that stood there is gone if the beam ends behind twice that; fewer such beams than the third say nothing."""
_OWN_HALF, _OWN_HALF_ANGLE = 0.2, 0.1
"""The scans of the own place are moved as a whole within these half-widths (m, rad), as those of another one are."""


class Comparison(NamedTuple):
    """A place and the fittest other one: the fitness of that divided by that of this one, at least 0.85, and its pose.

    `mirrored` is the same ratio for the mirrored scans at their fittest place, at least 0.97; NaN where not known.
    """

    rival: float
    other: Pose2 | None
    mirrored: float = float("nan")


class PlaceCheck:
    """Compares places of one map; holds its cells and the search of the whole of it, but no state."""

    def __init__(self, grid: OccupancyGrid, likelihood: LikelihoodField, parameters: PlaceCheckParameters) -> None:
        self.parameters = parameters
        self._grid = grid
        self._T_grid_map = grid.origin.inverse()
        self._field = likelihood
        self._search: WholeMapSearch | None = None

    def explain(self, paired: PairedScan, pose: Pose2) -> Explanation:
        """What the map explains of a scan with the base at `pose` in the map.

        Of several lasers that of which it explains most: one that is mounted otherwise than stated says nothing.
        """
        found = [self._explained(paired, pose)]
        found += [self._explained(other, pose @ paired.to(other)) for other in paired.companions]
        return max(found, key=lambda one: one.fitness)

    def is_hidden(self, paired: PairedScan, pose: Pose2, usual: float) -> bool:
        """Whether a scan fits badly because something hides the walls, and not because it is somewhere else.

        Beams that end before the walls do not count then; the others reach what the map explains elsewhere, `usual`,
        and hardly any ends behind a wall or where nothing is mapped.
        """
        found = self.explain(paired, pose)
        astray = found.through + found.unmapped
        return found.short <= _MOST_HIDDEN and astray <= _MOST_ASTRAY and found.fitness >= _AS_USUAL * usual

    def _explained(self, paired: PairedScan, T_map_base: Pose2) -> Explanation:
        beam, score = self._classify(paired, T_map_base)
        n = len(beam)
        if n == 0:
            return Explanation(0.0, 0.0, 0.0, 0.0)
        counts = np.bincount(beam, minlength=4)
        judged = (beam != SHORT) & (beam != UNMAPPED)
        fitness = float(score[judged].sum()) / int(judged.sum()) if judged.any() else 0.0
        # What else moves the hits hides in their noise: no more is given back than makes a usual fitness.
        fitness = max(min(fitness * self._lost_to_noise(paired.scan), USUAL_EXPLAINED), fitness)
        ends = T_map_base @ paired.scan.points_base()[beam == SHORT] if counts[SHORT] else np.empty((0, 2))
        return Explanation(fitness, int(counts[SHORT]) / n, int(counts[THROUGH]) / n, int(counts[UNMAPPED]) / n, ends)

    def _lost_to_noise(self, scan: Scan) -> float:
        """What the scores of a scan are to be multiplied by, 1 or more, so that they are those of a usual lidar."""
        ranges, increment = np.ascontiguousarray(scan.ranges), float(scan.angle_increment)
        limits = float(scan.range_min), float(scan.range_max)
        left = score_with_noise(ranges, *limits, increment, self._field.sigma)
        return max(_USUAL_SCORE / max(left, _LEAST_SCORE), 1.0)

    def still_stands(self, paired: PairedScan, pose: Pose2, ends: F64) -> float:
        """The share of what beams ended at before, `ends` (n, 2) in the map, that a scan with the base at `pose` sees.

        What stands behind something else does not count; NaN where too little is left.
        """
        scan = paired.scan
        seen = _polar(scan.T_base_laser.inverse() @ scan.points_base())
        seen = seen[np.argsort(seen[:, 1])]
        expected = _polar((pose @ scan.T_base_laser).inverse() @ ends)
        if len(seen) < 2:
            return float("nan")
        after = np.clip(np.searchsorted(seen[:, 1], expected[:, 1]), 1, len(seen) - 1)
        gaps = np.abs(seen[[after - 1, after], 1] - expected[:, 1])
        beyond = seen[after - (gaps[0] < gaps[1]), 0] - expected[:, 0]
        beyond = beyond[gaps.min(axis=0) < _BESIDE]
        stands, gone = int((np.abs(beyond) < _THERE_M).sum()), int((beyond > 2.0 * _THERE_M).sum())
        return stands / (stands + gone) if stands + gone >= _FEWEST_ENDS else float("nan")

    def _classify(self, paired: PairedScan, T_map_base: Pose2) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
        points = paired.scan.points_base()
        scores = np.empty(len(points), dtype=np.float32)
        x, y, theta = self._field.to_cells(T_map_base)
        point_scores(self._field.packed, self._field.scale(points), x, y, theta, scores)
        T_grid_base = self._T_grid_map @ T_map_base
        laser = T_grid_base @ paired.scan.T_base_laser
        cell = self._grid.resolution
        classes = np.empty(len(points), dtype=np.int8)
        origin = np.array((laser.x / cell, laser.y / cell))
        classify_beams(
            self._grid.cells,
            (T_grid_base @ points) / cell,
            origin,
            scores,
            _FITS,
            _MARGIN_M / cell,
            self._grid.occupied_threshold,
            classes,
        )
        return classes, scores

    def few(self, points: F64) -> F64:
        """The points of a scan that take part in a comparison, spread evenly over its beams."""
        return np.asarray(points[_spread(len(points), self.parameters.points)])

    @property
    def search(self) -> WholeMapSearch:
        """The search of the whole map, made when it is first asked for: a second and 50 MB on a large map."""
        if self._search is None:
            self._search = bounded_search(self._grid, self._field)
        return self._search

    def compare(self, scans: list[tuple[Pose2, F64]], pose: Pose2) -> Comparison:
        """A place with all others on the map.

        `scans` are poses of the base in the map and points (n, 2) seen from them, `pose` is the place in question.
        Where the work allowed does not suffice, the ratio is the bound that was reached, at most 1, without a place.
        """
        p = self.parameters
        cloud = np.vstack([pose.between(other) @ points for other, points in scans])
        if len(cloud) == 0:
            return Comparison(1.0, None)
        own = refine(cloud, self._field, Window(pose, _OWN_HALF, _OWN_HALF, _OWN_HALF_ANGLE)).fitness
        if own <= 0.0:
            return Comparison(1.0, None)
        place = Own(pose, own, p.own_distance, p.own_angle, _NEEDED)
        other, fitness = fittest_other(self.search, self._field, cloud, place, p.max_boxes)
        ratio = max(fitness / own, _NEEDED)
        return Comparison(min(ratio, 1.0) if other is None else ratio, other, self._mirrored(cloud, own))

    def _mirrored(self, cloud: F64, own: float) -> float:
        """Fitness of the fittest place for the mirrored points (n, 2) divided by `own`; NaN where it is not known."""
        anywhere = Own(Pose2(), own, -1.0, -1.0, MIRRORED_NEEDED)
        mirrored = cloud * np.array((1.0, -1.0))
        place, fitness = fittest_other(self.search, self._field, mirrored, anywhere, self.parameters.max_boxes)
        return fitness / own if place is not None or fitness < own else float("nan")


@lru_cache(maxsize=1024)
def _spread(beams: int, count: int) -> NDArray[np.int64]:
    """`count` of a number of beams, spread evenly; most scans of a lidar have as many hits as one before."""
    chosen = low_discrepancy_order(beams)[:count].copy()
    chosen.flags.writeable = False
    return chosen


def _polar(points: F64) -> F64:
    """Distances and bearings of points (n, 2) in the frame of the laser (n, 2)."""
    return np.column_stack((np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])))
