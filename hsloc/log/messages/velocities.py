"""Velocities as odometry: geometry_msgs/Twist, TwistStamped and TwistWithCovarianceStamped."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.log.messages import definitions
from hsloc.log.messages.from_objects import object_header
from hsloc.log.messages.odometry_kind import Motion, OdometryKind, Rank

if TYPE_CHECKING:
    from hsloc.log.messages.odometry_kind import Motion3
    from hsloc.log.summary import ReadOptions

_FASTEST = 100.0
"""Velocities beyond (m/s, rad/s) are taken for damage."""


class VelocityMessage(NamedTuple):
    """A twist of the base in the plane: m/s forwards and to the left, rad/s. `child_frame_id` is the base's frame."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    forwards: float
    left: float
    turn: float


def object_velocity(message: Any) -> VelocityMessage:
    """From a Twist, TwistStamped or TwistWithCovarianceStamped; a plain Twist has no stamp."""
    stamp, frame = object_header(message) if hasattr(message, "header") else (0, "")
    twist = getattr(message, "twist", message)
    twist = getattr(twist, "twist", twist)
    linear, angular = twist.linear, twist.angular
    return VelocityMessage(stamp, "odom", frame, float(linear.x), float(linear.y), float(angular.z))


class VelocityMotion(Motion):
    """Each velocity and the one before, averaged over their time."""

    def __init__(self) -> None:
        self._before: Motion3 | None = None

    def step(self, message: VelocityMessage, seconds: float) -> Motion3 | None:
        """The mean velocity times the time."""
        now = message.forwards, message.left, message.turn
        if not all(isfinite(value) and abs(value) < _FASTEST for value in now):
            return None
        before = now if self._before is None else self._before
        self._before = now
        half = 0.5 * seconds
        return half * (before[0] + now[0]), half * (before[1] + now[1]), half * (before[2] + now[2])


def _rank(topic: str, _: ReadOptions) -> Rank:
    # What is commanded is not what was driven.
    return Rank.NEVER if "cmd" in topic.lower() else Rank.VELOCITY


def _kind(typename: str, *, has_stamp: bool = True) -> OdometryKind:
    return OdometryKind(
        typename,
        object_velocity,
        _rank if has_stamp else lambda *_: Rank.NEVER,
        lambda *_: VelocityMotion(),
        says="there is no odometry; it is made of the velocities on {}",
    )


KINDS = (
    _kind(definitions.TWIST_STAMPED),
    _kind(definitions.TWIST_WITH_COVARIANCE_STAMPED),
    _kind(definitions.TWIST, has_stamp=False),
)
