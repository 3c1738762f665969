"""Payloads to values: by hand where the definition is the known one, by rosbags where it is not.

Each type has a named tuple of what hsloc needs of it, a decoder of ROS 2 CDR (little endian) written by hand, and
a function that takes the same from a message object of rosbags (other definitions, ROS 1, big endian). Hand-made
decoders raise `BAD_PAYLOAD` on what they cannot read.
"""

from __future__ import annotations

from functools import lru_cache
from struct import Struct
from struct import error as StructError
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hsloc.log.messages import definitions
from hsloc.log.transforms import Transform3
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Payload = memoryview | bytes

NANOSECONDS = 1_000_000_000
LITTLE_ENDIAN = b"\x00\x01"
BAD_PAYLOAD = (StructError, ValueError, IndexError, OverflowError)
"""What decoders raise on a payload that is not what its channel says (UnicodeDecodeError is a ValueError)."""


class ScanMessage(NamedTuple):
    """sensor_msgs/LaserScan."""

    stamp_ns: int
    frame_id: str
    angle_min: float
    angle_increment: float
    time_increment: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32] | None
    scan_time: float = 0.0
    T_frame_laser: Transform3 | None = None
    """The laser's pose in `frame_id`, which Foxglove's message has and ROS's has not."""


class OdometryMessage(NamedTuple):
    """nav_msgs/Odometry in the plane; the covariance is 3 x 3, None where the message states none."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    pose: Pose2
    covariance: NDArray[np.float64] | None
    quaternion: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    """As in the message, not normalised."""


class LinkMessage(NamedTuple):
    """One geometry_msgs/TransformStamped."""

    stamp_ns: int
    parent: str
    child: str
    transform: Transform3


class GridMessage(NamedTuple):
    """nav_msgs/OccupancyGrid."""

    stamp_ns: int
    frame_id: str
    grid: OccupancyGrid


class PoseMessage(NamedTuple):
    """geometry_msgs/PoseStamped and PoseWithCovarianceStamped in the plane; a covariance is not read."""

    stamp_ns: int
    frame_id: str
    pose: Pose2
    covariance: None = None


_STAMP_AND_SIZE = Struct("<iII")
_SIZE = Struct("<I")
_SCAN = Struct("<7fI")
_POSE = Struct("<7d")
POSE_BYTES = _POSE.size
_F4 = np.dtype("<f4")
_MAP_INFO = Struct("<fII")
COVARIANCE_BYTES = 36 * 8
_ZEROS = bytes(COVARIANCE_BYTES)
PLANE = np.array((0, 1, 5, 6, 7, 11, 30, 31, 35))
_BODY = 4
"""Offsets of CDR count from behind the encapsulation."""
_MAX_NAME = 4096


@lru_cache(maxsize=4096)
def _name(raw: bytes) -> str:
    """A frame's name: without the closing zero, and without the leading slash of ROS 1."""
    return raw.rstrip(b"\0").decode().lstrip("/")


def _aligned(at: int, size: int) -> int:
    return at + (_BODY - at) % size


def _check_encapsulation(data: Payload) -> None:
    if data[:2] != LITTLE_ENDIAN:
        raise ValueError("not little-endian CDR")


def _header(data: Payload, at: int) -> tuple[int, str, int]:
    """(stamp, frame_id, offset behind) of a std_msgs/Header."""
    seconds, nanoseconds, size = _STAMP_AND_SIZE.unpack_from(data, at)
    end = at + 12 + size
    if size > _MAX_NAME or end > len(data):
        raise ValueError("a name is longer than the message")
    return seconds * NANOSECONDS + nanoseconds, _name(bytes(data[at + 12 : end])), end


def _string(data: Payload, at: int) -> tuple[str, int]:
    at = _aligned(at, 4)
    (size,) = _SIZE.unpack_from(data, at)
    end = at + 4 + size
    if size > _MAX_NAME or end > len(data):
        raise ValueError("a name is longer than the message")
    return _name(bytes(data[at + 4 : end])), end


def _pose2(values: tuple[float, ...]) -> Pose2:
    x, y, _, qx, qy, qz, qw = values
    return Pose2.from_quaternion(x, y, qx, qy, qz, qw)


def _floats(data: Payload, at: int, count: int) -> NDArray[np.float32]:
    # A copy: a view would keep the whole chunk in memory for as long as the scan lives.
    return np.frombuffer(data, _F4, count, at).copy()


def laser_scan(data: Payload) -> ScanMessage:
    """sensor_msgs/LaserScan from CDR."""
    _check_encapsulation(data)
    stamp, frame, at = _header(data, 4)
    at = _aligned(at, 4)
    angle_min, _, increment, time_increment, scan_time, range_min, range_max, count = _SCAN.unpack_from(data, at)
    at += _SCAN.size
    if at + 4 * count > len(data):
        raise ValueError("more ranges than the message holds")
    ranges = _floats(data, at, count)
    at += 4 * count
    (count,) = _SIZE.unpack_from(data, at)
    intensities = _floats(data, at + 4, count) if count else None
    return ScanMessage(
        stamp, frame, angle_min, increment, time_increment, range_min, range_max, ranges, intensities, scan_time
    )


@lru_cache(maxsize=64)
def plane_covariance(raw: bytes) -> NDArray[np.float64] | None:
    """3 x 3 of (x, y, yaw) from the 36 doubles; None where all of them are zero. Most logs repeat a few."""
    if raw == _ZEROS:
        return None
    values: NDArray[np.float64] = np.frombuffer(raw, dtype="<f8")[PLANE].reshape(3, 3)
    if not values.any():
        return None
    values.setflags(write=False)
    return values


def _odometry_head(data: Payload) -> tuple[int, str, str, int]:
    """(stamp, frame, child frame, offset of the pose) of a nav_msgs/Odometry."""
    _check_encapsulation(data)
    stamp, frame, at = _header(data, 4)
    child, at = _string(data, at)
    return stamp, frame, child, _aligned(at, 8)


def odometry_pose_at(data: Payload) -> int:
    """The offset of the pose in a nav_msgs/Odometry, that of the covariance being behind it."""
    return _odometry_head(data)[3]


def odometry(data: Payload) -> OdometryMessage:
    """nav_msgs/Odometry from CDR."""
    stamp, frame, child, at = _odometry_head(data)
    values = _POSE.unpack_from(data, at)
    at += _POSE.size
    raw = bytes(data[at : at + COVARIANCE_BYTES])
    if len(raw) < COVARIANCE_BYTES:
        raise ValueError("the covariance is cut off")
    return OdometryMessage(stamp, frame, child, _pose2(values), plane_covariance(raw), values[3:])


def transforms(data: Payload) -> list[LinkMessage]:
    """tf2_msgs/TFMessage from CDR."""
    _check_encapsulation(data)
    (count,) = _SIZE.unpack_from(data, 4)
    if count * 76 > len(data):
        raise ValueError("more transforms than the message holds")
    links = []
    at = 8
    for _ in range(count):
        stamp, parent, at = _header(data, _aligned(at, 4))
        child, at = _string(data, at)
        at = _aligned(at, 8)
        x, y, z, qx, qy, qz, qw = _POSE.unpack_from(data, at)
        at += _POSE.size
        links.append(LinkMessage(stamp, parent, child, Transform3((x, y, z), (qx, qy, qz, qw))))
    return links


def occupancy_grid(data: Payload) -> GridMessage:
    """nav_msgs/OccupancyGrid from CDR."""
    _check_encapsulation(data)
    stamp, frame, at = _header(data, 4)
    at = _aligned(at, 4) + 8
    resolution, width, height = _MAP_INFO.unpack_from(data, at)
    at = _aligned(at + _MAP_INFO.size, 8)
    origin = _pose2(_POSE.unpack_from(data, at))
    at += _POSE.size
    (count,) = _SIZE.unpack_from(data, at)
    if at + 4 + count > len(data):
        raise ValueError("more cells than the message holds")
    cells = np.frombuffer(data, dtype=np.int8, count=count, offset=at + 4).copy()
    return GridMessage(stamp, frame, _grid(cells, width, height, resolution, origin))


def _grid(cells: NDArray[np.int8], width: int, height: int, resolution: float, origin: Pose2) -> OccupancyGrid:
    if width * height != len(cells) or not len(cells):
        raise ValueError(f"a map of {width} x {height} with {len(cells)} cells")
    if not 0.0 < resolution < 1e6 or not origin.is_finite():
        raise ValueError(f"a map of resolution {resolution} at {origin}")
    # The message's float32 is 0.05000000074...: the map's author meant the shortest number that rounds to it.
    return OccupancyGrid(cells.reshape(height, width), float(str(np.float32(resolution))), origin)


def _stamped_head(data: Payload) -> tuple[int, str, int]:
    """(stamp, frame, offset of the pose) of a geometry_msgs/PoseStamped."""
    _check_encapsulation(data)
    stamp, frame, at = _header(data, 4)
    return stamp, frame, _aligned(at, 8)


def stamped_pose_at(data: Payload) -> int:
    """The offset of the pose in a geometry_msgs/PoseStamped or PoseWithCovarianceStamped."""
    return _stamped_head(data)[2]


def pose_stamped(data: Payload) -> PoseMessage:
    """geometry_msgs/PoseStamped or PoseWithCovarianceStamped from CDR."""
    stamp, frame, at = _stamped_head(data)
    return PoseMessage(stamp, frame, _pose2(_POSE.unpack_from(data, at)))


# The same from message objects of rosbags.


def _object_header(message: Any) -> tuple[int, str]:
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec), str(message.header.frame_id).lstrip("/")


def _object_pose(pose: Any) -> Pose2:
    p, q = pose.position, pose.orientation
    return Pose2.from_quaternion(float(p.x), float(p.y), float(q.x), float(q.y), float(q.z), float(q.w))


def object_laser_scan(message: Any) -> ScanMessage:
    """From a message object."""
    intensities = np.array(message.intensities, dtype=np.float32)
    return ScanMessage(
        *_object_header(message),
        float(message.angle_min),
        float(message.angle_increment),
        float(message.time_increment),
        float(message.range_min),
        float(message.range_max),
        np.array(message.ranges, dtype=np.float32),
        intensities if len(intensities) else None,
        float(message.scan_time),
    )


def object_odometry(message: Any) -> OdometryMessage:
    """From a message object."""
    raw = np.array(message.pose.covariance, dtype="<f8").tobytes()
    child = str(message.child_frame_id).lstrip("/")
    pose, q = _object_pose(message.pose.pose), message.pose.pose.orientation
    quaternion = (float(q.x), float(q.y), float(q.z), float(q.w))
    return OdometryMessage(*_object_header(message), child, pose, plane_covariance(raw), quaternion)


def object_transforms(message: Any) -> list[LinkMessage]:
    """From a message object."""
    links = []
    for item in message.transforms:
        t, q = item.transform.translation, item.transform.rotation
        transform = Transform3((float(t.x), float(t.y), float(t.z)), (float(q.x), float(q.y), float(q.z), float(q.w)))
        links.append(LinkMessage(*_object_header(item), str(item.child_frame_id).lstrip("/"), transform))
    return links


def object_occupancy_grid(message: Any) -> GridMessage:
    """From a message object."""
    info = message.info
    cells = np.array(message.data, dtype=np.int8)
    grid = _grid(cells, int(info.width), int(info.height), float(info.resolution), _object_pose(info.origin))
    return GridMessage(*_object_header(message), grid)


def object_pose(message: Any) -> PoseMessage:
    """From a PoseStamped, or a PoseWithCovarianceStamped."""
    pose = getattr(message.pose, "pose", message.pose)
    return PoseMessage(*_object_header(message), _object_pose(pose))


BY_HAND: dict[str, Callable[[Payload], Any]] = {
    definitions.LASER_SCAN: laser_scan,
    definitions.ODOMETRY: odometry,
    definitions.TF_MESSAGE: transforms,
    definitions.OCCUPANCY_GRID: occupancy_grid,
    definitions.POSE_STAMPED: pose_stamped,
    definitions.POSE_WITH_COVARIANCE_STAMPED: pose_stamped,
}
FROM_OBJECT: dict[str, Callable[[Any], Any]] = {
    definitions.LASER_SCAN: object_laser_scan,
    definitions.ODOMETRY: object_odometry,
    definitions.TF_MESSAGE: object_transforms,
    definitions.OCCUPANCY_GRID: object_occupancy_grid,
    definitions.POSE_STAMPED: object_pose,
    definitions.POSE_WITH_COVARIANCE_STAMPED: object_pose,
}
