"""Figures of maps: how good one is, by itself, by the scans that made it and against a true map; and what changed.

What changed between two maps of one place is walls and things that appeared, and that vanished.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, nan, pi
from typing import TYPE_CHECKING, Literal

import numpy as np

from hsloc.dataclass_json import Measured  # noqa: TC001 - read by get_type_hints
from hsloc.errors import EvaluationError
from hsloc.model.occupancy_grid import UNKNOWN, OccupancyGrid
from hsloc.model.pose2 import IDENTITY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.pose2 import Pose2

    Floats = NDArray[np.float64]
    Bools = NDArray[np.bool_]

TOLERANCE_M = 0.15
"""Distance from a wall of the other map within which a wall is the same: two or three cells of error in both."""
MIN_SIZE_M = 0.3
"""Smallest change that is listed, unless another size is asked for."""
MOST_GONE = 0.2
"""Part of the walls that vanishes when a building is rebuilt, or when two frames are taken for one: of maps of one log
at most 0.05, of one that is 2 % too large 0.37 and more, of five other buildings 0.63 and more."""
_SQUARE_M = 0.15
"""Side of squares: changed cells in squares that touch are one thing, as the legs of a chair."""


@dataclass(frozen=True, slots=True)
class Crispness:
    """Sharpness of the walls of a map: small errors of the poses blur walls or double them.

    Around each occupied cell, the occupied cells within `radius` form a small cloud with a covariance.

    - `wall_thickness_*` (m): sqrt(12 * its smaller eigenvalue), of a straight wall exactly its thickness (two
      thin walls at a distance d read sqrt(3) d). This is the plane variance of [R], made a length.
    - `mean_map_entropy` (nats): the mean of ln det(2 pi e covariance) / 2, [R]'s and [D]'s measure. Lower is
      crisper. Both compare maps of one place, resolution and radius only: corners count as blur, in every map.
    - `occupancy_entropy` (bits): mean entropy of the occupancy within `radius` of a wall: 0 where all cells are
      certain (and always 0 in a map of three values), up to 1 where passes contradict each other.

    [D] D. Droeschel, J. Stückler, S. Behnke, "Local multi-resolution representation for 6D motion estimation and
    mapping with a continuously rotating 3D laser scanner", ICRA 2014. [R] J. Razlaw et al., "Evaluation of
    registration methods for sparse 3D laser scans", ECMR 2015.
    """

    wall_thickness_median: Measured
    """Median thickness of the walls [m]."""
    wall_thickness_mean: Measured
    """Mean thickness of the walls [m]."""
    wall_thickness_p95: Measured
    """Thickness that 95 of 100 wall cells stay below [m]."""
    mean_map_entropy: Measured
    """Mean map entropy [nats]; lower is crisper."""
    occupancy_entropy: Measured
    """Mean entropy of the occupancy near walls, from 0 to 1 [bits]."""
    radius: float
    """Radius around a cell in which its neighbours are considered [m]."""
    occupied_cells: int
    """Number of occupied cells."""


@dataclass(frozen=True, slots=True)
class MapComparison:
    """A map against the true map, by their occupied cells; distances in metres, NaN where a map has no wall.

    `precision`: which part of the map's walls lies within `tolerance` of a true wall; `recall`: which part of
    the true walls has a wall of the map within `tolerance` (a wall that no scan has seen counts as missed).
    """

    precision: Measured
    """Fraction of the map's occupied cells within the tolerance of an occupied cell of the true map, from 0 to 1."""
    recall: float
    """Fraction of the true map's occupied cells within the tolerance of one of the map, from 0 to 1."""
    f1: float
    """Harmonic mean of precision and recall, from 0 to 1."""
    mean_distance_to_truth: Measured
    """Mean distance from the map's occupied cells to the nearest of the true map [m]."""
    mean_distance_from_truth: Measured
    """Mean distance from the true map's occupied cells to the nearest of the map [m]."""
    tolerance: float
    """Tolerance of precision and recall [m]."""
    map_cells: int
    """Number of occupied cells of the map."""
    true_cells: int
    """Number of occupied cells of the true map."""


def compare_maps(
    grid: OccupancyGrid, truth: OccupancyGrid, *, tolerance: float = 0.1, T_truth_map: Pose2 = IDENTITY
) -> MapComparison:
    """Compare the walls of a map with those of the true map, after `T_truth_map` has moved the map.

    Raises `EvaluationError` where the true map holds no wall or the tolerance is negative.
    """
    if not tolerance >= 0.0:
        raise EvaluationError(f"the tolerance of the map comparison is {tolerance} m; it must not be negative")
    ours = T_truth_map @ grid.centres(grid.occupied())
    theirs = truth.centres(truth.occupied())
    if len(theirs) == 0:
        raise EvaluationError("the true map holds no occupied cell: nothing to compare with")
    if len(ours) == 0:
        return MapComparison(nan, 0.0, 0.0, nan, nan, tolerance, 0, len(theirs))
    to_truth, from_truth = truth.wall_distances(ours), grid.wall_distances(T_truth_map.inverse() @ theirs)
    # Cell centres on a common grid lie at exact multiples: rounding must not decide whether 0.1 is within 0.1.
    limit = tolerance * (1.0 + 1e-9) + 1e-12
    precision, recall = float((to_truth <= limit).mean()), float((from_truth <= limit).mean())
    f1 = 2.0 * precision * recall / (precision + recall) if precision + recall > 0.0 else 0.0
    return MapComparison(
        precision, recall, f1, float(to_truth.mean()), float(from_truth.mean()), tolerance, len(ours), len(theirs)
    )


def crispness(grid: OccupancyGrid, *, radius: float = 0.3) -> Crispness:
    """Measure how sharp the walls of a map are (see `Crispness`); NaN where it has none."""
    walls = grid.occupied()
    count = int(walls.sum())
    if count == 0:
        return Crispness(nan, nan, nan, nan, nan, radius, 0)
    offsets = _disc(radius / grid.resolution)
    xx, xy, yy = _local_covariance(walls, offsets)
    # A cell is a small square of mass: its own variance is a twelfth of its side squared.
    xx, yy = xx + 1.0 / 12.0, yy + 1.0 / 12.0
    smaller = (xx + yy) / 2.0 - np.hypot((xx - yy) / 2.0, xy)
    thickness = grid.resolution * np.sqrt(12.0 * np.maximum(smaller, 0.0))
    determinant = np.maximum(xx * yy - xy * xy, np.finfo(np.float64).tiny)
    entropy = log(2.0 * pi) + 1.0 + 2.0 * log(grid.resolution) + 0.5 * np.log(determinant)
    median, p95 = np.percentile(thickness, (50.0, 95.0))
    return Crispness(
        wall_thickness_median=float(median),
        wall_thickness_mean=float(thickness.mean()),
        wall_thickness_p95=float(p95),
        mean_map_entropy=float(entropy.mean()),
        occupancy_entropy=_occupancy_entropy(grid, walls, offsets),
        radius=radius,
        occupied_cells=count,
    )


def _disc(radius_cells: float) -> NDArray[np.int64]:
    """Offsets (row, column) of the cells within a radius, shape (n, 2)."""
    reach = int(radius_cells)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = rows**2 + columns**2 <= radius_cells**2
    return np.column_stack((rows[inside], columns[inside])).astype(np.int64)


def _local_covariance(walls: NDArray[np.bool_], offsets: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
    """Covariance in cells^2 (xx, xy, yy) of the wall cells around each wall cell: only those are visited."""
    reach = int(np.abs(offsets).max())
    padded = np.pad(walls, reach)
    rows, columns = np.nonzero(padded)
    n, sx, sy, sxx, sxy, syy = (np.zeros(len(rows)) for _ in range(6))
    for dy, dx in offsets.tolist():
        there = padded[rows + dy, columns + dx]
        n += there
        sx += dx * there
        sy += dy * there
        sxx += dx * dx * there
        sxy += dx * dy * there
        syy += dy * dy * there
    mx, my = sx / n, sy / n
    return sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my


def _occupancy_entropy(grid: OccupancyGrid, walls: NDArray[np.bool_], offsets: NDArray[np.int64]) -> float:
    reach = int(np.abs(offsets).max())
    near = np.zeros(np.array(walls.shape) + 2 * reach, dtype=bool)
    rows, columns = np.nonzero(walls)
    for dy, dx in offsets.tolist():
        near[rows + reach + dy, columns + reach + dx] = True
    height, width = walls.shape
    values = grid.cells[near[reach : reach + height, reach : reach + width] & (grid.cells >= 0)]
    p = np.clip(values / 100.0, 0.0, 1.0)
    certain = (p == 0.0) | (p == 1.0)
    q = np.where(certain, 0.5, p)
    bits = np.where(certain, 0.0, -(q * np.log2(q) + (1.0 - q) * np.log2(1.0 - q)))
    return float(bits.mean())


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


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeCounts:
    """What changed since a given map was made, as the scans with a known pose show it (changes.csv)."""

    appeared: int
    """Number of things, from 0.3 m on, that stand where the map is free."""
    vanished: int
    """Number of things or pieces of wall of the map that are gone."""
    gone: float
    """Fraction of the occupied cells of the map that were seen which are gone, from 0 to 1."""
    hidden: float
    """Mean fraction of a scan's beams that end at things which appeared, from 0 to 1."""
    hidden_max: float
    """Largest fraction of a scan's beams that end at them, from 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class MapChanges:
    """Changes from a map to another: `changes`, the largest first, and their cells in the first map's grid."""

    changes: tuple[MapChange, ...]
    appeared: Bools
    vanished: Bools
    shared: float
    """Part of the first map's known cells that the second knows as well, from 0 to 1."""
    gone: float
    """Part of the walls of the first map that vanished, of those at places that the second knows, from 0 to 1."""


def map_changes(
    first: OccupancyGrid, second: OccupancyGrid, T_first_second: Pose2 | None = None, min_size: float = MIN_SIZE_M
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
        found, numbers = changed_things(first, mask, kind, min_size)  # type: ignore[arg-type]
        changes += found
        kept.append(numbers > 0)
    known = first.cells != UNKNOWN
    shared = float((known & (seen != UNKNOWN)).sum() / max(int(known.sum()), 1))
    gone = float(kept[1].sum() / max(int((before & (seen != UNKNOWN)).sum()), 1))
    changes.sort(key=largest_first)
    return MapChanges(tuple(changes), kept[0], kept[1], shared, gone)


def largest_first(change: MapChange) -> tuple[float, float, float]:
    """The key that sorts changes."""
    return -change.size, change.x, change.y


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


def changed_things(
    grid: OccupancyGrid, mask: Bools, kind: Literal["appeared", "vanished"], min_size: float
) -> tuple[list[MapChange], NDArray[np.int32]]:
    """Changed cells that are near each other as one thing each, of `min_size` (m) and more.

    With the number of its thing, from 1 on, for each cell (h, w): 0 where there is none.
    """
    numbers = np.zeros(mask.shape, dtype=np.int32)
    if not mask.any():
        return [], numbers
    centres, of = grid.centres(mask), _groups(np.argwhere(mask), max(round(_SQUARE_M / grid.resolution), 1))
    order = np.argsort(of, kind="stable")
    numbered = np.zeros(int(of.max()) + 1, dtype=np.int32)
    things = []
    for k, rows in enumerate(np.split(order, np.flatnonzero(np.diff(of[order])) + 1)):
        points = centres[rows]
        low, high = points.min(axis=0), points.max(axis=0)
        size = float((high - low).max()) + grid.resolution
        if size < min_size:
            continue
        x, y = (float(value) for value in 0.5 * (low + high))
        things.append(MapChange(kind=kind, x=x, y=y, size=size, cells=len(points)))
        numbered[k] = len(things)
    numbers[mask] = numbered[of]
    return things, numbers


def _groups(cells: NDArray[np.int64], side: int) -> NDArray[np.int64]:
    """The number (n,), from 0 on, of the group of each of the cells (n, 2): those in squares that touch are one.

    By hand, for a run on a map that is right has a few such cells: SciPy takes a quarter of a second to be imported.
    """
    squares, of = np.unique(cells // side, axis=0, return_inverse=True)
    left = {(row, column): k for k, (row, column) in enumerate(squares.tolist())}
    group, count = np.zeros(len(squares), dtype=np.int64), 0
    while left:
        first, k = left.popitem()
        group[k], front = count, [first]
        while front:
            row, column = front.pop()
            for beside in [(row + v, column + u) for v in (-1, 0, 1) for u in (-1, 0, 1)]:
                if (k := left.pop(beside, -1)) >= 0:
                    group[k] = count
                    front.append(beside)
        count += 1
    return np.asarray(group[of.reshape(-1)])
