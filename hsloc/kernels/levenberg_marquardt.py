"""Local refinement of a pose on the interpolated field: damped Gauss-Newton (Levenberg-Marquardt)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from hsloc.kernels.fitness import normal_equations

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]

_STILL_CELLS, _STILL_RADIANS = 1e-3, 1e-5
"""Steps (cells, rad) below which the iteration has converged. Internal: far below the accuracy of any scan."""


@njit(cache=True, nogil=True)
def solve_damped(information: F64, gradient: F64, damping: float, step: F64) -> None:
    """Solve `(A + damping diag(A) + tiny I) step = gradient` for a 3 x 3 symmetric A, by Cramer's rule."""
    a = information[0, 0] * (1.0 + damping) + 1e-9
    b = information[0, 1]
    c = information[0, 2]
    d = information[1, 1] * (1.0 + damping) + 1e-9
    e = information[1, 2]
    f = information[2, 2] * (1.0 + damping) + 1e-9
    m00 = d * f - e * e
    m01 = c * e - b * f
    m02 = b * e - c * d
    m11 = a * f - c * c
    m12 = b * c - a * e
    m22 = a * d - b * b
    determinant = a * m00 + b * m01 + c * m02
    if determinant <= 0.0:
        step[:] = 0.0
        return
    step[0] = (m00 * gradient[0] + m01 * gradient[1] + m02 * gradient[2]) / determinant
    step[1] = (m01 * gradient[0] + m11 * gradient[1] + m12 * gradient[2]) / determinant
    step[2] = (m02 * gradient[0] + m12 * gradient[1] + m22 * gradient[2]) / determinant


@njit(cache=True, nogil=True)
def polish(
    packed: F32, points: F32, pose: F64, low: F64, high: F64, iterations: int, information: F64
) -> tuple[float, int]:
    """Climb from `pose` (x, y in cells, theta), in place, for at most `iterations` steps, within the box [low, high].

    The box holds every step: along a corridor the equations are nearly singular, and a free step would run off.

    Returns the sum of the scores and the number of evaluations; `information` (3, 3) is left as it is at the
    pose returned. Never ends at a lower sum than it began with.
    """
    gradient = np.empty(3, dtype=np.float64)
    step = np.empty(3, dtype=np.float64)
    trial = np.empty(3, dtype=np.float64)
    trial_information = np.empty((3, 3), dtype=np.float64)
    trial_gradient = np.empty(3, dtype=np.float64)
    total = normal_equations(packed, points, pose[0], pose[1], pose[2], information, gradient)
    evaluations = 1
    damping = 1e-3
    for _ in range(iterations):
        solve_damped(information, gradient, damping, step)
        for j in range(3):
            trial[j] = min(max(pose[j] + step[j], low[j]), high[j])
            step[j] = trial[j] - pose[j]
        trial_total = normal_equations(packed, points, trial[0], trial[1], trial[2], trial_information, trial_gradient)
        evaluations += 1
        if trial_total > total:
            for j in range(3):  # scalars: rows assigned as a whole take the compiler seconds
                pose[j] = trial[j]
                gradient[j] = trial_gradient[j]
                for k in range(3):
                    information[j, k] = trial_information[j, k]
            total = trial_total
            damping = max(damping / 5.0, 1e-6)
        else:
            damping *= 10.0
        still = abs(step[0]) < _STILL_CELLS and abs(step[1]) < _STILL_CELLS and abs(step[2]) < _STILL_RADIANS
        if still or damping > 100.0:
            break
    return total, evaluations
