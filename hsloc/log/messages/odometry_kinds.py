"""What odometry is read from: velocities, wheels and IMUs beside poses, and the table of all kinds.

Of a topic with several types the first of the table counts.
"""

from __future__ import annotations

import re
from functools import lru_cache
from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.log.messages import definitions
from hsloc.log.messages.from_objects import object_header, object_odometry, object_pose
from hsloc.log.messages.odometry_kind import Motion, OdometryKind, Rank
from hsloc.log.transforms import Transform3
from hsloc.model import wrap_angle

if TYPE_CHECKING:
    from collections.abc import Collection

    from hsloc.log.messages.odometry_kind import Motion3, Mounting3
    from hsloc.log.summary import ReadOptions

_FASTEST = 100.0
"""Velocities beyond (m/s, rad/s) are taken for damage; common gyroscopes end at 35 rad/s."""

_LEFT = re.compile(r"(^|[_/.])(left|l|lt)([_/.]|$)|left")
_RIGHT = re.compile(r"(^|[_/.])(right|r|rt)([_/.]|$)|right")


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


def _velocity_rank(topic: str) -> Rank:
    # What is commanded is not what was driven.
    return Rank.NEVER if "cmd" in topic.lower() else Rank.VELOCITY


def _velocity_kind(typename: str, *, has_stamp: bool = True) -> OdometryKind:
    return OdometryKind(
        typename,
        object_velocity,
        _velocity_rank if has_stamp else lambda _: Rank.NEVER,
        lambda *_: VelocityMotion(),
        says="there is no odometry; it is made of the velocities on {}",
    )


VELOCITY_KINDS = (
    _velocity_kind(definitions.TWIST_STAMPED),
    _velocity_kind(definitions.TWIST_WITH_COVARIANCE_STAMPED),
    _velocity_kind(definitions.TWIST, has_stamp=False),
)


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


@lru_cache(maxsize=64)
def wheels_of(names: tuple[str, ...]) -> tuple[list[int], list[int]] | None:
    """The joints of the left and of the right wheels, by their names; None where one side has none."""
    wheels = [k for k, name in enumerate(names) if "wheel" in name.lower() and "caster" not in name.lower()]
    left = [k for k in wheels if _LEFT.search(names[k].lower())]
    right = [k for k in wheels if _RIGHT.search(names[k].lower()) and k not in left]
    return (left, right) if left and right else None


def _wheel_motion(options: ReadOptions, _: Mounting3) -> WheelMotion:
    size = options.wheel_size()
    if size is None:
        raise ValueError("the size of the wheels is not known")
    return WheelMotion(*size)


_WHEEL_KINDS = (
    OdometryKind(
        definitions.JOINT_STATE,
        object_joints,
        lambda _: Rank.REQUESTED,
        _wheel_motion,
        missing=lambda options: "--wheels RADIUS,TRACK" if options.wheels is None else "",
    ),
)


class ImuMessage(NamedTuple):
    """Rates (rad/s) and orientation (x, y, z, w) in the sensor's frame; None where the sensor states that it has none.

    The base's frame is not known from the message: `child_frame_id` is empty.
    """

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    sensor_frame: str
    rates: tuple[float, float, float] | None
    orientation: tuple[float, float, float, float] | None


def object_imu(message: Any) -> ImuMessage:
    """From an Imu. A covariance that begins with -1 means, by its definition, that there is no such measurement."""
    stamp, frame = object_header(message)
    w, q = message.angular_velocity, message.orientation
    rates, orientation = (float(w.x), float(w.y), float(w.z)), (float(q.x), float(q.y), float(q.z), float(q.w))
    return ImuMessage(
        stamp,
        "odom",
        "",
        frame,
        None if message.angular_velocity_covariance[0] == -1.0 else rates,
        None if message.orientation_covariance[0] == -1.0 or not any(orientation) else orientation,
    )


class ImuMotion(Motion):
    """The rate about the base's vertical axis, each and the one before averaged over their time.

    Where the gyroscope is silent (rates of exactly zero, which none measures) the orientation's change is taken.
    """

    def __init__(self, mounting: Mounting3) -> None:
        self._mounting = mounting
        self._frames: dict[str, Transform3] = {}
        self._rate: float | None = None
        self._heading: float | None = None

    def step(self, message: ImuMessage, seconds: float) -> Motion3 | None:
        """The rotation alone."""
        T_base_imu = self._frames.get(message.sensor_frame)
        if T_base_imu is None:
            T_base_imu = self._frames[message.sensor_frame] = self._mounting(message.sensor_frame)
        heading, before = self._heading, self._rate
        if message.orientation is not None and all(map(isfinite, message.orientation)):
            T_world_imu = Transform3(rotation=message.orientation).normalised()
            heading = (T_world_imu @ T_base_imu.inverse()).to_pose2().theta
        last, self._heading = self._heading, heading
        if message.rates is not None and any(message.rates):
            rate = T_base_imu.rotate(message.rates)[2]
            if not abs(rate) < _FASTEST:
                return None
            self._rate = rate
            return 0.0, 0.0, 0.5 * seconds * (rate + (rate if before is None else before))
        self._rate = None
        if heading is None:
            return None
        return 0.0, 0.0, 0.0 if last is None else wrap_angle(heading - last)


_IMU_KINDS = (
    OdometryKind(
        definitions.IMU,
        object_imu,
        lambda _: Rank.HEADING,
        lambda _, mounting: ImuMotion(mounting),
        says="there is no odometry; rotations are predicted by {}, translations by the scans",
        has_position=False,
    ),
)


def _named_like_odometry(topic: str) -> Rank:
    # Poses may be of anything: they count if their name says so.
    parts = topic.lower().split("/")
    return Rank.POSE if "odom" in parts or "odometry" in parts else Rank.NEVER


ODOMETRY_KINDS = (
    OdometryKind(definitions.ODOMETRY, object_odometry, lambda _: Rank.ODOMETRY),
    OdometryKind(definitions.POSE_STAMPED, object_pose, _named_like_odometry),
    OdometryKind(definitions.POSE_WITH_COVARIANCE_STAMPED, object_pose, _named_like_odometry),
    *VELOCITY_KINDS,
    *_WHEEL_KINDS,
    *_IMU_KINDS,
)
POSE_TYPES = tuple(kind.typename for kind in ODOMETRY_KINDS if kind.motion is None)
"""Types that hold poses: these may be the truth, too."""


def kind_among(typenames: Collection[str]) -> OdometryKind:
    """The kind that is read of messages of these types; that of nav_msgs/Odometry where none is."""
    return next((kind for kind in ODOMETRY_KINDS if kind.typename in typenames), ODOMETRY_KINDS[0])
