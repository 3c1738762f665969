"""The heading of an inertial measurement unit, sensor_msgs/Imu: what predicts rotations where there is no odometry."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.log.messages import definitions
from hsloc.log.messages.from_objects import object_header
from hsloc.log.messages.odometry_kind import Motion, OdometryKind, Rank
from hsloc.log.transforms import Transform3
from hsloc.model import wrap_angle

if TYPE_CHECKING:
    from hsloc.log.messages.odometry_kind import Motion3, Mounting3

_FASTEST = 100.0
"""Rates beyond (rad/s) are taken for damage; common gyroscopes end at 35 rad/s."""


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


KINDS = (
    OdometryKind(
        definitions.IMU,
        object_imu,
        lambda *_: Rank.HEADING,
        lambda _, mounting: ImuMotion(mounting),
        says="there is no odometry; rotations are predicted by {}, translations by the scans",
        has_position=False,
    ),
)
