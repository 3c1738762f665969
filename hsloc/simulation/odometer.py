"""Simulated odometry: the true motion, with noise, and with the covariance of that noise.

Source of the motion model: Thrun, Burgard, Fox, *Probabilistic Robotics*, Table 5.6 (sample_motion_model_odometry).
There the pose is sampled around the odometry; here the truth is known, and the odometry is sampled around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, radians, sin, sqrt
from typing import TYPE_CHECKING, Annotated, Protocol

import numpy as np

from hsloc.model import IDENTITY, Pose2, wrap_angle
from hsloc.parameters import NonNegative, Parameters, Range
from hsloc.simulation.lattice import STEP, short, snap, snap_pose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class MotionNoise(Protocol):
    """How far a step of the odometry is off: standard deviations for a motion rot1, trans, rot2."""

    @property
    def interval_s(self) -> float:
        """Seconds between two samples of the noise; a sample holds in between. 0: a new one for each step."""
        ...

    def deviations(self, rot1: float, trans: float, rot2: float, step_s: float) -> tuple[float, float, float]:
        """Standard deviations (rad, m, rad) of a step of `step_s` seconds."""
        ...


@dataclass(frozen=True, slots=True)
class OdometryNoise(Parameters):
    """The four alphas of *Probabilistic Robotics*, Table 5.6: variances are

        rot1:  alpha1 rot1^2 + alpha2 trans^2
        trans: alpha3 trans^2 + alpha4 (rot1^2 + rot2^2)
        rot2:  alpha1 rot2^2 + alpha2 trans^2

    The variance that this gives to a path depends on how finely it is cut: with a new sample for each message of a
    50 Hz odometry, all but the wildest alphas average out. So a sample is held for `interval_s` seconds: over each
    interval of straight or evenly bent motion the error is what the book gives for that motion as a whole,
    spread evenly over its messages. `interval_s = 0` is the book's model on every message.
    """

    alpha1: NonNegative = 1e-4
    """Variance of a rotation per squared rotation [rad^2 / rad^2]."""
    alpha2: NonNegative = 6e-6
    """Variance of a rotation per squared translation [rad^2 / m^2]."""
    alpha3: NonNegative = 2e-4
    """Variance of a translation per squared translation [m^2 / m^2]."""
    alpha4: NonNegative = 1e-4
    """Variance of a translation per squared rotation [m^2 / rad^2]."""
    interval_s: NonNegative = 1.0
    """Time for which a sample of the noise is kept [s]; 0: one sample for each message."""

    def deviations(self, rot1: float, trans: float, rot2: float, step_s: float) -> tuple[float, float, float]:
        """See `MotionNoise`."""
        return (
            sqrt(self.alpha1 * rot1**2 + self.alpha2 * trans**2),
            sqrt(self.alpha3 * trans**2 + self.alpha4 * (rot1**2 + rot2**2)),
            sqrt(self.alpha1 * rot2**2 + self.alpha2 * trans**2),
        )


@dataclass(frozen=True, slots=True)
class SteeringNoise(Parameters):
    """The noise of [P] V on speed (m/s) and steering angle (rad), sampled at every step.

    A step of the course report's vehicle is rot1 = g, trans = v dt, rot2 = 0, so it is noise on rot1 and trans.
    """

    speed: NonNegative = 0.1
    """Standard deviation of the speed [m/s]."""
    steering: NonNegative = radians(0.5)
    """Standard deviation of the steering angle [rad]."""
    interval_s: NonNegative = 0.0
    """Time for which a sample of the noise is kept [s]; 0: one sample for each message."""

    def deviations(self, rot1: float, trans: float, rot2: float, step_s: float) -> tuple[float, float, float]:
        """See `MotionNoise`."""
        return self.steering, self.speed * step_s, 0.0


@dataclass(frozen=True, slots=True)
class Slip(Parameters):
    """Wheels that lose their grip from `at_s` on, for `duration_s` seconds.

    The odometry counts `factor` times the distance that was driven, and a turn of `turn_rate` rad/s that was not. It
    does not know: its covariance stays as it would be.
    """

    at_s: NonNegative
    """Begin of the slip after the start [s]."""
    duration_s: NonNegative = 1.5
    """Duration of the slip [s]."""
    factor: Annotated[float, Range(-100, 100)] = 1.5
    """Distance that the odometry counts, as a ratio to the distance driven."""
    turn_rate: Annotated[float, Range(-100, 100)] = 0.0
    """Rate of a turn that the odometry counts and the robot does not make [rad/s]."""

    def is_on(self, time_s: float) -> bool:
        """Whether the wheels slip at `time_s` seconds after the start."""
        return self.at_s <= time_s < self.at_s + self.duration_s


class Odometer:
    """Adds up noisy steps. Its frame is where the robot stood at the start."""

    INITIAL_VARIANCE = 1e-8
    """Of x, y (m^2) and theta (rad^2) at the start: a covariance of zeros would read as "unknown" in a log."""

    def __init__(self, noise: MotionNoise, rng: np.random.Generator, step_s: float, slips: Sequence[Slip] = ()) -> None:
        self.T_odom_base = IDENTITY
        self.twist = (0.0, 0.0, 0.0)
        self._noise, self._rng, self._step_s, self._slips = noise, rng, step_s, slips
        self._hold = max(1, round(noise.interval_s / step_s))
        self._steps = 0
        self._draw: Array = np.zeros(3)
        self._settled: Array = np.eye(3) * self.INITIAL_VARIANCE  # of earlier samples, propagated to here
        self._held: Array = np.zeros((3, 3))  # derivative of the pose by the present sample

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of `T_odom_base` (m^2, m rad, rad^2) since the start, to first order, as it is sent."""
        covariance = self._settled + self._held @ self._held.T
        return short((covariance + covariance.T) / 2.0)

    def step(self, before: Pose2, after: Pose2) -> None:
        """Take in a true motion from `before` to `after` during one step."""
        if self._steps % self._hold == 0:
            self._draw = self._rng.standard_normal(3)
            self._settled, self._held = self._settled + self._held @ self._held.T, np.zeros((3, 3))
        rot1, trans, rot2 = decompose(before, after)
        deviations = np.array(self._noise.deviations(rot1, trans, rot2, self._step_s))
        for slip in self._slips:
            if slip.is_on(self._steps * self._step_s):
                trans, rot2 = trans * slip.factor, rot2 + slip.turn_rate * self._step_s
        self._steps += 1
        errors = deviations * self._draw
        rot1, trans, rot2 = rot1 + float(errors[0]), trans + float(errors[1]), rot2 + float(errors[2])
        self._propagate(rot1, trans, deviations)
        heading = self.T_odom_base.theta + rot1
        self.T_odom_base = snap_pose(
            Pose2(
                self.T_odom_base.x + trans * cos(heading),
                self.T_odom_base.y + trans * sin(heading),
                wrap_angle(heading + rot2),
            )
        )
        self.twist = (snap(trans / self._step_s), 0.0, snap((rot1 + rot2) / self._step_s))

    def _propagate(self, rot1: float, trans: float, deviations: Array) -> None:
        """Covariance to first order: earlier samples are propagated, the present one adds up coherently."""
        c, s = cos(self.T_odom_base.theta + rot1), sin(self.T_odom_base.theta + rot1)
        by_pose = np.array(((1.0, 0.0, -trans * s), (0.0, 1.0, trans * c), (0.0, 0.0, 1.0)))
        by_motion = np.array(((-trans * s, c, 0.0), (trans * c, s, 0.0), (1.0, 0.0, 1.0)))
        self._settled = by_pose @ self._settled @ by_pose.T
        self._held = by_pose @ self._held + by_motion * deviations


def decompose(before: Pose2, after: Pose2) -> tuple[float, float, float]:
    """A motion as a turn, a straight line and a turn (rad, m, rad), as in *Probabilistic Robotics*, Table 5.6.

    On the spot the direction of the translation is undefined, and all of the turn is the second.
    """
    dx, dy = after.x - before.x, after.y - before.y
    trans = hypot(dx, dy)
    rot1 = wrap_angle(atan2(dy, dx) - before.theta) if trans > 4.0 * STEP else 0.0
    return rot1, trans, wrap_angle(after.theta - before.theta - rot1)
