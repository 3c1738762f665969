"""Hypotheses of where the robot is, the test between two of them, and the places that are searched for them."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]

_NEAR = 0.5
_NEAR_ANGLE = radians(15.0)
_BLOCK = 7
"""Scans of a block: two metres at the steps of the search."""
_RESOLUTION = 0.02
"""Standard deviation of the fitness of the same place, matched twice: what blocks differ by at least."""


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A pose T_map_base, and how well the scans fit there; `total` sums their fitness over `scans`."""

    pose: Pose2
    covariance: F64
    fitness: float
    total: float
    scans: int
    history: list[float]
    """Fitness of each scan since it was found."""

    @property
    def mean(self) -> float:
        """Mean fitness over the scans."""
        return self.total / self.scans


def fits_better(best: list[float], other: list[float], confidence: float) -> bool:
    """Student's paired t-test, one-sided, over means of blocks of scans.

    Scans that follow each other see the same errors of the map, so that their differences are no independent evidence;
    blocks about two metres long are taken for it. An error of the map in one place makes the blocks differ, and a sum
    that comes from few of them proves nothing.
    """
    from scipy.special import stdtrit

    n = min(len(best), len(other)) // _BLOCK
    if n < 2:
        return False
    difference = np.array(best[-n * _BLOCK :]) - np.array(other[-n * _BLOCK :])
    means = difference.reshape(n, _BLOCK).mean(axis=1)
    error = np.sqrt((means.var(ddof=1) + _RESOLUTION**2) / n)
    return bool(means.mean() >= float(stdtrit(n - 1, confidence)) * error)


class Places:
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


def tiles(grid: OccupancyGrid, side: float) -> list[tuple[float, float]]:
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
