"""How good a map is: by itself, by the scans that made it, and against a true map."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, nan, pi
from typing import TYPE_CHECKING

import numpy as np

from hsloc.dataclass_json import Measured
from hsloc.errors import EvaluationError
from hsloc.model import IDENTITY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid, Pose2

    Floats = NDArray[np.float64]


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
    to_truth, from_truth = _nearest_distances(ours, theirs), _nearest_distances(theirs, ours)
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


def _nearest_distances(points: Floats, others: Floats) -> Floats:
    """Distance of each point (n, 2) to the nearest of others (m, 2), shape (n,)."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(points)[0], dtype=np.float64)


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
