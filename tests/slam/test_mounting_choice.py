"""Of mountings that a log states twice the one is used under which scans and odometry agree."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING

import pytest

from hsloc.analysis import mounting_warnings
from hsloc.analysis.quality import quality_warnings
from hsloc.log import LogWriter, ReadOptions, Transform3, open_log
from hsloc.model import Odometry, Pose2, Scan
from hsloc.replay import clock_offset
from hsloc.replay.run import run
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world
from hsloc.slam.front_end_parameters import FrontEndParameters
from hsloc.slam.heading_offset import UNKNOWN
from hsloc.slam.mounting_choice import direction_warnings, with_chosen_mountings
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.model import Event

RIGHT = Pose2(0.2, 0.05, 0.4)
UPSIDE_DOWN = Transform3.from_pose2(RIGHT) @ Transform3((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def recorded() -> list[Event]:
    scenario = Scenario("office", seed=4, sensor=Lidar(beams=180, mounting=RIGHT), duration_s=20.0, scan_rate_hz=5.0)
    return list(events(scenario, load_world("office")))


def write(path: Path, recorded: list[Event], mountings: list[Transform3], odometry: bool = True) -> Path:
    """The log with a message on /tf_static for each of the mountings."""
    with LogWriter(path) as log:
        for mounting in mountings:
            log.transforms(recorded[0].stamp_ns, [("base_link", "laser", mounting)], static=True)
        for event in recorded:
            if isinstance(event, Scan):
                log.scan(event)
            elif isinstance(event, Odometry) and odometry:
                log.odometry(event.stamp_ns, event.T_odom_base)
    return path


@pytest.mark.parametrize(
    "wrong",
    [
        Transform3.from_pose2(Pose2(0.05, 0.05, 0.4)),
        UPSIDE_DOWN,
    ],
    ids=["elsewhere", "upside down"],
)
def test_the_mounting_under_which_scans_and_odometry_agree_is_used(
    tmp_path: Path, recorded: list[Event], wrong: Transform3
) -> None:
    right = Transform3.from_pose2(RIGHT)
    path = write(tmp_path / "a.mcap", recorded, [right, wrong])
    options, (warning,) = with_chosen_mountings(open_log(path), [path], ReadOptions(), FrontEndParameters())
    assert warning.code == WarningCode.EXTRINSICS_CHOSEN
    assert "0.200,0.050,0.400 is used" in warning.text
    summary = open_log(path, options).summary
    assert summary.T_base_laser.to_array() == pytest.approx(RIGHT.to_array(), abs=1e-9)
    assert (summary.laser_flipped, summary.warnings) == (False, ())


def test_without_odometry_the_last_mounting_is_used_and_the_result_is_doubted(
    tmp_path: Path, recorded: list[Event]
) -> None:
    path = write(tmp_path / "a.mcap", recorded[:200], [UPSIDE_DOWN, Transform3.from_pose2(RIGHT)], odometry=False)
    reading = ReadOptions(require_odometry=False)
    options, (warning,) = with_chosen_mountings(open_log(path, reading), [path], reading, FrontEndParameters())
    assert warning.code == WarningCode.EXTRINSICS_UNDECIDED
    assert "--laser-pose" in warning.remedy
    assert not open_log(path, options).summary.laser_flipped


def test_a_mounting_that_the_user_gives_is_not_chosen_again(tmp_path: Path, recorded: list[Event]) -> None:
    path = write(tmp_path / "a.mcap", recorded[:20], [UPSIDE_DOWN, Transform3.from_pose2(RIGHT)])
    given = ReadOptions(laser_pose=Pose2(0.1, 0.0, 0.0))
    assert with_chosen_mountings(open_log(path, given), [path], given, FrontEndParameters()) == (given, ())


@pytest.mark.parametrize(
    ("mounting", "text"),
    [
        (None, "looks turned by 23 deg from where it is assumed to"),
        (RIGHT @ Pose2(0.0, 0.0, pi), "looks backwards from where it is stated to"),
        (RIGHT, ""),
        (UPSIDE_DOWN, ""),
    ],
    ids=["not stated", "backwards", "right", "upside down"],
)
def test_a_laser_that_looks_elsewhere_than_it_is_said_to_is_reported(
    tmp_path: Path, recorded: list[Event], mounting: Pose2 | Transform3 | None, text: str
) -> None:
    mounting = Transform3.from_pose2(mounting) if isinstance(mounting, Pose2) else mounting
    path = write(tmp_path / "a.mcap", recorded, [] if mounting is None else [mounting])
    log, options = open_log(path), ReadOptions()
    found = direction_warnings(log, [path], options, FrontEndParameters(), stated=True)
    assert [warning.code for warning in found] == [WarningCode.EXTRINSICS_WRONG] * bool(text)
    for warning in found:
        assert text in warning.text
        pose = warning.remedy.removeprefix("--laser-pose=").partition(";")[0]
        x, y, yaw = (float(value) for value in pose.split(","))
        assert yaw == pytest.approx(RIGHT.theta, abs=0.01)
        assert (x, y) == pytest.approx((RIGHT.x, RIGHT.y), abs=0.03)
    if mounting is not None:  # A run asks only where the log states nothing.
        assert direction_warnings(log, [path], options, FrontEndParameters(), stated=False) == []


def test_a_map_is_built_with_the_yaw_that_scans_and_odometry_show(tmp_path: Path, recorded: list[Event]) -> None:
    wrong = RIGHT @ Pose2(0.0, 0.0, 0.14)
    path = write(tmp_path / "a.mcap", recorded, [Transform3.from_pose2(wrong)])
    result = run(path, mode="slam")
    (warning,) = (each for each in result.warnings if each.code == WarningCode.EXTRINSICS_WRONG)
    assert "from where it is stated to (/tf_static)" in warning.text
    used = result.summary.T_base_laser
    assert f"--laser-pose={used.x:.3f},{used.y:.3f},{used.theta:.4f}" in warning.remedy
    assert used.to_array() == pytest.approx(RIGHT.to_array(), abs=0.02)
    given = run(path, mode="slam", laser_pose=wrong)
    assert given.summary.T_base_laser == wrong
    (named,) = quality_warnings(given)
    assert named.code == WarningCode.EXTRINSICS_WRONG
    assert named.remedy == warning.remedy


def test_scans_that_show_no_other_yaw_by_themselves_are_asked_once(
    tmp_path: Path, recorded: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    for module in (clock_offset, mounting_warnings):
        monkeypatch.setattr(module, "right_mounting", lambda *_, used: asked.append(used))
    path = write(tmp_path / "a.mcap", recorded, [Transform3.from_pose2(RIGHT @ Pose2(0.0, 0.0, 0.14))])
    result = run(path, mode="slam")
    assert result.mounting_error is not None
    assert result.mounting_error.is_turned
    assert quality_warnings(result) == []
    assert asked == [True]


def test_a_map_shows_a_laser_that_is_elsewhere_than_it_is_stated(
    tmp_path: Path, recorded: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.mcap", recorded, [Transform3.from_pose2(Pose2(0.22, 0.0, 0.0) @ RIGHT)])
    result = run(path, mode="slam")
    (warning,) = quality_warnings(result)
    assert warning.code == WarningCode.EXTRINSICS_WRONG
    assert "0.22" in warning.text
    x, y, _ = (float(value) for value in warning.remedy.partition("--laser-pose=")[2].split(","))
    assert (x, y) == pytest.approx((RIGHT.x, RIGHT.y), abs=0.02)
    # Clocks that differ put it ahead or behind by the way in that time.
    for seconds, is_named in ((0.05, True), (1.0, False)):
        monkeypatch.setattr(
            "hsloc.analysis.mounting_warnings.find_offset",
            lambda *_, s=seconds: UNKNOWN._replace(seconds=s, sigma=1e-3),
        )
        assert bool(quality_warnings(result)) == is_named
