"""What the tests of the localiser share: a small map, events, and a matcher whose answers are written down."""

from __future__ import annotations

import numpy as np

from hsloc.localisation.localiser import Localiser, LocaliserParameters
from hsloc.matching import LikelihoodField, Match, StopReason
from hsloc.model import Odometry, PairedScan, Pose2, Scan
from hsloc.model.occupancy_grid import OccupancyGrid
from hsloc.model.pose2 import IDENTITY

SECOND_NS = 1_000_000_000


def room(width=6.0, height=4.0, resolution=0.05):
    """A free rectangle with walls around it, its lower-left corner at the origin."""
    cells = np.zeros((round(height / resolution), round(width / resolution)), dtype=np.int8)
    cells[[0, -1], :] = 100
    cells[:, [0, -1]] = 100
    return OccupancyGrid(cells, resolution)


def paired(x, beams=40, stamp_s=None, y=0.0, theta=0.0):
    """A scan of a circle of 1 m at odometry (x, y, theta)."""
    ranges = np.ones(beams, dtype=np.float32)
    stamp = round((x if stamp_s is None else stamp_s) * SECOND_NS)
    return PairedScan(Scan(stamp, ranges, 0.0, 2.0 * np.pi / beams, 0.1, 10.0), Pose2(x, y, theta))


def odometry(x, stamp_s):
    return Odometry(round(stamp_s * SECOND_NS), Pose2(x, 0.0, 0.0))


class ScriptedMatcher:
    """Answers with the next fitness of a list, at the window's centre moved by `offset`; notes each window."""

    def __init__(self, fitness, offset=IDENTITY, variance=1e-4):
        self.fitness = list(fitness)
        self.offset = offset
        self.variance = variance
        self.windows = []

    def match(self, points, field, window, rng):
        self.windows.append(window)
        fitness = self.fitness.pop(0)
        return Match(window.centre @ self.offset, fitness, np.eye(3) * self.variance, 7, StopReason.BUDGET)


def localiser(matcher, start=IDENTITY, grid=None, seed=0, **changes):
    grid = room() if grid is None else grid
    field = LikelihoodField.from_grid(grid)
    return Localiser.from_parameters(
        grid, field, matcher, LocaliserParameters(**changes), np.random.default_rng(seed), start
    )
