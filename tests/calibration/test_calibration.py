"""Calibration: on tracks whose truth is known, and from a simulated log through the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.calibration.estimator import NAMES, Track, Undetermined, estimate
from hsloc.cli.main import main
from hsloc.errors import ConfigError
from hsloc.log import LogWriter, ReadOptions, Transform3, open_log, read_calibration
from hsloc.maps import save_map
from hsloc.model import Odometry, Pose2, Scan
from hsloc.model.calibration import (
    Calibration,
    LidarCalibration,
    OdometryCorrection,
    corrected_odometry,
    step_derivatives,
)
from hsloc.model.pose2 import compose_poses
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

TRUTH = OdometryCorrection(1.02, 0.97, 0.008)
MOUNTING = Pose2(0.21, -0.06, 3.0)
LAG_S = 0.07


def tracks(turn_rates: NDArray[np.float64], speed: float = 0.8) -> tuple[Track, Track]:
    """What a laser and a wrong odometry see of a drive with turn rates (rad/s) at 50 Hz; noise of 1 mm and 0.5 mrad."""
    stamps = np.arange(len(turn_rates) + 1, dtype=np.int64) * 20_000_000
    theta = np.concatenate(([0.0], np.cumsum(turn_rates) * 0.02))
    middle = 0.5 * (theta[1:] + theta[:-1])
    x, y = (np.concatenate(([0.0], np.cumsum(speed * 0.02 * f(middle)))) for f in (np.cos, np.sin))
    base = np.column_stack((x, y, theta))
    rng = np.random.default_rng(3)
    laser = compose_poses(base[::5], MOUNTING.to_array()) + rng.normal(0.0, (0.001, 0.001, 0.0005), (len(base[::5]), 3))
    return Track.of(stamps[::5] + round(LAG_S * 1e9), laser), Track.of(stamps, TRUTH.inverse()(base))


def test_all_parameters_are_found_within_their_intervals() -> None:
    t = np.arange(3000) * 0.02
    laser, odometry = tracks(0.9 * np.sin(t) + 0.3 * np.sin(2.7 * t))
    found = estimate(laser, odometry, Pose2(0.2, 0.0, 3.05))
    apart = found.values - np.array((1.02, 0.97, 0.008, 0.21, -0.06, 3.0, LAG_S))
    assert found.determined.all()
    assert np.all(np.abs(apart) < 3.0 * found.sigmas + 1e-9)
    assert np.all(np.abs(apart) < (1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 1e-3, 2e-3))
    track, sigma = found.track
    assert abs(track - 1.02 / 0.97) < 3.0 * sigma
    wheels = {name: value for name, (value, _) in found.wheels(0.1, 0.4).items()}
    assert abs(wheels["track"] - 0.4 * 1.02 / 0.97) < 1e-3
    assert abs(wheels["right_radius"] - wheels["left_radius"] - 0.008 * wheels["track"] * 0.1) < 1e-4


@pytest.mark.parametrize(
    ("rates", "missing"),
    [
        (np.zeros(3000), {"rotation_scale", "x", "y", "time_offset"}),
        (np.full(3000, 0.3), {"x", "y"}),
    ],
)
def test_what_the_motion_does_not_determine_is_named_and_kept(rates: NDArray[np.float64], missing: set[str]) -> None:
    laser, odometry = tracks(rates)
    found = estimate(laser, odometry, Pose2(0.2, 0.0, 3.05))
    assert missing <= found.reasons.keys()
    assert found.values[3] == 0.2
    assert np.isnan(found.sigmas[[NAMES.index(name) for name in missing]]).all()


def test_a_laser_that_is_mounted_backwards_and_is_lost_at_first() -> None:
    """A start that is off by half a turn is found, however the equations come to it: scales are positive."""
    t = np.arange(3000) * 0.02
    laser, odometry = tracks(0.9 * np.sin(t) + 0.3 * np.sin(2.7 * t))
    laser.poses[:40, :2] += np.random.default_rng(1).normal(0.0, 3.0, (40, 2))
    found = estimate(laser, odometry, Pose2(0.0, 0.0, 0.0))
    assert abs(found.values[0] - 1.02) < 0.005
    assert np.abs(found.values[3:6] - (0.21, -0.06, 3.0)).max() < 0.01


def test_outliers_are_weighed_down() -> None:
    t = np.arange(3000) * 0.02
    laser, odometry = tracks(0.9 * np.sin(t))
    laser.poses[100:110, 0] += 0.5
    found = estimate(laser, odometry, Pose2())
    assert found.outliers >= 1
    assert abs(found.values[0] - 1.02) < 1e-3


def test_a_robot_at_rest_gives_no_calibration() -> None:
    laser, odometry = tracks(np.zeros(3000), speed=0.0)
    with pytest.raises(Undetermined, match="are needed"):
        estimate(laser, odometry, Pose2())


def test_a_correction_and_its_inverse() -> None:
    poses = np.array(((1.0, 2.0, 0.5), (1.5, 2.2, 0.9), (1.6, 2.9, 2.0)))
    np.testing.assert_allclose(TRUTH.inverse()(TRUTH(poses)), poses, atol=1e-12)
    uncorrected = [Odometry(k, Pose2.from_array(pose)) for k, pose in enumerate(poses)]
    streamed = [
        event.T_odom_base.to_array() for event in corrected_odometry(uncorrected, TRUTH) if isinstance(event, Odometry)
    ]
    np.testing.assert_allclose(streamed, TRUTH(poses), atol=1e-12)


def test_derivatives_of_corrected_steps(rng: np.random.Generator) -> None:
    steps, small = rng.normal(size=(20, 3)), 1e-6
    for found, by in zip(step_derivatives(steps), small * np.eye(3), strict=True):
        more, less = (OdometryCorrection(1.0 + v[0], 1.0 + v[1], v[2]).steps(steps) for v in (by, -by))
        np.testing.assert_allclose(found, (more - less) / (2.0 * small), atol=1e-8)


def write_log(path: Path) -> Path:
    """Half a minute in the office with a wrong odometry, mounting and clock."""
    lidar = Lidar(mounting=MOUNTING, upside_down=True)
    scenario = Scenario("office", sensor=lidar, duration_s=32.0, scan_rate_hz=5.0)
    stated = Transform3.from_pose2(Pose2(0.2, 0.0, 3.05)) @ Transform3(rotation=(1.0, 0.0, 0.0, 0.0))
    with LogWriter(path) as log:
        log.transforms(scenario.start_stamp_ns, [("base_link", "laser", stated)], static=True)
        for event in corrected_odometry(events(scenario, load_world("office")), TRUTH.inverse()):
            if isinstance(event, Scan):
                stamp = event.stamp_ns + round(LAG_S * 1e9)
                angles = -event.angle_min, -event.angle_increment
                log.scan(replace(event, stamp_ns=stamp, angle_min=angles[0], angle_increment=angles[1]))
            elif isinstance(event, Odometry):
                log.odometry(event.stamp_ns, event.T_odom_base)
    return path


def test_from_a_log_to_a_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out = write_log(tmp_path / "run.mcap"), tmp_path / "robot.yaml"
    assert main(["calibrate", str(log), "--out", str(out), "--json"]) == 0
    values = {name: each["value"] for name, each in json.loads(capsys.readouterr().out)["parameters"].items()}
    assert abs(values["scale"] - 1.02) < 0.01
    assert abs(values["rotation_scale"] - 0.97) < 0.01
    assert abs(values["x"] - 0.21) < 0.01
    assert abs(values["yaw"] - 3.0) < 0.01
    assert abs(values["time_offset"] + LAG_S) < 0.01
    known = read_calibration(out)
    assert known.lidar("scan").T_base_laser == Pose2(values["x"], values["y"], values["yaw"])
    assert known.odometry.scale == values["scale"]
    assert 'rpy="3.141593 0' in out.with_suffix(".urdf").read_text()
    # Files are not overwritten, and the replay reads them.
    assert main(["calibrate", str(log), "--out", str(out)]) == 1
    assert "--force" in capsys.readouterr().err
    result = tmp_path / "result"
    arguments = ["replay", str(log), "--mode", "slam", "--end", "3", "--calibration", str(out), "--out", str(result)]
    assert main(arguments) == 0
    assert f"--calibration={out}" in (result / "report.html").read_text()


def test_on_a_given_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out, world = write_log(tmp_path / "run.mcap"), tmp_path / "robot.yaml", load_world("office")
    save_map(world.occupancy_grid(0.05), tmp_path / "map.yaml")
    start = ",".join(str(value) for value in world.start().to_array())
    arguments = ["calibrate", str(log), "--out", str(out), "--json", f"--initial-pose={start}"]
    assert main(arguments) == 1
    assert "give one with --map" in capsys.readouterr().err
    assert main([*arguments, f"--map={tmp_path / 'map.yaml'}"]) == 0
    values = {name: each["value"] for name, each in json.loads(capsys.readouterr().out)["parameters"].items()}
    assert abs(values["scale"] - 1.02) < 0.01
    assert abs(values["rotation_scale"] - 0.97) < 0.01
    assert np.abs(np.array((values["x"], values["yaw"])) - (0.21, 3.0)).max() < 0.01
    assert abs(values["time_offset"] + LAG_S) < 0.01


def test_a_calibration_is_applied_when_a_log_is_read(tmp_path: Path) -> None:
    log = write_log(tmp_path / "run.mcap")
    known = Calibration(TRUTH, (("/scan", LidarCalibration(MOUNTING, -LAG_S)),))
    plain, right = (open_log(log, ReadOptions(calibration=each)) for each in (None, known))
    assert right.summary.extrinsics == "calibration"
    assert right.summary.laser_flipped
    other = open_log(log, ReadOptions(calibration=Calibration(lidars=(("/front", LidarCalibration(MOUNTING)),))))
    assert [warning.code for warning in other.summary.warnings] == ["calibration_unused"]
    assert other.summary.extrinsics == "/tf_static"
    first = [next(event for event in each.events() if isinstance(event, Scan)) for each in (plain, right)]
    assert first[1].T_base_laser == MOUNTING
    assert first[0].stamp_ns - first[1].stamp_ns == 70_000_000
    ends = [[e.T_odom_base for e in each.events() if isinstance(e, Odometry)][-1].to_array() for each in (plain, right)]
    assert np.abs(ends[0] - ends[1]).max() > 0.1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: 1\n", "neither odometry nor lidars"),
        ("odometry: {scale: 5}\n", "from 0.5 to 2"),
        ("odometry: {scale: .nan}\n", "from 0.5 to 2"),
        ("odometry: {scle: 1}\n", "unknown key 'scle'"),
        ("odometry: 3\n", "must be a table"),
        ("lidars: [1]\n", "must be a table of topics"),
        (f"odometry: {{scale: {10**400}}}\n", "from 0.5 to 2"),
        ("lidars: {/scan: {x: 1}}\n", "x, y and yaw together"),
        ("a: &a 1\nb: *a\n", "alias"),
        ("- 1\n", "is not a calibration"),
        ("{", "is not YAML"),
        ("#" * 70_000, "too large"),
    ],
)
def test_files_that_are_no_calibration(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=expected):
        read_calibration(path)
    with pytest.raises(ConfigError, match="no such calibration"):
        read_calibration(tmp_path / "missing.yaml")
