"""APE, the absolute pose error: how far each pose is from its reference (evo's `evo_ape`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.evaluation.statistics import PoseErrors
from hsloc.model import wrap_angles

if TYPE_CHECKING:
    from numpy.typing import NDArray


def ape(reference: NDArray[np.float64], estimate: NDArray[np.float64]) -> PoseErrors:
    """Errors of poses (n, 3) against reference poses (n, 3), row by row."""
    return PoseErrors.of(axis_errors(reference, estimate))


def axis_errors(reference: NDArray[np.float64], estimate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Estimate minus reference, (n, 3): x and y in metres along the map's axes, theta in radians, wrapped."""
    errors = estimate - reference
    errors[:, 2] = wrap_angles(errors[:, 2])
    return errors


def axis_rmse(reference: NDArray[np.float64], estimate: NDArray[np.float64]) -> tuple[float, float, float]:
    """RMSE of x (m), y (m) and theta (rad, wrapped): the figures of [P]'s experiments, which did not wrap."""
    x, y, theta = np.sqrt(np.square(axis_errors(reference, estimate)).mean(axis=0))
    return float(x), float(y), float(theta)
