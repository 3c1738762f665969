"""The final map: every beam of every keyscan, traced through a grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from hsloc.errors import ConfigError
from hsloc.kernels.beams import trace
from hsloc.model.occupancy_grid import UNKNOWN, OccupancyGrid
from hsloc.model.pose2 import Pose2
from hsloc.parameters import NonNegative, Parameters, Positive, Range

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class OccupancyMapperParameters(Parameters):
    """How beams become cells of the map."""

    resolution: Positive = 0.05
    """Side of a cell of the map [m]."""
    hit_probability: Annotated[float, Range(0.5, 1, is_open=True)] = 0.7
    """Probability that a cell in which a beam ended is occupied."""
    miss_probability: Annotated[float, Range(0, 0.5, is_open=True)] = 0.45
    """Probability that a cell through which a beam passed is occupied; near 0.5, as beams graze walls."""
    max_probability: Annotated[float, Range(0.5, 1, is_open=True)] = 0.97
    """Maximum probability of a cell to be occupied, and to be free."""
    max_range: Positive = 30.0
    """Maximum length of a beam that is traced [m]; a hit farther away does not count."""
    no_return_range: NonNegative = 4.0
    """Length that a beam without a return clears [m]; short, as glass and black walls give no return either."""
    margin: NonNegative = 0.5
    """Margin of the map around its outermost hit [m]."""


_MOST_CELLS = 400_000_000
"""Maximum number of cells of a map. Internal: its counts take 3.2 GB of memory."""


def build_grid(poses: F64, scans: KeyScans, parameters: OccupancyMapperParameters) -> OccupancyGrid:
    """The occupancy grid of keyscans at `poses` (n, 3), n at least 1; what no beam met stays unknown.

    Each cell's log odds are `hits * logit(hit) + misses * logit(miss)`, clamped: people who walked through
    vanish, for more beams have passed where they were.
    """
    p = parameters
    low, high = _extent(poses, scans, p)
    corner = np.floor(low / p.resolution - p.margin / p.resolution)
    width, height = (int(n) for n in np.ceil(high / p.resolution + p.margin / p.resolution) - corner)
    if width * height > _MOST_CELLS:
        raise ConfigError(
            f"occupancy: the map would have {width} x {height} cells of {p.resolution} m; choose a larger resolution"
        )
    hits, misses = np.zeros((height, width), dtype=np.int32), np.zeros((height, width), dtype=np.int32)
    for k in range(len(scans)):
        origins, ends, is_hit = _beams(poses[k], scans, k, p)
        trace(hits, misses, origins / p.resolution - corner, ends / p.resolution - corner, is_hit)
    limit = _logit(p.max_probability)
    odds = np.clip(hits * _logit(p.hit_probability) + misses * _logit(p.miss_probability), -limit, limit)
    cells = np.round(100.0 / (1.0 + np.exp(-odds))).astype(np.int8)
    cells[(hits == 0) & (misses == 0)] = UNKNOWN
    return OccupancyGrid(cells, p.resolution, Pose2(float(corner[0]) * p.resolution, float(corner[1]) * p.resolution))


def _extent(poses: F64, scans: KeyScans, p: OccupancyMapperParameters) -> tuple[F64, F64]:
    low, high = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
    for k in range(len(scans)):
        hits = scans.hits(k).astype(np.float64)
        near = hits[np.hypot(hits[:, 0], hits[:, 1]) < p.max_range]
        if len(near):
            moved = Pose2.from_array(poses[k]) @ near
            low, high = np.minimum(low, moved.min(axis=0)), np.maximum(high, moved.max(axis=0))
    return low, high


def _beams(pose: F64, scans: KeyScans, k: int, p: OccupancyMapperParameters) -> tuple[F64, F64, NDArray[np.uint8]]:
    """Origins, ends (n, 2) in the map (m) and whether each beam ends in a hit."""
    x, y, theta, angle_min, increment = scans.geometry[k]
    laser = Pose2.from_array(pose) @ Pose2(float(x), float(y), float(theta))
    # Hits as they were taken in: a scan taken in motion is already straightened there.
    hits = Pose2.from_array(pose) @ scans.hits(k).astype(np.float64) - (laser.x, laser.y)
    depth = np.hypot(hits[:, 0], hits[:, 1])
    hits *= np.minimum(1.0, p.max_range / np.maximum(depth, 1e-9))[:, None]
    ranges = scans.ranges[scans.table_start[k] : scans.table_start[k + 1]]
    angles = laser.theta + angle_min + increment * np.flatnonzero(np.isposinf(ranges))
    cleared = p.no_return_range * np.column_stack((np.cos(angles), np.sin(angles)))
    ends = np.concatenate((hits, cleared)) + np.array((laser.x, laser.y))
    is_hit = np.concatenate((depth < p.max_range, np.zeros(len(cleared), dtype=bool)))
    origins = np.broadcast_to(np.array((laser.x, laser.y)), ends.shape)
    return origins, ends, is_hit.astype(np.uint8)


def _logit(probability: float) -> float:
    return float(np.log(probability / (1.0 - probability)))
