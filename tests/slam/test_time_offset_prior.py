from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.model.pose2 import compose_poses, relative_poses, wrap_angles
from hsloc.slam.calibration import OdometryCalibration, apply, calibrate, delayed

if TYPE_CHECKING:
    from numpy.typing import NDArray


def way(n: int = 2000, seed: int = 0) -> NDArray[np.float64]:
    """Steps of a robot that drives and turns in bursts."""
    random = np.random.default_rng(seed)
    turns = np.repeat(random.normal(0, 0.01, n // 50), 50)
    poses = [np.zeros(3)]
    for turn in turns:
        poses.append(compose_poses(poses[-1], np.array((0.02, 0.0, turn)))[0])
    return np.array(poses)


def scaled(poses: NDArray[np.float64], forward: float, turn: float) -> NDArray[np.float64]:
    steps = relative_poses(poses[:-1], poses[1:]) * (forward, forward, turn)
    measured = [poses[0]]
    for step in steps:
        measured.append(compose_poses(measured[-1], step)[0])
    return np.array(measured)


@pytest.mark.parametrize(("delay", "forward", "turn"), [(0.0, 1.0, 1.0), (0.5, 0.96, 0.97), (-0.3, 1.05, 1.02)])
def test_what_was_done_to_the_odometry_is_found(delay: float, forward: float, turn: float) -> None:
    fine = way(20_000)  # ten poses for each message
    true = fine[10:-10:10]
    measured = scaled(fine[10 + round(10 * delay) : -10 + round(10 * delay) : 10], 1.0 / forward, 1.0 / turn)
    index = np.arange(len(true), dtype=float)
    keys = np.arange(1, len(true) - 1, 2)
    found = calibrate(index, measured, keys, true[keys])
    assert found.delay == pytest.approx(delay, abs=0.11)
    assert found.way == pytest.approx(forward, abs=0.01)
    assert found.turn == pytest.approx(turn, abs=0.01)
    if turn != 1.0:
        told_wrong, left_wrong = (
            np.abs(wrap_angles(relative_poses(poses[:-50], poses[50:]) - relative_poses(true[:-50], true[50:])))[:, 2]
            for poses in (measured, apply(found, index, measured))
        )
        assert left_wrong.mean() < 0.7 * told_wrong.mean()


def test_few_steps_give_no_offset() -> None:
    true = way()[:60]
    index = np.arange(len(true), dtype=float)
    assert calibrate(index, scaled(true, 0.9, 0.9), np.arange(60), true) == OdometryCalibration()


def test_an_absurd_scale_is_not_accepted() -> None:
    true = way()
    index = np.arange(len(true), dtype=float)
    assert calibrate(index, scaled(true, 0.5, 1.0), np.arange(0, 2000, 2), true[:2000:2]).way == 1.0


def test_a_delay_reads_between_messages() -> None:
    odometry = np.array(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 0.0, 0.0)))
    index = np.array((1.0, 2.0, 3.0, 3.0))
    np.testing.assert_allclose(delayed(index, odometry, 0.5)[:, 0], (0.0, 0.5, 2.0, 2.0))
    np.testing.assert_allclose(delayed(index, odometry, -0.5)[:, 0], (0.5, 2.0, 3.0, 3.0))
