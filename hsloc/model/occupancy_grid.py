"""A map of cells: occupied, free or unknown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import IDENTITY, Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

UNKNOWN = -1
FREE = 0
OCCUPIED = 100


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """Occupancy as in nav_msgs/OccupancyGrid: int8 of shape (height, width), row 0 at the bottom (lowest y).

    Values: -1 unknown, 0 free .. 100 occupied. `resolution` is the side of a cell in metres; `origin` is the
    pose in the map frame of the lower-left corner of cell [0, 0]; its theta may be other than zero. The centre of
    cell [row, column] is `origin @ ((column + 0.5) * resolution, (row + 0.5) * resolution)`.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: Pose2 = IDENTITY
    occupied_threshold: int = 65

    def __repr__(self) -> str:
        height, width = self.cells.shape
        return f"<OccupancyGrid: {width} x {height} cells of {self.resolution:g} m, {self.occupied().sum()} occupied>"

    def occupied(self) -> NDArray[np.bool_]:
        """Which cells count as occupied, shape (height, width)."""
        return self.cells >= self.occupied_threshold

    def free(self) -> NDArray[np.bool_]:
        """Which cells count as free (known, and below 20), shape (height, width)."""
        return (self.cells >= 0) & (self.cells < 20)

    def centres(self, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Centres of the masked cells in the map frame, metres, shape (n, 2), row by row."""
        rows, columns = np.nonzero(mask)
        local = np.column_stack((columns + 0.5, rows + 0.5)) * self.resolution
        return self.origin @ local

    def wall_distances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances (m) of points (n, 2) in the map frame to the nearest occupied cell's centre; infinite without."""
        # Imported where it is used: reading a map does without numba.
        from hsloc.kernels.score_field import wall_distances

        distances = np.empty(len(points))
        wall_distances(self.occupied(), (self.origin.inverse() @ points) / self.resolution - 0.5, distances)
        return distances * self.resolution

    def bounds(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max) in metres of the whole grid in the map frame."""
        height, width = self.cells.shape
        corners = np.array([(0, 0), (width, 0), (width, height), (0, height)]) * self.resolution
        moved = self.origin @ corners
        (x0, y0), (x1, y1) = moved.min(axis=0), moved.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)
