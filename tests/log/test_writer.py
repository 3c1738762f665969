"""The writer against rosbags: what we encode by hand is what the reference serialiser writes."""

from __future__ import annotations

import errno
from dataclasses import replace
from math import inf, nan, pi
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from hsloc.errors import OutputError
from hsloc.log.messages import definitions, encode
from hsloc.log.transforms import Transform3
from hsloc.log.writer import LogWriter
from hsloc.model import OccupancyGrid, Pose2, Scan, Trajectory

if TYPE_CHECKING:
    from pathlib import Path

STAMP = 1_663_967_375_548_411_329
STORE = get_typestore(Stores.ROS2_HUMBLE)


def make_scan(beams: int = 5, intensities: bool = False) -> Scan:
    ranges = np.linspace(0.1, 9.9, beams).astype(np.float32)
    if beams > 3:
        ranges[1:4] = inf, nan, -inf
    extra = np.arange(beams, dtype=np.float32) if intensities else None
    return Scan(STAMP, ranges, -1.5, 0.01, 0.05, 12.0, 1e-4, frame_id="laser_link", intensities=extra)


@pytest.mark.parametrize("name", definitions.KNOWN_TYPES)
def test_definitions_are_those_rosbags_generates(name: str) -> None:
    assert definitions.definition_text(name) == STORE.generate_msgdef(name, ros_version=2)[0]


def reencoded(data: bytes, name: str) -> bytes:
    """Through the reference decoder and encoder: equal only if every byte, also of padding, is right."""
    return bytes(STORE.serialize_cdr(STORE.deserialize_cdr(data, name), name, little_endian=True))


MARKERS = [
    encode.Marker("accepted", np.arange(8.0).reshape(4, 2), (0.0, 0.5, 1.0, 0.25), 0.05),
    encode.Marker("reason", np.array([[1.5, -2.0]]), (1.0, 0.0, 0.0, 1.0), 0.3, "poses_lost: \u00e4"),
    encode.Marker("none", np.zeros((0, 2)), (0.0, 0.0, 0.0, 1.0), 0.1),
]
FRAMES = ["", "m", "ab", "map", "odom", "frame", "laser_", "base_lk", "base_link", "a/long/frame/name"]


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("child", ["", "base", "base_link", "b_link"])
def test_bytes_equal_the_reference_for_every_alignment(frame: str, child: str) -> None:
    pose, cov = Pose2(1.25, -2.5, 3.0), np.arange(9.0).reshape(3, 3)
    tilted = Transform3((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
    trajectory = Trajectory.from_pairs([(STAMP, pose), (STAMP + 1, Pose2(0, 0, -1.0)), (5, Pose2())])
    grid = OccupancyGrid(np.arange(-1, 14, dtype=np.int8).reshape(3, 5), 0.05, Pose2(-1, -2, 0.5))
    for data, name in [
        (encode.laser_scan(make_scan(), frame, 0.1), definitions.LASER_SCAN),
        (encode.laser_scan(make_scan(4, intensities=True), frame, 0.1), definitions.LASER_SCAN),
        (encode.laser_scan(make_scan(0), frame, 0.1), definitions.LASER_SCAN),
        (encode.log_message(STAMP, 30, child, frame), definitions.LOG),
        (encode.float64(-0.25), definitions.FLOAT64),
        (encode.string(frame), definitions.STRING),
        (encode.marker_array(STAMP, [], frame), definitions.MARKER_ARRAY),
        (encode.marker_array(STAMP, MARKERS + MARKERS[::-1], frame), definitions.MARKER_ARRAY),
        (
            encode.marker_array(STAMP, [replace(each, namespace=child) for each in MARKERS], frame),
            definitions.MARKER_ARRAY,
        ),
        (encode.odometry(STAMP, pose, cov, (1, 2, 3), (frame, child)), definitions.ODOMETRY),
        (encode.transforms(STAMP, [(frame, child, pose), (child, frame, tilted)]), definitions.TF_MESSAGE),
        (encode.transforms(STAMP, []), definitions.TF_MESSAGE),
        (encode.occupancy_grid(grid, STAMP, frame), definitions.OCCUPANCY_GRID),
        (encode.pose_stamped(STAMP, pose, frame), definitions.POSE_STAMPED),
        (
            encode.pose_with_covariance_stamped(STAMP, pose, cov, frame),
            definitions.POSE_WITH_COVARIANCE_STAMPED,
        ),
        (encode.path(STAMP, trajectory, frame), definitions.PATH),
    ]:
        assert reencoded(data, name) == data, name


def write_everything(path: Path) -> None:
    scan = make_scan()
    with LogWriter(path, chunk_size=300) as log:
        log.metadata("hsloc.recorder", {"seed": "1", "scenario": "office"})
        log.transforms(STAMP, [("base_link", "laser_link", Pose2(0.2, 0, pi / 2))], static=True)
        log.occupancy_grid(OccupancyGrid(np.zeros((2, 3), np.int8), 0.05), STAMP)
        for step in range(5):
            stamp = STAMP + step * 100_000_000
            log.odometry(stamp, Pose2(step, 0, 0.1), covariance=np.diag((0.1, 0.2, 0.3)), twist=(1, 0, 0.5))
            log.transforms(stamp, [("odom", "base_link", Pose2(step, 0, 0.1))])
            log.scan(scan, log_time_ns=stamp)
            log.pose(stamp, Pose2(step, 0, 0.1))
            log.pose_with_covariance(stamp, Pose2(step, 0, 0.1), np.eye(3))
        log.path(STAMP, Trajectory.from_pairs([(STAMP, Pose2(1, 2, 3))]))
        log.attachment("config.yaml", b"seed: 1\n", "application/yaml")


def test_rosbags_reads_what_was_written(tmp_path: Path) -> None:
    write_everything(tmp_path / "log.mcap")
    with AnyReader([tmp_path / "log.mcap"]) as reader:
        messages: list[tuple[str, int, Any]] = [
            (c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()
        ]
    assert len(messages) == 2 + 5 * 5 + 1
    odometry = [m for topic, _, m in messages if topic == "/odom"]
    assert [m.pose.pose.position.x for m in odometry] == [0, 1, 2, 3, 4]
    assert odometry[0].pose.covariance[[0, 7, 35]] == pytest.approx((0.1, 0.2, 0.3))
    assert odometry[0].twist.twist.linear.x == 1
    assert odometry[0].twist.twist.angular.z == 0.5
    assert odometry[0].child_frame_id == "base_link"
    (scan_time, scan), *_ = ((t, m) for topic, t, m in messages if topic == "/scan")
    np.testing.assert_array_equal(scan.ranges, make_scan().ranges)
    assert scan.angle_max == pytest.approx(-1.5 + 4 * 0.01)
    assert scan.header.stamp.sec * 10**9 + scan.header.stamp.nanosec == STAMP == scan_time


def test_mcap_finds_index_statistics_and_valid_crcs(tmp_path: Path) -> None:
    write_everything(tmp_path / "log.mcap")
    with (tmp_path / "log.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 28 == len(list(reader.iter_messages()))
        assert len(summary.chunk_indexes) > 3
        assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
        assert reader.get_header().profile == "ros2"
        assert reader.get_header().library == "hsloc"
        (metadata,) = reader.iter_metadata()
        assert metadata.metadata == {"seed": "1", "scenario": "office"}
        (attachment,) = reader.iter_attachments()
        assert (attachment.data, attachment.media_type) == (b"seed: 1\n", "application/yaml")


def test_same_calls_same_bytes(tmp_path: Path) -> None:
    write_everything(tmp_path / "a.mcap")
    write_everything(tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_an_exception_leaves_nothing_behind_and_an_old_file_untouched(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"old")

    def interrupted() -> None:
        with LogWriter(path) as log:
            log.pose(0, Pose2())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [p.name for p in tmp_path.iterdir()] == ["log.mcap"]
    assert path.read_bytes() == b"old"


def test_a_missing_folder_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"log[.]mcap: cannot be written"):
        LogWriter(tmp_path / "missing" / "log.mcap")
    with pytest.raises(OutputError, match="is a folder"):
        LogWriter(tmp_path)


def test_a_full_disk_is_an_output_error_and_leaves_nothing(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "log.mcap", chunk_size=100)

    def full(data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    log._writer._Writer__stream = type("Full", (), {"write": staticmethod(full), "tell": lambda self: 0})()  # type: ignore[attr-defined]

    def write() -> None:
        with log:
            for step in range(1000):
                log.pose(step, Pose2())

    with pytest.raises(OutputError, match=r"log[.]mcap: cannot be written \(No space left"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_times_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        with pytest.raises(OutputError, match="does not fit ROS time"):
            log.pose(2**62, Pose2())
        with pytest.raises(OutputError, match="does not fit MCAP"):
            log.pose(-1, Pose2())
        log.pose(-1, Pose2(), log_time_ns=0)
