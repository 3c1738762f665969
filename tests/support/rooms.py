"""Rooms of straight walls: their map, and what a full-turn lidar sees in them."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scripted_matcher import SECOND_NS

from hsloc.kernels.raycasting import cast_rays
from hsloc.model import OccupancyGrid, PairedScan, Pose2, Scan

if TYPE_CHECKING:
    from collections.abc import Sequence

Segments: TypeAlias = NDArray[np.float64]
Box: TypeAlias = tuple[float, float, float, float]

NO_CIRCLES = np.empty((0, 3))


def walls(*corners: tuple[float, float]) -> Segments:
    """Segments (m, 4) of a closed line through corners."""
    points = np.array(corners, dtype=np.float64)
    return np.hstack((points, np.roll(points, -1, axis=0)))


L_SHAPE = walls((0, 0), (9, 0), (9, 3), (4, 3), (4, 7), (0, 7))
"""No two places of it look alike: the legs differ in length and width."""


def beside(segments: Segments, x: float) -> Segments:
    """The same walls again, `x` metres to the right."""
    return np.vstack((segments, segments + np.array((x, 0.0, x, 0.0))))


def grid(segments: Segments, inside: Sequence[Box], resolution: float = 0.05, margin: float = 0.5) -> OccupancyGrid:
    """A map of walls; free within the boxes `inside` (x0, y0, x1, y1), unknown elsewhere."""
    low = segments.reshape(-1, 2).min(axis=0) - margin
    high = segments.reshape(-1, 2).max(axis=0) + margin
    width, height = (int(n) for n in np.ceil((high - low) / resolution))
    cells = np.full((height, width), -1, dtype=np.int8)
    for x0, y0, x1, y1 in inside:
        c0, r0, c1, r1 = ((np.array((x0, y0, x1, y1)) - np.tile(low, 2)) / resolution).astype(int)
        cells[r0:r1, c0:c1] = 0
    for x0, y0, x1, y1 in segments:
        n = int(np.hypot(x1 - x0, y1 - y0) / (resolution / 4.0)) + 2
        columns = ((np.linspace(x0, x1, n) - low[0]) / resolution).astype(int)
        rows = ((np.linspace(y0, y1, n) - low[1]) / resolution).astype(int)
        cells[rows, columns] = 100
    return OccupancyGrid(cells, resolution, Pose2(float(low[0]), float(low[1]), 0.0))


def seen(segments: Segments, pose: Pose2, T_odom_base: Pose2, stamp_s: float, beams: int = 180) -> PairedScan:
    """What a lidar at a pose sees, paired with an odometry."""
    angles = 2.0 * np.pi * np.arange(beams) / beams
    heading = angles + pose.theta
    directions = np.column_stack((np.cos(heading), np.sin(heading)))
    origins = np.tile((pose.x, pose.y), (beams, 1))
    ranges = cast_rays(origins, directions, segments, NO_CIRCLES).astype(np.float32)
    scan = Scan(round(stamp_s * SECOND_NS), ranges, 0.0, 2.0 * np.pi / beams, 0.1, 30.0)
    return PairedScan(scan, T_odom_base)
