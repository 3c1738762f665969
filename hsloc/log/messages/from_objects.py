"""From message objects of rosbags (ROS 1, big endian, other definitions) or of JSON to the tuples of `decode`.

JSON is that of rosbridge and some recorders: fields by their ROS names, also in camel case, arrays of numbers also as
objects with the indices as keys (JavaScript's typed arrays). Times are `{"sec", "nanosec"}` (ROS 2), `{"secs",
"nsecs"}` (ROS 1), `{"seconds", "nanos"}`, or one number: seconds, or nanoseconds where it is too large for those. What
JSON has no number for is null, or one of the words NaN, Infinity and -Infinity.
"""

from __future__ import annotations

import json
import re
from base64 import b64decode
from math import inf, nan
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.log.messages import definitions
from hsloc.log.messages.decode import (
    NANOSECONDS,
    GridMessage,
    LinkMessage,
    OdometryMessage,
    PoseMessage,
    ScanMessage,
    first_echoes,
    make_grid,
    plane_covariance,
)
from hsloc.log.transforms import Transform3
from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.log.messages.decode import Payload

MAX_PAYLOAD_BYTES = 64 << 20
_WORDS = {"nan": nan, "inf": inf, "infinity": inf, "+infinity": inf, "-inf": -inf, "-infinity": -inf}
_ALIASES = {
    **dict.fromkeys(("secs", "seconds"), "sec"),
    **dict.fromkeys(("nsecs", "nsec", "nanos", "nanoseconds", "nanosecs"), "nanosec"),
}
_CAMEL = re.compile(r"(?<=[a-z])[A-Z]")
_NUMBERS = ("ranges", "intensities", "covariance")
_DEFAULTS: dict[str, Any] = {
    "intensities": [],
    "scan_time": 0.0,
    "time_increment": 0.0,
    "angle_max": nan,
    "child_frame_id": "",
    **dict.fromkeys(("sec", "nanosec"), 0),
}
_LARGEST_SECONDS = 1e11
"""Stamps beyond are in nanoseconds: of our time these are some 10^18, of seconds 10^9."""


def object_header(message: Any) -> tuple[int, str]:
    """(stamp in ns, frame_id) of a message object."""
    stamp = message.header.stamp
    if isinstance(stamp, int | float):
        ns = int(stamp) if stamp > _LARGEST_SECONDS else round(stamp * NANOSECONDS)
        return ns, str(message.header.frame_id).lstrip("/")
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec), str(message.header.frame_id).lstrip("/")


def _object_pose(pose: Any) -> Pose2:
    p, q = pose.position, pose.orientation
    return Pose2.from_quaternion(float(p.x), float(p.y), float(q.x), float(q.y), float(q.z), float(q.w))


def object_laser_scan(message: Any) -> ScanMessage:
    """From a message object."""
    ranges = np.array(message.ranges, dtype=np.float32)
    return _object_scan(message, ranges, np.array(message.intensities, dtype=np.float32))


def object_multi_echo_laser_scan(message: Any) -> ScanMessage:
    """From a message object: the first echo of each beam, and all of them."""
    echoes, strengths = ([beam.echoes for beam in beams] for beams in (message.ranges, message.intensities))
    scan = _object_scan(message, first_echoes(echoes), first_echoes(strengths))
    return scan._replace(echoes=(echoes, strengths)) if len(strengths) == len(echoes) else scan


def _object_scan(message: Any, ranges: NDArray[np.float32], intensities: NDArray[np.float32]) -> ScanMessage:
    return ScanMessage(
        *object_header(message),
        float(message.angle_min),
        float(message.angle_increment),
        float(message.time_increment),
        float(message.range_min),
        float(message.range_max),
        ranges,
        intensities if len(intensities) else None,
        float(message.scan_time),
        angle_max=float(message.angle_max),
    )


def object_odometry(message: Any) -> OdometryMessage:
    """From a message object."""
    raw = np.array(message.pose.covariance, dtype="<f8").tobytes()
    child = str(message.child_frame_id).lstrip("/")
    pose, q = _object_pose(message.pose.pose), message.pose.pose.orientation
    quaternion = (float(q.x), float(q.y), float(q.z), float(q.w))
    return OdometryMessage(*object_header(message), child, pose, plane_covariance(raw), quaternion)


def object_transforms(message: Any) -> list[LinkMessage]:
    """From a message object."""
    links = []
    for item in message.transforms:
        t, q = item.transform.translation, item.transform.rotation
        transform = Transform3((float(t.x), float(t.y), float(t.z)), (float(q.x), float(q.y), float(q.z), float(q.w)))
        links.append(LinkMessage(*object_header(item), str(item.child_frame_id).lstrip("/"), transform))
    return links


def object_occupancy_grid(message: Any) -> GridMessage:
    """From a message object."""
    info = message.info
    cells = np.array(message.data, dtype=np.int8)
    grid = make_grid(cells, int(info.width), int(info.height), float(info.resolution), _object_pose(info.origin))
    return GridMessage(*object_header(message), grid)


def object_pose(message: Any) -> PoseMessage:
    """From a PoseStamped, or a PoseWithCovarianceStamped."""
    pose = getattr(message.pose, "pose", message.pose)
    return PoseMessage(*object_header(message), _object_pose(pose))


FROM_OBJECT: dict[str, Callable[[Any], Any]] = {
    definitions.LASER_SCAN: object_laser_scan,
    definitions.MULTI_ECHO_LASER_SCAN: object_multi_echo_laser_scan,
    definitions.TF_MESSAGE: object_transforms,
    definitions.OCCUPANCY_GRID: object_occupancy_grid,
}


class _Message(SimpleNamespace):
    """An object of a JSON message; what a message may leave out has its default."""

    def __getattr__(self, name: str) -> Any:
        if name == "covariance":
            return [0.0] * 36
        try:
            return _DEFAULTS[name]
        except KeyError:
            raise AttributeError(f"the field {name} is missing") from None


def json_decoder(convert: Callable[[Any], Any]) -> Callable[[Payload], Any]:
    """A function from payload to what `convert` makes of a message object; it raises whatever JSON may lead to."""

    def decode(data: Payload) -> Any:
        if len(data) > MAX_PAYLOAD_BYTES:
            raise ValueError(f"a message of {len(data)} bytes, at most {MAX_PAYLOAD_BYTES} are read")
        message = json.loads(bytes(data).rstrip(b"\0"))
        if isinstance(message, dict) and isinstance(message.get("msg"), dict):  # as rosbridge sends it
            message = message["msg"]
        return convert(_object(message, ""))

    return decode


def _object(value: Any, name: str) -> Any:
    if isinstance(value, dict) and name in _NUMBERS:
        value = list(value.values())
    if isinstance(value, dict):
        names = {key: _CAMEL.sub(lambda found: f"_{found[0].lower()}", str(key)) for key in value}
        return _Message(**{_ALIASES.get(names[key], names[key]): _object(value[key], names[key]) for key in value})
    if name in _NUMBERS and isinstance(value, list):
        return np.array([_number(item) for item in value])
    if name == "data" and isinstance(value, str):  # rosbridge writes int8[] in base64
        return np.frombuffer(b64decode(value, validate=True), dtype=np.int8)
    if isinstance(value, list):
        return [_object(item, name) for item in value]
    if value is None or (isinstance(value, str) and value.lower() in _WORDS and not name.endswith("frame_id")):
        return _number(value)
    return value


def _number(value: Any) -> float:
    if value is None:
        return nan
    if isinstance(value, str):
        return _WORDS[value.lower()]
    return float(value)
