"""`open_log`: what users bring, what they get, and the message when it is not enough."""

from __future__ import annotations

import hashlib
from math import pi
from typing import TYPE_CHECKING

import numpy as np
import pytest
from log_builders import (
    MOUNTING,
    SECOND,
    START,
    chunk_data_at,
    chunks_of,
    describe,
    flipped,
    make_scan,
    scan_payloads,
    write_raw,
    write_run,
)
from paths import DATA

from hsloc.errors import LogError, LogFormatError, TopicError
from hsloc.log.reader import open_log
from hsloc.log.summary import Losses, ReadOptions
from hsloc.log.writer import LogWriter
from hsloc.model import OccupancyGrid, Odometry, Pose2, Scan
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

ALL = ReadOptions(require_scan=False, require_odometry=False)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run.mcap", truth=True)


def test_events_come_in_the_order_of_their_stamps(run: Path) -> None:
    log = open_log(run)
    events = [describe(event) for event in log.events()]
    stamps = [stamp for _, stamp, _ in events]
    assert stamps == sorted(stamps)
    assert [kind for kind, *_ in events[:4]] == ["odometry", "truth", "scan", "odometry"]
    assert {kind: sum(k == kind for k, *_ in events) for kind in ("odometry", "scan", "truth")} == {
        "odometry": 80,
        "scan": 40,
        "truth": 40,
    }
    assert [x for kind, _, x in events if kind == "scan"] == pytest.approx([1 + n / 1000 for n in range(40)], abs=1e-4)
    assert log.losses == Losses()
    assert events == [describe(event) for event in log.events()]


def test_the_summary_lists_what_is_there_and_what_is_taken(run: Path) -> None:
    summary = open_log(run).summary
    assert (summary.scan_topic, summary.odom_topic, summary.truth_topic) == ("/scan", "/odom", "/ground_truth")
    assert (summary.odom_frame, summary.base_frame, summary.laser_frame) == ("odom", "base_link", "laser")
    assert (summary.extrinsics, summary.order, summary.format, summary.profile) == (
        "/tf_static",
        "stamp",
        "mcap",
        "ros2",
    )
    np.testing.assert_allclose(summary.T_base_laser.to_array(), MOUNTING.to_array(), atol=1e-12)
    assert summary.origin_ns == START
    topics = {topic.topic: topic for topic in summary.topics}
    assert topics["/odom"].count == 80
    assert topics["/odom"].rate_hz == pytest.approx(20.0)
    assert topics["/scan"].largest_gap_s == pytest.approx(0.1)
    assert topics["/scan"].typename == "sensor_msgs/msg/LaserScan"
    assert summary.duration_s == pytest.approx(3.95)
    assert summary.warnings == ()


def test_the_mounting_is_on_every_scan(run: Path) -> None:
    for event in open_log(run).events():
        if isinstance(event, Scan):
            np.testing.assert_allclose(event.T_base_laser.to_array(), MOUNTING.to_array(), atol=1e-12)
    option = ReadOptions(laser_pose=Pose2(1, 2, 3))
    log = open_log(run, option)
    assert log.summary.extrinsics == "option"
    assert next(e for e in log.events() if isinstance(e, Scan)).T_base_laser == Pose2(1, 2, 3)


def test_the_window_is_half_open_and_counts_from_the_first_event(run: Path) -> None:
    def stamps(start: float | None, end: float | None) -> list[int]:
        events = open_log(run, ReadOptions(start_s=start, end_s=end)).events()
        return [event.stamp_ns - START for event in events]

    everything = stamps(None, None)
    assert stamps(1.0, 2.0) == [stamp for stamp in everything if SECOND <= stamp < 2 * SECOND]
    assert stamps(1.0, None) == [stamp for stamp in everything if stamp >= SECOND]
    assert stamps(None, 1.0) + stamps(1.0, None) == everything
    assert stamps(100.0, None) == []


def test_static_transforms_count_from_wherever_they_stand(tmp_path: Path) -> None:
    # The last message of the log, and the window starts late: both lose it with tools that play logs back.
    path = write_run(tmp_path / "a.mcap", mounting=None)
    with LogWriter(tmp_path / "b.mcap") as log:
        log.transforms(START + 100 * SECOND, [("base_link", "laser", MOUNTING)], static=True)
    log_read = open_log([path, tmp_path / "b.mcap"], ReadOptions(start_s=3.0))
    scan = next(event for event in log_read.events() if isinstance(event, Scan))
    np.testing.assert_allclose(scan.T_base_laser.to_array(), MOUNTING.to_array(), atol=1e-12)


def write_topics(path: Path, scans: list[str], odometry: list[str]) -> Path:
    with LogWriter(path) as log:
        log.pose(START, Pose2(), topic="/goal")
        for topic in odometry:
            log.odometry(START, Pose2(), topic=topic)
        for topic in scans:
            log.scan(make_scan(START), topic=topic)
    return path


def test_two_scan_topics_must_be_chosen_from(tmp_path: Path) -> None:
    path = write_topics(tmp_path / "log.mcap", ["/scan_rear", "/scan_front"], ["/odom"])
    with pytest.raises(
        TopicError, match=r"2 scan topics \(/scan_front, /scan_rear\); choose with --scan-topic /scan_f"
    ):
        open_log(path)
    assert open_log(path, ReadOptions(scan_topic="scan_rear")).summary.scan_topic == "/scan_rear"
    summary = open_log(path, ALL).summary
    assert summary.scan_topic is None
    assert summary.warnings[0].code == WarningCode.TOPIC_AMBIGUOUS
    assert "--scan-topic" in summary.warnings[0].remedy


def test_two_odometry_topics_must_be_chosen_from(tmp_path: Path) -> None:
    path = write_topics(tmp_path / "log.mcap", ["/scan"], ["/odom", "/odometry/filtered"])
    with pytest.raises(TopicError, match=r"2 odometry topics .*; choose with --odom-topic /odom"):
        open_log(path)
    log = open_log(path, ReadOptions(odom_topic="/odometry/filtered"))
    assert log.summary.odom_topic == "/odometry/filtered"


def test_no_scan_topic_lists_what_there_is(tmp_path: Path) -> None:
    path = write_topics(tmp_path / "log.mcap", [], ["/odom"])
    with pytest.raises(TopicError, match=r"no scan topic .*; the log holds /goal \(geometry_msgs/msg/PoseStamped\)"):
        open_log(path)
    assert len(list(open_log(path, ALL).events())) == 1


def test_no_odometry_is_an_error_unless_it_is_allowed(tmp_path: Path) -> None:
    path = write_topics(tmp_path / "log.mcap", ["/scan"], [])
    with pytest.raises(TopicError, match="no odometry topic"):
        open_log(path)
    log = open_log(path, ReadOptions(require_odometry=False))
    assert [type(event) for event in log.events()] == [Scan]
    assert any(warning.code == WarningCode.TOPIC_MISSING for warning in log.summary.warnings)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ReadOptions(scan_topic="/nope"), r"no topic /nope; --scan-topic may be /scan"),
        (ReadOptions(scan_topic="/odom"), r"/odom is nav_msgs/msg/Odometry \(cdr\), not sensor_msgs/msg/LaserScan"),
        (ReadOptions(odom_topic="/nope"), r"no topic /nope; --odom-topic may be /odom"),
        (ReadOptions(truth_topic="/nope"), r"no topic /nope to take as truth; --truth-topic may be .*/odom, tf"),
        (
            ReadOptions(time_offset="/nope=1,/scan=2"),
            r"no topic nope that --time-offset .* of this log /scan, /odom are",
        ),
    ],
)
def test_a_topic_that_is_not_there_is_named_with_those_that_are(
    tmp_path: Path, options: ReadOptions, message: str
) -> None:
    path = write_topics(tmp_path / "log.mcap", ["/scan"], ["/odom"])
    with pytest.raises(TopicError, match=message) as caught:
        open_log(path, options)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# What else a log may hold


def test_map_start_pose_and_metadata(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    cells = np.array([[0, 100, -1]], dtype=np.int8)
    with LogWriter(path) as log:
        log.metadata("hsloc.initial_pose", {"x": "1.5", "y": "-2", "theta": "0.25"})
        log.metadata("hsloc.recorder", {"seed": "7"})
        log.odometry(START, Pose2())
        log.scan(make_scan(START))
        log.occupancy_grid(OccupancyGrid(cells * 0, 0.1), START, topic="/local_costmap/costmap")
        log.occupancy_grid(OccupancyGrid(cells * 0, 0.05), START)
        log.occupancy_grid(OccupancyGrid(cells, 0.05, Pose2(1, 2, 0)), START + 1)
    read = open_log(path)
    grid = read.map()
    assert grid is not None
    np.testing.assert_array_equal(grid.cells, cells)
    assert (grid.resolution, grid.origin) == (0.05, Pose2(1, 2, 0))
    assert read.initial_pose() == (START, Pose2(1.5, -2.0, 0.25))
    assert read.metadata()["hsloc.recorder"] == {"seed": "7"}
    assert read.sha256() == hashlib.sha256(path.read_bytes()).hexdigest()


def test_initialpose_comes_before_metadata(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.metadata("hsloc.initial_pose", {"x": "1.5", "y": "-2", "theta": "0.25"})
        log.odometry(START, Pose2())
        log.scan(make_scan(START))
        log.pose_with_covariance(START + 5, Pose2(3, 0, 0), np.eye(3), topic="/initialpose")
        log.pose_with_covariance(START + 6, Pose2(4, 0, 0), np.eye(3), topic="/initialpose")
    assert open_log(path).initial_pose() == (START + 5, Pose2(3, 0, 0))
    assert open_log(path).map() is None


def test_split_logs_are_one_log(tmp_path: Path) -> None:
    whole = write_run(tmp_path / "whole.mcap", scans=60)
    folder = tmp_path / "bag"
    folder.mkdir()
    for part in range(12):  # part 10 comes after part 9, not after part 1
        write_run(folder / f"bag_{part}.mcap", scans=5, first=part * 5, mounting=MOUNTING if part == 7 else None)
    expected = [describe(event) for event in open_log(whole).events()]
    for paths in (folder, sorted(folder.iterdir())):
        log = open_log(paths)
        assert [describe(event) for event in log.events()] == expected
        assert log.losses == Losses()
        assert log.summary.extrinsics == "/tf_static"
        odom = next(topic for topic in log.summary.topics if topic.topic == "/odom")
        assert (odom.count, odom.largest_gap_s) == (120, pytest.approx(0.05))  # type: ignore[comparison-overlap]
    assert [p.name for p in open_log(folder).summary.paths][-2:] == ["bag_10.mcap", "bag_11.mcap"]


def test_other_channels_in_the_file_do_no_harm(tmp_path: Path) -> None:
    for name, form, encoding in [
        ("foxglove.Log", "protobuf", "protobuf"),
        ("Thing", "jsonschema", "json"),
        ("", "", "json"),
        ("my_msgs/msg/Odd", "ros2idl", "cdr"),
    ]:
        other = write_raw(
            tmp_path / "other.mcap",
            [("/other", START + 1, b"\xff\xfe{}")],
            schema=(name, form, b"\xff(((" if form else b""),
            encoding=encoding,
            profile="",
        )
        log = open_log([write_run(tmp_path / "run.mcap"), other])
        assert len(list(log.events())) == 120
        assert log.losses == Losses()


def test_damage_and_rubbish_are_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run.mcap", scans=200)
    data = path.read_bytes()
    chunk = chunks_of(data)[20]
    path.write_bytes(flipped(data, chunk_data_at(data, chunk) + 30))
    rubbish = [("/scan", START + 100 * SECOND + n, b"\x00\x01\x00\x00rubbish") for n in range(3)]
    log = open_log([path, write_raw(tmp_path / "more.mcap", rubbish)])
    events = list(log.events())
    assert 500 < len(events) < 600
    assert log.losses.damaged_chunks == 1
    assert log.losses.undecodable_messages == {"/scan": 3}
    assert log.losses.data_lost
    assert len(log.losses.lines()) == 2
    first = log.losses
    assert len(list(log.events())) == len(events)
    assert log.losses == first


def test_scans_without_meaning_are_skipped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    good = make_scan(START + 3)
    with LogWriter(path) as log:
        log.odometry(START, Pose2())
        log.odometry(START + 1, Pose2(float("nan"), 0, 0))
        log.scan(Scan(START, good.ranges, 0.0, 0.1, 0.0, 0.0))
        log.scan(Scan(START + 1, good.ranges, float("nan"), 0.1, 0.0, 10.0))
        log.scan(good)
        log.scan(Scan(START + 4, good.ranges[:0], 0.0, 0.1, 0.0, 10.0))
        log.scan(Scan(START + 5, good.ranges[:3], 1.0, -0.1, 0.0, 10.0))
    read = open_log(path)
    scans = [event for event in read.events() if isinstance(event, Scan)]
    assert [len(scan.ranges) for scan in scans] == [8, 0, 3]
    assert scans[2].angle_increment == pytest.approx(-0.1)
    assert read.losses.invalid_messages == {"/scan": 2, "/odom": 1}
    assert not read.losses.data_lost


def test_messages_without_stamp_take_the_time_of_the_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.odometry(0, Pose2(1), log_time_ns=START)
        log.scan(make_scan(0, 1), log_time_ns=START + 1)
        log.odometry(START + 2, Pose2(2))
    read = open_log(path)
    assert [event.stamp_ns for event in read.events()] == [START, START + 1, START + 2]
    assert read.losses.stamps_zero == {"/odom": 1, "/scan": 1}
    assert read.summary.origin_ns == START


def test_a_simulation_of_other_time_drops_what_came_before_its_clock(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for number, stamp in enumerate([0, 0, 36 * SECOND, 37 * SECOND]):
            log.odometry(stamp, Pose2(number), log_time_ns=START + number)
            log.scan(make_scan(stamp, number), log_time_ns=START + number)
    read = open_log(path)
    assert [event.stamp_ns // SECOND for event in read.events()] == [36, 36, 37, 37]
    assert read.losses.stamps_zero_dropped == {"/odom": 2, "/scan": 2}
    assert read.summary.origin_ns == 36 * SECOND


def test_different_clocks_are_warned_of(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.odometry(START, Pose2())
        log.scan(make_scan(36 * SECOND), log_time_ns=START)
    assert any(warning.code == WarningCode.CLOCKS_APART for warning in open_log(path).summary.warnings)


# Mistakes


def test_each_mistake_is_one_line_that_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "notes.txt").write_text("hello\nworld\n")
    (tmp_path / "photo.mcap").write_bytes(b"\x89PNG\r\n" + bytes(200))
    (tmp_path / "folder").mkdir()
    (tmp_path / "bare.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "zipped.gz").write_bytes(b"\x1f\x8b" + bytes(50))
    for name, kind, message in [
        ("missing.mcap", LogError, "no such file"),
        ("empty.mcap", LogFormatError, "is empty"),
        ("notes.txt", LogFormatError, "is not an MCAP, a ROS bag or a CARMEN log"),
        ("photo.mcap", LogFormatError, "is an image, not a log"),
        ("zipped.gz", LogFormatError, "nothing of it can be unpacked; copy it again"),
        ("folder", LogFormatError, r"is a folder without \.mcap, \.db3 or \.bag"),
        ("bare.mcap", TopicError, "no scan topic .*the log holds no messages"),
    ]:
        with pytest.raises(kind, match=message) as caught:
            open_log(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(LogError, match="no log was named"):
        open_log([])


def test_a_log_that_vanishes_under_way_is_a_log_error(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run.mcap")
    log = open_log(path)
    path.unlink()
    with pytest.raises(LogError, match=r"run\.mcap: cannot be read"):
        list(log.events())


@pytest.mark.unmeasured
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    import tracemalloc

    def peak(count: int) -> int:
        path = write_raw(tmp_path / "log.mcap", scan_payloads(count), chunk_size=20_000)
        log = open_log(path, ReadOptions(require_odometry=False))
        tracemalloc.start()
        for _ in log.events():
            pass
        _, size = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return size

    peak(1_000)  # what is imported and kept once
    assert peak(20_000) < peak(2_000) * 1.5 + 100_000


@pytest.mark.data
def test_turtlebot4_reads_the_same_from_both_formats() -> None:
    folder = DATA / "turtlebot4"
    if not folder.is_dir():
        pytest.skip(f"no TurtleBot 4 log in {folder}; set HSLOC_DATA")
    logs = [open_log(folder / name) for name in ("mcap_zstd", "macfirst_floor_take_2")]
    first, second = (list(log.events()) for log in logs)
    assert [describe(event) for event in first] == [describe(event) for event in second]
    for a, b in zip(first, second, strict=True):
        if isinstance(a, Scan):
            assert isinstance(b, Scan)
            np.testing.assert_array_equal(a.ranges, b.ranges)
    for log in logs:
        assert log.losses == Losses()
        assert log.summary.extrinsics == "/tf_static"
        assert log.summary.T_base_laser.theta == pytest.approx(pi / 2)
        assert log.summary.warnings == ()
    assert sum(isinstance(event, Scan) for event in first) == 357
    assert sum(isinstance(event, Odometry) for event in first) == 920
