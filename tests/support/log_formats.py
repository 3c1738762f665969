"""The same recording in other formats: MCAP of ROS 1, JSON and protobuf messages, ROS 1 and ROS 2 bags, in parts.

All start from an MCAP of ROS 2 messages. What Foxglove has no message for (maps) stays as it is.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hsloc.log.messages import decode, definitions, encode
from hsloc.model import IDENTITY

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from mcap.records import Channel, Schema

    from hsloc.model import Pose2

SECOND = 1_000_000_000
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", definitions.TF_MESSAGE))
ROS2 = get_typestore(Stores.ROS2_HUMBLE)

Message = tuple["Schema", "Channel", int, bytes]


def messages(source: Path) -> Iterator[Message]:
    """All messages of an MCAP in the order of time."""
    with source.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            yield schema, channel, message.log_time, message.data


def write(
    target: Path, items: Iterable[Message], metadata: Path | None = None, profile: str = "ros2", **options: Any
) -> Path:
    """Messages to an MCAP; its metadata records are those of another."""
    with target.open("wb") as stream:
        log = Writer(stream, **options)
        log.start(profile=profile, library="test")
        schemas: dict[tuple[str, str], int] = {}
        channels: dict[tuple[str, str], int] = {}
        for schema, channel, log_time, data in items:
            kind, name = (schema.name, schema.encoding), (channel.topic, channel.message_encoding)
            if kind not in schemas:
                schemas[kind] = log.register_schema(schema.name, schema.encoding, schema.data)
            if name not in channels:
                channels[name] = log.register_channel(channel.topic, channel.message_encoding, schemas[kind])
            log.add_message(channels[name], log_time, data, log_time)
        if metadata is not None:
            with metadata.open("rb") as other:
                for record in make_reader(other).iter_metadata():
                    log.add_metadata(record.name, record.metadata)
        log.finish()  # type: ignore[no-untyped-call]
    return target


def cut(source: Path, target: Path, seconds: float) -> Path:
    """The first seconds of an MCAP."""
    start = next(messages(source))[2]
    return write(target, (m for m in messages(source) if m[2] < start + seconds * SECOND), source)


def split(source: Path, folder: Path, parts: int) -> Path:
    """An MCAP in parts of about the same length, in a folder."""
    everything = list(messages(source))
    folder.mkdir()
    size = -(-len(everything) // parts)
    for number in range(parts):
        write(folder / f"run_{number}.mcap", everything[number * size : (number + 1) * size], source)
    return folder


# ROS.


def to_ros1(message: Any) -> Any:
    """ROS 1's headers have a sequence number, and its frames a slash."""
    if hasattr(message, "header"):
        header = message.header
        message.header = ROS1.types["std_msgs/msg/Header"](seq=0, stamp=header.stamp, frame_id="/" + header.frame_id)
    for part in getattr(message, "transforms", ()):
        to_ros1(part)
    return message


def ros1_mcap(source: Path, target: Path) -> Path:
    """As MCAP of ROS 1 messages."""

    def items() -> Iterator[Message]:
        for schema, channel, log_time, data in messages(source):
            name = schema.name
            raw = ROS1.serialize_ros1(to_ros1(ROS2.deserialize_cdr(data, name)), name)
            text, _ = ROS1.generate_msgdef(name)
            schema.name, schema.encoding, schema.data = definitions.short_name(name), "ros1msg", text.encode()
            channel.message_encoding = "ros1"
            yield schema, channel, log_time, bytes(raw)
            schema.name = name

    return write(target, items(), source)


def bag1(source: Path, target: Path, chunk_bytes: int = 1 << 20, compression: str = "LZ4") -> Path:
    """As a ROS 1 bag, compressed with `LZ4` or `BZ2`, or not."""
    bag = Writer1(target)
    bag.chunk_threshold = chunk_bytes
    if compression:
        bag.set_compression(Writer1.CompressionFormat[compression])
    with AnyReader([source]) as reader, bag as writer:
        connections: dict[str, Any] = {}
        for connection, log_time, raw in reader.messages():
            name = connection.msgtype
            if connection.topic not in connections:
                connections[connection.topic] = writer.add_connection(connection.topic, name, typestore=ROS1)
            message = to_ros1(reader.deserialize(raw, name))
            writer.write(connections[connection.topic], log_time, ROS1.serialize_ros1(message, name))
    return target


def bag2(source: Path, target: Path, compression: str = "", storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    """As a folder with a ROS 2 bag in SQLite, compressed as `FILE` or `MESSAGE`, or not."""
    bag = Writer2(target, version=8, storage_plugin=storage)
    if compression:
        bag.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with AnyReader([source]) as reader, bag as writer:
        connections: dict[str, Any] = {}
        for connection, log_time, raw in reader.messages():
            if connection.topic not in connections:
                connections[connection.topic] = writer.add_connection(
                    connection.topic, connection.msgtype, typestore=ROS2
                )
            writer.write(connections[connection.topic], log_time, raw)
    return target


# Foxglove: messages as dictionaries, which are JSON or become protobuf.


def _time(stamp_ns: int) -> dict[str, int]:
    return {"sec": stamp_ns // SECOND, "nsec": stamp_ns % SECOND}


def _vector(values: tuple[float, ...], names: str = "xyz") -> dict[str, float]:
    return dict(zip(names, values, strict=True))


def _pose(x: float, y: float, rotation: tuple[float, ...]) -> dict[str, Any]:
    return {"position": _vector((x, y, 0.0)), "orientation": _vector(rotation, "xyzw")}


def to_foxglove(typename: str, data: bytes) -> tuple[str, dict[str, Any]] | None:
    """(type, content) of the equivalent message, if there is one."""
    if typename == definitions.LASER_SCAN:
        scan = decode.laser_scan(data)
        return "foxglove.LaserScan", {
            "timestamp": _time(scan.stamp_ns),
            "frame_id": scan.frame_id,
            "start_angle": scan.angle_min,
            "end_angle": scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1),
            "ranges": [float(value) for value in scan.ranges],
            "intensities": [] if scan.intensities is None else [float(value) for value in scan.intensities],
        }
    if typename == definitions.ODOMETRY:
        message: Any = ROS2.deserialize_cdr(data, typename)
        p, q = message.pose.pose.position, message.pose.pose.orientation
        content = {"frame_id": message.header.frame_id, "pose": _pose(p.x, p.y, (q.x, q.y, q.z, q.w))}
        return "foxglove.PoseInFrame", {"timestamp": _time(decode.odometry(data).stamp_ns), **content}
    if typename == definitions.TF_MESSAGE:
        links = [
            {
                "timestamp": _time(link.stamp_ns),
                "parent_frame_id": link.parent,
                "child_frame_id": link.child,
                "translation": _vector(link.transform.translation),
                "rotation": _vector(link.transform.rotation, "xyzw"),
            }
            for link in decode.transforms(data)
        ]
        return "foxglove.FrameTransforms", {"transforms": links}
    return None


def foxglove_mcap(source: Path, target: Path, encoding: str, single_transforms: bool = False) -> Path:
    """As MCAP of Foxglove's messages in `json` or `protobuf`; each transform on its own, or all in one."""

    def items() -> Iterator[Message]:
        for schema, channel, log_time, data in messages(source):
            found = to_foxglove(schema.name, data)
            if found is None:
                yield schema, channel, log_time, data
                continue
            parts = [found]
            if single_transforms and found[0] == "foxglove.FrameTransforms":
                parts = [("foxglove.FrameTransform", link) for link in found[1]["transforms"]]
            for name, content in parts:
                text, encoded = (
                    (b'{"type": "object"}', json.dumps(content).encode())
                    if encoding == "json"
                    else (DESCRIPTORS.SerializeToString(), to_protobuf(name, content).SerializeToString())
                )
                kept = schema.name, schema.encoding, schema.data, channel.message_encoding
                schema.name, schema.encoding, schema.data = name, {"json": "jsonschema"}.get(encoding, encoding), text
                channel.message_encoding = encoding
                yield schema, channel, log_time, encoded
                schema.name, schema.encoding, schema.data, channel.message_encoding = kept

    return write(target, items(), source)


DOUBLE, INT32, FIXED32, STRING, MESSAGE, BYTES = 1, 5, 7, 9, 11, 12
FIELDS: dict[str, list[tuple[str, int, str | int, bool]]] = {
    "Vector3": [(name, n + 1, DOUBLE, False) for n, name in enumerate("xyz")],
    "Quaternion": [(name, n + 1, DOUBLE, False) for n, name in enumerate("xyzw")],
    "Pose": [("position", 1, "foxglove.Vector3", False), ("orientation", 2, "foxglove.Quaternion", False)],
    "LaserScan": [
        ("timestamp", 1, "google.protobuf.Timestamp", False),
        ("frame_id", 2, STRING, False),
        ("pose", 3, "foxglove.Pose", False),
        ("start_angle", 4, DOUBLE, False),
        ("end_angle", 5, DOUBLE, False),
        ("ranges", 6, DOUBLE, True),
        ("intensities", 7, DOUBLE, True),
    ],
    "FrameTransform": [
        ("timestamp", 1, "google.protobuf.Timestamp", False),
        ("parent_frame_id", 2, STRING, False),
        ("child_frame_id", 3, STRING, False),
        ("translation", 4, "foxglove.Vector3", False),
        ("rotation", 5, "foxglove.Quaternion", False),
    ],
    "FrameTransforms": [("transforms", 1, "foxglove.FrameTransform", True)],
    "Vector2": [(name, n + 1, DOUBLE, False) for n, name in enumerate("xy")],
    # Its type is an enumeration, which is an int32 on the wire.
    "PackedElementField": [("name", 1, STRING, False), ("offset", 2, FIXED32, False), ("type", 3, INT32, False)],
    "Grid": [
        ("timestamp", 1, "google.protobuf.Timestamp", False),
        ("frame_id", 2, STRING, False),
        ("pose", 3, "foxglove.Pose", False),
        ("column_count", 4, FIXED32, False),
        ("cell_size", 5, "foxglove.Vector2", False),
        ("row_stride", 6, FIXED32, False),
        ("cell_stride", 7, FIXED32, False),
        ("fields", 8, "foxglove.PackedElementField", True),
        ("data", 9, BYTES, False),
    ],
    "PoseInFrame": [
        ("timestamp", 1, "google.protobuf.Timestamp", False),
        ("frame_id", 2, STRING, False),
        ("pose", 3, "foxglove.Pose", False),
    ],
}
"""(name, number, type, repeated) of each field, as in Foxglove's published .proto files."""


def descriptors() -> descriptor_pb2.FileDescriptorSet:
    """The definitions as a recorder embeds them; the file that is imported stands behind the one that imports."""
    file = descriptor_pb2.FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    for name, fields in FIELDS.items():
        message = file.message_type.add(name=name)
        for field, number, kind, repeated in fields:
            item = message.field.add(name=field, number=number, label=3 if repeated else 1)
            item.type = MESSAGE if isinstance(kind, str) else kind
            if isinstance(kind, str):
                item.type_name = f".{kind}"
    timestamp = descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    return descriptor_pb2.FileDescriptorSet(file=[file, timestamp])


DESCRIPTORS = descriptors()
_POOL = descriptor_pool.DescriptorPool()
for _file in reversed(DESCRIPTORS.file):
    _POOL.AddSerializedFile(_file.SerializeToString())


def to_protobuf(name: str, content: dict[str, Any]) -> Any:
    """A message of the type with the content."""
    message = message_factory.GetMessageClass(_POOL.FindMessageTypeByName(name))()
    _fill(message, content)
    return message


def _fill(message: Any, content: dict[str, Any]) -> None:
    for key, value in content.items():
        if key == "timestamp":
            message.timestamp.seconds, message.timestamp.nanos = value["sec"], value["nsec"]
        elif isinstance(value, dict):
            getattr(message, key).SetInParent()
            _fill(getattr(message, key), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for part in value:
                _fill(getattr(message, key).add(), part)
        elif isinstance(value, list):
            getattr(message, key).extend(value)
        else:
            setattr(message, key, value)


def with_motions(target: Path, source: Path, change: Callable[[int, Pose2], Pose2]) -> Path:
    """A simulated log whose odometry counts otherwise: `change` gets number and motion from message to message."""
    last, now = IDENTITY, IDENTITY

    def changed(number: int, pose: Pose2) -> Pose2:
        nonlocal last, now
        now, last = now @ change(number, last.between(pose)), pose
        return now

    return with_odometry(target, source, changed)


def with_odometry(target: Path, source: Path, change: Callable[[int, Pose2], Pose2 | None]) -> Path:
    """A simulated log with other odometry: `change` gets number and pose of a message; None is no rotation."""

    def items() -> list[Message]:
        found, number = [], 0
        for schema, channel, log_time, data in messages(source):
            if channel.topic == "/tf":
                continue
            if schema.name == definitions.ODOMETRY and channel.topic == "/odom":
                message = decode.odometry(data)
                pose = change(number, message.pose)
                number += 1
                kept = message.pose if pose is None else pose
                data = encode.odometry(message.stamp_ns, kept, None, (0.0, 0.0, 0.0), ("odom", "base_link"))
                if pose is None:
                    at = len(data) - 680
                    data = data[: at + 24] + bytes(32) + data[at + 56 :]
            found.append((schema, channel, log_time, data))
        return found

    return write(target, items(), source)
