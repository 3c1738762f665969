"""`open_log`: where the mounting, the odometry and the truth of a log come from, and in which frame."""

from __future__ import annotations

from math import pi, radians
from typing import TYPE_CHECKING

import numpy as np
import pytest
from log_builders import (
    MOUNTING,
    SECOND,
    START,
    make_scan,
)

from hsloc.errors import TopicError
from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions
from hsloc.log.transforms import Transform3
from hsloc.log.writer import LogWriter
from hsloc.model import IDENTITY, Odometry, Pose2, Scan, Truth
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

ALL = ReadOptions(require_scan=False, require_odometry=False)


def write_with_links(path: Path, links: list[tuple[str, str, Pose2 | Transform3]], static: bool = True) -> Path:
    with LogWriter(path) as log:
        log.transforms(START, links, static=static)
        log.odometry(START, Pose2())
        log.scan(make_scan(START))
    return path


def test_a_chain_of_transforms_in_space_comes_down_to_the_plane(tmp_path: Path) -> None:
    path = write_with_links(
        tmp_path / "log.mcap",
        [
            ("base_link", "tower", Transform3((0.1, 0.0, 0.5), (0.0, 0.0, np.sin(pi / 4), np.cos(pi / 4)))),
            ("tower", "laser", Transform3((0.2, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0))),
        ],
    )
    log = open_log(path)
    (scan,) = (event for event in log.events() if isinstance(event, Scan))
    assert log.summary.laser_flipped
    np.testing.assert_allclose(scan.T_base_laser.to_array(), (0.1, 0.2, pi / 2), atol=1e-12)
    assert (scan.angle_min, scan.angle_increment) == (1.0, -0.25)


def test_a_tilted_laser_is_warned_of(tmp_path: Path) -> None:
    tilt = radians(10.0)
    path = write_with_links(
        tmp_path / "log.mcap",
        [("base_link", "laser", Transform3((0, 0, 0), (0.0, np.sin(tilt / 2), 0.0, np.cos(tilt / 2))))],
    )
    (warning,) = open_log(path).summary.warnings
    assert warning.code == WarningCode.LASER_TILTED
    assert "tilted by 10.0 deg" in warning.text


def test_the_mounting_may_stand_in_tf(tmp_path: Path) -> None:
    path = write_with_links(tmp_path / "log.mcap", [("base_link", "laser", MOUNTING)], static=False)
    summary = open_log(path).summary
    assert summary.extrinsics == "/tf"
    np.testing.assert_allclose(summary.T_base_laser.to_array(), MOUNTING.to_array(), atol=1e-12)
    assert summary.warnings == ()


def test_a_mounting_that_moves_is_warned_of(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.odometry(START, Pose2())
        log.scan(make_scan(START))
        log.transforms(START, [("base_link", "laser", Pose2())])
        log.transforms(START + 1, [("base_link", "laser", Pose2(0, 0, 1))])
    summary = open_log(path).summary
    assert summary.T_base_laser.theta == pytest.approx(1.0)
    assert summary.warnings[0].code == WarningCode.LASER_MOVES


def test_without_a_transform_the_laser_is_in_the_base_with_a_warning(tmp_path: Path) -> None:
    path = write_with_links(tmp_path / "log.mcap", [("somewhere", "else", MOUNTING)])
    summary = open_log(path).summary
    assert (summary.extrinsics, summary.T_base_laser) == ("identity", IDENTITY)
    (warning,) = summary.warnings
    assert warning.code == WarningCode.EXTRINSICS_ASSUMED
    assert "from base_link to laser" in warning.text
    assert "--laser-pose" in warning.remedy


def test_frames_of_ros_1_lose_their_slash(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.transforms(START, [("/base_link", "/laser", MOUNTING)], static=True)
        log.odometry(START, Pose2(), frame_id="/odom", child_frame_id="base_link")
        log.scan(make_scan(START, frame="/laser"))
    summary = open_log(path).summary
    assert summary.extrinsics == "/tf_static"
    assert (summary.odom_frame, summary.laser_frame) == ("odom", "laser")


def test_another_base_frame_moves_odometry_and_laser(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.transforms(
            START, [("base_link", "rear_axle", Pose2(-0.5, 0, 0)), ("base_link", "laser", Pose2(0.2, 0, 0))], True
        )
        log.odometry(START, Pose2(1.0, 0.0, 0.0))
        log.scan(make_scan(START))
    with pytest.raises(TopicError, match=r"no frame axle, .*; --base-frame may be base_link, laser, rear_axle"):
        open_log(path, ReadOptions(base_frame="axle"))
    odometry, scan = open_log(path, ReadOptions(base_frame="rear_axle")).events()
    assert isinstance(odometry, Odometry)
    assert isinstance(scan, Scan)
    assert odometry.T_odom_base.x == pytest.approx(0.5)
    assert scan.T_base_laser.x == pytest.approx(0.7)


def test_odometry_without_covariance_is_unknown_and_not_perfect(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.odometry(START, Pose2())
        log.odometry(START + 1, Pose2(), covariance=np.diag((0.1, 0.2, 0.3)))
        log.scan(make_scan(START + 2))
    first, second, _ = open_log(path).events()
    assert isinstance(first, Odometry)
    assert isinstance(second, Odometry)
    assert first.covariance is None
    assert second.covariance is not None
    np.testing.assert_allclose(np.diag(second.covariance), (0.1, 0.2, 0.3))


# Odometry and truth from transforms


def write_transforms_alone(path: Path) -> Path:
    with LogWriter(path) as log:
        log.transforms(START, [("base_link", "laser", MOUNTING)], static=True)
        for number in range(10):
            stamp = START + number * SECOND
            if number >= 3:
                log.transforms(stamp, [("map", "odom", Pose2(0, 10, 0))])
            log.transforms(stamp, [("odom", "base_link", Pose2(number, 0, 0)), ("base_link", "arm", Pose2(number))])
            log.scan(make_scan(stamp + SECOND // 10))
    return path


def test_odometry_is_taken_from_tf_where_no_topic_has_it(tmp_path: Path) -> None:
    log = open_log(write_transforms_alone(tmp_path / "log.mcap"))
    assert (log.summary.odom_topic, log.summary.base_frame, log.summary.odom_frame) == ("/tf", "base_link", "odom")
    assert log.summary.extrinsics == "/tf_static"
    assert log.summary.reference_candidates == ("tf",)
    assert log.summary.origin_ns == START
    events = list(log.events())
    assert [e.T_odom_base.x for e in events if isinstance(e, Odometry)] == list(range(10))
    assert not [e for e in events if isinstance(e, Truth)]
    assert [type(e) for e in events[:4]] == [Odometry, Scan, Odometry, Scan]


def test_truth_may_be_taken_from_tf(tmp_path: Path) -> None:
    log = open_log(write_transforms_alone(tmp_path / "log.mcap"), ReadOptions(truth_topic="tf"))
    truths = [event.T_map_base for event in log.events() if isinstance(event, Truth)]
    assert truths == [Pose2(number, 10, 0) for number in range(3, 10)]


def test_a_base_that_tf_does_not_move_directly_is_reached_by_its_static_transform(tmp_path: Path) -> None:
    path = write_transforms_alone(tmp_path / "log.mcap")
    with LogWriter(tmp_path / "more.mcap") as log:
        log.transforms(START, [("base_link", "axle", Pose2(-0.5, 0, 0))], static=True)
    read = open_log([path, tmp_path / "more.mcap"], ReadOptions(base_frame="axle", truth_topic="tf"))
    events = list(read.events())
    assert [e.T_odom_base.x for e in events if isinstance(e, Odometry)] == [n - 0.5 for n in range(10)]
    assert [e.T_map_base for e in events if isinstance(e, Truth)] == [Pose2(n - 0.5, 10, 0) for n in range(3, 10)]
    assert read.summary.T_base_laser.x == pytest.approx(MOUNTING.x + 0.5)


def test_truth_may_be_map_to_base_without_odometry_between(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for number in range(3):
            log.odometry(START + number, Pose2())
            log.transforms(START + number, [("map", "base_link", Pose2(number, 5, 0))])
            log.scan(make_scan(START + number))
    read = open_log(path, ReadOptions(truth_topic="tf"))
    assert [e.T_map_base for e in read.events() if isinstance(e, Truth)] == [Pose2(n, 5, 0) for n in range(3)]


def test_a_truth_of_the_same_frame_moves_with_the_base(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.transforms(START, [("base_link", "axle", Pose2(-0.5, 0, 0)), ("base_link", "laser", Pose2())], static=True)
        log.odometry(START, Pose2(1, 0, 0))
        log.odometry(START, Pose2(2, 0, 0), topic="/ground_truth", frame_id="map")
        log.scan(make_scan(START))
    odometry, _, truth = open_log(path, ReadOptions(base_frame="axle")).events()
    assert isinstance(odometry, Odometry)
    assert isinstance(truth, Truth)
    assert (odometry.T_odom_base.x, truth.T_map_base.x) == (0.5, 1.5)


def test_truth_may_be_poses(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.odometry(START, Pose2(), topic="/odom")
        log.scan(make_scan(START))
        log.pose(START + 1, Pose2(1, 2, 3), topic="/groundtruth")
        log.pose_with_covariance(START + 2, Pose2(4, 5, 0.5), topic="/amcl_pose")
    log_read = open_log(path)
    assert log_read.summary.truth_topic == "/groundtruth"
    assert log_read.summary.reference_candidates == ("/amcl_pose", "/groundtruth")
    truth = list(log_read.events())[-1]
    assert isinstance(truth, Truth)
    np.testing.assert_allclose(truth.T_map_base.to_array(), (1, 2, 3))
    truth = list(open_log(path, ReadOptions(truth_topic="amcl_pose")).events())[-1]
    assert isinstance(truth, Truth)
    np.testing.assert_allclose(truth.T_map_base.to_array(), (4, 5, 0.5))


def test_truth_is_never_taken_for_odometry(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.odometry(START, Pose2(), topic="/odometry/ground_truth")
        log.scan(make_scan(START))
    with pytest.raises(TopicError, match="no odometry topic"):
        open_log(path)
    # Unless it is chosen: then it is odometry, and not truth as well.
    log_read = open_log(path, ReadOptions(odom_topic="/odometry/ground_truth"))
    assert [type(event) for event in log_read.events()] == [Odometry, Scan]
    with pytest.raises(TopicError, match="cannot be both"):
        open_log(path, ReadOptions(odom_topic="odometry/ground_truth", truth_topic="/odometry/ground_truth"))


# Choosing topics
