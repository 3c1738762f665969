"""An extended Kalman filter over poses: prediction, update, and smoothing backwards over a run.

Offline, the scans to come are known, so the poses at matches are smoothed by the recursion of Rauch, Tung and Striebel
(AIAA Journal 3(8), 1965): `x_i += C (x_(i+1) - x_(i+1|i))` with `C = P_i F^T P_(i+1|i)^-1`; that brings what a
corridor's end shows to the poses before it. Those between two matches are in `between_matches`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import cos, exp, hypot, log, radians, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.localisation.interpolated_odometry import AtStamp, motion_variances
from hsloc.model.pose2 import Pose2, rotated, wrap_angle, wrap_angles

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel
    from hsloc.matching.match import Match

    F64 = NDArray[np.float64]

MAX_SQUARED = 16.3
"""Squared difference by its covariance, prediction to smoothed pose, up to which it was noise: the 99.9 % quantile
of chi squared with 3 degrees of freedom. Beyond it a wheel slipped."""
_LEAST_M, _LEAST_RAD = 0.1, radians(3.0)
"""How far a robot was moved, or its wheels slipped, at least (m, rad): less makes no pose wrong, and people shift the
optimum by some centimetres."""
SETTLED = 5
"""Matches after which the covariance no longer knows how a track began."""
_REMEMBERED = 0.98
"""Weight of an innovation after the next one: about 50 are remembered, the 10 m of a match each 0.2 m."""
_HALF_MEMORY = 25
"""Innovations after which what is remembered is centred on one."""
_ASSUMED = 7.5
"""Information of the assumption that the odometry is as noisy as stated: that of five innovations."""
_EXCESS_GAIN = 0.1
"""Gain of the running mean of squared innovations by their expected ones: it follows within about ten matches."""
_MOST_EXCESS = 10.0
"""One innovation counts for at most this multiple of its expected square: a slip is not noise."""
_LEAST_NOISE = 0.04
"""And at least: a fifth of the standard deviation, the 2 % of the distance of wheels that are calibrated well."""
_MOST_NOISE = 30.0
"""Variance of the odometry by the assumed one, at most: half of the distance, more than its whole turn."""
_EYE = np.eye(3)
_NO_NOISE = 1e-10 * _EYE


def transition(pose: Pose2, motion: Pose2) -> F64:
    """`F` (3, 3) of the prediction: how an error of `pose` in the map frame moves `pose @ motion`."""
    c, s = cos(pose.theta), sin(pose.theta)
    return np.array(
        ((1.0, 0.0, -s * motion.x - c * motion.y), (0.0, 1.0, c * motion.x - s * motion.y), (0.0, 0.0, 1.0)),
    )


def predict_covariance(covariance: F64, pose: Pose2, motion: Pose2, motion_covariance: F64) -> F64:
    """Covariance of `pose @ motion` in the map frame: `F P F^T + V M V^T`, all (3, 3)."""
    f = transition(pose, motion)
    result: F64 = f @ covariance @ f.T + rotated(motion_covariance, pose.theta)
    return result


def predict_covariances(covariances: F64, headings: F64, motions: F64, noise: F64) -> F64:
    """`predict_covariance` of n poses with these `headings` (n,) at once: `F P F^T + V M V^T`, (n, 3, 3)."""
    c, s = np.cos(headings), np.sin(headings)
    f, turn = np.tile(_EYE, (2, len(motions), 1, 1))
    f[:, 0, 2] = -s * motions[:, 0] - c * motions[:, 1]
    f[:, 1, 2] = c * motions[:, 0] - s * motions[:, 1]
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 0, 1], turn[:, 1, 0] = -s, s
    predicted: F64 = f @ covariances @ f.transpose(0, 2, 1) + turn @ noise @ turn.transpose(0, 2, 1)
    return predicted


def fuse(prediction: Pose2, covariance: F64, measured: Pose2, measured_covariance: F64) -> tuple[Pose2, F64]:
    """The EKF's update with a measured pose: `K = P (P + R)^-1`."""
    gain = np.linalg.solve((covariance + measured_covariance).T, covariance.T).T
    pose = Pose2.from_array(prediction.to_array() + gain @ difference(measured, prediction))
    updated = (_EYE - gain) @ covariance
    return pose, 0.5 * (updated + updated.T)


def update_with_information(prediction: Pose2, covariance: F64, measured: Pose2, information: F64) -> tuple[Pose2, F64]:
    """The EKF's update with a measured pose of which `information` (3, 3) is known: `K = (I + P L)^-1 P L`.

    Where the information is zero the prediction stays as it is, and so does its variance.
    """
    updated = np.linalg.solve(_EYE + covariance @ information, covariance)
    updated = 0.5 * (updated + updated.T)
    pose = Pose2.from_array(prediction.to_array() + updated @ information @ difference(measured, prediction))
    return pose, updated


def fuse_match(prediction: Pose2, covariance: F64, match: Match, information: F64 | None) -> tuple[Pose2, F64]:
    """The EKF's update with a match: by the information of its walls, or by its covariance where that is not known."""
    if information is None:
        return fuse(prediction, covariance, match.pose, match.covariance)
    return update_with_information(prediction, covariance, match.pose, information)


def innovation_weight(covariance: F64, information: F64) -> F64:
    """Inverse covariance of an innovation, by covariance of the prediction and information of the match (3, 3).

    `L (I + P L)^-1`: directions that are not measured count for none.
    """
    weight: F64 = information @ np.linalg.inv(_EYE + covariance @ information)
    return weight


def is_slip(innovation: F64, weight: F64) -> bool:
    """Whether an innovation (3,), by its inverse covariance (3, 3), is no noise."""
    return float(innovation @ weight @ innovation) > MAX_SQUARED


def is_far(off: F64) -> bool:
    """Whether a difference of poses (3,) makes one wrong: people, or stamps that are a little late, make less."""
    return bool(hypot(off[0], off[1]) >= _LEAST_M or abs(off[2]) >= _LEAST_RAD)


class Innovations:
    """What the innovations of a run show: how noisy the odometry is, and whether covariances are too small.

    `noise_scale` is the variance of the odometry by the assumed one, by maximum likelihood. With `S` the covariance of
    an innovation `v` and `Q` the part of it that is due to the odometry, the derivative of the log likelihood by the
    log of the scale is `(v^T S^-1 Q S^-1 v - tr(S^-1 Q)) / 2`, its information `tr((S^-1 Q)^2) / 2`. Old innovations
    are forgotten. The filter takes no scale below 1: errors of the map last while a wall is seen, and where it trusts
    the odometry more it averages over them as over independent ones.

    `excess`, 1 or more, is what is left: the running mean of squared innovations by what is expected of them then.
    Covariances that are reported grow by it. Whether odometry or matches are worse than assumed it does not show.
    """

    def __init__(self) -> None:
        self.noise_scale = 1.0
        self._sum, self._information = 0.0, 0.0
        self._excess = 1.0

    @property
    def excess(self) -> float:
        """See the class."""
        return max(self._excess, 1.0)

    def add(self, innovation: F64, information: F64, propagated: F64, noise: F64) -> F64:
        """Take an innovation (3,): a measured pose of known information (3, 3) less a prediction.

        The prediction's covariance is that of the pose before, `propagated` (3, 3), and the assumed one of the motion,
        `noise` (3, 3), by the scale; all in the map frame. Directions that are not measured count for none: the inverse
        of the innovation's covariance, which is returned (3, 3), is `L (I + P L)^-1`, its degrees of freedom are the
        trace of the gain.
        """
        covariance = propagated + max(self.noise_scale, 1.0) * noise
        weight = innovation_weight(covariance, information)
        found = weight
        squared = float(innovation @ weight @ innovation)
        freedom = float(np.trace(covariance @ weight))
        if freedom <= 0.0:
            return weight
        self._excess += _EXCESS_GAIN * (min(squared / freedom, _MOST_EXCESS) - self._excess)
        if self.noise_scale < 1.0:
            scaled = propagated + self.noise_scale * noise
            weight = innovation_weight(scaled, information)
            squared = float(innovation @ weight @ innovation)
        part = weight @ (self.noise_scale * noise)
        limited = min(1.0, MAX_SQUARED / squared) if squared > 0.0 else 1.0  # a slip is not noise
        score = 0.5 * (limited * float(innovation @ part @ weight @ innovation) - float(np.trace(part)))
        weighed = 0.5 * float(np.trace(part @ part))
        self._sum = _REMEMBERED * self._sum + weighed * log(self.noise_scale) + score
        self._information = _REMEMBERED * self._information + weighed
        logarithm = self._sum / (self._information + _ASSUMED)
        self.noise_scale = exp(min(max(logarithm, log(_LEAST_NOISE)), log(_MOST_NOISE)))
        return found


def difference(pose: Pose2, other: Pose2) -> F64:
    """x, y and theta (wrapped) of a pose less those of another, shape (3,)."""
    return np.array((pose.x - other.x, pose.y - other.y, wrap_angle(pose.theta - other.theta)))


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A match of a track: the pose in the odometry's and in the map's frame, and its covariance (3, 3).

    `count` odometry messages came before. `begins` says that it does not continue the anchor before. The odometry up
    to here is `noise_scale` times as noisy as assumed (variances).
    `fits_as_usual` says that the match was as fit as usual. `at` is when the odometry was taken.
    """

    count: int
    T_odom_base: Pose2
    T_map_base: Pose2
    covariance: F64
    begins: bool
    noise_scale: float = 1.0
    fits_as_usual: bool = True
    at: AtStamp = field(default_factory=AtStamp)


class SmoothedMatches(NamedTuple):
    """Poses (n, 3) and covariances (n, 3, 3) at the matches, and the variances (n, 3) of the odometry up to each.

    `slips` (n, 3) are the squares of what the wheels slipped before a match, 0 where its innovation is noise.
    """

    poses: F64
    covariances: F64
    motion: F64
    slips: F64


def smooth_matches(anchors: Sequence[Anchor], motion_model: MotionModel) -> SmoothedMatches:
    """The poses of the matches, T_map_base, each smoothed by those of its track that follow, and their covariances.

    The covariances follow by the same recursion: `P_i + C (P_(i+1) - P_(i+1|i)) C^T`. Where a match is farther from the
    prediction than noise explains, the wheels slipped, then or before: matches before it that were not as fit as usual
    may be off by as much.
    """
    poses = np.array([anchor.T_map_base.to_array() for anchor in anchors]).reshape(-1, 3)
    covariances = np.array([anchor.covariance for anchor in anchors]).reshape(-1, 3, 3)
    variances, slips = np.zeros((2, len(anchors), 3))
    jump = np.zeros((3, 3))
    for k in range(len(anchors) - 2, -1, -1):
        here, following = anchors[k], anchors[k + 1]
        if following.begins or here.fits_as_usual:
            jump = np.zeros((3, 3))
        if following.begins:
            continue
        motion = here.T_odom_base.between(following.T_odom_base)
        noise = motion_model.covariance(motion)
        variances[k + 1] = noise_around(anchors, k + 1) * np.diag(rotated(noise, here.T_map_base.theta))
        noise = max(following.noise_scale, 1.0) * noise + np.diag(motion_variances(here.at, following.at))
        predicted = here.T_map_base @ motion
        variance = predict_covariance(here.covariance, here.T_map_base, motion, noise) + _NO_NOISE
        off = difference(Pose2.from_array(poses[k + 1]), predicted)
        weighted = np.linalg.solve(variance, off)
        if off @ weighted > MAX_SQUARED:
            slips[k + 1] = np.maximum(off**2 - np.diag(variance), 0.0)
            if not here.fits_as_usual:
                jump = max(jump, np.outer(off, off), key=np.trace)
            covariances[k] += jump
            continue
        gain = np.linalg.solve(variance, transition(here.T_map_base, motion) @ here.covariance).T
        poses[k] += gain @ off
        poses[k, 2] = wrap_angles(poses[k, 2:])[0]
        smoothed = here.covariance + gain @ (covariances[k + 1] - variance) @ gain.T
        covariances[k] = 0.5 * (smoothed + smoothed.T) + jump
    return SmoothedMatches(poses, covariances, variances, slips)


def noise_around(anchors: Sequence[Anchor], k: int) -> float:
    """Variance of the odometry by the assumed one around the k-th anchor; its own knows only the matches before."""
    return anchors[min(k + _HALF_MEMORY, len(anchors) - 1)].noise_scale
