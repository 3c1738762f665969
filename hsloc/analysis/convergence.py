"""How the search of a run converges: some of its scans matched anew, with the best fitness after each evaluation."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.matching.harmony_search import HarmonySearch
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.match import Matcher
    from hsloc.model.events import Scan
    from hsloc.model.occupancy_grid import OccupancyGrid

SCANS = 25
HALF, HALF_ANGLE = 0.5, radians(20.0)
"""Half-widths of the window (m, rad): that of a search after a refused match."""
_MIN_POINTS = 30


class ConvergenceSample:
    """Takes the believed scans of a run with their poses; about `SCANS` of them are searched for anew."""

    def __init__(
        self, grid: OccupancyGrid, likelihood: LikelihoodField | None, matcher: Matcher, sigma: float, scans: int
    ) -> None:
        """The map's field is made where it is not given: of a large map it takes seconds.

        Nothing is sampled for a matcher that does not search (ICP), or on a map without walls.
        """
        usable = isinstance(matcher, HarmonySearch) and grid.occupied().any()
        self._matcher = replace(matcher, restarts=1) if usable and isinstance(matcher, HarmonySearch) else None
        self._field = (likelihood or LikelihoodField.from_grid(grid, sigma)) if usable else None
        self._every = max(scans // SCANS, 1)
        self._seen = -1
        self._rng = np.random.default_rng(0)
        self._curves: list[NDArray[np.float64]] = []

    def add(self, scan: Scan, T_map_base: Pose2) -> None:
        """A scan, and where the base was."""
        self._seen += 1
        if self._matcher is None or self._field is None or self._seen % self._every or len(self._curves) >= SCANS:
            return
        points = scan.points_base()
        if len(points) < _MIN_POINTS:
            return
        # The window is not centred on the answer.
        off = Pose2(*(self._rng.uniform(-0.5, 0.5, 3) * (HALF, HALF, HALF_ANGLE)).tolist())
        window = Window(T_map_base @ off, HALF, HALF, HALF_ANGLE)
        history = self._matcher.match(points, self._field, window, self._rng, keep_history=True).history
        if history is not None and len(history):
            self._curves.append(history)

    def curves(self, name: str) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """(evaluations, best fitness), the median over the scans, under a heading; empty where nothing was sampled."""
        if not self._curves:
            return {}
        length = min(len(curve) for curve in self._curves)
        middle = np.median([curve[:length] for curve in self._curves], axis=0)
        heading = f"{name}, {len(self._curves)} scans, ±{HALF:g} m, ±{degrees(HALF_ANGLE):.0f}°"
        return {heading: (np.arange(1.0, length + 1.0), middle)}
