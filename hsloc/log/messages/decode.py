"""Payloads to values: by hand where the definition is the known one, by rosbags where it is not.

Each type has a named tuple of what hsloc needs of it, a decoder of ROS 2 CDR (little endian) written by hand, and
a function that takes the same from a message object of rosbags (other definitions, ROS 1, big endian). Hand-made
decoders raise `BAD_PAYLOAD` on what they cannot read.
"""

from __future__ import annotations

from functools import lru_cache
from math import nan
from struct import Struct, unpack_from
from struct import error as StructError
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hsloc.log.messages import definitions
from hsloc.log.transforms import Transform3
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Payload = memoryview | bytes
    Echoes = Sequence[Sequence[float] | NDArray[np.float32]]
    """A value for each echo of each beam."""

NANOSECONDS = 1_000_000_000
LITTLE_ENDIAN, BIG_ENDIAN = b"\x00\x01", b"\x00\x00"
_ALIGNMENTS = {LITTLE_ENDIAN: 8, b"\x00\x07": 4}
"""Encapsulations that are read by hand, and the widest alignment in them: XCDR2 aligns doubles to four bytes."""
_ENCAPSULATIONS = {
    b"\x00\x02": "big-endian PL_CDR (a parameter list)",
    b"\x00\x03": "PL_CDR (a parameter list)",
    b"\x00\x06": "big-endian XCDR2",
    b"\x00\x08": "big-endian delimited XCDR2",
    b"\x00\x09": "delimited XCDR2",
    b"\x00\x0a": "big-endian PL_CDR2 (a parameter list)",
    b"\x00\x0b": "PL_CDR2 (a parameter list)",
}
"""Encapsulations that are not read, by the names of the DDS-XTypes standard (7.6.3.1.2)."""
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
    angle_max: float = nan
    echoes: tuple[Echoes, Echoes] | None = None
    """Ranges and intensities of all echoes of each beam, of a lidar that reports several with their intensities."""


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
"""Size of a ROS covariance of 6 x 6 doubles."""
_ODOMETRY_TAIL = POSE_BYTES + COVARIANCE_BYTES + 6 * 8 + COVARIANCE_BYTES
_STAMPED_TAILS = (POSE_BYTES, POSE_BYTES + COVARIANCE_BYTES)
"""Bytes behind the head of an odometry message, and of the stamped poses: they differ between XCDR1 and XCDR2."""
_ZEROS = bytes(COVARIANCE_BYTES)
PLANE = np.array((0, 1, 5, 6, 7, 11, 30, 31, 35))
"""Where (x, y, yaw) x (x, y, yaw) lie in the 36 values of a ROS covariance over (x, y, z, roll, pitch, yaw)."""
_BODY = 4
"""Offsets of CDR count from behind the encapsulation."""
_MAX_NAME = 4096
"""Maximum length of a frame's name. Internal: guards the memory against a hostile file."""


@lru_cache(maxsize=4096)
def _name(raw: bytes) -> str:
    """A frame's name: without the closing zero, and without the leading slash of ROS 1."""
    return raw.rstrip(b"\0").decode().lstrip("/")


def aligned(at: int, size: int) -> int:
    """The next offset that is a multiple of `size` bytes behind the encapsulation."""
    return at + (_BODY - at) % size


def alignment(data: Payload) -> int:
    """The alignment of doubles in a message; raises ValueError for an encapsulation that is not read."""
    identifier = bytes(data[:2])
    found = _ALIGNMENTS.get(identifier)
    if found is None:
        name = _ENCAPSULATIONS.get(identifier)
        if name:
            raise ValueError(
                f"encoded as {name}, which is not read; play it with the middleware that wrote it and record it as CDR"
            )
        raise ValueError(f"it begins with the bytes {bytes(data[:4]).hex(' ') or 'of nothing'}, which is no CDR")
    return found


def _fits(data: Payload, end: int) -> bool:
    """Whether a message ends at `end`, but for bytes that fill up a word.

    Some middleware labels its messages as XCDR2 and lays them out as XCDR1 does: the length decides.
    """
    return 0 <= len(data) - end < 4


def header(data: Payload, at: int) -> tuple[int, str, int]:
    """(stamp, frame_id, offset behind) of a std_msgs/Header."""
    seconds, nanoseconds, size = _STAMP_AND_SIZE.unpack_from(data, at)
    end = at + 12 + size
    if size > _MAX_NAME or end > len(data):
        raise ValueError("a name is longer than the message")
    return seconds * NANOSECONDS + nanoseconds, _name(bytes(data[at + 12 : end])), end


def string(data: Payload, at: int) -> tuple[str, int]:
    """(text, offset behind) of a string; of a frame's name without the leading slash of ROS 1."""
    at = aligned(at, 4)
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
    alignment(data)
    stamp, frame, at = header(data, 4)
    at = aligned(at, 4)
    angle_min, angle_max, increment, time_increment, scan_time, range_min, range_max, count = _SCAN.unpack_from(
        data, at
    )
    at += _SCAN.size
    if at + 4 * count > len(data):
        raise ValueError("more ranges than the message holds")
    ranges = _floats(data, at, count)
    at += 4 * count
    (count,) = _SIZE.unpack_from(data, at)
    intensities = _floats(data, at + 4, count) if count else None
    values = (increment, time_increment, range_min, range_max, ranges, intensities, scan_time)
    return ScanMessage(stamp, frame, angle_min, *values, angle_max=angle_max)


def multi_echo_laser_scan(data: Payload) -> ScanMessage:
    """sensor_msgs/MultiEchoLaserScan from CDR: the first echo of each beam, NaN where it has none, and all of them."""
    alignment(data)
    stamp, frame, at = header(data, 4)
    at = aligned(at, 4)
    angle_min, angle_max, increment, time_increment, scan_time, range_min, range_max, count = _SCAN.unpack_from(
        data, at
    )
    echoes, at = _echoes(data, at + _SCAN.size, count)
    (count,) = _SIZE.unpack_from(data, at)
    strengths = _echoes(data, at + 4, count)[0] if count else []
    limits = (increment, time_increment, range_min, range_max)
    found = first_echoes(echoes), first_echoes(strengths) if strengths else None
    scan = ScanMessage(stamp, frame, angle_min, *limits, *found, scan_time, angle_max=angle_max)
    return scan._replace(echoes=(echoes, strengths)) if len(strengths) == len(echoes) else scan


def _echoes(data: Payload, at: int, count: int) -> tuple[list[tuple[float, ...]], int]:
    if at + 4 * count > len(data):
        raise ValueError("more echoes than the message holds")
    echoes = []
    for _ in range(count):
        (size,) = _SIZE.unpack_from(data, at)
        if at + 4 + 4 * size > len(data):
            raise ValueError("more echoes than the message holds")
        echoes.append(unpack_from(f"<{size}f", data, at + 4))
        at += 4 + 4 * size
    return echoes, at


def first_echoes(values: Echoes) -> NDArray[np.float32]:
    """The value of the first echo of each beam (n,), NaN where it has none."""
    return np.array([echoes[0] if len(echoes) else nan for echoes in values], dtype=np.float32)


def strongest_echoes(ranges: Echoes, intensities: Echoes) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Range and intensity of the strongest echo of each beam, both (n,); the first range where it has no intensity."""
    best = np.full((2, len(ranges)), nan, dtype=np.float32)
    for beam, (echoes, strength) in enumerate(zip(ranges, intensities, strict=True)):
        count = min(len(echoes), len(strength))
        if count:
            k = max(range(count), key=strength.__getitem__)
            best[:, beam] = echoes[k], strength[k]
        elif len(echoes):
            best[0, beam] = echoes[0]
    return best[0], best[1]


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
    widest = alignment(data)
    stamp, frame, at = header(data, 4)
    child, at = string(data, at)
    if widest == 4 and not _fits(data, aligned(at, 4) + _ODOMETRY_TAIL):
        widest = 8
    return stamp, frame, child, aligned(at, widest)


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
    widest = alignment(data)
    links, end = _links(data, widest)
    if widest == 4 and not _fits(data, end):
        links, end = _links(data, 8)
    if end < 0:
        raise ValueError("a transform is cut off")
    return links


def _links(data: Payload, widest: int) -> tuple[list[LinkMessage], int]:
    """The links of a message whose doubles are aligned to `widest` bytes, and where the last of them ends."""
    (count,) = _SIZE.unpack_from(data, 4)
    if count * 76 > len(data):
        raise ValueError("more transforms than the message holds")
    links: list[LinkMessage] = []
    at = 8
    for _ in range(count):
        stamp, parent, at = header(data, aligned(at, 4))
        child, at = string(data, at)
        at = aligned(at, widest)
        if at + _POSE.size > len(data):
            return links, -1
        x, y, z, qx, qy, qz, qw = _POSE.unpack_from(data, at)
        at += _POSE.size
        links.append(LinkMessage(stamp, parent, child, Transform3((x, y, z), (qx, qy, qz, qw))))
    return links, at


def occupancy_grid(data: Payload) -> GridMessage:
    """nav_msgs/OccupancyGrid from CDR."""
    widest = alignment(data)
    stamp, frame, at = header(data, 4)
    at = aligned(at, 4) + 8
    resolution, width, height = _MAP_INFO.unpack_from(data, at)
    at += _MAP_INFO.size
    if widest == 4 and not _fits(data, aligned(at, 4) + POSE_BYTES + 4 + width * height):
        widest = 8
    at = aligned(at, widest)
    origin = _pose2(_POSE.unpack_from(data, at))
    at += _POSE.size
    (count,) = _SIZE.unpack_from(data, at)
    if at + 4 + count > len(data):
        raise ValueError("more cells than the message holds")
    cells = np.frombuffer(data, dtype=np.int8, count=count, offset=at + 4).copy()
    return GridMessage(stamp, frame, make_grid(cells, width, height, resolution, origin))


def make_grid(cells: NDArray[np.int8], width: int, height: int, resolution: float, origin: Pose2) -> OccupancyGrid:
    """A grid of int8 cells (width * height,), row by row; raises ValueError where they do not fit."""
    if width * height != len(cells) or not len(cells):
        raise ValueError(f"a map of {width} x {height} with {len(cells)} cells")
    if not 0.0 < resolution < 1e6 or not origin.is_finite():
        raise ValueError(f"a map of resolution {resolution} at {origin}")
    # The message's float32 is 0.05000000074...: the map's author meant the shortest number that rounds to it.
    return OccupancyGrid(cells.reshape(height, width), float(str(np.float32(resolution))), origin)


def _stamped_head(data: Payload) -> tuple[int, str, int]:
    """(stamp, frame, offset of the pose) of a geometry_msgs/PoseStamped."""
    widest = alignment(data)
    stamp, frame, at = header(data, 4)
    if widest == 4 and not any(_fits(data, aligned(at, 4) + tail) for tail in _STAMPED_TAILS):
        widest = 8
    return stamp, frame, aligned(at, widest)


def stamped_pose_at(data: Payload) -> int:
    """The offset of the pose in a geometry_msgs/PoseStamped or PoseWithCovarianceStamped."""
    return _stamped_head(data)[2]


def pose_stamped(data: Payload) -> PoseMessage:
    """geometry_msgs/PoseStamped or PoseWithCovarianceStamped from CDR."""
    stamp, frame, at = _stamped_head(data)
    return PoseMessage(stamp, frame, _pose2(_POSE.unpack_from(data, at)))


BY_HAND: dict[str, Callable[[Payload], Any]] = {
    definitions.LASER_SCAN: laser_scan,
    definitions.MULTI_ECHO_LASER_SCAN: multi_echo_laser_scan,
    definitions.ODOMETRY: odometry,
    definitions.TF_MESSAGE: transforms,
    definitions.OCCUPANCY_GRID: occupancy_grid,
    definitions.POSE_STAMPED: pose_stamped,
    definitions.POSE_WITH_COVARIANCE_STAMPED: pose_stamped,
}
