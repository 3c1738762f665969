"""Where a finished map lies on a floor plan: its walls are searched for on the whole plan, in all headings.

The walls of the map, thinned, are one large scan seen from a pose of the robot, and the search of whole maps gives all
places where it fits, with a proof that there is no other. The right place stands apart from all others; where the plan
is that of another building, the best place is only the first of many that are hardly worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.evaluation.maps import TOLERANCE_M, compare_maps
from hsloc.localisation.whole_map_search import WholeMapParameters, WholeMapSearch
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.matching.local_refinement import refine
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2, compose_poses

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.evaluation.maps import MapComparison
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]

_APART = 0.25
"""Distance between the points of walls that are compared [m]: a wall counts by its length, not by its thickness."""
_MOST_POINTS = 1500
"""Points that are compared, at most."""
_LEAST_FITNESS = 0.25
"""Fitness below which a place is none. Walls and things that the plan does not have count as unfit."""
_MARGIN = 0.1
"""Fitness below the best within which another place may be the right one."""
_RADIUS, _ANGLE = 1.0, np.radians(5.0)
"""Distance [m] and angle [rad] within which fits are one place: plans are drawn to some decimetres."""
_MOST_PLACES = 8


@dataclass(frozen=True, slots=True, eq=False)
class PlanFit:
    """The place of a map on a plan.

    `T_plan_map` is the fittest pose of the map's frame on the plan, None where it fits nowhere; `fitness` is the mean
    score there of points along the walls of the map. No pose elsewhere has more than `elsewhere`, and `places` are
    those within the margin; the fit `is_certain` where there is one, and the proof that there is no other.
    """

    T_plan_map: Pose2 | None
    fitness: float
    elsewhere: float
    places: tuple[Pose2, ...]
    is_certain: bool
    comparison: MapComparison | None = None
    """The walls of the finished map against those of the plan; None where its place is not certain."""

    def moved(self, poses: F64) -> F64:
        """Poses (n, 3) in the map's frame, on the plan."""
        assert self.T_plan_map is not None
        return compose_poses(self.T_plan_map.to_array(), poses)

    def compared(self, grid: OccupancyGrid, plan: OccupancyGrid) -> PlanFit:
        """The same with the comparison of the finished map, which lies on the plan if its place is certain."""
        if not self.is_certain:
            return self
        return replace(self, comparison=compare_maps(grid, plan, tolerance=TOLERANCE_M))


def find_on_plan(plan: OccupancyGrid, grid: OccupancyGrid, poses: F64) -> PlanFit:
    """Where the walls of a grid fit on the plan; `poses` (n, 3) are the robot's in the frame of the grid.

    Raises MapError for a plan without an occupied cell.
    """
    field = LikelihoodField.from_grid(plan)
    walls = _thinned(grid.centres(grid.occupied()))
    if len(walls) == 0 or len(poses) == 0:
        return PlanFit(None, 0.0, 1.0, (), False)
    # The robot stood on open ground, also on the plan. From the middle of the map the points are nearest.
    middle = 0.5 * (walls.min(axis=0) + walls.max(axis=0))
    T_map_base = Pose2.from_array(poses[np.argmin(np.hypot(*(poses[:, :2] - middle).T))])
    parameters = WholeMapParameters(
        min_fitness=_LEAST_FITNESS, margin=_MARGIN, radius=_RADIUS, angle=_ANGLE, max_modes=_MOST_PLACES
    )
    points = T_map_base.inverse() @ walls
    found = WholeMapSearch(plan, field, parameters).search(points)
    if not found.modes:
        return PlanFit(None, 0.0, found.bound, (), False)
    T_base_map = T_map_base.inverse()
    best = refine(points, field, Window(found.modes[0].pose, 0.2, 0.2, np.radians(1.0)))
    places = tuple(mode.pose @ T_base_map for mode in found.modes)
    return PlanFit(best.pose @ T_base_map, best.fitness, found.bound, places, found.is_unique)


def _thinned(points: F64) -> F64:
    """One of the points (n, 2) in each square of `_APART`, at most `_MOST_POINTS`, evenly chosen."""
    squares = np.floor(points / _APART).astype(np.int64)
    _, first = np.unique(squares, axis=0, return_index=True)
    if len(first) > _MOST_POINTS:
        first = first[np.linspace(0, len(first) - 1, _MOST_POINTS).astype(np.int64)]
    return points[first]
