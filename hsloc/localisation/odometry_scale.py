"""By how much the odometry counts distances and turns wrongly, from the innovations of a run.

Wheels that are worn, or whose diameter or track is stated wrongly, count each metre and each radian wrongly by the same
part. The filter takes errors for noise, another one at each step: where a corridor holds the poses weakly they lag
behind, by 0.3 m where distances are counted 0.8 times, and each innovation alone is within its noise.

Scale and turn scale are what Friedland calls a bias (Treatment of bias in recursive filtering, IEEE Transactions on
Automatic Control 14(4), 1969): the filter runs as if there were none, and beside it goes `V` (3, 2), by how much its
pose is off for each unit of the two. A prediction makes `U = F V + D` of it, `D` being what they do in this motion; an
innovation `v` of covariance `S` has the mean `U s`, so that `U^T S^-1 v` and `U^T S^-1 U` add up to the normal
equations of `s`; the update leaves `V = (1 - K) U`. That is what a filter finds whose state holds both.

Where the errors are beyond doubt the log is replayed with the odometry corrected. A filter whose state holds the scales
needs no replay, but along corridors without features it knows the poses less well before it knows the scales: with a
standard deviation of 5 % it doubted 27 % of a Wean Hall log, 9 % before (benchmarks/README.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.kalman_filter import MAX_SQUARED
from hsloc.model.calibration import OdometryCorrection, corrected_odometry
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.model.events import Event
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

_BLOCK_M = 4.0
"""Path length of a block (m), whose errors count as independent of those of the others: longer than a room's wall is
seen at one place of the scan."""
_FEWEST_BLOCKS = 8
"""Blocks below which nothing is said: their scatter is not known."""
_PRIOR = 0.3
"""Standard deviation of both before anything is known: it keeps apart from others only what no scan shows."""
_SIGMAS = 7.0
"""Standard deviations from which on a scale is beyond doubt: Student's t of 7 degrees of freedom exceeds them in 1 of
5,000 runs."""
_LEAST = 0.02
"""Smaller errors are left to the filter: along corridors poses then lag by less than 4 cm."""
_LEFT = 0.5
"""Part of an error that may be left in the replay."""
_NONE = [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]


@dataclass(frozen=True, slots=True)
class OdometryScale:
    """What a metre and a radian of the odometry are more than that, and the standard deviations of both."""

    way: float
    turn: float
    way_sigma: float = 0.0
    turn_sigma: float = 0.0

    @property
    def of_way(self) -> bool:
        """Whether distances are counted wrongly beyond doubt, and by enough to matter."""
        return abs(self.way) > max(_SIGMAS * self.way_sigma, _LEAST)

    @property
    def of_turn(self) -> bool:
        """Whether turns are."""
        return abs(self.turn) > max(_SIGMAS * self.turn_sigma, _LEAST)

    @property
    def is_significant(self) -> bool:
        """Whether distances or turns are."""
        return self.of_way or self.of_turn

    def is_mended(self, after: OdometryScale | None) -> bool:
        """Whether little is left of what was significant, by a run with the odometry corrected."""
        if after is None:
            return False
        way = not self.of_way or abs(after.way) < _LEFT * abs(self.way)
        return way and (not self.of_turn or abs(after.turn) < _LEFT * abs(self.turn))

    def warning(self) -> RunWarning:
        """What was found, for a run with the odometry corrected."""
        way, turn = (1.0 / (1.0 + value) for value in (self.way, self.turn))
        parts = [f"distances {way:.3f} times"] if self.of_way else []
        parts += [f"turns {turn:.3f} times"] if self.of_turn else []
        return RunWarning(
            WarningCode.ODOMETRY_SCALE,
            f"the odometry counts {' and '.join(parts)}, by the matches on the map; it is corrected in this run",
            "correct radius and distance of the wheels in the robot's driver: hsloc calibrate measures them",
        )

    def applied(self, events: Iterable[Event]) -> Iterator[Event]:
        """Events whose odometry counts rightly; it begins where it did."""
        correction = OdometryCorrection(1.0 + self.of_way * self.way, 1.0 + self.of_turn * self.turn)
        return corrected_odometry(events, correction)


class OdometryScaleEstimator:
    """State: the sensitivity `V` of the filter's pose, and of each block of the path the normal equations.

    `V` is kept in rows of Python's own numbers: it is moved for each scan, and products of small arrays take longer.
    """

    def __init__(self) -> None:
        self._sensitivity = _NONE
        self._path_length = 0.0
        self._information: dict[int, F64] = {}
        self._vector: dict[int, F64] = {}

    def restart(self) -> None:
        """The pose was found again by the scans alone."""
        self._sensitivity = _NONE

    def predict(self, pose: Pose2, motion: Pose2) -> None:
        """The filter predicted `pose @ motion`, T_map_base."""
        c, s = cos(pose.theta), sin(pose.theta)
        x, y = c * motion.x - s * motion.y, s * motion.x + c * motion.y
        (xa, xb), (ya, yb), (ta, tb) = self._sensitivity
        # An error of the heading moves the end of the motion aside; a turn that is counted wrongly turns the chord of
        # its arc by half of the error.
        turned = tb + 0.5 * motion.theta
        self._sensitivity = [
            [xa - y * ta + x, xb - y * turned],
            [ya + x * ta + y, yb + x * turned],
            [ta, tb + motion.theta],
        ]
        self._path_length += hypot(x, y)

    def update(self, off: F64, covariance: F64, weight: F64) -> None:
        """The filter took an innovation (3,), by covariance of the prediction; `weight` is the inverse of its own."""
        sensitivity = np.array(self._sensitivity)
        weighed = weight @ sensitivity
        if off @ weight @ off < MAX_SQUARED:  # a slip says nothing of the scale
            block = int(self._path_length / _BLOCK_M)
            self._information[block] = self._information.get(block, 0.0) + sensitivity.T @ weighed
            self._vector[block] = self._vector.get(block, 0.0) + off @ weighed
        self._sensitivity = (sensitivity - covariance @ weighed).tolist()

    def estimate(self) -> OdometryScale | None:
        """Both scales, with standard deviations by the scatter of the blocks (jackknife); None before `_FEWEST_BLOCKS`.

        The noise of the odometry that is assumed says less: it is meant for robots whose scales are not known.
        """
        n = len(self._information)
        if n < _FEWEST_BLOCKS:
            return None
        information, vector = np.array(list(self._information.values())), np.array(list(self._vector.values()))
        total, sums = information.sum(axis=0) + np.eye(2) / _PRIOR**2, vector.sum(axis=0)
        values = np.linalg.solve(total, sums)
        without = np.linalg.solve(total - information, (sums - vector)[:, :, None])[:, :, 0]
        scatter = np.sqrt((n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
        return OdometryScale(*values.tolist(), *scatter.tolist())
