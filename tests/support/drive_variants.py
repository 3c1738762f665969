"""Variants of one recorded drive, each wrong in the way of a public report: what `benchmarks/reported_logs.py` runs.

The drive is `plain.mcap` of the folder of cases. Each function returns the arguments of a command, the log first.
"""

from __future__ import annotations

import copy
import json
import shutil
import sqlite3
import tarfile
import zipfile
from typing import TYPE_CHECKING, Any

import log_formats
import numpy as np
from log_formats import ROS2, SECOND
from mcap.records import Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Edit = Callable[[str, Any, int], "list[tuple[str, Any, int]] | None"]
    """From topic, message and log time to messages in its place; None leaves it, as it was changed."""

SCAN, ODOM = "/scan", "/odom"


class Cases:
    """The folder of cases, and a folder for what is made of it."""

    def __init__(self, cases: Path, folder: Path) -> None:
        self.cases = cases
        self.folder = folder
        self.plain = cases / "plain.mcap"
        self.start = next(log_formats.messages(self.plain))[2]

    def rewritten(self, name: str, edit: Edit, source: Path | None = None) -> Path:
        """A log whose messages an edit changed, in their order."""
        schemas: dict[str, Schema] = {}
        items = []
        for schema, channel, log_time, data in log_formats.messages(source or self.plain):
            message: Any = ROS2.deserialize_cdr(data, schema.name)
            edited = edit(channel.topic, message, log_time)
            for topic, each, at in [(channel.topic, message, log_time)] if edited is None else edited:
                kind = each.__msgtype__
                if kind not in schemas:
                    schemas[kind] = Schema(0, ROS2.generate_msgdef(kind, ros_version=2)[0].encode(), "ros2msg", kind)
                payload = bytes(ROS2.serialize_cdr(each, kind))
                items.append((schemas[kind], Channel(0, topic, "cdr", {}, 0), at, payload))
        return log_formats.write(self.folder / name, items, self.plain)

    def scans(self, name: str, change: Callable[[Any], None], source: Path | None = None) -> Path:
        """A log whose scans were changed."""

        def edit(topic: str, message: Any, log_time: int) -> None:
            if topic == SCAN:
                change(message)

        return self.rewritten(name, edit, source)

    def raw(self, name: str, change: Callable[[Schema, Channel, int, bytes], log_formats.Message]) -> Path:
        """A log whose records were changed."""
        items = [change(*item) for item in log_formats.messages(self.plain)]
        return log_formats.write(self.folder / name, items, self.plain)


def moved(message: Any, seconds: float) -> None:
    """Add to a message's stamp, and to those of its transforms."""
    for each in (message, *getattr(message, "transforms", ())):
        if hasattr(each, "header"):
            stamp = each.header.stamp
            value = stamp.sec * SECOND + stamp.nanosec + round(seconds * SECOND)
            each.header.stamp = type(stamp)(sec=value // SECOND, nanosec=value % SECOND)


def turned(message: Any, z: Callable[[float], float], w: Callable[[float], float]) -> None:
    """Replace the quaternion of an odometry message by functions of half its heading."""
    old = message.pose.pose.orientation
    half = float(np.arctan2(old.z, old.w))
    message.pose.pose.orientation = type(old)(x=0.0, y=0.0, z=z(half), w=w(half))


def packed_wal(own: Cases) -> list[str]:
    """A zip of a folder with a database whose newest messages are in its write-ahead log."""
    folder = log_formats.bag2(own.plain, own.folder / "wal")
    (database,) = folder.glob("*.db3")
    live = sqlite3.connect(own.folder / "live.db3")
    with sqlite3.connect(database) as source:
        source.backup(live)
    live.executescript("PRAGMA journal_mode=WAL; PRAGMA wal_autocheckpoint=0;")
    newest = "FROM messages WHERE timestamp > ?"
    limit = (own.start + 10 * SECOND,)
    rows = live.execute(f"SELECT topic_id, timestamp, data {newest}", limit).fetchall()
    live.execute(f"DELETE {newest}", limit)
    live.commit()
    live.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    live.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    live.commit()
    target = own.folder / "copied.zip"
    with zipfile.ZipFile(target, "w") as archive:
        for file in own.folder.glob("live.db3*"):
            archive.write(file, f"bag/{file.name}")
    return [str(target)]


def of_bag(own: Cases, name: str, compression: str = "") -> Path:
    """A folder with a bag of SQLite."""
    return log_formats.bag2(own.plain, own.folder / name, compression)


def one_message_file(own: Cases) -> list[str]:
    """The database of a bag whose messages are compressed, away from its folder and metadata."""
    (file,) = of_bag(own, "messages", "MESSAGE").glob("*.db3*")
    return [str(shutil.copy(file, own.folder / "alone"))]


def packed_folder(own: Cases) -> list[str]:
    """A tar with xz of a folder with a compressed database, two folders deep."""
    target = own.folder / "bag.tar.xz"
    with tarfile.open(target, "w:xz") as archive:
        archive.add(of_bag(own, "files", "FILE"), "runs/today")
    return [str(target)]


def damaged_bag(own: Cases) -> list[str]:
    """A ROS 1 bag called .mcap with a damaged chunk in the middle."""
    data = bytearray(log_formats.bag1(own.plain, own.folder / "whole.bag", 1 << 16).read_bytes())
    data[len(data) // 2 : len(data) // 2 + 500] = b"\x55" * 500
    (own.folder / "bag.mcap").write_bytes(data)
    return [str(own.folder / "bag.mcap")]


def bad_log_times(own: Cases) -> list[str]:
    """A database with times at the end of 64 bits, and before 1970."""
    (file,) = of_bag(own, "times").glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET timestamp = 9223372036854775807 WHERE id IN (400, 900, 1500)")
        database.execute("UPDATE messages SET timestamp = -5 WHERE id IN (410, 910)")
    return [str(file)]


def definition_without_parts(own: Cases) -> list[str]:
    """Definitions that end where their parts should follow."""

    def cut(schema: Schema, channel: Channel, at: int, data: bytes) -> log_formats.Message:
        return Schema(0, schema.data.split(b"=" * 80)[0], schema.encoding, schema.name), channel, at, data

    return [str(own.raw("parts.mcap", cut))]


def ros1_json(own: Cases) -> list[str]:
    """JSON with ROS 1's names of types and times."""

    def plain(value: Any) -> Any:
        if hasattr(value, "__dataclass_fields__"):
            found = {k: plain(getattr(value, k)) for k in value.__dataclass_fields__ if k != "__msgtype__"}
            return {"secs": found["sec"], "nsecs": found["nanosec"]} if set(found) == {"sec", "nanosec"} else found
        if isinstance(value, list | np.ndarray):
            return [plain(each) for each in value]
        if isinstance(value, float | np.floating):
            return float(value) if np.isfinite(value) else None
        return value.item() if isinstance(value, np.generic) else value

    def text(schema: Schema, channel: Channel, at: int, data: bytes) -> log_formats.Message:
        name = schema.name.replace("/msg/", "/")
        content = json.dumps(plain(ROS2.deserialize_cdr(data, schema.name))).encode()
        return Schema(0, b"", "jsonschema", name), Channel(0, channel.topic, "json", {}, 0), at, content

    return [str(own.raw("json.mcap", text))]


def parameter_list(own: Cases) -> list[str]:
    """Headers that say PL_CDR2."""
    return [str(own.raw("pl.mcap", lambda s, c, t, data: (s, c, t, b"\0\x0b\0\0" + data[4:])))]


def odd_names(own: Cases) -> list[str]:
    """A database with `?`, `&` and `=` in its name, in a folder with `#` and `%`."""
    folder = own.folder / "a #2 100%41"
    folder.mkdir()
    (file,) = of_bag(own, "odd").glob("*.db3")
    return [str(shutil.copy(file, folder / "a?b&c=1.db3"))]


def prefixed(own: Cases) -> list[str]:
    """Transforms alone, in a namespace of two names, with prefixes of frames."""

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]]:
        for each in (message, *getattr(message, "transforms", ())):
            for owner in (each, getattr(each, "header", None)):
                for name in ("frame_id", "child_frame_id"):
                    if hasattr(owner, name):
                        setattr(owner, name, "r7/" + getattr(owner, name))
        return [] if topic == ODOM else [("/fleet/r7" + topic, message, at)]

    return [str(own.rewritten("r7.mcap", edit))]


def frozen(own: Cases) -> list[str]:
    """Odometry that stands still from 12 s on."""
    kept: dict[str, Any] = {}

    def edit(topic: str, message: Any, at: int) -> None:
        if topic in (ODOM, "/tf"):
            value = message.pose if topic == ODOM else message.transforms[0].transform
            if at <= own.start + 12 * SECOND:
                kept[topic] = value
            elif topic == ODOM:
                message.pose = kept[topic]
            else:
                message.transforms[0].transform = kept[topic]

    return [str(own.rewritten("frozen.mcap", edit))]


def two_parents(own: Cases) -> list[str]:
    """The laser on two parents at different places."""

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]] | None:
        if topic != "/tf_static":
            return None
        other = copy.deepcopy(message)
        other.transforms = [copy.deepcopy(message.transforms[0]) for _ in range(2)]
        foot, laser = other.transforms
        foot.child_frame_id = laser.header.frame_id = "base_footprint"
        foot.transform.translation.x, laser.transform.translation.x = 0.0, -0.1
        return [(topic, message, at), (topic, other, at + 1)]

    return [str(own.rewritten("parents.mcap", edit))]


def rolling_map(own: Cases) -> list[str]:
    """A grid in the frame `map` that moves along with the robot."""
    kind = ROS2.types
    data = np.zeros(6400, np.int8)

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]] | None:
        if topic != SCAN or (at - own.start) % SECOND > SECOND // 20:
            return None
        point = kind["geometry_msgs/msg/Point"](x=(at - own.start) / SECOND / 2.0, y=0.0, z=0.0)
        turn = kind["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        origin = kind["geometry_msgs/msg/Pose"](position=point, orientation=turn)
        stamp = message.header.stamp
        info = kind["nav_msgs/msg/MapMetaData"](
            map_load_time=stamp, resolution=0.05, width=80, height=80, origin=origin
        )
        header = kind["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
        grid = kind["nav_msgs/msg/OccupancyGrid"](header=header, info=info, data=data)
        return [(topic, message, at), ("/window", grid, at)]

    return [str(own.rewritten("rolling.mcap", edit))]


def start_on_base(own: Cases) -> list[str]:
    """An initial pose in the frame of the base."""
    kind = ROS2.types

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]] | None:
        if topic != "/tf_static":
            return None
        zero = kind["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
        turn = kind["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        pose = kind["geometry_msgs/msg/PoseWithCovariance"](
            pose=kind["geometry_msgs/msg/Pose"](position=zero, orientation=turn), covariance=np.zeros(36)
        )
        header = kind["std_msgs/msg/Header"](stamp=message.transforms[0].header.stamp, frame_id="base_link")
        start = kind["geometry_msgs/msg/PoseWithCovarianceStamped"](header=header, pose=pose)
        return [(topic, message, at), ("/initialpose", start, at + 1)]

    return [str(own.rewritten("start.mcap", edit))]


def windows_path(own: Cases) -> list[str]:
    """A map whose image is named with a drive and backslashes."""
    text = (own.cases / "map/office.yaml").read_text().replace("office.pgm", r"'C:\maps\office.pgm'")
    (own.folder / "office.yaml").write_text(text)
    shutil.copy(own.cases / "map/office.pgm", own.folder / "office.pgm")
    return [str(own.plain), "--map", str(own.folder / "office.yaml")]


def quaternions(own: Cases, name: str, z: Callable[[float], float], w: Callable[[float], float]) -> list[str]:
    """Odometry with other quaternions, without transforms beside it."""

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]] | None:
        if topic == ODOM:
            turned(message, z, w)
        return [] if topic == "/tf" else None

    return [str(own.rewritten(f"{name}.mcap", edit))]


def late(own: Cases, name: str, topic: str, seconds: float, after_s: float = 0.0) -> list[str]:
    """Stamps of one topic, later by some seconds from a time on."""

    def edit(each: str, message: Any, at: int) -> None:
        if each == topic and at >= own.start + after_s * SECOND:
            moved(message, seconds)

    return [str(own.rewritten(f"{name}.mcap", edit))]


def big_endian_cloud(own: Cases) -> list[str]:
    """A cloud of four rings in big-endian doubles, with a ceiling and points that are none."""
    kind = ROS2.types

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]] | None:
        if topic != SCAN:
            return None
        ranges = np.asarray(message.ranges, dtype=float)
        angles = message.angle_min + np.arange(len(ranges)) * message.angle_increment
        rings = [(-0.3, ranges), (0.05, ranges), (0.4, ranges), (2.5, np.ones_like(ranges))]
        points = np.vstack(
            [np.column_stack((r * np.cos(angles), r * np.sin(angles), np.full(len(r), z))) for z, r in rings]
        )
        fields = [
            kind["sensor_msgs/msg/PointField"](name=name, offset=8 * k, datatype=8, count=1)
            for k, name in enumerate("xyz")
        ]
        data = np.frombuffer(points.astype(">f8").tobytes(), np.uint8)
        cloud = kind["sensor_msgs/msg/PointCloud2"](
            header=message.header, height=1, width=len(points), fields=fields, is_bigendian=True, point_step=24,
            row_step=24 * len(points), data=data, is_dense=False,
        )  # fmt: skip
        return [("/points", cloud, at)]

    return [str(own.rewritten("cloud.mcap", edit)), "--slice", "-0.1,0.3"]


def quarters(own: Cases) -> list[str]:
    """A turn in four messages of 90 degrees."""

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]] | None:
        if topic != SCAN:
            return None
        found = []
        for k in range(4):
            part = copy.deepcopy(message)
            part.ranges = message.ranges[90 * k : 90 * k + 90]
            part.intensities = message.intensities[90 * k : 90 * k + 90]
            part.angle_min = message.angle_min + 90 * k * message.angle_increment
            part.angle_max = part.angle_min + 89 * message.angle_increment
            part.time_increment = 0.1 / 360
            moved(part, 0.025 * k)
            found.append(("/quarters", part, at + k * SECOND // 40))
        return found

    return [str(own.rewritten("quarters.mcap", edit, own.cases / "S05-scan-time-thousandth/scan.mcap"))]


def three_echoes(own: Cases) -> list[str]:
    """/first, /last and /most_intense of one laser."""

    def edit(topic: str, message: Any, at: int) -> list[tuple[str, Any, int]] | None:
        if topic != SCAN:
            return None
        first = copy.deepcopy(message)
        first.ranges = np.where(np.arange(len(message.ranges)) % 9, message.ranges, 0.6 * message.ranges)
        first.ranges = first.ranges.astype(np.float32)
        return [("/first", first, at), ("/last", message, at), ("/most_intense", message, at)]

    return [str(own.rewritten("echoes.mcap", edit))]
