"""How far a match may be trusted: its covariance from the curvature of the field, and its information without a prior.

The covariance has the variance of the search window where the scan determines nothing. A filter must not take that for
a measurement: along a corridor it would shrink with every scan. The information is zero where nothing is measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.beams import wall_information, wall_normals, wall_rows
from hsloc.kernels.fitness import point_scores
from hsloc.model.pose2 import rotated

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

_CELL_SIGMA = 1.0 / np.sqrt(12.0)
"""Standard deviation of a wall's place within its cell, in cells. Internal: that of a uniform distribution."""
CORRELATED = 30.0
"""Number of beams that count as one. Internal: neighbouring beams see one wall with one error of the map, and
a covariance is only compared with that of the odometry, whose parameters are what is to be set."""


def match_covariance(information: F64, n_points: int, fitness: float, field: LikelihoodField, window: Window) -> F64:
    """Covariance (3, 3) of a match in the map frame from the normal equations of the scores.

    `information` is the sum of J^T J of the scores by (cells, cells, rad), as `kernels.polish` leaves it. A score is
    exp(-d / sigma), so near a wall its slope is the distance's slope / sigma; a distance is known to the place of the
    wall within its cell and to the residual that is left, -sigma ln(fitness). A direction without slope keeps
    the variance of the uniform distribution over the window.
    """
    to_metres = np.array((1.0 / field.resolution, 1.0 / field.resolution, 1.0))
    slope = information * np.outer(to_metres, to_metres) * field.sigma**2
    residual = -field.sigma * np.log(max(fitness, 1e-3))
    variance = (_CELL_SIGMA * field.resolution) ** 2 + residual**2
    half = np.minimum(window.half_widths(), (np.inf, np.inf, np.pi))
    prior = np.diag(3.0 / half**2)
    covariance: F64 = np.linalg.inv(slope / (variance * CORRELATED) + prior)
    angle = field.T_map_field.theta
    if angle != 0.0:
        covariance = rotated(covariance, angle)
    return 0.5 * (covariance + covariance.T)


POINT_SIGMA = 0.02
"""Standard deviation of a point from its wall (m): the range noise of indoor lidars, 1 to 3 cm by their data sheets."""
_LEAST_ON_WALLS = 0.5
"""Share of points on walls below which the world is one of points, or the lidar too coarse to show walls."""
MAX_GAP = 0.2
"""Neighbouring points of one wall lie as near as this (m), and farther apart with distance."""


def match_information(
    points: F64, field: LikelihoodField, pose: Pose2, wall_variance: float | None = None
) -> F64 | None:
    """Information (3, 3) of (x, y, theta) in the map frame (1/m^2, 1/rad^2) of points (n, 2) in the order of the beams.

    Zero in directions that no wall holds; None where most points show no wall, so that nothing is known of it.
    `wall_variance` is that of the place of a wall (m^2), by default of a uniform one within a cell.
    """
    if len(points) == 0:
        return np.zeros((3, 3))
    points = np.ascontiguousarray(points)
    cells = field.to_cells(pose)
    scores = np.empty(len(points), dtype=np.float32)
    point_scores(field.packed, field.scale(points), cells[0], cells[1], cells[2], scores)
    normals = np.empty_like(points)
    wall_normals(points, MAX_GAP, POINT_SIGMA**2, normals)
    if np.count_nonzero(np.abs(normals).sum(axis=1)) < _LEAST_ON_WALLS * len(points):
        return None
    metres = cells * (field.resolution, field.resolution, 1.0)
    rows = np.empty(len(points), dtype=np.int64)
    wall_rows(points, normals, metres, field.resolution, rows)
    order = np.argsort(rows, kind="stable")
    within_cell = field.resolution**2 / 12.0
    variances = np.array((POINT_SIGMA**2 + within_cell, within_cell if wall_variance is None else wall_variance))
    information = wall_information(
        points, normals, scores.astype(np.float64), metres, field.resolution, variances, rows, order
    )
    angle = field.T_map_field.theta
    if angle != 0.0:
        information = rotated(information, angle)
    return information
