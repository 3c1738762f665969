"""The final map: every beam of every keyscan, traced through a grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from hsloc.errors import ConfigError
from hsloc.kernels.beams import trace
from hsloc.model.occupancy_grid import UNKNOWN, OccupancyGrid
from hsloc.model.pose2 import Pose2, compose_poses
from hsloc.parameters import NonNegative, Parameters, Positive, Range

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


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
_AT_ONCE = 64
"""Scans that are traced by one call. Internal: time, and some megabytes with a thousand beams."""


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
    for members in _parts(len(scans)):
        origins, ends, is_hit = _beams(poses, scans, members, p)
        trace(hits, misses, origins / p.resolution - corner, ends / p.resolution - corner, is_hit)
    limit = _logit(p.max_probability)
    odds = np.clip(hits * _logit(p.hit_probability) + misses * _logit(p.miss_probability), -limit, limit)
    cells = np.round(100.0 / (1.0 + np.exp(-odds))).astype(np.int8)
    cells[(hits == 0) & (misses == 0)] = UNKNOWN
    return OccupancyGrid(cells, p.resolution, Pose2(float(corner[0]) * p.resolution, float(corner[1]) * p.resolution))


def _parts(scans: int) -> list[slice]:
    """All scans, some at once."""
    return [slice(begin, min(begin + _AT_ONCE, scans)) for begin in range(0, scans, _AT_ONCE)]


def _extent(poses: F64, scans: KeyScans, p: OccupancyMapperParameters) -> tuple[F64, F64]:
    low, high = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
    for members in _parts(len(scans)):
        points, of = _hits(scans, members)
        is_near = np.hypot(points[:, 0], points[:, 1]) < p.max_range
        near = _moved(poses[members], of[is_near], points[is_near])
        if len(near):
            low, high = np.minimum(low, near.min(axis=0)), np.maximum(high, near.max(axis=0))
    return low, high


def _hits(scans: KeyScans, members: slice) -> tuple[F64, I64]:
    """Hits (n, 2) of some scans, each in the frame of its base, and which of the scans each is of (n,)."""
    start = scans.start[members.start : members.stop + 1]
    return scans.points[start[0] : start[-1]].astype(np.float64), np.repeat(np.arange(len(start) - 1), np.diff(start))


def _moved(poses: F64, of: I64, points: F64) -> F64:
    """Points (n, 2), each seen from that of the poses (k, 3) which `of` (n,) has the number of."""
    c, s = np.cos(poses[:, 2])[of], np.sin(poses[:, 2])[of]
    moved = np.empty_like(points)
    moved[:, 0] = poses[:, 0][of] + c * points[:, 0] - s * points[:, 1]
    moved[:, 1] = poses[:, 1][of] + s * points[:, 0] + c * points[:, 1]
    return moved


def _beams(
    poses: F64, scans: KeyScans, members: slice, p: OccupancyMapperParameters
) -> tuple[F64, F64, NDArray[np.uint8]]:
    """Origins, ends (n, 2) in the map (m) and whether each beam ends in a hit."""
    geometry = scans.geometry[members]
    lasers = compose_poses(poses[members], geometry[:, :3])
    # Hits as they were taken in: a scan taken in motion is already straightened there.
    points, of = _hits(scans, members)
    hits = _moved(poses[members], of, points) - lasers[of, :2]
    depth = np.hypot(hits[:, 0], hits[:, 1])
    hits *= np.minimum(1.0, p.max_range / np.maximum(depth, 1e-9))[:, None]
    start = scans.table_start[members.start : members.stop + 1]
    beams = np.flatnonzero(np.isposinf(scans.ranges[start[0] : start[-1]])) + start[0]
    of_beam = np.searchsorted(start, beams, side="right") - 1
    angles = lasers[of_beam, 2] + geometry[of_beam, 3] + geometry[of_beam, 4] * (beams - start[of_beam])
    cleared = p.no_return_range * np.column_stack((np.cos(angles), np.sin(angles)))
    origins = lasers[np.concatenate((of, of_beam)), :2]
    ends = np.concatenate((hits, cleared)) + origins
    is_hit = np.concatenate((depth < p.max_range, np.zeros(len(cleared), dtype=bool)))
    return origins, ends, is_hit.astype(np.uint8)


def _logit(probability: float) -> float:
    return float(np.log(probability / (1.0 - probability)))
