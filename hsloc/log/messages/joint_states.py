"""Wheels as odometry: sensor_msgs/JointState of a differential drive."""

from __future__ import annotations

import re
from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.log.messages import definitions
from hsloc.log.messages.from_objects import object_header
from hsloc.log.messages.odometry_kind import Motion, OdometryKind, Rank
from hsloc.model import wrap_angle

if TYPE_CHECKING:
    from hsloc.log.messages.odometry_kind import Motion3, Mounting3
    from hsloc.log.summary import ReadOptions

_LEFT = re.compile(r"(^|[_/.])(left|l|lt)([_/.]|$)|left")
_RIGHT = re.compile(r"(^|[_/.])(right|r|rt)([_/.]|$)|right")


class JointsMessage(NamedTuple):
    """Positions (rad) and velocities (rad/s) of the named joints; either may be empty."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    names: tuple[str, ...]
    positions: tuple[float, ...]
    velocities: tuple[float, ...]


def object_joints(message: Any) -> JointsMessage:
    """From a JointState."""
    stamp, _ = object_header(message)
    positions, velocities = (tuple(float(value) for value in each) for each in (message.position, message.velocity))
    return JointsMessage(stamp, "odom", "", tuple(str(name) for name in message.name), positions, velocities)


class WheelMotion(Motion):
    """The angles of the wheels of a differential drive, or their velocities."""

    def __init__(self, radius: float, track: float) -> None:
        """Radius of the wheels and distance between them (m)."""
        self._radius, self._track = radius, track
        self._before: tuple[float, float] | None = None

    def concerns(self, message: JointsMessage) -> bool:
        """Other joints may have messages of their own."""
        return wheels_of(message.names) is not None

    def step(self, message: JointsMessage, seconds: float) -> Motion3 | None:
        """The motion of the middle of the axle."""
        sides, count = wheels_of(message.names), len(message.names)
        values = message.positions if len(message.positions) == count else message.velocities
        if sides is None or len(values) != count or not all(isfinite(values[k]) for side in sides for k in side):
            return None
        left, right = (sum(values[k] for k in side) / len(side) for side in sides)
        if values is message.positions:
            before = (left, right) if self._before is None else self._before
            self._before = left, right
            # Some drivers give angles within one turn; none gives less than two messages for half a turn.
            left, right = wrap_angle(left - before[0]), wrap_angle(right - before[1])
        else:
            left, right = left * seconds, right * seconds
        return 0.5 * self._radius * (left + right), 0.0, self._radius * (right - left) / self._track


def wheels_of(names: tuple[str, ...]) -> tuple[list[int], list[int]] | None:
    """The joints of the left and of the right wheels, by their names; None where one side has none."""
    wheels = [k for k, name in enumerate(names) if "wheel" in name.lower() and "caster" not in name.lower()]
    left = [k for k in wheels if _LEFT.search(names[k].lower())]
    right = [k for k in wheels if _RIGHT.search(names[k].lower()) and k not in left]
    return (left, right) if left and right else None


def _motion(options: ReadOptions, _: Mounting3) -> WheelMotion:
    size = options.wheel_size()
    if size is None:
        raise ValueError("the size of the wheels is not known")
    return WheelMotion(*size)


KINDS = (
    OdometryKind(
        definitions.JOINT_STATE,
        object_joints,
        lambda _, options: Rank.NEVER if options.wheels is None else Rank.REQUESTED,
        _motion,
        missing=lambda options: "--wheels RADIUS,TRACK" if options.wheels is None else "",
    ),
)
