"""Kinds of logs from public reports that were misread: transforms, frames of maps, orientations."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import TYPE_CHECKING

import log_formats
import numpy as np
import pytest
from log_builders import MOUNTING, START, describe, make_scan, write_run

from hsloc.cli.main import main
from hsloc.errors import TopicError
from hsloc.log import LogWriter, ReadOptions, check_log, convert_log, open_log
from hsloc.log.messages import definitions
from hsloc.log.summary import Losses
from hsloc.log.transforms import Transform3
from hsloc.model import OccupancyGrid, Pose2, Scan

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("reported") / "run.mcap")


def assert_alike(a: Pose2, b: Pose2) -> None:
    np.testing.assert_allclose(a.to_array(), b.to_array(), atol=1e-9)


def write_robot(
    path: Path, space: str, prefix: str = "", odom: str = "odom", topic: bool = True, mounting: Pose2 = MOUNTING
) -> Path:
    """A run whose topics are in a namespace, and whose frames may have a prefix."""
    with LogWriter(path) as log:
        _add_robot(log, space, prefix, odom, topic, MOUNTING)
    return path


def _add_robot(log: LogWriter, space: str, prefix: str, odom: str, topic: bool, mounting: Pose2 | Transform3) -> None:
    base, laser = f"{prefix}base_link", f"{prefix}laser"
    log.transforms(START, [(base, laser, mounting)], static=True, topic=f"{space}/tf_static")
    for number in range(30):
        stamp = START + number * SECOND // 10
        pose = Pose2(0.1 * number, 0.0, 0.0)
        log.transforms(stamp, [(f"{prefix}{odom}", base, pose)], topic=f"{space}/tf")
        if topic:
            log.odometry(stamp, pose, topic=f"{space}/odom", frame_id=f"{prefix}{odom}", child_frame_id=base)
        log.scan(make_scan(stamp + SECOND // 100, number), frame_id=laser, topic=f"{space}/scan")


@pytest.mark.parametrize("prefix", ["", "robot1/"])
@pytest.mark.parametrize("odom", ["odom", "odom_combined"])
@pytest.mark.parametrize("topic", [True, False])
@pytest.mark.parametrize("space", ["/robot1", "/fleet/robot1", ""])
def test_transforms_are_found_in_any_namespace_with_any_prefix(
    tmp_path: Path, space: str, prefix: str, odom: str, topic: bool
) -> None:
    log = open_log(write_robot(tmp_path / "a.mcap", space, prefix, odom, topic))
    assert_alike(log.summary.T_base_laser, MOUNTING)
    assert log.summary.extrinsics == f"{space}/tf_static"
    assert log.summary.odom_topic == (f"{space}/odom" if topic else f"{space}/tf")
    assert log.summary.warnings == ()
    assert sum(kind == "odometry" for kind, *_ in map(describe, log.events())) == 30


def test_of_two_robots_the_one_whose_scans_are_read_counts(tmp_path: Path) -> None:
    other = Pose2(-0.3, 0.1, 1.0)
    with LogWriter(tmp_path / "two.mcap") as log:
        _add_robot(log, "/robot1", "", "odom", False, MOUNTING)
        _add_robot(log, "/robot2", "", "odom", False, other)
    for name, mounting in (("/robot1", MOUNTING), ("/robot2", other)):
        found = open_log(tmp_path / "two.mcap", ReadOptions(scan_topic=f"{name}/scan"))
        assert_alike(found.summary.T_base_laser, mounting)
        assert found.summary.odom_topic == f"{name}/tf"


def test_transforms_can_be_named_in_place_of_an_odometry_topic(tmp_path: Path) -> None:
    path = write_robot(tmp_path / "a.mcap", "/robot1")
    log = open_log(path, ReadOptions(odom_topic="/robot1/tf", base_frame="base_link"))
    assert log.summary.odom_topic == "/robot1/tf"
    assert sum(kind == "odometry" for kind, *_ in map(describe, log.events())) == 30


def test_static_transforms_stated_twice_are_both_named(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with LogWriter(path) as log:
        log.transforms(START, [("base_link", "laser", Pose2(0.18, 0.0, 0.0))], static=True)
        _add_robot(log, "", "", "odom", True, Pose2(0.0, 0.0, 0.0))
    (warning,) = open_log(path).summary.warnings
    for part in ("0.180,0.000,0.000", "0.000,0.000,0.000", "--laser-pose"):
        assert part in str(warning)
    assert any("0.180,0.000,0.000" in finding.text for finding in check_log(open_log(path)).findings)


@pytest.mark.parametrize("places", [(0.5,), (0.5, 0.3)])
def test_places_that_are_stated_on_tf_again_and_again_are_named(tmp_path: Path, places: tuple[float, ...]) -> None:
    path = tmp_path / "two.mcap"
    with LogWriter(path) as log:
        if len(places) > 1:
            log.odometry(START, Pose2(0.0, 0.0, 0.0))
            log.scan(make_scan(START))
        else:
            _add_robot(log, "", "", "odom", True, MOUNTING)
        for number in range(10):
            for x in places:
                log.transforms(START + number * SECOND // 10, [("base_link", "laser", Pose2(x, 0.0, 0.0))])
    (warning,) = open_log(path).summary.warnings
    for x in (*places, *([] if len(places) > 1 else [MOUNTING.x])):
        assert f"base_link -> laser at {x:.3f},0.000," in str(warning)
    assert "--laser-pose" in str(warning)


def test_poses_are_offered_as_the_odometry_where_there_is_no_other(tmp_path: Path) -> None:
    path = tmp_path / "poses.mcap"
    with LogWriter(path) as log:
        for number in range(5):
            log.pose_with_covariance(START + number * SECOND, Pose2(0.0, 0.0, 0.0), topic="/amcl_pose", frame_id="map")
            log.pose_with_covariance(
                START + number * SECOND, Pose2(0.1, 0.0, 0.0), topic="/robot_pose", frame_id="odom"
            )
            log.scan(make_scan(START + number * SECOND))
    with pytest.raises(TopicError, match="--odom-topic /robot_pose"):
        open_log(path)
    assert open_log(path, ReadOptions(odom_topic="/robot_pose")).summary.odom_topic == "/robot_pose"


@pytest.mark.parametrize("name", ["/robot1/tf", "tf"])
def test_transforms_of_any_name_may_be_chosen_as_the_odometry(tmp_path: Path, name: str) -> None:
    path = write_robot(tmp_path / "a.mcap", "/robot1", odom="world", topic=False)
    with pytest.raises(TopicError, match="--odom-topic /robot1/tf"):
        open_log(path)
    log = open_log(path, ReadOptions(odom_topic=name))
    assert log.summary.odom_frame == "world"
    assert_alike(log.summary.T_base_laser, MOUNTING)
    assert sum(kind == "odometry" for kind, *_ in map(describe, log.events())) == 30


def test_a_frame_with_two_parents_is_looked_up_by_the_one_that_leads_to_the_base(tmp_path: Path) -> None:
    path = tmp_path / "parents.mcap"
    with LogWriter(path) as log:
        _add_robot(log, "", "", "odom", True, MOUNTING)
        log.transforms(START + SECOND, [("camera_mount", "laser", Pose2(5.0, 0.0, 0.0))], static=True)
    summary = open_log(path).summary
    assert_alike(summary.T_base_laser, MOUNTING)
    assert any("camera_mount" in str(warning) for warning in summary.warnings)


def test_a_static_transform_is_no_odometry(tmp_path: Path) -> None:
    path = tmp_path / "static.mcap"
    with LogWriter(path) as log:
        log.transforms(START, [("odom", "base_link", Pose2()), ("base_link", "laser", MOUNTING)], static=True)
        for number in range(5):
            log.scan(make_scan(START + number * SECOND, number))
    found = open_log(path)
    assert found.summary.odom_topic is None
    (warning,) = found.summary.warnings
    assert warning.code == "odometry_unusable"
    assert "odom -> base_link is a static transform" in warning.text
    assert [finding.code for finding in check_log(found).findings] == ["odometry_unusable"]
    assert all(isinstance(event, Scan) for event in found.events())


def test_a_mounting_that_was_assumed_stays_an_assumption_after_conversion(tmp_path: Path) -> None:
    source = write_run(tmp_path / "a.mcap", mounting=None)
    convert_log(open_log(source), tmp_path / "b.mcap")
    for path in (source, tmp_path / "b.mcap"):
        log = open_log(path)
        assert log.summary.extrinsics == "identity"
        assert any("--laser-pose" in str(warning) for warning in log.summary.warnings)
        assert any(finding.code == "no_extrinsic" for finding in check_log(log).findings)
    before, after = ([describe(event) for event in open_log(path).events()] for path in (source, tmp_path / "b.mcap"))
    assert before == after


def test_mountings_between_which_nothing_decides_are_all_converted(tmp_path: Path) -> None:
    source, target = tmp_path / "two.mcap", tmp_path / "converted.mcap"
    with LogWriter(source) as log:
        log.transforms(START, [("base_link", "laser", Pose2(0.18, 0.0, 0.0))], static=True)
        _add_robot(log, "", "", "odom", True, Pose2(0.1, 0.0, 0.0))
    assert main(["convert", str(source), str(target), "-q"]) == 0
    (laser,) = open_log(target).summary.lasers
    assert [transform.translation[0] for transform in laser.alternatives] == [0.18, 0.1]
    assert_alike(laser.T_base_laser, Pose2(0.1, 0.0, 0.0))
    options = ReadOptions(mountings=(("laser", laser.alternatives[0]),))
    convert_log(open_log(source, options), target)
    (laser,) = open_log(target).summary.lasers
    assert laser.alternatives == ()
    assert_alike(laser.T_base_laser, Pose2(0.18, 0.0, 0.0))


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 90.0, 1.0), (0.0, 0.0, 0.0, 0.0)])
def test_a_mounting_without_a_rotation_is_named(tmp_path: Path, rotation: tuple[float, float, float, float]) -> None:
    path = tmp_path / "degrees.mcap"
    with LogWriter(path) as log:
        _add_robot(log, "", "", "odom", True, Transform3((0.1, 0.0, 0.0), rotation))
    (warning,) = open_log(path).summary.warnings
    assert warning.code == "extrinsics_unturned"
    assert f"{rotation[2]:g}, {rotation[3]:g}" in warning.text
    assert "--laser-pose" in warning.remedy


# Frames of maps.

GRID = OccupancyGrid(np.zeros((4, 6), dtype=np.int8), 0.05, Pose2(1.0, 2.0, 0.0))


@pytest.mark.parametrize(
    ("topic", "frame", "is_map"),
    [
        ("/map", "map", True),
        ("/robot1/map", "robot1/map", True),
        ("/floor_plan", "map", True),
        ("/local_costmap/costmap", "odom", False),
        ("/global_costmap/costmap", "map", False),
        ("/grid", "odom", False),
        ("/map", "odom", False),
        ("/map", "base_link", False),
        ("/map", "rolling", False),
    ],
)
def test_a_costmap_is_no_map(tmp_path: Path, topic: str, frame: str, is_map: bool) -> None:
    path = tmp_path / "map.mcap"
    with LogWriter(path) as log:
        _add_robot(log, "", "", "odom", True, MOUNTING)
        log.occupancy_grid(GRID, START, topic=topic, frame_id=frame)
        for x in (1.1, 1.2, 1.3) if frame == "rolling" else ():
            log.occupancy_grid(replace(GRID, origin=Pose2(x, 2.0, 0.0)), START, topic=topic, frame_id=frame)
    log_ = open_log(path)
    assert (log_.map() is not None) is is_map
    assert any(topic in str(warning) for warning in log_.summary.warnings) is not is_map


@pytest.mark.parametrize("transform", [True, False])
def test_a_start_pose_in_the_frame_of_the_odometry_is_moved_or_left_out(tmp_path: Path, transform: bool) -> None:
    T_map_odom = Pose2(3.0, 4.0, 0.5)
    path = tmp_path / "start.mcap"
    with LogWriter(path) as log:
        if transform:
            log.transforms(START, [("map", "odom", T_map_odom)])
        _add_robot(log, "", "", "odom", True, MOUNTING)
        log.pose_with_covariance(START + SECOND, Pose2(1.0, 0.0, 0.0), topic="/initialpose", frame_id="odom")
    found = open_log(path)
    if transform:
        start = found.initial_pose()
        assert start is not None
        assert np.allclose(start[1].to_array(), (T_map_odom @ Pose2(1.0, 0.0, 0.0)).to_array())
    else:
        assert found.initial_pose() is None
        assert any("frame odom" in str(warning) for warning in found.summary.warnings)


@pytest.mark.parametrize(
    "quaternion",
    [
        (0.0, 0.0, 0.0, 0.0),
        (float("nan"),) * 4,
        (0.0, 0.0, 0.3, 0.0),
        (0.001, 0.0, 0.3, 0.0),
        (0.0, 0.0, 45.0, 1.0),
        (0.0, 0.1, -0.4, 1.0),
    ],
    ids=["zeros", "nan", "z alone", "no w", "degrees", "angles"],
)
def test_orientations_that_were_never_filled_are_counted(
    tmp_path: Path, plain: Path, quaternion: tuple[float, ...]
) -> None:
    def zeroed(number: int, name: str, data: bytes) -> bytes:
        if name != definitions.ODOMETRY or not (number < 40 or 80 < number < 84):
            return data
        pose = len(data) - 680
        return data[: pose + 24] + struct.pack("<4d", *quaternion) + data[pose + 56 :]

    items = [(s, c, t, zeroed(n, s.name, data)) for n, (s, c, t, data) in enumerate(log_formats.messages(plain))]
    log = open_log(log_formats.write(tmp_path / "zeros.mcap", items))
    events = list(log.events())
    unset = sum(not getattr(event, "has_heading", True) for event in events)
    assert log.losses.orientations_unset["/odom"] > unset > 5, "those between others are left out"
    assert replace_losses(log.losses) == Losses()


def replace_losses(losses: Losses) -> Losses:
    """The losses but for the count of unset orientations."""
    return replace(losses, orientations_unset=Losses().orientations_unset)


def test_of_two_robots_the_odometry_of_the_chosen_scans_is_read(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with LogWriter(path) as log:
        for number in range(5):
            for robot in ("a", "b"):
                log.odometry(START + number * SECOND, Pose2(float(number), 0.0, 0.0), topic=f"/{robot}/odom")
                log.scan(make_scan(START + number * SECOND), topic=f"/{robot}/scan")
    assert open_log(path, ReadOptions(scan_topic="/b/scan")).summary.odom_topic == "/b/odom"
    with pytest.raises(TopicError, match="they are of several robots") as caught:
        open_log(path)
    assert "take all" not in str(caught.value)
