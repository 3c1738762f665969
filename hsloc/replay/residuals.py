"""How well the scans of a run fit its map: distances of their points to the nearest wall."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hsloc.model.events import Scan
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2

_BIN = 0.005
_FARTHEST = 5.0
NEAR_WALL = 0.15
"""A point within so many metres of a wall is explained by the map."""


class Residuals:
    """Distances to the nearest occupied cell, counted in bins of 5 mm, so that memory does not grow."""

    def __init__(self, grid: OccupancyGrid) -> None:
        from scipy.ndimage import distance_transform_edt

        self._grid = grid
        self._distance = (distance_transform_edt(~grid.occupied()) * grid.resolution).astype(np.float32)
        self._T_grid_map = grid.origin.inverse()
        self._counts = np.zeros(int(_FARTHEST / _BIN) + 1, dtype=np.int64)

    def add(self, scan: Scan, T_map_base: Pose2) -> None:
        """Count the points of a scan; those outside the map count as far."""
        local = (self._T_grid_map @ T_map_base) @ scan.points_base()
        cells = np.floor(local / self._grid.resolution).astype(np.int64)
        height, width = self._distance.shape
        inside = (cells[:, 0] >= 0) & (cells[:, 0] < width) & (cells[:, 1] >= 0) & (cells[:, 1] < height)
        distance = np.full(len(cells), _FARTHEST, dtype=np.float32)
        distance[inside] = self._distance[cells[inside, 1], cells[inside, 0]]
        bins = np.minimum(distance / _BIN, len(self._counts) - 1).astype(np.int64)
        self._counts += np.bincount(bins, minlength=len(self._counts))

    def to_dict(self) -> dict[str, float | int | None]:
        """Median and 95th percentile (m, to 5 mm), the part within `NEAR_WALL` of a wall, and how many points."""
        total = int(self._counts.sum())
        if total == 0:
            return {"points": 0, "median": None, "p95": None, "within_0.15_m": None}
        part = np.cumsum(self._counts) / total
        return {
            "points": total,
            "median": float(np.searchsorted(part, 0.5) * _BIN),
            "p95": float(np.searchsorted(part, 0.95) * _BIN),
            "within_0.15_m": float(part[int(NEAR_WALL / _BIN)]),
        }
