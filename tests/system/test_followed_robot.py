"""A robot whose map is made while its operator walks behind it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from log_builders import write_events

from hsloc import run
from hsloc.analysis.analyse import analyse
from hsloc.analysis.second_pass import posed_events
from hsloc.kernels.raycasting import cast_rays
from hsloc.maps import save_map
from hsloc.model import Pose2, Scan, Trajectory, Truth
from hsloc.model.events import PairedScan
from hsloc.model.pose2 import compose_poses
from hsloc.model.verdict import Verdict
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

WORLD = "hall"


def followed(scan: Scan, pose: Pose2, seconds: float) -> tuple[Scan, np.ndarray]:
    """The scan with a person 0.8 to 1.1 m behind the robot, and which beams see the person."""
    at, person = (
        pose @ scan.T_base_laser,
        pose @ Pose2(-0.95 - 0.15 * np.sin(seconds), 0.3 * np.sin(0.8 * seconds), 0.0),
    )
    angles = at.theta + scan.angles()
    ranges = cast_rays(
        np.tile((at.x, at.y), (len(angles), 1)),
        np.column_stack((np.cos(angles), np.sin(angles))),
        np.empty((0, 4)),
        np.array(((person.x, person.y, 0.22),)),
    )
    seen = np.fmin(scan.ranges, ranges.astype(np.float32))
    return replace(scan, ranges=seen), np.isfinite(ranges) & (ranges < scan.ranges)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trajectory, dict[int, np.ndarray]]:
    """A log of 40 s, the truth and which beams of each scan see the person."""
    scenario = Scenario(WORLD, seed=4, sensor=Lidar(beams=270), duration_s=40.0, scan_rate_hz=5.0)
    drive = list(events(scenario, load_world(WORLD)))
    truth = Trajectory.from_pairs([(e.stamp_ns, e.T_map_base) for e in drive if isinstance(e, Truth)])
    on_person: dict[int, np.ndarray] = {}
    for k, event in enumerate(drive):
        if isinstance(event, Scan):
            (pose,) = truth.interpolated(np.array([event.stamp_ns]))
            seconds = (event.stamp_ns - drive[0].stamp_ns) / 1e9
            drive[k], on_person[event.stamp_ns] = followed(event, Pose2.from_array(pose), seconds)
    return write_events(tmp_path_factory.mktemp("followed") / "run.mcap", drive), truth, on_person


def test_its_map_is_right_and_the_operator_is_left_out(
    recorded: tuple[Path, Trajectory, dict[int, np.ndarray]],
) -> None:
    path, truth, on_person = recorded
    result = run(path, mode="slam")
    metrics = analyse(result).metrics
    assert WarningCode.SCAN_COMPANIONS in {warning.code for warning in metrics.warnings}
    assert metrics.verdict is not Verdict.FAILED
    true = truth.interpolated(result.trajectory.stamps_ns)
    begin = Pose2.from_array(true[0]) @ Pose2.from_array(result.trajectory.poses[0]).inverse()
    off = compose_poses(begin.to_array(), result.trajectory.poses) - true
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    # The reports' pass over the log leaves the operator out as well.
    left, seen = 0, 0
    for posed in posed_events(result):
        if isinstance(posed.event, PairedScan):
            person = on_person[posed.event.scan.stamp_ns]
            left += int((person & np.isnan(posed.event.scan.ranges)).sum())
            seen += int(person.sum())
    assert left > 0.9 * seen


def test_on_a_given_map_the_operator_does_no_harm(
    recorded: tuple[Path, Trajectory, dict[int, np.ndarray]], tmp_path: Path
) -> None:
    path, truth, _ = recorded
    world = load_world(WORLD)
    start = Pose2.from_array(truth.poses[0])
    result = run(path, map=save_map(world.occupancy_grid(), tmp_path / "map.yaml"), initial_pose=start)
    assert result.localised.all()
    off = result.trajectory.poses - truth.interpolated(result.trajectory.stamps_ns)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.1
    assert WarningCode.SCAN_COMPANIONS not in {warning.code for warning in result.warnings}
