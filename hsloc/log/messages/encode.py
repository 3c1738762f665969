"""Messages as ROS 2 CDR (little endian), for the types that hsloc writes.

Offsets in CDR count from behind the four bytes of encapsulation; a field is aligned to its own size. What does
not change between messages (frame names and their padding) is made once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import cos, sin
from struct import Struct, pack
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import OutputError
from hsloc.log.transforms import Transform3
from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid, Scan, Trajectory

ENCAPSULATION = b"\x00\x01\x00\x00"
NANOSECONDS = 1_000_000_000

_STAMP = Struct("<iI")
_COUNT = Struct("<I")
_SCAN = Struct("<7f")
_POSE = Struct("<7d")
_COVARIANCE = Struct("<36d")
_NOTHING = (0.0,) * 18
"""Rows of a covariance over (x, y, z, roll, pitch, yaw) that a robot in the plane does not know."""
_MAP_INFO = Struct("<iIfII")


@lru_cache(maxsize=16)  # Messages of one moment follow each other.
def stamp_bytes(stamp_ns: int) -> bytes:
    """builtin_interfaces/Time. Raises OutputError for a time that 32-bit seconds cannot hold."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    if not -(2**31) <= seconds < 2**31:
        raise OutputError(f"stamp {stamp_ns} ns does not fit ROS time (32-bit seconds)")
    return _STAMP.pack(seconds, nanoseconds)


@lru_cache(maxsize=1024)
def padded_string(text: str, offset: int, alignment: int) -> bytes:
    """A string at an offset, padded so that what follows is aligned."""
    data = text.encode() + b"\0"
    data = _COUNT.pack(len(data)) + data
    return data + b"\0" * (-(offset + len(data)) % alignment)


@lru_cache(maxsize=1024)
def _two_strings(first: str, second: str, offset: int) -> bytes:
    head = padded_string(first, offset, 4)
    return head + padded_string(second, offset + len(head), 8)


def laser_scan(scan: Scan, frame_id: str, scan_time: float) -> bytes:
    """sensor_msgs/LaserScan."""
    ranges = np.ascontiguousarray(scan.ranges, dtype="<f4")
    count = len(ranges)
    limits = _SCAN.pack(
        scan.angle_min,
        scan.angle_min + max(count - 1, 0) * scan.angle_increment,
        scan.angle_increment,
        scan.time_increment,
        scan_time,
        scan.range_min,
        scan.range_max,
    )
    tail = b"\0\0\0\0"
    if scan.intensities is not None and len(scan.intensities):
        intensities = np.ascontiguousarray(scan.intensities, dtype="<f4")
        tail = _COUNT.pack(len(intensities)) + intensities.tobytes()
    return b"".join(
        (
            ENCAPSULATION,
            stamp_bytes(scan.stamp_ns),
            padded_string(frame_id, 8, 4),
            limits,
            _COUNT.pack(count),
            ranges.tobytes(),
            tail,
        )
    )


def _pose(pose: Pose2) -> bytes:
    half = pose.theta / 2.0  # `to_quaternion`, without a call: each message of a run has a pose
    return _POSE.pack(pose.x, pose.y, 0.0, 0.0, 0.0, sin(half), cos(half))


def _covariance(covariance: NDArray[np.float64] | None) -> bytes:
    if covariance is None:
        return bytes(_COVARIANCE.size)
    (xx, xy, xt), (yx, yy, yt), (tx, ty, tt) = np.asarray(covariance, dtype=np.float64).tolist()
    return _COVARIANCE.pack(xx, xy, 0, 0, 0, xt, yx, yy, 0, 0, 0, yt, *_NOTHING, tx, ty, 0, 0, 0, tt)


_NO_COVARIANCE = _covariance(None)
_TWIST = Struct("<6d")


def odometry(
    stamp_ns: int,
    pose: Pose2,
    covariance: NDArray[np.float64] | None,
    twist: tuple[float, float, float],
    frames: tuple[str, str],
) -> bytes:
    """nav_msgs/Odometry; `frames` are (frame_id, child_frame_id), `twist` is (vx, vy, wz)."""
    vx, vy, wz = twist
    return b"".join(
        (
            ENCAPSULATION,
            stamp_bytes(stamp_ns),
            _two_strings(*frames, 8),
            _pose(pose),
            _NO_COVARIANCE if covariance is None else _covariance(covariance),
            _TWIST.pack(vx, vy, 0.0, 0.0, 0.0, wz),
            _NO_COVARIANCE,
        )
    )


_IMU = Struct("<37d")
_NOT_MEASURED = (-1.0, *(0.0,) * 8)


def imu(stamp_ns: int, theta: float, frame_id: str) -> bytes:
    """sensor_msgs/Imu with an orientation alone (rad about the vertical axis)."""
    orientation, nothing = Pose2(0.0, 0.0, theta).to_quaternion(), (0.0, 0.0, 0.0)
    values = _IMU.pack(*orientation, *(0.0,) * 9, *nothing, *_NOT_MEASURED, *nothing, *_NOT_MEASURED)
    return ENCAPSULATION + stamp_bytes(stamp_ns) + padded_string(frame_id, 8, 8) + values


def transforms(stamp_ns: int, links: Sequence[tuple[str, str, Pose2 | Transform3]]) -> bytes:
    """tf2_msgs/TFMessage; links are (parent, child, T_parent_child)."""
    stamp = stamp_bytes(stamp_ns)
    parts = [ENCAPSULATION, _COUNT.pack(len(links))]
    offset = 4
    for parent, child, link in links:
        names = _two_strings(parent, child, offset % 8)
        values = _POSE.pack(*link.translation, *link.rotation) if isinstance(link, Transform3) else _pose(link)
        parts += (stamp, names, values)
        offset += 8 + len(names) + len(values)
    return b"".join(parts)


def occupancy_grid(grid: OccupancyGrid, stamp_ns: int, frame_id: str) -> bytes:
    """nav_msgs/OccupancyGrid; the map's load time is the stamp."""
    height, width = grid.cells.shape
    stamp = stamp_bytes(stamp_ns)
    names = padded_string(frame_id, 8, 4)
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    info = _MAP_INFO.pack(seconds, nanoseconds, grid.resolution, width, height)
    padding = b"\0" * (-(8 + len(names) + len(info)) % 8)
    cells = np.ascontiguousarray(grid.cells, dtype=np.int8).tobytes()
    return b"".join((ENCAPSULATION, stamp, names, info, padding, _pose(grid.origin), _COUNT.pack(len(cells)), cells))


def pose_stamped(stamp_ns: int, pose: Pose2, frame_id: str) -> bytes:
    """geometry_msgs/PoseStamped."""
    return ENCAPSULATION + stamp_bytes(stamp_ns) + padded_string(frame_id, 8, 8) + _pose(pose)


def pose_with_covariance_stamped(
    stamp_ns: int, pose: Pose2, covariance: NDArray[np.float64] | None, frame_id: str
) -> bytes:
    """geometry_msgs/PoseWithCovarianceStamped."""
    return pose_stamped(stamp_ns, pose, frame_id) + _covariance(covariance)


def path(stamp_ns: int, trajectory: Trajectory, frame_id: str) -> bytes:
    """nav_msgs/Path; each pose has its own stamp."""
    head = padded_string(frame_id, 8, 4)
    parts = [ENCAPSULATION, stamp_bytes(stamp_ns), head, _COUNT.pack(len(trajectory))]
    offset = 8 + len(head) + 4
    cosines, sines = np.cos(trajectory.poses[:, 2] / 2.0), np.sin(trajectory.poses[:, 2] / 2.0)
    columns = (trajectory.stamps_ns, trajectory.poses, sines, cosines)
    for stamp, (x, y, _), sine, cosine in zip(*(column.tolist() for column in columns), strict=True):
        name = padded_string(frame_id, offset % 8, 8)
        parts += (stamp_bytes(stamp), name, _POSE.pack(x, y, 0.0, 0.0, 0.0, sine, cosine))
        offset += 8 + len(name) + _POSE.size
    return b"".join(parts)


def log_message(stamp_ns: int, level: int, name: str, text: str) -> bytes:
    """rcl_interfaces/Log; file, function and line are left empty."""
    data = stamp_bytes(stamp_ns) + bytes((level, 0, 0, 0))
    for each in (name, text, "", ""):
        data += padded_string(each, len(data), 4)
    return ENCAPSULATION + data + _COUNT.pack(0)


def float64(value: float) -> bytes:
    """std_msgs/Float64."""
    return ENCAPSULATION + pack("<d", value)


def string(text: str) -> bytes:
    """std_msgs/String."""
    return ENCAPSULATION + padded_string(text, 0, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """What a viewer draws: line segments between pairs of `points` (n, 2) [m], or a text at the first of them.

    `colour` is red, green, blue and opacity, each 0 to 1; `size` [m] the width of the lines or the height of the text.
    """

    namespace: str
    points: NDArray[np.float64]
    colour: tuple[float, float, float, float]
    size: float
    text: str = ""


_LINE_LIST, _TEXT_VIEW_FACING = 5, 9


def marker_array(stamp_ns: int, markers: Sequence[Marker], frame_id: str) -> bytes:
    """visualization_msgs/MarkerArray; they stay until they are replaced."""
    data = bytearray(_COUNT.pack(len(markers)))

    def field(layout: str, size: int, *values: float) -> None:
        data.extend(b"\0" * (-len(data) % size) + pack(layout, *values))

    def text(value: str) -> None:
        data.extend(b"\0" * (-len(data) % 4) + padded_string(value, 0, 1))

    for number, marker in enumerate(markers):
        points = np.zeros((0 if marker.text else len(marker.points), 3), dtype="<f8")
        at = (0.0, 0.0)
        if marker.text:
            at = float(marker.points[0, 0]), float(marker.points[0, 1])
        else:
            points[:, :2] = marker.points
        field("<iI", 4, *divmod(stamp_ns, NANOSECONDS))
        text(frame_id)
        text(marker.namespace)
        field("<3i", 4, number, _TEXT_VIEW_FACING if marker.text else _LINE_LIST, 0)
        field("<7d", 8, *at, 0.0, 0.0, 0.0, 0.0, 1.0)
        # Lines take their width from x, texts their height from z.
        field("<3d", 8, marker.size, marker.size, marker.size)
        field("<4f", 4, *marker.colour)
        field("<iI", 4, 0, 0)  # without end
        field("<?", 1, False)
        field("<I", 4, len(points))
        if len(points):
            field("", 8)
            data.extend(points.tobytes())
        field("<I", 4, 0)  # colours
        text("")  # texture
        field("<iI", 4, 0, 0)
        text("")
        text("")
        field("<2I", 4, 0, 0)  # its data, and coordinates in it
        text(marker.text)
        text("")  # mesh
        text("")
        field("<I", 4, 0)
        field("<?", 1, False)
    return ENCAPSULATION + bytes(data)
