"""Calibration of the odometry by the poses of the scans: its scale, its delay, and how noisy it is.

Wheels are a few per cent too large or too small, and a message may hold the pose of some hundredths of a second before
or after the scan that bears its stamp. Neither matters to the keyscans; between two of them, where poses come from the
odometry alone, both do. Delays are counted in messages, not in seconds: stamps of real logs run backwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import compose_poses, mahalanobis_distances, pose_differences, relative_poses, wrap_angles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import OdometryNoise
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class OdometryCalibration:
    """The odometry of `delay` messages earlier, its rotations times `turn`, its translations times `way`."""

    delay: float = 0.0
    way: float = 1.0
    turn: float = 1.0
    steps: int = 0
    """Steps between keyscans from which this was found; 0: nothing was found."""


_FEWEST = 100
"""Minimum number of steps of an estimate. Internal: fewer do not average the noise out."""
_DELAYS = np.arange(-10, 11) / 10.0
"""Delays that are tried, in periods of the odometry. Internal: the grid of a line search."""
_OUTLIER = 0.1
"""Difference (rad) between odometry and scans above which a step slipped. Internal: far above the noise of both."""
_STRETCH = 20
"""Steps in a row over which rotations are compared. Internal: it averages the noise of the single steps."""
_GAIN = 0.97
"""Ratio of the rotation error with a delay to that without one that is enough. Internal: a test of significance."""
_WORST_SCALE = 0.15
"""Maximum difference of a scale from 1. Internal: wheels are not wrong by more, such an estimate is an artefact."""

FLOOR = np.diag((0.005**2, 0.005**2, 0.002**2))
"""Least covariance of a motion (m^2, rad^2). Internal: a part of a cell, keeps the equations solvable."""
_HIGH_CHI = 2.795
"""95th percentile of the chi of three degrees of freedom."""
_BEST_ODOMETRY = 0.5
_WORST_ODOMETRY = 10.0
"""Factors within which the assumed noise of the odometry is adapted to the log."""
_FEWEST_WEIGHED = 20
"""Steps without which the assumed noise stays as it is."""
_WEIGHED_EVERY = 20
"""Matched keyscans after which the odometry's weight is estimated again; of more than 1000, 2 % of them."""


def calibrate(index: F64, odometry: F64, keys: I64, key_poses: F64) -> OdometryCalibration:
    """Find the calibration that brings the steps of the odometry nearest to those of the keyscans.

    `odometry` (n, 3) are poses at `index` (n,), counted in messages; rows `keys` (m,) are keyscans, in the end at
    `key_poses` (m, 3).
    """
    seen = relative_poses(key_poses[:-1], key_poses[1:])
    if len(seen) < _FEWEST:
        return OdometryCalibration()

    def turns(delay: float) -> tuple[F64, float]:
        measured = delayed(index, odometry, delay)[keys]
        steps = relative_poses(measured[:-1], measured[1:])
        # Each delay is judged with the scale that suits it best, or a wrong scale would drown it.
        error = np.abs(wrap_angles(_turn_scale(steps, seen) * steps[:, 2] - seen[:, 2]))
        return steps, float(np.minimum(error, _OUTLIER).mean())

    errors = [turns(float(delay))[1] for delay in _DELAYS]
    best = int(np.argmin(errors))
    delay = float(_DELAYS[best]) if errors[best] < _GAIN * turns(0.0)[1] else 0.0
    steps, _ = turns(delay)
    fair = np.abs(wrap_angles(steps[:, 2] - seen[:, 2])) < _OUTLIER
    forward, sideways = steps[fair, :2].T
    way = _scale(np.concatenate((forward, sideways)), np.concatenate((seen[fair, 0], seen[fair, 1])))
    return OdometryCalibration(delay, way, _turn_scale(steps, seen), int(fair.sum()))


def _turn_scale(measured: F64, seen: F64) -> float:
    """The scale of turns, from stretches of `_STRETCH` steps.

    In single steps a delay, or the interpolation that undoes it, blurs the beginning and end of every turn, and least
    squares would take the blur for a scale.
    """
    fair = np.abs(wrap_angles(measured[:, 2] - seen[:, 2])) < _OUTLIER
    sums = [np.concatenate(([0.0], np.cumsum(np.where(fair, steps[:, 2], 0.0)))) for steps in (measured, seen)]
    measured_turns, seen_turns = (turned[_STRETCH:] - turned[:-_STRETCH] for turned in sums)
    return _scale(measured_turns, seen_turns)


def _scale(measured: F64, seen: F64) -> float:
    """Least squares, held towards 1 by as much as a hundred steps of average length would."""
    power = float((measured**2).sum())
    prior = 100.0 * power / max(len(measured), 1)
    scale = (float((measured * seen).sum()) + prior) / (power + prior) if power > 0.0 else 1.0
    return scale if abs(scale - 1.0) <= _WORST_SCALE else 1.0


def apply(calibration: OdometryCalibration, index: F64, odometry: F64) -> F64:
    """The odometry as it should have been, shape (n, 3); the first pose stays."""
    measured = delayed(index, odometry, calibration.delay)
    if calibration.way == 1.0 and calibration.turn == 1.0:
        return measured
    steps = relative_poses(measured[:-1], measured[1:]) * (calibration.way, calibration.way, calibration.turn)
    theta = measured[0, 2] + np.concatenate(([0.0], np.cumsum(steps[:, 2])))
    c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
    x = measured[0, 0] + np.concatenate(([0.0], np.cumsum(c * steps[:, 0] - s * steps[:, 1])))
    y = measured[0, 1] + np.concatenate(([0.0], np.cumsum(s * steps[:, 0] + c * steps[:, 1])))
    return np.column_stack((x, y, wrap_angles(theta)))


def delayed(index: F64, odometry: F64, delay: float) -> F64:
    """The poses `delay` messages before each, interpolated, shape (n, 3); `index` never decreases."""
    if delay == 0.0:
        return odometry
    wanted = np.clip(index - delay, index[0], index[-1])
    after = np.clip(np.searchsorted(index, wanted, side="right"), 1, len(index) - 1)
    span = index[after] - index[after - 1]
    fraction = np.where(span > 0.0, (wanted - index[after - 1]) / np.maximum(span, 1e-12), 0.0)
    step = relative_poses(odometry[after - 1], odometry[after])
    return compose_poses(odometry[after - 1], step * fraction[:, None])


def odometry_chi(motions: F64, found: F64, covariances: F64) -> F64:
    """How far steps (n, 3) of the odometry are off those `found` (n, 3), in standard deviations, shape (n,).

    `covariances` (n, 3, 3) are those of the noise that is assumed.
    """
    return mahalanobis_distances(pose_differences(found, motions), covariances + FLOOR)


def odometry_scale(chi: F64) -> float:
    """Factor on the standard deviations of the assumed noise that fits the steps' `chi` (n,) of this log (robustly).

    By its 95th percentile, as turns are rare and err most; not below a half, for what slips once in a hundred steps
    is beyond that.
    """
    if len(chi) < _FEWEST_WEIGHED:
        return 1.0
    return float(np.clip(np.percentile(chi, 95.0) / _HIGH_CHI, _BEST_ODOMETRY, _WORST_ODOMETRY))


class WeighedOdometry:
    """State: how much worse or better than assumed a log's odometry is, by the steps of odometry and scans so far."""

    def __init__(self, noise: OdometryNoise) -> None:
        self.scale = 1.0
        """Factor on the standard deviations of `noise`."""
        self._noise = noise
        self._steps: list[tuple[Pose2, Pose2]] = []
        self._chi = np.zeros(0)
        self._weighed_at = _WEIGHED_EVERY

    def add(self, motion: Pose2, found: Pose2) -> None:
        """Take a step of the odometry, and the same one as the scans have it."""
        self._steps.append((motion, found))
        known = len(self._chi) + len(self._steps)
        if known < self._weighed_at:
            return
        # Many at once: a call of numpy takes longer than three unknowns do.
        motions = np.array([motion.to_array() for motion, _ in self._steps])
        by_scans = np.array([found.to_array() for _, found in self._steps])
        covariances = np.array([self._noise.covariance(step) for step, _ in self._steps])
        self._chi = np.concatenate((self._chi, odometry_chi(motions, by_scans, covariances)))
        self._steps = []
        self.scale = odometry_scale(self._chi)
        self._weighed_at = known + max(_WEIGHED_EVERY, known // 50)
