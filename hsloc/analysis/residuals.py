"""How well the scans of a run fit its map: distances of their points to the nearest wall."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.events import Scan
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2

_BIN = 0.005
_FARTHEST = 5.0
_BINS = int(_FARTHEST / _BIN) + 1
NEAR_WALL = 0.15
"""A point within so many metres of a wall is explained by the map."""
_FAR_WORSE = 0.8
"""A laser of which less than this part of the best laser's points is explained has another mounting, or is broken."""


class Residuals:
    """Distances to the nearest occupied cell, counted in bins of 5 mm, so that memory does not grow."""

    def __init__(self, grid: OccupancyGrid) -> None:
        from scipy.ndimage import distance_transform_edt

        self._grid = grid
        self._distance = (distance_transform_edt(~grid.occupied()) * grid.resolution).astype(np.float32)
        self._T_grid_map = grid.origin.inverse()
        self._by_laser: dict[str, NDArray[np.int64]] = {}

    def add(self, scan: Scan, T_map_base: Pose2) -> None:
        """Count the points of a scan; those outside the map count as far."""
        local = (self._T_grid_map @ T_map_base) @ scan.points_base()
        cells = np.floor(local / self._grid.resolution).astype(np.int64)
        height, width = self._distance.shape
        inside = (cells[:, 0] >= 0) & (cells[:, 0] < width) & (cells[:, 1] >= 0) & (cells[:, 1] < height)
        distance = np.full(len(cells), _FARTHEST, dtype=np.float32)
        distance[inside] = self._distance[cells[inside, 1], cells[inside, 0]]
        bins = np.minimum(distance / _BIN, _BINS - 1).astype(np.int64)
        counts = self._by_laser.setdefault(scan.frame_id, np.zeros(_BINS, dtype=np.int64))
        counts += np.bincount(bins, minlength=_BINS)

    def to_dict(self) -> dict[str, object]:
        """Median and 95th percentile (m, to 5 mm), the part within `NEAR_WALL` of a wall, and how many points.

        Where there are several lasers, the same of each under `by_laser`.
        """
        values: dict[str, object] = dict(_figures(sum(self._by_laser.values(), np.zeros(_BINS, dtype=np.int64))))
        if len(self._by_laser) > 1:
            values["by_laser"] = {frame: _figures(counts) for frame, counts in sorted(self._by_laser.items())}
        return values

    def doubts(self) -> list[str]:
        """Lasers whose scans fit the map far worse than the best one's: they are mounted elsewhere than is said."""
        near = {frame: _figures(counts)["within_0.15_m"] for frame, counts in sorted(self._by_laser.items())}
        known = {frame: part for frame, part in near.items() if part is not None}
        if len(known) < 2:
            return []
        best = max(known, key=lambda frame: known[frame])
        return [
            f"{100.0 * part:.0f} % of the points of the laser {frame} lie at a wall of the map, but "
            f"{100.0 * known[best]:.0f} % of those of {best}: check the mounting of {frame} in /tf_static, or leave it "
            "out with --scan-topic"
            for frame, part in known.items()
            if part < _FAR_WORSE * known[best]
        ]


def _figures(counts: NDArray[np.int64]) -> dict[str, float | int | None]:
    total = int(counts.sum())
    if total == 0:
        return {"points": 0, "median": None, "p95": None, "within_0.15_m": None}
    part = np.cumsum(counts) / total
    return {
        "points": total,
        "median": float(np.searchsorted(part, 0.5) * _BIN),
        "p95": float(np.searchsorted(part, 0.95) * _BIN),
        "within_0.15_m": float(part[int(NEAR_WALL / _BIN)]),
    }
