"""The result of a matcher, and the protocol of all matchers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window
    from hsloc.model.certificate import Certificate
    from hsloc.model.pose2 import Pose2


class StopReason(StrEnum):
    """Why a matcher stopped."""

    BUDGET = "budget"
    """The budget was spent."""
    AGREEMENT = "agreement"
    """Enough restarts found the same best pose."""
    CONVERGED = "converged"
    """The pose no longer moved (ICP)."""
    PROVEN = "proven"
    """No pose of the window is fitter by more than epsilon (exact)."""
    NO_POINTS = "no_points"
    """There was nothing to match."""


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """The fittest pose that was found.

    `fitness` is in [0, 1], over all the points. `covariance` is 3 x 3 over (x, y, theta) in the map frame (m^2, rad^2);
    a direction that the scan does not determine has the variance of the window. `evaluations` counts every fitness
    evaluation, the initial ones and those of the refinement included. `history` is the best fitness after each
    evaluation of the first restart, where it was asked for; `certificate` what was proven, where it was.
    """

    pose: Pose2
    fitness: float
    covariance: NDArray[np.float64]
    evaluations: int
    stopped: StopReason
    restarts: int = 1
    history: NDArray[np.float64] | None = None
    certificate: Certificate | None = None


class Matcher(Protocol):
    """Finds the pose in a window that fits a scan best.

    Contract: the same points, field, window and state of `rng` give the same Match; the pose lies in the
    window (ICP, which knows none, excepted); nothing but `rng` changes.
    """

    def match(self, points: NDArray[np.float64], field: LikelihoodField, window: Window, rng: Generator) -> Match:
        """Match points (n, 2), in metres and seen from the base, against a field."""
        ...
