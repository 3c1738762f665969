"""Several lasers: whether they are mounted where the log says, by what each alone says of the robot's place.

A laser that is mounted elsewhere, by five degrees or a hand, bends a map and spoils a pose without any other sign: the
pose is a compromise between the lasers. So some scans of each are matched alone on the map of the run. What two
lasers then disagree in, time and again and in the frame of the base, is the error of a mounting.
"""

from __future__ import annotations

from math import degrees, hypot, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.matching.hide import Hide
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.events import Scan
    from hsloc.model.occupancy_grid import OccupancyGrid

SAMPLES = 60
"""So many scans of each laser are looked at."""
_FEWEST = 10
_HALF, _HALF_ANGLE = 0.6, radians(20.0)
_MIN_FITNESS = 0.5
_MIN_POINTS = 30
OFF, OFF_ANGLE = 0.1, radians(2.0)
"""A mounting that is wrong by less is not told."""
_SURE = 4.0
"""And it must be so many of its standard errors."""


class MountingCheck:
    """Takes the believed scans of a run with their poses, a few of which it matches again."""

    def __init__(self, grid: OccupancyGrid, scans: int, lasers: int) -> None:
        """`scans` are to come, of so many lasers; of one laser there is nothing to compare."""
        self._every = max(scans // (max(lasers, 1) * SAMPLES), 1)
        self._field = LikelihoodField.from_grid(grid) if lasers > 1 and grid.occupied().any() else None
        self._rng = np.random.default_rng(0)
        self._seen: dict[str, int] = {}
        self._mounted: dict[str, Pose2] = {}
        self._offsets: dict[str, list[NDArray[np.float64]]] = {}

    def add(self, scan: Scan, T_map_base: Pose2) -> None:
        """A scan, and where the base was."""
        frame = scan.frame_id
        number = self._seen[frame] = self._seen.get(frame, -1) + 1
        self._mounted.setdefault(frame, scan.T_base_laser)
        if self._field is None or number % self._every:
            return
        points = scan.points_base()
        if len(points) < _MIN_POINTS:
            return
        match = Hide().match(points, self._field, Window(T_map_base, _HALF, _HALF, _HALF_ANGLE), self._rng)
        if match.fitness >= _MIN_FITNESS:
            self._offsets.setdefault(frame, []).append(T_map_base.between(match.pose).to_array())

    def doubts(self) -> list[str]:
        """A line for each laser that disagrees with the first in the order of names."""
        told = {frame: np.array(rows) for frame, rows in sorted(self._offsets.items()) if len(rows) >= _FEWEST}
        lines = []
        for other, offsets in list(told.items())[1:]:
            first = next(iter(told))
            a, sigma_a = _middle(told[first])
            b, sigma_b = _middle(offsets)
            off = a.between(b)
            sigma = np.hypot(sigma_a, sigma_b)
            far = hypot(off.x, off.y) > max(OFF, _SURE * float(np.hypot(*sigma[:2])))
            if far or abs(off.theta) > max(OFF_ANGLE, _SURE * float(sigma[2])):
                is_at, would = self._mounted[other], off @ self._mounted[other]
                lines.append(
                    f"the laser {other} does not fit {first}: it is said to be at {_text(is_at)}, by the map it would "
                    f"be at about {_text(would)}; one of the two is mounted otherwise than /tf_static says"
                )
        return lines


def _middle(offsets: NDArray[np.float64]) -> tuple[Pose2, NDArray[np.float64]]:
    """The median, and its standard error from the spread about it."""
    middle = np.median(offsets, axis=0)
    spread = 1.4826 * np.median(np.abs(offsets - middle), axis=0)
    return Pose2.from_array(middle), 1.25 * spread / np.sqrt(len(offsets))


def _text(pose: Pose2) -> str:
    return f"{pose.x:.2f}, {pose.y:.2f} m, {degrees(pose.theta):.1f} deg"
