"""Odometry that is wrong for metres: a robot that is pushed, wheels that spin, or count backwards as forwards."""

from __future__ import annotations

from pathlib import Path

import log_formats
import numpy as np
import pytest

from hsloc.log import ReadOptions
from hsloc.model import Pose2
from hsloc.model.pose2 import compose_poses
from hsloc.replay.run import run
from hsloc.request import RunRequest

OFFICE = Path(__file__).resolve().parents[2] / "recordings" / "office.mcap"


@pytest.mark.parametrize(
    ("way", "turn"),
    [(0.0, 0.0), (0.0, 1.0), (-1.0, 1.0), (3.0, 1.0), (1.0, -1.0)],
    ids=["pushed", "turns are counted", "backwards as forwards", "wheels spin", "turned the other way"],
)
def test_a_map_is_right_where_the_odometry_is_wrong_for_metres(tmp_path: Path, way: float, turn: float) -> None:
    def change(number: int, motion: Pose2) -> Pose2:
        """Six seconds, in which the robot goes 4 m."""
        return Pose2(way * motion.x, way * motion.y, turn * motion.theta) if 600 <= number < 900 else motion

    log = log_formats.with_motions(tmp_path / "log.mcap", OFFICE, change)
    result = run(RunRequest(logs=(log,), mode="slam", read=ReadOptions(end_s=24.0)))
    assert result.reference is not None
    true = result.reference.interpolated(result.trajectory.stamps_ns)
    begin = Pose2.from_array(true[0]) @ Pose2.from_array(result.trajectory.poses[0]).inverse()
    off = compose_poses(begin.to_array(), result.trajectory.poses) - true
    error = np.hypot(off[:, 0], off[:, 1])
    assert np.sqrt(np.mean(error**2)) < 0.03
    # A push is seen after two scans without a way, and 0.1 m: until then nothing says where the robot was.
    assert error.max() < 0.3
