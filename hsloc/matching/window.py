"""The box of poses that is searched."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Window:
    """[LB, UB] of [P]: a box of poses around `centre`, with half-widths in metres, metres and radians."""

    centre: Pose2
    half_x: float
    half_y: float
    half_theta: float

    @staticmethod
    def from_covariance(
        centre: Pose2, covariance: NDArray[np.float64], sigmas: float, minimum: tuple[float, float]
    ) -> Window:
        """The box of `sigmas` standard deviations, at least `minimum` = (metres, radians) and at most half a turn."""
        # Python's own numbers: this is done for each scan.
        x, y, theta = (sigmas * sqrt(max(variance, 0.0)) for variance in covariance.diagonal().tolist())
        return Window(centre, max(x, minimum[0]), max(y, minimum[0]), min(max(theta, minimum[1]), pi))

    def at_least(self, half_x: float, half_y: float, half_theta: float) -> Window:
        """The box with half-widths that are no smaller than these."""
        return Window(self.centre, max(self.half_x, half_x), max(self.half_y, half_y), max(self.half_theta, half_theta))

    def half_widths(self) -> NDArray[np.float64]:
        """(half_x, half_y, half_theta), shape (3,)."""
        return np.array((self.half_x, self.half_y, self.half_theta))

    def has_on_border(self, pose: Pose2) -> bool:
        """Whether a pose lies on the border of the box, or within a hundredth of it: an optimum may lie beyond."""
        return (
            abs(pose.x - self.centre.x) >= 0.99 * self.half_x
            or abs(pose.y - self.centre.y) >= 0.99 * self.half_y
            or abs(wrap_angle(pose.theta - self.centre.theta)) >= 0.99 * self.half_theta
        )

    def contains(self, pose: Pose2) -> bool:
        """Whether a pose lies in the box, its border included."""
        return (
            abs(pose.x - self.centre.x) <= self.half_x
            and abs(pose.y - self.centre.y) <= self.half_y
            and abs(wrap_angle(pose.theta - self.centre.theta)) <= self.half_theta
        )
