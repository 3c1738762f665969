"""Foxglove's own messages, as JSON or protobuf: LaserScan, FrameTransform(s), PoseInFrame and Grid.

Their values become the same tuples as those of ROS messages (see `hsloc.log.messages.decode`). Protobuf messages are
decoded by the definition that the log carries, which needs the optional package protobuf.
"""

from __future__ import annotations

import json
from base64 import b64decode
from math import inf, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.errors import LogFormatError, install_hint
from hsloc.log.messages import definitions
from hsloc.log.messages.decode import GridMessage, LinkMessage, PoseMessage, ScanMessage
from hsloc.log.transforms import Transform3
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from hsloc.log.container import Channel
    from hsloc.log.messages.decode import Payload

    Get = Callable[[Any, str], Any]
    """A field of a message by its name; None where it is not set."""

PREFIX = "foxglove."
TYPES = {
    "foxglove.LaserScan": definitions.LASER_SCAN,
    "foxglove.FrameTransform": definitions.TF_MESSAGE,
    "foxglove.FrameTransforms": definitions.TF_MESSAGE,
    "foxglove.PoseInFrame": definitions.POSE_STAMPED,
    "foxglove.Grid": definitions.OCCUPANCY_GRID,
}
"""The type of ROS 2 that stands for each of Foxglove's."""
ENCODINGS = ("json", "protobuf")
RANGE_MIN = 1e-3
"""Metres. Foxglove's scans have no limits of range; a reading of zero is invalid all the same."""

MAX_PAYLOAD_BYTES = 4 << 20
"""A message beyond is refused unread: objects take many times the memory of their bytes."""
_MAX_GRID_BYTES = 512 << 20
"""Its cells are one run of bytes, and stay that."""
_MAX_LINKS = 10_000
_MAX_NAME = 4096
_MAX_SECONDS = 1 << 33
_MAX_FILES = 200
"""Maximum links of a message, length of a name, seconds and files of a schema. Internal: guards the memory."""
_SECOND = 1_000_000_000


def is_foxglove(channel: Channel) -> bool:
    """Whether a channel holds messages that `decoder` reads."""
    if channel.typename not in TYPES:
        return False
    return channel.message_encoding == "json" or (channel.message_encoding == "protobuf" and bool(channel.schema))


def decoder(channel: Channel) -> Callable[[Payload], Any]:
    """A function from payload to a tuple; it raises whatever a payload that is not what it should be leads to.

    Raises LogFormatError where the channel's definition cannot be used, or protobuf is not installed.
    """
    convert = _CONVERT[channel.typename]
    most = _MAX_GRID_BYTES if channel.typename == "foxglove.Grid" else MAX_PAYLOAD_BYTES
    if channel.message_encoding == "json":
        return lambda data: convert(json.loads(_bounded(data, most)), _get_json)
    parse = _protobuf_parser(channel)
    return lambda data: convert(parse(_bounded(data, most)), _get_protobuf)


def _bounded(data: Payload, most: int) -> bytes:
    if len(data) > most:
        raise ValueError(f"a message of {len(data)} bytes, at most {most} are read")
    return bytes(data)


def _get_json(message: Any, name: str) -> Any:
    if not isinstance(message, dict):
        raise TypeError("not an object")
    return message.get(name)


def _get_protobuf(message: Any, name: str) -> Any:
    value = getattr(message, name)
    # An unset message reads as one of zeros; JSON leaves it out.
    return None if hasattr(value, "DESCRIPTOR") and not message.HasField(name) else value


def _protobuf_parser(channel: Channel) -> Callable[[bytes], Any]:
    """From bytes to a message of the type that the channel's FileDescriptorSet defines."""
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, duration_pb2, message_factory, timestamp_pb2
    except ImportError as error:
        raise LogFormatError(
            f"{channel.topic}: {channel.typename} in protobuf needs a package more: {install_hint('foxglove')}"
        ) from error
    try:
        files = {item.name: item for item in descriptor_pb2.FileDescriptorSet.FromString(channel.schema).file}
        for known in (timestamp_pb2, duration_pb2):  # Some recorders leave out what every installation has.
            name = known.DESCRIPTOR.name
            files.setdefault(name, descriptor_pb2.FileDescriptorProto.FromString(known.DESCRIPTOR.serialized_pb))
        if len(files) > _MAX_FILES:
            raise ValueError(f"{len(files)} files")
        pool = descriptor_pool.DescriptorPool()
        for name in _dependencies_first({name: tuple(item.dependency) for name, item in files.items()}):
            pool.AddSerializedFile(files[name].SerializeToString())
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel.typename))
    except Exception as error:  # Its C code raises many things.
        reason = (str(error).splitlines() or [""])[0][:120]
        raise LogFormatError(
            f"{channel.topic}: the definition of {channel.typename} cannot be used "
            f"({type(error).__name__}: {reason}); name another topic"
        ) from error
    parse: Callable[[bytes], Any] = kind.FromString
    return parse


def _dependencies_first(files: dict[str, tuple[str, ...]]) -> list[str]:
    order: list[str] = []
    waiting = dict(files)
    while waiting:
        free = [name for name, needs in waiting.items() if not any(need in waiting and need != name for need in needs)]
        if not free:
            raise ValueError("its files import each other in a circle")
        for name in free:
            del waiting[name]
        order += free
    return order


# From messages of either encoding to tuples.


def _stamp(message: Any, get: Get) -> int:
    time = get(message, "timestamp")
    if time is None:
        return 0
    if isinstance(time, dict):
        seconds, nanoseconds = time.get("sec", 0), time.get("nsec", time.get("nanosec", 0))
    else:
        seconds, nanoseconds = time.seconds, time.nanos
    if type(seconds) is not int or type(nanoseconds) is not int:
        raise TypeError("a time that is no whole number")
    if abs(seconds) > _MAX_SECONDS or not 0 <= nanoseconds < _SECOND:
        raise ValueError(f"a time of {seconds} s and {nanoseconds} ns")
    return seconds * _SECOND + nanoseconds


def _frame(message: Any, get: Get, name: str) -> str:
    value = get(message, name)
    if value is None:
        return ""
    if not isinstance(value, str) or len(value) > _MAX_NAME:
        raise ValueError(f"{name} is no name")
    return value.lstrip("/")


def _number(value: Any) -> float:
    return 0.0 if value is None else float(value)  # JSON has no infinity; "Infinity" and "NaN" stand for them


def _transform(translation: Any, rotation: Any, get: Get) -> Transform3:
    x, y, z = (0.0, 0.0, 0.0) if translation is None else (_number(get(translation, name)) for name in "xyz")
    if rotation is None:
        return Transform3((x, y, z))
    qx, qy, qz, qw = (_number(get(rotation, name)) for name in "xyzw")
    return Transform3((x, y, z), (qx, qy, qz, qw))


def _pose(message: Any, get: Get) -> Transform3:
    pose = get(message, "pose")
    return Transform3() if pose is None else _transform(get(pose, "position"), get(pose, "orientation"), get)


def _numbers(values: Any) -> NDArray[np.float64]:
    if values is None:
        return np.zeros(0)
    if isinstance(values, str | bytes | dict):
        raise TypeError("not an array")
    try:
        return np.fromiter(values, dtype=np.float64, count=len(values))
    except TypeError:
        # JSON says null where it means NaN.
        return np.array([np.nan if value is None else float(value) for value in values])


def laser_scan(message: Any, get: Get) -> ScanMessage:
    """foxglove.LaserScan. Beams are spread evenly from start_angle to end_angle; `pose` is the laser's in its frame."""
    ranges = _numbers(get(message, "ranges"))
    intensities = _numbers(get(message, "intensities"))
    start, end = _number(get(message, "start_angle")), _number(get(message, "end_angle"))
    pose = _pose(message, get).normalised()
    with np.errstate(over="ignore", invalid="ignore"):
        return ScanMessage(
            _stamp(message, get),
            _frame(message, get, "frame_id"),
            start,
            _increment(start, end, len(ranges)),
            0.0,
            RANGE_MIN,
            inf,
            ranges.astype(np.float32),
            intensities.astype(np.float32) if len(intensities) else None,
            T_frame_laser=None if pose == Transform3() else pose,
        )


def _increment(start: float, end: float, count: int) -> float:
    """Angle between beams: the float32 of a driver, where the angles were made from one."""
    if count < 2 or not (isfinite(start) and isfinite(end)):
        return 0.0
    step = (end - start) / (count - 1)
    if abs(step) > 1e3:
        return step
    short = float(np.float32(step))
    # What start + (count - 1) * step loses by rounding, and not more.
    lost = 4.0 * np.finfo(np.float64).eps * (abs(start) + abs(end)) / (count - 1)
    return short if abs(short - step) <= lost else step


def transform(message: Any, get: Get) -> list[LinkMessage]:
    """foxglove.FrameTransform."""
    return [
        LinkMessage(
            _stamp(message, get),
            _frame(message, get, "parent_frame_id"),
            _frame(message, get, "child_frame_id"),
            _transform(get(message, "translation"), get(message, "rotation"), get),
        )
    ]


def transforms(message: Any, get: Get) -> list[LinkMessage]:
    """foxglove.FrameTransforms."""
    items: Sequence[Any] = get(message, "transforms") or ()
    if len(items) > _MAX_LINKS:
        raise ValueError(f"{len(items)} transforms in a message")
    return [link for item in items for link in transform(item, get)]


def pose_in_frame(message: Any, get: Get) -> PoseMessage:
    """foxglove.PoseInFrame."""
    return PoseMessage(_stamp(message, get), _frame(message, get, "frame_id"), _pose(message, get).to_pose2())


def grid(message: Any, get: Get) -> GridMessage:
    """foxglove.Grid that holds occupancies."""
    origin = _pose(message, get).normalised().to_pose2()
    if not origin.is_finite():
        raise ValueError("its place is not finite")
    return GridMessage(_stamp(message, get), _frame(message, get, "frame_id"), occupancy(message, get, origin))


_CONVERT: dict[str, Callable[[Any, Get], Any]] = {
    "foxglove.LaserScan": laser_scan,
    "foxglove.FrameTransform": transform,
    "foxglove.FrameTransforms": transforms,
    "foxglove.PoseInFrame": pose_in_frame,
    "foxglove.Grid": grid,
}


_UINT8, _INT8 = 1, 2
"""foxglove.NumericType."""
_NAMES = {"UINT8": _UINT8, "INT8": _INT8}
_MOST_CELLS = 400_000_000
"""Maximum number of cells. Internal: guards the memory against a hostile file."""


def occupancy(message: Any, get: Get, origin: Pose2) -> OccupancyGrid:
    """The grid, its lower-left corner at `origin`. Raises ValueError or TypeError for what is no occupancy grid."""
    fields = list(get(message, "fields") or ())
    if len(fields) != 1:
        raise ValueError(f"{len(fields)} values a cell, not one occupancy")
    kind = get(fields[0], "type")
    if _NAMES.get(kind, kind) not in (_UINT8, _INT8):
        raise ValueError(f"values of type {kind}, not bytes")
    data = get(message, "data") or b""
    raw = np.frombuffer(b64decode(data, validate=True) if isinstance(data, str) else bytes(data), dtype=np.uint8)
    size = get(message, "cell_size")
    side, other = (0.0, 0.0) if size is None else (float(get(size, axis) or 0.0) for axis in "xy")
    if not (isfinite(side) and side > 0.0 and abs(side - other) <= 1e-6 * side):
        raise ValueError(f"cells of {side:g} x {other:g} m, not squares")
    columns, stride, step, offset = (
        _count(value)
        for value in (
            get(message, "column_count"),
            get(message, "row_stride"),
            get(message, "cell_stride"),
            get(fields[0], "offset"),
        )
    )
    if columns < 1 or step < offset + 1 or stride < columns * step or len(raw) < stride or len(raw) > _MOST_CELLS:
        raise ValueError(f"{columns} columns, rows of {stride} bytes and cells of {step} in {len(raw)} bytes")
    rows = len(raw) // stride
    cells = raw[: rows * stride].reshape(rows, stride)[:, offset : offset + columns * step : step].astype(np.int16)
    cells = np.where(cells == 255, -1, cells)
    if cells.max() > 100:
        raise ValueError(f"values up to {cells.max()}, not occupancies of 0 to 100")
    return OccupancyGrid(np.ascontiguousarray(cells, dtype=np.int8), float(str(np.float32(side))), origin)


def _count(value: Any) -> int:
    if value is None:
        return 0
    if type(value) is not int or not 0 <= value < 1 << 31:
        raise TypeError("a count that is no whole number")
    return value
