"""Logs for tests, whole and broken."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from hsloc.log.messages import definitions, encode
from hsloc.log.writer import LogWriter
from hsloc.model import Odometry, Pose2, Scan, Truth

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from hsloc.model import Event

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
MOUNTING = Pose2(0.2, 0.0, 0.5)


def make_scan(stamp_ns: int, number: int = 0, beams: int = 8, frame: str = "laser") -> Scan:
    """A scan that is identified by its first range."""
    ranges = np.full(beams, 2.0, dtype=np.float32)
    ranges[0] = 1.0 + number / 1000.0
    return Scan(stamp_ns, ranges, -1.0, 0.25, 0.05, 12.0, frame_id=frame)


def write_run(
    path: Path,
    scans: int = 40,
    chunk_size: int = 1000,
    mounting: Pose2 | None = MOUNTING,
    truth: bool = False,
    first: int = 0,
) -> Path:
    """A log of `scans` scans at 10 Hz, each 10 ms after an odometry message, which are at 20 Hz."""
    with LogWriter(path, chunk_size=chunk_size) as log:
        if mounting is not None:
            log.transforms(START, [("base_link", "laser", mounting)], static=True)
        for number in range(first, first + scans):
            stamp = START + number * SECOND // 10
            for half in (0, SECOND // 20):
                pose = Pose2((stamp + half - START) / SECOND, 0.0, 0.0)
                log.odometry(stamp + half, pose, covariance=np.diag((0.1, 0.2, 0.3)))
                log.transforms(stamp + half, [("odom", "base_link", pose)])
                if half == 0:
                    log.scan(make_scan(stamp + SECOND // 100, number))
            if truth:
                log.odometry(stamp, Pose2(float(number), 1.0, 0.0), topic="/ground_truth", frame_id="map")
    return path


def write_events(path: Path, events: Sequence[Event]) -> Path:
    """A log of the scans and the odometry among these, with the mounting of the first scan; without truth."""
    first = next(event for event in events if isinstance(event, Scan))
    with LogWriter(path) as log:
        log.transforms(events[0].stamp_ns, [("base_link", first.frame_id, first.T_base_laser)], static=True)
        for event in events:
            if isinstance(event, Odometry):
                log.odometry(event.stamp_ns, event.T_odom_base)
            elif isinstance(event, Scan):
                log.scan(event, log_time_ns=event.stamp_ns)
    return path


def write_raw(
    path: Path,
    messages: Iterable[tuple[str, int, bytes]],
    *,
    schema: tuple[str, str, bytes] | None = None,
    encoding: str = "cdr",
    profile: str = "ros2",
    chunk_size: int = 1000,
    **writer: Any,
) -> Path:
    """(topic, log time, payload) as MCAP with any schema; LaserScan of ROS 2 by default."""
    name, form, text = schema or (
        definitions.LASER_SCAN,
        "ros2msg",
        definitions.definition_text(definitions.LASER_SCAN).encode(),
    )
    options: dict[str, Any] = {"compression": CompressionType.ZSTD, "index_types": IndexType.ALL} | writer
    with path.open("wb") as stream:
        log = Writer(stream, chunk_size=chunk_size, **options)
        log.start(profile=profile, library="test")
        number = log.register_schema(name, form, text) if form else 0
        channels: dict[str, int] = {}
        for topic, log_time, data in messages:
            if topic not in channels:
                channels[topic] = log.register_channel(topic, encoding, number)
            log.add_message(channels[topic], log_time, data, log_time)
        log.finish()  # type: ignore[no-untyped-call]
    return path


def scan_payloads(count: int, topic: str = "/scan") -> list[tuple[str, int, bytes]]:
    """Scans at 10 Hz as (topic, log time, payload)."""
    return [
        (topic, stamp, encode.laser_scan(make_scan(stamp, number), "laser", 0.1))
        for number in range(count)
        for stamp in [START + number * SECOND // 10]
    ]


def chunks_of(data: bytes) -> list[tuple[int, int]]:
    """(offset, length with prefix) of each chunk record of an MCAP."""
    found, at = [], 8
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 0x06:
            found.append((at, 9 + length))
        at += 9 + length
        if opcode == 0x02:
            break
    return found


def chunk_data_at(data: bytes, chunk: tuple[int, int]) -> int:
    """Where the compressed bytes of a chunk start."""
    at = chunk[0] + 9 + 28
    (name,) = struct.unpack_from("<I", data, at)
    return int(at + 4 + name + 8)


def flipped(data: bytes, at: int) -> bytes:
    """One byte inverted."""
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


def describe(event: Event) -> tuple[str, int, float]:
    """(kind, stamp, a number that identifies events of a kind)."""
    if isinstance(event, Scan):
        return "scan", event.stamp_ns, round(float(event.ranges[0]), 4)
    if isinstance(event, Odometry):
        return "odometry", event.stamp_ns, event.T_odom_base.x
    assert isinstance(event, Truth)
    return "truth", event.stamp_ns, event.T_map_base.x
