"""By how much the odometry counts distances and turns wrongly, from the innovations of a run.

Wheels that are worn, or whose diameter or track is stated wrongly, count each metre and each radian wrongly by the same
part; where one is larger than the other, the robot turns a little with each metre, unseen. The filter takes errors for
noise, another one at each step: where a corridor holds the poses weakly they lag behind, by 0.3 m where distances are
counted 0.8 times, and each innovation alone is within its noise.

These three are what Friedland calls a bias (Treatment of bias in recursive filtering, IEEE Transactions on Automatic
Control 14(4), 1969): the filter runs as if there were none, and beside it goes `V` (3, 6), by how much its pose is off
for each unit of them. A prediction makes `U = F V + D` of it, `D` being what they do in this motion; an innovation `v`
of covariance `S` has the mean `U s`, so that `U^T S^-1 v` and `U^T S^-1 U` add up to the normal equations of `s`; the
update leaves `V = (1 - K) U`. That is what a filter finds whose state holds all of them. Beside the three goes the pose
of the laser, or the point about which the robot turns, where it is stated wrongly: a few centimetres move the scans
aside in each turn, which passed for turns that are counted 0.84 times (Freiburg 079; its headings alone say 1.00).

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
_PRIOR = np.array((0.3, 0.3, 0.1, 0.3, 0.3, 0.3))
"""Standard deviations before anything is known (1, 1, rad/m, m, m, rad): they keep apart from others only what no scan
shows. One wheel that is 5 % larger than the other, half a metre apart, turns the robot by 0.1 rad/m."""
_SIGMAS = 7.0
"""Standard deviations from which on a scale is beyond doubt: Student's t of 7 degrees of freedom exceeds them in 1 of
5,000 runs."""
_LEAST = 0.02
"""Smaller errors are left to the filter (1, 1, rad/m): along corridors poses then lag by less than 4 cm, and over two
metres without a wall the end is beside its place by as much."""
_LEFT = 0.5
"""Part of an error that may be left in the replay."""
_NONE = [[0.0] * 6] * 3


@dataclass(frozen=True, slots=True)
class OdometryScale:
    """What a metre and a radian of the odometry are more than that, what it turns unseen (rad/m), and deviations."""

    way: float
    turn: float
    way_sigma: float = 0.0
    turn_sigma: float = 0.0
    drift: float = 0.0
    drift_sigma: float = 0.0

    @property
    def of_way(self) -> bool:
        """Whether distances are counted wrongly beyond doubt, and by enough to matter."""
        return abs(self.way) > max(_SIGMAS * self.way_sigma, _LEAST)

    @property
    def of_turn(self) -> bool:
        """Whether turns are."""
        return abs(self.turn) > max(_SIGMAS * self.turn_sigma, _LEAST)

    @property
    def of_drift(self) -> bool:
        """Whether it turns while it drives, unseen."""
        return abs(self.drift) > max(_SIGMAS * self.drift_sigma, _LEAST)

    @property
    def is_significant(self) -> bool:
        """Whether any of them is."""
        return self.of_way or self.of_turn or self.of_drift

    def is_mended(self, after: OdometryScale | None) -> bool:
        """Whether little is left of what was significant, by a run with the odometry corrected."""
        if after is None:
            return False
        way = not self.of_way or abs(after.way) < _LEFT * abs(self.way)
        drift = not self.of_drift or abs(after.drift) < _LEFT * abs(self.drift)
        return way and drift and (not self.of_turn or abs(after.turn) < _LEFT * abs(self.turn))

    def warning(self) -> RunWarning:
        """What was found, for a run with the odometry corrected."""
        way, turn = (1.0 / (1.0 + value) for value in (self.way, self.turn))
        parts = [f"distances {way:.3f} times"] if self.of_way else []
        parts += [f"turns {turn:.3f} times"] if self.of_turn else []
        counts = [f"counts {' and '.join(parts)}"] if parts else []
        counts += [f"misses turns of {np.degrees(self.drift):.2f} deg with each metre"] if self.of_drift else []
        return RunWarning(
            WarningCode.ODOMETRY_SCALE,
            f"the odometry {' and '.join(counts)}, by the matches on the map; it is corrected in this run",
            "correct radius and distance of the wheels in the robot's driver: hsloc calibrate measures them",
        )

    def applied(self, events: Iterable[Event]) -> Iterator[Event]:
        """Events whose odometry counts rightly; it begins where it did."""
        correction = OdometryCorrection(
            1.0 + self.of_way * self.way, 1.0 + self.of_turn * self.turn, self.of_drift * self.drift
        )
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
        half = 0.5 * motion.theta
        driven = cos(half) * motion.x + sin(half) * motion.y  # negative where the robot drives backwards
        # What turns about another point than is stated swings it round: by (R - 1) times its distance.
        swing, back = sin(pose.theta + motion.theta) - s, cos(pose.theta + motion.theta) - c
        # A turn that is counted wrongly turns the chord of its arc by half of the error.
        moved = (
            (x, y, 0.0),
            (-y * half, x * half, motion.theta),
            (-0.5 * y * driven, 0.5 * x * driven, driven),
            (back, swing, 0.0),
            (-swing, back, 0.0),
            (y, -x, 0.0),
        )
        # An error of the heading moves the end of the motion aside.
        columns = zip(*self._sensitivity, strict=True)
        after = [
            (px - y * pt + dx, py + x * pt + dy, pt + dt)
            for (px, py, pt), (dx, dy, dt) in zip(columns, moved, strict=True)
        ]
        self._sensitivity = [list(row) for row in zip(*after, strict=True)]
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
        """The three, with standard deviations by the scatter of the blocks (jackknife); None before `_FEWEST_BLOCKS`.

        The noise of the odometry that is assumed says less: it is meant for robots whose scales are not known.
        """
        n = len(self._information)
        if n < _FEWEST_BLOCKS:
            return None
        information, vector = np.array(list(self._information.values())), np.array(list(self._vector.values()))
        total, sums = information.sum(axis=0) + np.diag(1.0 / _PRIOR**2), vector.sum(axis=0)
        values = np.linalg.solve(total, sums)
        without = np.linalg.solve(total - information, (sums - vector)[:, :, None])[:, :, 0]
        scatter = np.sqrt((n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
        (way, turn, drift, *_), (way_sigma, turn_sigma, drift_sigma, *_) = values.tolist(), scatter.tolist()
        return OdometryScale(way, turn, way_sigma, turn_sigma, drift, drift_sigma)
