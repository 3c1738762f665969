"""The optimum next to a prediction, by damped Gauss-Newton steps: a few evaluations instead of a search."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.levenberg_marquardt import polish
from hsloc.matching.covariance import match_covariance
from hsloc.matching.harmony_search import half_widths_in
from hsloc.matching.match import Match, StopReason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window

    F64 = NDArray[np.float64]

_ITERATIONS = 15
"""Steps, at most; from a prediction some five are enough."""


def refine(points: F64, field: LikelihoodField, window: Window) -> Match:
    """The optimum that is reached uphill from the window's centre; it lies in the window.

    `points` (n, 2) are seen from the base. Whether it is the best of the window is not known.
    """
    half = half_widths_in(field, window) * (1.0 / field.resolution, 1.0 / field.resolution, 1.0)
    pose = field.to_cells(window.centre)
    information = np.zeros((3, 3))
    total, evaluations = polish(
        field.packed, field.scale(points), pose, pose - half, pose + half, _ITERATIONS, information
    )
    fitness = float(total) / max(len(points), 1)
    covariance = match_covariance(information, len(points), fitness, field, window)
    return Match(field.from_cells(pose), fitness, covariance, int(evaluations), StopReason.CONVERGED)
