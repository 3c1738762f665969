"""What the tests of the localiser share: a small map, events, and a matcher with scripted results."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.localisation.localiser import Localiser
from hsloc.localisation.parameters import LocaliserParameters
from hsloc.matching import LikelihoodField, Match, StopReason, Window
from hsloc.model import IDENTITY, OccupancyGrid, Odometry, PairedScan, Pose2, Scan

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching import Matcher

SECOND_NS = 1_000_000_000


def room(width: float = 6.0, height: float = 4.0, resolution: float = 0.05) -> OccupancyGrid:
    """A free rectangle with walls around it, its lower-left corner at the origin."""
    cells = np.zeros((round(height / resolution), round(width / resolution)), dtype=np.int8)
    cells[[0, -1], :] = 100
    cells[:, [0, -1]] = 100
    return OccupancyGrid(cells, resolution)


def paired(x: float, beams: int = 40, theta: float = 0.0) -> PairedScan:
    """A scan of a circle of 1 m at odometry (x, 0, theta)."""
    ranges = np.ones(beams, dtype=np.float32)
    scan = Scan(round(x * SECOND_NS), ranges, 0.0, 2.0 * np.pi / beams, 0.1, 10.0)
    return PairedScan(scan, Pose2(x, 0.0, theta))


def odometry(x: float, stamp_s: float) -> Odometry:
    return Odometry(round(stamp_s * SECOND_NS), Pose2(x, 0.0, 0.0))


class ScriptedMatcher:
    """Answers with the next fitness of a list, at the window's centre moved by `offset`; records each window.

    `offsets`, one for each fitness, go before `offset`.
    """

    def __init__(
        self, fitness: Sequence[float], offset: Pose2 = IDENTITY, offsets: Sequence[Pose2] | None = None
    ) -> None:
        self.fitness = list(fitness)
        self.offsets = [offset] * len(fitness) if offsets is None else list(offsets)
        self.windows: list[Window] = []

    def match(self, points: NDArray[np.float64], field: LikelihoodField, window: Window, rng: Generator) -> Match:
        self.windows.append(window)
        fitness = self.fitness.pop(0)
        return Match(window.centre @ self.offsets.pop(0), fitness, np.eye(3) * 1e-4, 7, StopReason.BUDGET)


def localiser(
    matcher: Matcher, start: Pose2 | None = IDENTITY, grid: OccupancyGrid | None = None, **changes: Any
) -> Localiser:
    """A localiser that calls the matcher for every match; in a room unless a grid is given."""
    chosen = room() if grid is None else grid
    field = LikelihoodField.from_grid(chosen)
    parameters = replace(LocaliserParameters(refine_first=False), **changes)
    return Localiser.from_parameters(chosen, field, matcher, parameters, np.random.default_rng(0), start)
