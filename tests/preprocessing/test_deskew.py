"""Deskewing: each beam moved to where the robot was, for real on a recording whose lidar turns while it drives."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hsloc.errors import ConfigError
from hsloc.evaluation import evaluate
from hsloc.log import LogWriter, ReadOptions, open_log
from hsloc.maps import save_map
from hsloc.model import Odometry, Pose2, Scan
from hsloc.model.events import PairedScan
from hsloc.preprocessing.scans import pair
from hsloc.replay.run import run
from hsloc.request import RunRequest
from hsloc.simulation.built_in import built_in
from hsloc.simulation.presets import preset
from hsloc.simulation.recorder import record
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 1_000_000_000


def drive(rate: int = 50, seconds: float = 2.0, speed: float = 1.0, turn: float = 0.5) -> list[Odometry]:
    """Odometry on a circle."""
    return [Odometry(round(k * SECOND / rate), at(k / rate, speed, turn)) for k in range(round(seconds * rate) + 1)]


def at(seconds: float, speed: float = 1.0, turn: float = 0.5) -> Pose2:
    angle = turn * seconds
    return Pose2(speed / turn * np.sin(angle), speed / turn * (1.0 - np.cos(angle)), angle)


def scan(stamp_s: float = 1.0, beams: int = 100, sweep_s: float = 0.1, **changes: Any) -> Scan:
    values: dict[str, Any] = {"T_base_laser": Pose2(0.2, 0.1, 0.3), "time_increment": sweep_s / max(beams, 1)} | changes
    return Scan(round(stamp_s * SECOND), np.full(beams, 2.0, np.float32), -1.0, 0.02, 0.1, 10.0, **values)


def paired_scan(events: list[Any]) -> PairedScan:
    (found,) = (event for event in pair(sorted(events, key=lambda e: e.stamp_ns), deskew=True) if is_scan(event))  # type: ignore[arg-type]
    return found  # type: ignore[return-value]


def is_scan(event: Odometry | PairedScan) -> bool:
    return isinstance(event, PairedScan)


@pytest.mark.parametrize("increment", [1.0, -1.0])
def test_every_point_is_where_the_robot_saw_it(increment: float) -> None:
    seen = scan(time_increment=increment * 0.1 / 100)
    found = paired_scan([*drive(rate=500), seen])
    assert found.T_odom_base.to_array() == pytest.approx(at(1.0).to_array())
    points = found.T_odom_base @ found.scan.points_base()
    for k, angle in enumerate(seen.angles()):
        T_odom_laser = at(1.0 + k * seen.time_increment) @ seen.T_base_laser
        expected = T_odom_laser @ np.array([2.0 * np.cos(angle), 2.0 * np.sin(angle)])
        assert points[k] == pytest.approx(expected, abs=1e-5)


def test_points_that_hit_nothing_are_left_out() -> None:
    ranges = np.full(100, 2.0, np.float32)
    ranges[::3] = np.inf
    found = paired_scan([*drive(), scan()])
    part = replace(found.scan, ranges=ranges)
    np.testing.assert_array_equal(part.points_base(), found.scan.points_base()[np.isfinite(ranges)])


@pytest.mark.parametrize(
    "changes", [{"sweep_s": 0.0}, {"sweep_s": 5.0}, {"beams": 1}, {"beams": 0, "time_increment": 1.0}]
)
def test_scans_without_a_usable_time_of_their_beams_stay(changes: dict[str, Any]) -> None:
    found = paired_scan([*drive(), scan(**changes)])
    assert found.scan.T_base_beam is None


def test_all_events_come_once_and_scans_keep_their_order() -> None:
    events: list[Any] = [*drive(), *(scan(s / 10, sweep_s=0.15) for s in range(20))]
    events.sort(key=lambda e: e.stamp_ns)
    found = list(pair(events, deskew=True))
    assert len(found) == len(events)
    stamps = [event.stamp_ns for event in found if isinstance(event, Odometry)]
    assert stamps == sorted(stamps)
    scans = [event.scan.stamp_ns for event in found if is_scan(event)]  # type: ignore[arg-type]
    assert scans == sorted(scans)
    assert len(scans) == 20


def test_where_odometry_ends_the_robot_is_taken_to_stand() -> None:
    odometry = [o for o in drive(rate=100) if o.stamp_ns <= SECOND + SECOND // 20]
    found = paired_scan([*odometry, scan()])
    last = found.scan.T_base_beam[-1]
    assert last == pytest.approx(at(1.0).between(at(1.05)).to_array(), abs=1e-6)


def test_without_odometry_nothing_is_moved() -> None:
    (found,) = pair([scan()], deskew=True)
    assert found.scan.T_base_beam == pytest.approx(np.zeros((100, 3)))
    with pytest.raises(ConfigError, match="deskewed with odometry"):
        RunRequest(logs=(), no_odometry=True, read=ReadOptions(deskew=True))


def test_the_duration_of_a_scan_stands_in_for_the_time_of_its_beams(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        log.odometry(SECOND, Pose2())
        log.scan(scan(sweep_s=0.0), scan_time=0.2)
    for deskew, expected in ((False, 0.0), (True, 0.002)):
        events = open_log(tmp_path / "log.mcap", ReadOptions(deskew=deskew)).events()
        (found,) = (event for event in events if isinstance(event, Scan))
        assert found.time_increment == pytest.approx(expected)


@pytest.fixture(scope="module")
def skew(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a lidar that turns while the robot does."""
    path = tmp_path_factory.mktemp("skew") / "skew.mcap"
    scenario = preset("office")
    scenario = replace(scenario, seed=8, duration_s=25.0, sensor=replace(scenario.sensor, motion_distortion=True))  # type: ignore[arg-type]
    record(scenario, path)
    return path


def test_scans_of_a_turning_lidar_are_deskewed_where_the_result_shows_the_need(skew: Path) -> None:
    as_recorded, deskewed = ReadOptions(time_offset="/scan=0"), ReadOptions(deskew=True)
    errors = []
    for read in (as_recorded, deskewed, ReadOptions()):
        result = run(RunRequest(logs=(skew,), read=read))
        codes = [warning.code for warning in result.warnings]
        assert codes == ([WarningCode.SCANS_DESKEWED] if read == ReadOptions() else [])
        assert result.deskewed == (read != as_recorded)
        difference = result.trajectory.interpolated(result.reference.stamps_ns) - result.reference.poses
        errors.append(float(np.sqrt(np.mean(difference[:, 0] ** 2 + difference[:, 1] ** 2))))
    assert errors[1] < 0.015
    assert errors[0] > 3.0 * errors[1]
    assert errors[2] == errors[1]
    built = run(RunRequest(logs=(skew,), mode="slam"))
    assert [each.code for each in built.warnings] == [WarningCode.SCANS_DESKEWED]
    assert built.reference is not None
    assert evaluate(built.trajectory, built.reference, alignment="se2").ape.trans_part.rmse < 0.005


def test_beams_that_are_listed_against_their_time_are_found_out(skew: Path, tmp_path: Path) -> None:
    log = open_log(skew)
    map_path = save_map(built_in("office").occupancy_grid(0.05), tmp_path)
    with LogWriter(tmp_path / "clockwise.mcap") as out:
        out.transforms(SECOND, [("base_link", "laser", log.summary.T_base_laser)], static=True)
        for event in log.events():
            if isinstance(event, Scan):
                last = event.angle_min + (len(event.ranges) - 1) * event.angle_increment
                turned = replace(
                    event, angle_min=last, angle_increment=-event.angle_increment, ranges=event.ranges[::-1]
                )
                out.scan(turned)
            elif isinstance(event, Odometry):
                out.odometry(event.stamp_ns, event.T_odom_base)
    for mode in ("localise", "slam"):
        given: dict[str, Any] = {"map": map_path} if mode == "localise" else {}
        found = run(tmp_path / "clockwise.mcap", mode=mode, reference=skew, **given)
        (warning,) = (each for each in found.warnings if each.code == WarningCode.SCANS_DESKEWED)
        assert "the last beam was measured first" in warning.text
        assert found.request.read.scan_fix == "time_increment=reverse"
        assert found.reference is not None
        assert evaluate(found.trajectory, found.reference, alignment="se2").ape.trans_part.rmse < 0.01
