from __future__ import annotations

from dataclasses import replace
from math import radians
from typing import TYPE_CHECKING

import numpy as np
import pytest
from drives import ape_rmse, drive
from room_scans import room_scan

from hsloc.localisation.motion_models import OdometryNoise
from hsloc.model import Odometry, PairedScan, Pose2
from hsloc.model.pose2 import relative_poses, wrap_angle
from hsloc.simulation.floor_plan import floor_plan
from hsloc.simulation.odometer import Slip
from hsloc.simulation.presets import preset
from hsloc.simulation.sensors import Lidar, SensorNoise
from hsloc.simulation.world import World
from hsloc.slam.calibration import odometry_chi, odometry_scale
from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import GraphMapperParameters

if TYPE_CHECKING:
    from hsloc.slam.result import MappingResult


def mapped(events: list[Odometry | PairedScan]) -> MappingResult:
    mapper = Mapper(GraphMapperParameters(), np.random.default_rng(0))
    for event in events:
        mapper.update(event)
    return mapper.finish()


def test_the_weight_of_the_odometry_is_what_its_steps_deserve() -> None:
    noise, random = OdometryNoise(), np.random.default_rng(0)
    motion = Pose2(0.3, 0.0, 0.2)
    root = np.linalg.cholesky(noise.covariance(motion) + np.diag((0.005, 0.005, 0.002)) ** 2)
    for factor in (0.7, 1.0, 3.0):
        errors = factor * random.normal(size=(400, 3)) @ root.T
        motions = np.tile(motion.to_array(), (400, 1))
        chi = odometry_chi(motions, motions + errors, np.tile(noise.covariance(motion), (400, 1, 1)))
        assert odometry_scale(chi) == pytest.approx(factor, rel=0.15)
    assert odometry_scale(np.full(100, 0.01)) == 0.5
    assert odometry_scale(np.array([9.0])) == 1.0, "one step says nothing"


@pytest.mark.parametrize(
    "slip",
    [
        Slip(at_s=12.0, duration_s=0.5, factor=1.0, turn_rate=np.radians(160.0)),
        Slip(at_s=12.0, duration_s=0.5, factor=-1.0),
        Slip(at_s=12.0, duration_s=0.8, factor=2.0),
    ],
    ids=["80 deg", "reversed", "1 m"],
)
def test_a_step_that_odometry_has_wrong_is_found_by_the_scans(slip: Slip) -> None:
    """An 80 degree turn that did not happen was refused, and the rest of the map turned with it."""
    events, truth = drive("office", duration_s=25.0, seed=4, slips=(slip,))
    result = mapped(events)
    assert ape_rmse(events, result.scan_poses, truth) < 0.03
    assert result.evidence.verdict == "good"


def test_a_lidar_that_sees_four_metres_does_not_shorten_corridors() -> None:
    """The mean score pulled every step back to where the scans overlapped most."""
    sensor = replace(preset("corridor-loop").sensor, range_max=4.0)
    events, truth = drive("corridor-loop", duration_s=30.0, seed=2, sensor=sensor)
    result = mapped(events)
    assert ape_rmse(events, result.scan_poses, truth) < 0.15


def test_after_a_gap_in_the_scans_another_room_is_not_taken_for_the_last_one() -> None:
    """The window that was searched grew with the step, so that a map was 6 m off where corridors look alike."""
    mapper = Mapper(GraphMapperParameters(), np.random.default_rng(0))
    # Equal rooms, the second one entered with a turn; between them the lidar pauses, and the odometry goes on.
    there = [Pose2(x, 1.5, 0.0) for x in np.arange(2.0, 4.0, 0.2).tolist()]
    back = [Pose2(x, 2.5, np.pi) for x in np.arange(4.0, 2.0, -0.2).tolist()]
    moved = Pose2(-5.0, 8.0, 0.0)
    for k, in_room in enumerate((*there, *back)):
        scan = replace(room_scan(in_room, noise=0.01, seed=k), stamp_ns=k * 200_000_000)
        mapper.update(PairedScan(scan, in_room if k < len(there) else moved @ in_room))
    poses = mapper.finish().scan_poses
    step = relative_poses(poses[:1], poses[-1:])[0]
    assert step[:2] == pytest.approx((-5.0 + back[-1].x - there[0].x, 8.0 + 1.0), abs=0.1)


def test_a_camera_that_turns_at_a_dead_end_does_not_take_one_wall_for_another() -> None:
    """It saw a side wall only, which fits the end wall before it: a map was turned by 90 deg, and 43 m off."""
    world = World("end", floor_plan([(0.0, 0.0, 8.0, 1.85)]), np.empty((0, 2)))
    camera = Lidar(
        beams=160, field_of_view=radians(70.0), range_min=0.4, range_max=4.0, range_noise=0.02,
        mounting=Pose2(0.213, 0.031, 0.0),
    )  # fmt: skip
    random, mapper = np.random.default_rng(2), Mapper(GraphMapperParameters(), np.random.default_rng(0))
    there = [Pose2(x, 0.925, 0.0) for x in np.arange(4.0, 7.2, 0.1).tolist()]
    turn = [Pose2(7.2, 0.925, -angle) for angle in np.arange(0.08, np.pi, 0.15).tolist()]
    back = [Pose2(x, 0.925, np.pi) for x in np.arange(7.2, 5.2, -0.1).tolist()]
    for k, pose in enumerate((*there, *turn, *back)):
        at = pose.to_array()[None]
        scan = camera.measure(world, k * 100_000_000, 0.1, at, np.empty((0, 3)), SensorNoise(random, random))
        mapper.update(PairedScan(scan, pose))
    poses = mapper.finish().scan_poses
    step = relative_poses(poses[:1], poses[-1:])[0]
    expected = there[0].between(back[-1])
    assert np.hypot(step[0] - expected.x, step[1] - expected.y) < 0.1
    assert abs(wrap_angle(step[2] - expected.theta)) < radians(3.0)
