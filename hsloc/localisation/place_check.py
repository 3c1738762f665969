"""Whether a place is the right one: what the map explains of a scan there, and whether another place fits as well.

Two questions that the fitness alone does not answer. A crowd hides the walls and lowers the fitness of the right place;
a wrong place keeps more than half of it. But in a crowd beams end *before* the walls, in a wrong place as many end
behind them or where nothing is mapped. And on a wrong map, or off the map, the best place is one of many that fit
alike: the fittest other place on the whole map, divided by this one, is then about 1, where the right place of a map
with some character leaves all others behind. One scan is not enough for that (half of them have a look-alike at 180
deg), so the scans of the last metres are joined by the poses of the track.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.beam_classes import SHORT, THROUGH, UNMAPPED, classify_beams
from hsloc.kernels.branch_and_bound import Excluded, Lattice, best_on_lattice, pool
from hsloc.kernels.fitness import point_scores
from hsloc.matching.harmony_search import low_discrepancy_order
from hsloc.parameters import Angle, Count, NonNegative, Parameters, Positive

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.model.events import PairedScan
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceCheckParameters(Parameters):
    """How a place is compared with all others on the map."""

    interval: NonNegative = 8.0
    """Path length between two comparisons with the whole map [m]; 0 turns them off."""
    length: Positive = 6.0
    """Path length over which scans are joined for a comparison [m]."""
    scans: Count = 8
    """Number of scans that are joined."""
    points: Count = 8
    """Number of points taken of each scan."""
    cell: Positive = 0.2
    """Spacing of the lattice of other places [m]; multiples of the map's resolution are used."""
    own_distance: Positive = 1.0
    """Places nearer than this, and within `own_angle`, are the same place [m]."""
    own_angle: Angle = 0.5
    """Headings nearer than this, within `own_distance`, are the same place [rad]."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """What the map explains of a scan at a pose.

    `fitness` is the mean score over the beams that neither end at an object in free space nor where nothing is mapped;
    `short`, `through` and `unmapped` are the shares of all beams that end before a wall, behind one, or there.
    """

    fitness: float
    short: float
    through: float
    unmapped: float


_FITS = 0.3
"""A point scores this much within about 1.2 sigma of a wall."""
_MARGIN_M = 0.1
"""A wall this near before a beam's end is the one that it ends at (m)."""
_NEEDED = 0.85
"""Other places below this part of the own fitness are not looked for: they make no difference."""
_OWN_HALF, _OWN_HALF_ANGLE = 0.4, 0.15
"""The own place is the best of the lattice within these half-widths (m, rad): it gets the lattice's chances, too."""
_LEVELS = 6
_MOST_VISITS = 2_000_000
"""Bounds computed in one comparison, at most: about a second."""
_MOST_VISITS_OF_FITTEST = 300_000
"""The same in the search for the fittest place."""
_LEVER_QUANTILE = 70.0
_LEAST_LEVER = 2.0
"""Headings are so close that a point at this distance (m), or at this percentile of all, moves by a cell."""


class PlaceCheck:
    """Compares places of one map; holds its cells and a pyramid of its field, but no state."""

    def __init__(self, grid: OccupancyGrid, likelihood: LikelihoodField, parameters: PlaceCheckParameters) -> None:
        self.parameters = parameters
        self._grid = grid
        self._T_grid_map = grid.origin.inverse()
        self._field = likelihood
        self._coarser = max(round(parameters.cell / likelihood.resolution), 1)
        self._pooled: NDArray[np.float32] | None = None

    def explain(self, paired: PairedScan, pose: Pose2) -> Explanation:
        """What the map explains of a scan with the base at `pose` in the map.

        Of several lasers that of which it explains most: one that is mounted otherwise than stated says nothing.
        """
        found = [self._explained(paired, pose)]
        found += [self._explained(other, pose @ paired.to(other)) for other in paired.companions]
        return max(found, key=lambda one: one.fitness)

    def _explained(self, paired: PairedScan, T_map_base: Pose2) -> Explanation:
        beam, score = self._classify(paired, T_map_base)
        n = len(beam)
        if n == 0:
            return Explanation(0.0, 0.0, 0.0, 0.0)
        counts = np.bincount(beam, minlength=4)
        judged = (beam != SHORT) & (beam != UNMAPPED)
        fitness = float(score[judged].sum()) / int(judged.sum()) if judged.any() else 0.0
        return Explanation(fitness, int(counts[SHORT]) / n, int(counts[THROUGH]) / n, int(counts[UNMAPPED]) / n)

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
        return np.asarray(points[low_discrepancy_order(len(points))[: self.parameters.points]])

    def rival(self, scans: list[tuple[Pose2, F64]], pose: Pose2) -> float:
        """Fitness of the fittest other place on the map divided by that of this one; at least 0.85.

        `scans` are poses of the base in the map and points (n, 2) seen from them, `pose` is the place in question.
        """
        pooled = self._pyramid()
        points, step = self._cloud(scans, pose)
        side = self._field.resolution * self._coarser
        here = self._field.to_cells(pose)
        here[:2] /= self._coarser
        nowhere = np.array((-1.0, -1.0, -1.0))
        found = np.empty(3)
        near = np.array((_OWN_HALF / side, _OWN_HALF / side, _OWN_HALF_ANGLE))
        own, _ = best_on_lattice(
            pooled, points, Lattice(here, near, step), Excluded(here, nowhere), 0.0, _MOST_VISITS, found
        )
        if own <= 0.0:
            return 1.0
        height, width = pooled.shape[1:]
        middle = np.array((width / 2.0, height / 2.0, 0.0))
        whole = np.array((width / 2.0, height / 2.0, np.pi))
        p = self.parameters
        same = np.array((p.own_distance / side, p.own_distance / side, p.own_angle))
        other, _ = best_on_lattice(
            pooled, points, Lattice(middle, whole, step), Excluded(here, same), _NEEDED * own, _MOST_VISITS, found
        )
        return 1.0 if other < 0.0 else other / own

    def fittest(self, scans: list[tuple[Pose2, F64]], last: Pose2, needed: float) -> Pose2 | None:
        """The fittest place on the whole map for scans joined by odometry; None if none is fitter than `needed`.

        `scans` are poses of the base and points (n, 2) seen from them, `last` is the pose of the base whose place in
        the map is asked for, all in the frame of the odometry.
        """
        pooled = self._pyramid()
        points, step = self._cloud(scans, last)
        height, width = pooled.shape[1:]
        middle = np.array((width / 2.0, height / 2.0, 0.0))
        whole = np.array((width / 2.0, height / 2.0, np.pi))
        nowhere = np.array((-1.0, -1.0, -1.0))
        lattice = Lattice(middle, whole, step)
        found = np.empty(3)
        best, _ = best_on_lattice(
            pooled, points, lattice, Excluded(middle, nowhere), needed, _MOST_VISITS_OF_FITTEST, found
        )
        if best <= needed:
            return None
        found[:2] *= self._coarser
        return self._field.from_cells(found)

    def _cloud(self, scans: list[tuple[Pose2, F64]], pose: Pose2) -> tuple[NDArray[np.float32], float]:
        """The points of scans seen from a pose, in units of the lattice, and the step between headings (rad)."""
        cloud = np.vstack([pose.between(other) @ points for other, points in scans])
        side = self._field.resolution * self._coarser
        lever = max(float(np.percentile(np.hypot(cloud[:, 0], cloud[:, 1]), _LEVER_QUANTILE)), _LEAST_LEVER)
        return np.ascontiguousarray(cloud / side, dtype=np.float32), side / lever

    def _pyramid(self) -> NDArray[np.float32]:
        """The field's scores, pooled: of each block of nodes the largest, and on each level those of four blocks."""
        if self._pooled is None:
            scores = self._field.packed[:, :, 0]
            k = self._coarser
            height, width = -(-scores.shape[0] // k), -(-scores.shape[1] // k)
            padded = np.zeros((height * k, width * k), dtype=np.float32)
            padded[: scores.shape[0], : scores.shape[1]] = scores
            self._pooled = pool(np.ascontiguousarray(padded.reshape(height, k, width, k).max(axis=(1, 3))), _LEVELS)
        return self._pooled
