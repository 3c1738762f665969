"""What changed between two maps of one place: walls and things that appeared, and that vanished."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from hsloc.model.occupancy_grid import UNKNOWN, OccupancyGrid
from hsloc.model.pose2 import IDENTITY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.pose2 import Pose2

    Bools = NDArray[np.bool_]

TOLERANCE_M = 0.15
"""Distance from a wall of the other map within which a wall is the same: two or three cells of error in both."""
_JOINED_M = 0.2
"""Distance within which changed cells are one thing: a table has four legs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapChange:
    """A thing that is in one of the maps alone; lengths in metres in the frame of the first map."""

    kind: Literal["appeared", "vanished"]
    """appeared: occupied in the second map, free in the first; vanished: the other way round."""
    x: float
    """Middle of its occupied cells along x [m]."""
    y: float
    """Middle of its occupied cells along y [m]."""
    size: float
    """Longer side of the box around it [m]."""
    cells: int
    """Number of its occupied cells."""


@dataclass(frozen=True, slots=True, eq=False)
class MapChanges:
    """Changes from a map to another: `changes`, the largest first, and their cells in the first map's grid."""

    changes: tuple[MapChange, ...]
    appeared: Bools
    vanished: Bools
    shared: float
    """Part of the first map's known cells that the second knows as well, from 0 to 1."""


def map_changes(
    first: OccupancyGrid, second: OccupancyGrid, T_first_second: Pose2 | None = None, min_size: float = 0.3
) -> MapChanges:
    """What changed, where both maps know the place; `T_first_second` is the second's frame seen from the first's.

    Things with a size (m) below `min_size` are left out. What one map does not know is no change.
    """
    from scipy.ndimage import distance_transform_edt

    pose = T_first_second or IDENTITY
    seen = _resampled(first, second, pose)
    now = _cells_of(first, pose @ second.centres(second.occupied()))
    before = first.occupied()
    reach = TOLERANCE_M / first.resolution
    far_from_before = distance_transform_edt(~before) > reach if before.any() else np.ones_like(before)
    far_from_now = distance_transform_edt(~now) > reach if now.any() else np.ones_like(now)
    appeared: Bools = now & first.free() & far_from_before
    vanished: Bools = before & (seen == 0) & far_from_now
    changes: list[MapChange] = []
    kept = []
    for kind, mask in (("appeared", appeared), ("vanished", vanished)):
        found, cells = _things(first, mask, kind, min_size)  # type: ignore[arg-type]
        changes += found
        kept.append(cells)
    known = first.cells != UNKNOWN
    shared = float((known & (seen != UNKNOWN)).sum() / max(int(known.sum()), 1))
    changes.sort(key=lambda change: (-change.size, change.x, change.y))
    return MapChanges(tuple(changes), kept[0], kept[1], shared)


def _resampled(first: OccupancyGrid, second: OccupancyGrid, pose: Pose2) -> NDArray[np.int8]:
    """The second map on the cells of the first: 0 free, 100 occupied, otherwise unknown."""
    places = pose.inverse() @ first.centres(np.ones(first.cells.shape, dtype=np.bool_))
    states = np.full(second.cells.shape, UNKNOWN, dtype=np.int8)
    states[second.free()], states[second.occupied()] = 0, 100
    rows, columns, inside = _rows(second, places)
    found = np.full(len(places), UNKNOWN, dtype=np.int8)
    found[inside] = states[rows[inside], columns[inside]]
    return found.reshape(first.cells.shape)


def _cells_of(grid: OccupancyGrid, points: NDArray[np.float64]) -> Bools:
    """Cells in which points (n, 2) lie."""
    rows, columns, inside = _rows(grid, points)
    mask = np.zeros(grid.cells.shape, dtype=np.bool_)
    mask[rows[inside], columns[inside]] = True
    return mask


def _rows(grid: OccupancyGrid, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64], Bools]:
    cells = np.floor((grid.origin.inverse() @ points) / grid.resolution).astype(np.int64)
    height, width = grid.cells.shape
    inside: Bools = np.all((cells >= 0) & (cells < (width, height)), axis=1)
    return cells[:, 1], cells[:, 0], inside


def _things(
    grid: OccupancyGrid, mask: Bools, kind: Literal["appeared", "vanished"], min_size: float
) -> tuple[list[MapChange], Bools]:
    """Changed cells that are near each other as one thing each, and the cells of those that are large enough."""
    from scipy.ndimage import binary_dilation, label

    kept = np.zeros_like(mask)
    if not mask.any():
        return [], kept
    around = binary_dilation(
        mask, np.ones((3, 3), dtype=np.bool_), iterations=max(round(0.5 * _JOINED_M / grid.resolution), 1)
    )
    labels, count = label(around, np.ones((3, 3), dtype=np.bool_))
    centres, numbers = grid.centres(mask), labels[mask]
    large = []
    things = []
    for k in range(1, count + 1):
        points = centres[numbers == k]
        low, high = points.min(axis=0), points.max(axis=0)
        size = float((high - low).max()) + grid.resolution
        if size < min_size:
            continue
        large.append(k)
        x, y = (float(value) for value in 0.5 * (low + high))
        things.append(MapChange(kind=kind, x=x, y=y, size=size, cells=len(points)))
    kept[mask] = np.isin(numbers, large)
    return things, kept
