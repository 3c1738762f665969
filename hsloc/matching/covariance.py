"""How far a match may be trusted: its covariance, from the curvature of the field."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window

    F64 = NDArray[np.float64]

_CELL_SIGMA = 1.0 / np.sqrt(12.0)
"""Standard deviation of a wall's place within its cell, in cells. Internal: that of a uniform distribution."""
_CORRELATED = 30.0
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
    covariance: F64 = np.linalg.inv(slope / (variance * _CORRELATED) + prior)
    angle = field.T_map_field.theta
    if angle != 0.0:
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
        covariance = rotation @ covariance @ rotation.T
    return 0.5 * (covariance + covariance.T)
