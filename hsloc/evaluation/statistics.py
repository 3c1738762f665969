"""The statistics of errors, under evo's names."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING

import numpy as np

from hsloc.dataclass_json import Measured

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of errors, in the errors' unit; NaN (null in JSON) where there is no error.

    `std` is the population's (divided by n), as numpy and evo have it.
    """

    rmse: Measured
    """Root mean square."""
    mean: Measured
    """Mean."""
    median: Measured
    """Median."""
    std: Measured
    """Standard deviation of the population."""
    min: Measured
    """Smallest error."""
    max: Measured
    """Largest error."""
    sse: Measured
    """Sum of squares, in the square of the errors' unit."""
    count: int
    """Number of errors."""

    @staticmethod
    def of(errors: NDArray[np.float64]) -> Statistics:
        """Of errors of shape (n,)."""
        if len(errors) == 0:
            return Statistics(nan, nan, nan, nan, nan, nan, nan, 0)
        squares = np.square(errors)
        return Statistics(
            rmse=float(np.sqrt(squares.mean())),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            std=float(errors.std()),
            min=float(errors.min()),
            max=float(errors.max()),
            sse=float(squares.sum()),
            count=len(errors),
        )


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of n poses (or pairs of poses) in evo's two relations: `trans_part` (m) and `angle_deg` (deg)."""

    trans_part: NDArray[np.float64]
    angle_deg: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.trans_part)

    @staticmethod
    def of(deltas: NDArray[np.float64]) -> PoseErrors:
        """Of error poses of shape (n, 3): x, y in metres, theta in radians and wrapped."""
        return PoseErrors(np.hypot(deltas[:, 0], deltas[:, 1]), np.degrees(np.abs(deltas[:, 2])))

    def statistics(self) -> PoseStatistics:
        """The statistics of both relations."""
        return PoseStatistics(Statistics.of(self.trans_part), Statistics.of(self.angle_deg))


@dataclass(frozen=True, slots=True)
class PoseStatistics:
    """Statistics of translation (m) and of absolute rotation (deg)."""

    trans_part: Statistics
    """Translation [m]."""
    angle_deg: Statistics
    """Absolute rotation [deg]."""
