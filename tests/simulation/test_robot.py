"""The robots keep their limits and get where they are sent."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, pi, radians
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from paths import DATA

from hsloc.model import Pose2
from hsloc.model.pose2 import wrap_angles
from hsloc.simulation.built_in import built_in
from hsloc.simulation.robot import DifferentialDrive, SteeredVehicle
from hsloc.simulation.world_files import load_world

if TYPE_CHECKING:
    from numpy.typing import NDArray

STEP_S = 0.02


def drive(
    robot: DifferentialDrive | SteeredVehicle,
    start: Pose2,
    path: NDArray[np.float64] | list[Any],
    step_s: float = STEP_S,
) -> NDArray[np.float64]:
    return np.array([pose.to_array() for pose in robot.drive(start, np.array(path, dtype=float), step_s)])


def rates(poses: NDArray[np.float64], step_s: Any = STEP_S) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    delta = np.diff(poses, axis=0)
    return np.hypot(delta[:, 0], delta[:, 1]) / step_s, wrap_angles(delta[:, 2]) / step_s


PATHS = {
    "straight": [(0, 0), (6, 0)],
    "right angle": [(0, 0), (4, 0), (4, 4)],
    "gentle": [(0, 0), (4, 0), (8, 1.5), (12, 0)],
    "there and back": [(0, 0), (4, 0), (0.5, 0)],
    "acute": [(0, 0), (4, 0), (1, 1.5)],
    "starts backwards": [(0, 0), (-4, 0)],
    "tiny legs": [(0, 0), (0.1, 0), (0.2, 0.05), (0.2, 0.05), (3, 0)],
}


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_differential_drive_follows_the_path_within_its_limits(path: list[Any]) -> None:
    robot = DifferentialDrive()
    poses = drive(robot, Pose2(), path)
    speed, turn = rates(poses)
    assert hypot(*(poses[-1, :2] - path[-1])) < 0.05
    assert speed[-1] < 0.05
    assert speed.max() <= robot.speed + 1e-3
    assert np.abs(turn).max() <= robot.turn_rate + 1e-3
    # a micrometre's lattice is a jitter of up to 2.4 mm/s^2 in what the differences show
    assert np.abs(np.diff(speed)).max() / STEP_S <= robot.acceleration + 0.02
    assert np.abs(np.diff(turn)).max() / STEP_S <= robot.turn_acceleration + 0.02
    legs = np.concatenate([a + np.linspace(0, 1, 200)[:, None] * np.subtract(b, a) for a, b in pairwise(path)])
    off = [np.hypot(*(legs - pose[:2]).T).min() for pose in poses[::10]]
    assert max(off) < 0.35


def test_the_robot_stands_still_before_it_starts() -> None:
    poses = drive(DifferentialDrive(pause_s=1.0), Pose2(0.5, 0.25, 0.125), [(0.5, 0.25), (4, 0)])
    assert (poses[: round(1.0 / STEP_S) + 1] == poses[0]).all()
    assert (poses[round(1.0 / STEP_S) + 5] != poses[0]).any()


def test_steered_vehicle_is_the_reports_motion_model() -> None:
    """x += v dt cos(g + theta), y += v dt sin(g + theta), theta += g, |g| <= 20 deg/s dt [P V]."""
    dt, v = 0.025, 3.0
    poses = drive(SteeredVehicle(), Pose2(), [(0, 0), (10, 5), (-20, 30)], dt)
    g = wrap_angles(np.diff(poses[:, 2]))
    assert np.abs(g).max() == pytest.approx(radians(20.0) * dt, abs=3e-6)
    np.testing.assert_allclose(np.diff(poses[:, 0]), v * dt * np.cos(g + poses[:-1, 2]), atol=3e-6)
    np.testing.assert_allclose(np.diff(poses[:, 1]), v * dt * np.sin(g + poses[:-1, 2]), atol=3e-6)


def test_a_u_turn_takes_the_time_that_the_turn_rate_gives() -> None:
    """Radius v / rate: a U-turn of 180 degrees takes pi / rate seconds, whatever the speed."""
    poses = drive(SteeredVehicle(), Pose2(), [(0, 0), (-60, 0)], 0.025)
    turning = np.abs(wrap_angles(np.diff(poses[:, 2]))) > radians(19.9) * 0.025
    assert turning.sum() * 0.025 == pytest.approx(pi / radians(20.0), rel=0.15)


def test_paper_world_is_driven_like_the_reports() -> None:
    world = built_in("paper")
    poses = drive(SteeredVehicle(), world.start(), world.path(), 0.025)
    assert len(poses) * 0.025 == pytest.approx(120.0, rel=0.1)


@pytest.mark.data
def test_the_reports_way_takes_the_published_time() -> None:
    """[P]: 119.8 s and 359 m; scans come every 0.2 s, of which 599 fit."""
    folder = DATA / "paper"
    if not (folder / "waypoints.csv").exists():
        pytest.skip(f"{folder} is not there; set HSLOC_DATA")
    world = load_world(folder / "localisation_map.csv", folder / "waypoints.csv")
    poses = drive(SteeredVehicle(), world.start(), world.path(), 0.025)
    seconds = (len(poses) - 1) * 0.025
    assert seconds == pytest.approx(119.8, abs=0.1)
    assert 3.0 * seconds == pytest.approx(359.0, abs=0.3)


def test_a_drive_is_the_same_every_time() -> None:
    world = built_in("office")
    first, second = (drive(DifferentialDrive(), world.start(), world.path(0.2)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
