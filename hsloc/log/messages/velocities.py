"""Velocities and wheels: what odometry can be made of where a log has none."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.log.messages import definitions
from hsloc.log.messages.from_objects import object_header

if TYPE_CHECKING:
    from collections.abc import Callable

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

    @property
    def is_usable(self) -> bool:
        """Whether it is finite and no damage."""
        return all(isfinite(value) and abs(value) < _FASTEST for value in self[3:])


class JointsMessage(NamedTuple):
    """sensor_msgs/JointState: positions (rad) and velocities (rad/s) of the named joints; either may be empty."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    names: tuple[str, ...]
    positions: tuple[float, ...]
    velocities: tuple[float, ...]


def object_velocity(message: Any) -> VelocityMessage:
    """From a Twist, TwistStamped or TwistWithCovarianceStamped; a plain Twist has no stamp."""
    stamp, frame = object_header(message) if hasattr(message, "header") else (0, "")
    twist = getattr(message, "twist", message)
    twist = getattr(twist, "twist", twist)
    linear, angular = twist.linear, twist.angular
    return VelocityMessage(stamp, "odom", frame, float(linear.x), float(linear.y), float(angular.z))


def object_joints(message: Any) -> JointsMessage:
    """From a JointState."""
    stamp, _ = object_header(message)
    positions, velocities = (tuple(float(value) for value in each) for each in (message.position, message.velocity))
    return JointsMessage(stamp, "odom", "", tuple(str(name) for name in message.name), positions, velocities)


FROM_OBJECT: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(definitions.VELOCITY_TYPES, object_velocity),
    definitions.JOINT_STATE: object_joints,
}
