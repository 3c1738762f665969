"""How uncertain the motion is that odometry states, for bases that move in different ways.

Every model gives the covariance of one motion to first order: the variances of the model's own noise terms, brought
into x, y and theta by the Jacobian at the motion that was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING, Protocol

import numpy as np

from hsloc.model.pose2 import wrap_angle
from hsloc.parameters import NonNegative, Parameters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

MOTION_MODELS = ("differential", "ackermann", "omnidirectional")
"""What `localiser.motion_model` may be."""
_STRAIGHT = 1e-6
"""Below this turn (rad) an arc is computed by its series."""


class MotionModel(Protocol):
    """How uncertain a motion is.

    Contract: the covariance is symmetric and positive semidefinite, depends on the motion alone, and is zero for none.
    """

    def covariance(self, motion: Pose2) -> F64:
        """Covariance (3, 3) of a motion, in the frame in which it began (m^2, m rad, rad^2)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNoise(Parameters):
    """The odometry motion model of *Probabilistic Robotics* (Thrun, Burgard, Fox; 5.4), names as in AMCL.

    A motion is a turn, a straight line and a turn; their variances are `alpha1 rot^2 + alpha2 trans^2` (both turns)
    and `alpha3 trans^2 + alpha4 (rot1^2 + rot2^2)`. The defaults are those of a robot without calibration: 10 % of the
    distance, 20 % of a turn. (With 20 % of the distance the matches pull the pose from door to door in the corridors
    of Wean Hall.)
    """

    alpha1: NonNegative = 0.04
    """Variance of a turn per squared rotation [rad^2 / rad^2]."""
    alpha2: NonNegative = 0.02
    """Variance of a turn per squared translation [rad^2 / m^2]."""
    alpha3: NonNegative = 0.01
    """Variance of a translation per squared translation [m^2 / m^2]."""
    alpha4: NonNegative = 0.01
    """Variance of a translation per squared rotation [m^2 / rad^2]."""

    def covariance(self, motion: Pose2) -> F64:
        """See `MotionModel`. For a robot that drove backwards the first turn is taken from its back, as in AMCL."""
        trans = hypot(motion.x, motion.y)
        rot1 = atan2(motion.y, motion.x) if trans > 0.01 else 0.0
        rot2 = wrap_angle(motion.theta - rot1)
        turn1, turn2 = _shortest(rot1), _shortest(rot2)
        var1 = self.alpha1 * turn1**2 + self.alpha2 * trans**2
        var2 = self.alpha1 * turn2**2 + self.alpha2 * trans**2
        var_trans = self.alpha3 * trans**2 + self.alpha4 * (turn1**2 + turn2**2)
        # J diag(var1, var_trans, var2) J^T with J = ((-s trans, c, 0), (c trans, s, 0), (1, 0, 1)), written out:
        # this is done several times for each scan, and products of small arrays take ten times as long.
        c, s = cos(rot1), sin(rot1)
        across = trans * trans * var1
        xy = s * c * (var_trans - across)
        xt, yt = -s * trans * var1, c * trans * var1
        xx, yy = s * s * across + c * c * var_trans, c * c * across + s * s * var_trans
        return np.array(((xx, xy, xt), (xy, yy, yt), (xt, yt, var1 + var2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class AckermannNoise(Parameters):
    """The velocity motion model of *Probabilistic Robotics* (5.3, eq. 5.9 to 5.13) for a base that steers like a car.

    A motion is an arc of a circle: a distance along it, and a turn. The arc's length has the variance
    `alpha1 arc^2 + alpha2 turn^2`, its turn `alpha3 arc^2 + alpha4 turn^2`, and a final rotation of
    `alpha5 arc^2 + alpha6 turn^2` covers what no arc explains. A car does not move sideways, so that the error across
    the motion comes from the turn alone.
    """

    alpha1: NonNegative = 0.01
    """Variance of the arc's length per squared length [m^2 / m^2]."""
    alpha2: NonNegative = 0.01
    """Variance of the arc's length per squared rotation [m^2 / rad^2]."""
    alpha3: NonNegative = 0.02
    """Variance of the arc's turn per squared length [rad^2 / m^2]."""
    alpha4: NonNegative = 0.04
    """Variance of the arc's turn per squared rotation [rad^2 / rad^2]."""
    alpha5: NonNegative = 0.005
    """Variance of the final rotation per squared length [rad^2 / m^2]."""
    alpha6: NonNegative = 0.01
    """Variance of the final rotation per squared rotation [rad^2 / rad^2]."""

    def covariance(self, motion: Pose2) -> F64:
        """See `MotionModel`. The arc is the one that ends in the motion's heading and has its chord's length."""
        chord = hypot(motion.x, motion.y)
        turn = motion.theta
        ahead = motion.x * cos(turn / 2.0) + motion.y * sin(turn / 2.0) >= 0.0
        arc = (chord if ahead else -chord) / _chord_of(turn)
        var_arc = self.alpha1 * arc**2 + self.alpha2 * turn**2
        var_turn = self.alpha3 * arc**2 + self.alpha4 * turn**2
        var_final = self.alpha5 * arc**2 + self.alpha6 * turn**2
        along_x, along_y, bend_x, bend_y = _arc_derivatives(arc, turn)
        jacobian = np.array(((along_x, bend_x, 0.0), (along_y, bend_y, 0.0), (0.0, 1.0, 1.0)))
        covariance: F64 = jacobian @ np.diag((var_arc, var_turn, var_final)) @ jacobian.T
        return covariance


@dataclass(frozen=True, slots=True, kw_only=True)
class OmnidirectionalNoise(Parameters):
    """AMCL's motion model of a holonomic base (`nav2_amcl::OmniMotionModel`), which also moves sideways.

    A motion is a translation in any direction and a turn at once. Along the translation the variance is
    `alpha3 trans^2 + alpha4 rot^2`, across it `alpha5 trans^2 + alpha4 rot^2`, of the turn
    `alpha1 rot^2 + alpha2 trans^2`.
    """

    alpha1: NonNegative = 0.04
    """Variance of a turn per squared rotation [rad^2 / rad^2]."""
    alpha2: NonNegative = 0.02
    """Variance of a turn per squared translation [rad^2 / m^2]."""
    alpha3: NonNegative = 0.01
    """Variance along the translation per squared translation [m^2 / m^2]."""
    alpha4: NonNegative = 0.01
    """Variance of the translation per squared rotation [m^2 / rad^2]."""
    alpha5: NonNegative = 0.01
    """Variance across the translation per squared translation [m^2 / m^2]."""

    def covariance(self, motion: Pose2) -> F64:
        """See `MotionModel`."""
        trans, rot = hypot(motion.x, motion.y), motion.theta
        bearing = atan2(motion.y, motion.x) if trans > 0.0 else 0.0
        var_along = self.alpha3 * trans**2 + self.alpha4 * rot**2
        var_across = self.alpha5 * trans**2 + self.alpha4 * rot**2
        var_turn = self.alpha1 * rot**2 + self.alpha2 * trans**2
        c, s = cos(bearing), sin(bearing)
        jacobian = np.array(((c, s, 0.0), (s, -c, 0.0), (0.0, 0.0, 1.0)))
        covariance: F64 = jacobian @ np.diag((var_along, var_across, var_turn)) @ jacobian.T
        return covariance


def _shortest(turn: float) -> float:
    """A turn, or what it lacks to half a turn: driving backwards is no turn."""
    return min(abs(turn), abs(pi - abs(turn)))


def _chord_of(turn: float) -> float:
    """Length of the chord of an arc of length 1 that turns by `turn`."""
    half = turn / 2.0
    return 1.0 - half * half / 6.0 if abs(half) < _STRAIGHT else sin(half) / half


def _arc_derivatives(arc: float, turn: float) -> tuple[float, float, float, float]:
    """Derivatives of the arc's end, `arc / turn * (sin turn, 1 - cos turn)`, by its length and by its turn."""
    if abs(turn) < _STRAIGHT:
        return 1.0, turn / 2.0, -arc * turn / 3.0, arc / 2.0
    s, c = sin(turn), cos(turn)
    along_x, along_y = s / turn, (1.0 - c) / turn
    return along_x, along_y, arc * (c - along_x) / turn, arc * (s - along_y) / turn
