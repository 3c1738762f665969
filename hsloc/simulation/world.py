"""The world a simulated robot drives through: line segments, and a path that leads through them."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Pose2
from hsloc.simulation.rasterise import rasterise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid
    from hsloc.warnings import RunWarning

    Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Walls and a way through them, in metres in the map frame.

    `segments` (n, 4) are x0 y0 x1 y1. `waypoints` (m, 2) are corners of the path that the robot follows; where
    `closed`, it goes on from the last to the first, lap after lap. `points` (k, 2) are what the course report's sensor
    sees, whatever stands between, or None where the world has walls. `start_heading` is the robot's heading at the
    first waypoint in radians, or None: towards the second. `grid` is the map that the world was made from, if any,
    and `warnings` are those of its map.
    """

    name: str
    segments: Array
    waypoints: Array
    closed: bool = False
    points: Array | None = None
    start_heading: float | None = None
    grid: OccupancyGrid | None = None
    warnings: tuple[RunWarning, ...] = ()

    def path(self, laps: float = 1.0) -> Array:
        """The waypoints of `laps` laps, shape (k, 2); of a broken lap, its first part.

        A closed path is repeated and ends where it began; an open one is driven there and back again in turn.
        """
        forth = self._lap()
        legs = [forth if self.closed or lap % 2 == 0 else forth[::-1] for lap in range(ceil(laps))]
        path = np.concatenate([legs[0], *(leg[1:] for leg in legs[1:])])
        along = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
        end = laps * self.lap_length()
        kept = along < end - 1e-9
        last = [np.interp(end, along, path[:, axis]) for axis in (0, 1)]
        return np.vstack((path[kept], last))

    def start(self) -> Pose2:
        """Where the robot stands at first."""
        (x0, y0), (x1, y1) = self._lap()[:2]
        heading = self.start_heading
        return Pose2(float(x0), float(y0), float(np.arctan2(y1 - y0, x1 - x0)) if heading is None else heading)

    def _lap(self) -> Array:
        return np.vstack((self.waypoints, self.waypoints[:1])) if self.closed else self.waypoints

    def lap_length(self) -> float:
        """Length in metres of one lap along the waypoints."""
        return float(np.hypot(*np.diff(self._lap(), axis=0).T).sum())

    def occupancy_grid(self, resolution: float = 0.05) -> OccupancyGrid:
        """The true map at `resolution` metres a cell; see `rasterise`. Points occupy the cell they lie in.

        A world that was made from a map has that map, whatever the resolution.
        """
        if self.grid is not None:
            return self.grid
        shapes = self.segments
        if self.points is not None:
            shapes = np.vstack((shapes, np.tile(self.points, 2)))
        return rasterise(shapes, self.path(), resolution)

    def distance_to_walls(self, positions: Array) -> Array:
        """Distance in metres from positions, shape (n, 2), to the nearest wall, shape (n,)."""
        nearest = np.full(len(positions), np.inf)
        for x0, y0, x1, y1 in self.segments:
            start, along = np.array((x0, y0)), np.array((x1 - x0, y1 - y0))
            fraction = np.clip((positions - start) @ along / max(along @ along, 1e-300), 0.0, 1.0)
            offset = positions - start - fraction[:, None] * along
            nearest = np.minimum(nearest, np.hypot(offset[:, 0], offset[:, 1]))
        return nearest

    def fingerprint(self) -> str:
        """sha256 over all shapes: two worlds with one fingerprint are one world."""
        digest = sha256()
        for array in (self.segments, self.waypoints, self.points):
            digest.update(b"-" if array is None else np.ascontiguousarray(array, dtype="<f8").tobytes())
        return digest.hexdigest()


def rotated(points: Array, angle: float) -> Array:
    """Points or segments, rows of x y pairs, turned about the origin by `angle` radians."""
    c, s = np.cos(angle), np.sin(angle)
    pairs = points.reshape(-1, 2)
    return np.round(np.column_stack((c * pairs[:, 0] - s * pairs[:, 1], s * pairs[:, 0] + c * pairs[:, 1])), 6).reshape(
        points.shape
    )
