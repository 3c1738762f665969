"""People who walk about while the robot drives: to a lidar at shin height, pairs of moving circles."""

from __future__ import annotations

from math import tau
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

LEG_RADIUS = 0.07
STANCE = 0.1
"""Metres from the middle of the body to each leg, sideways."""
STRIDE = 0.22
"""Metres that a leg swings forwards and backwards."""
STEPS_PER_METRE = 0.75
PERSONAL_SPACE = 0.4
"""Nearer to the laser (metres) nobody walks: who would, has stepped aside and is not seen."""


class Walkers:
    """`count` people on the world's path, there and back without end, each with a pace and a side of their own."""

    def __init__(self, path: Array, count: int, rng: np.random.Generator) -> None:
        self._path = path
        self._along = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
        length = float(self._along[-1])
        self._start = rng.uniform(0.0, 2.0 * length, count)
        self._pace = rng.uniform(0.7, 1.4, count)
        self._aside = rng.uniform(-0.22, 0.22, count)

    def legs(self, time_s: float, laser: Array) -> Array:
        """Circles x y radius (metres), shape (k, 3), at `time_s` seconds; `laser` (2,) is the robot's place."""
        length = float(self._along[-1])
        walked = self._start + self._pace * time_s
        there = np.mod(walked, 2.0 * length)
        along = np.where(there < length, there, 2.0 * length - there)
        leg = np.clip(np.searchsorted(self._along, along, side="right") - 1, 0, len(self._path) - 2)
        delta = self._path[leg + 1] - self._path[leg]
        forward = delta / np.hypot(delta[:, 0], delta[:, 1])[:, None]
        left = np.column_stack((-forward[:, 1], forward[:, 0]))
        body = self._path[leg] + (along - self._along[leg])[:, None] * forward + self._aside[:, None] * left
        swing = STRIDE * np.sin(tau * STEPS_PER_METRE * walked)[:, None]
        feet = np.concatenate((body + STANCE * left + swing * forward, body - STANCE * left - swing * forward))
        feet = feet[np.hypot(feet[:, 0] - laser[0], feet[:, 1] - laser[1]) > PERSONAL_SPACE]
        return np.column_stack((feet, np.full(len(feet), LEG_RADIUS)))
