"""The mounting of a laser is found from the steps between matches and those of the odometry, with its uncertainty."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import isfinite

import numpy as np
import pytest

from hsloc.localisation.kalman_filter import Anchor
from hsloc.localisation.mounting_error import mounting_error
from hsloc.model.pose2 import IDENTITY, Pose2


def drive(wrong_by: Pose2, seed: int, left: float = 0.5, turned: float = 0.0) -> list[Anchor]:
    """200 matches 0.2 m apart, each with 5 mm and 2 mrad of noise; the odometry has 1 % of scale and noise, too.

    `turned` is the standard deviation of turns that the odometry reports before each step (rad), and there are none.
    """
    rng, other = np.random.default_rng(seed), np.random.default_rng(seed + 100)
    pose, odometry, anchors = Pose2(3.0, 4.0, 1.0), IDENTITY, []
    for k in range(200):
        turn = 0.2 if rng.random() < left else -0.2
        turn *= float(k % 3 != 0)
        noise = rng.normal(0.0, 1.0, 6) * (0.005, 0.005, 0.002, 0.004, 0.0, 0.004)
        seen = (pose @ wrong_by).to_array() + noise[:3]
        anchors.append(Anchor(k, odometry, Pose2.from_array(seen), np.eye(3), begins=k == 0))
        pose = pose @ Pose2(0.2, 0.0, turn)
        odometry = (
            odometry
            @ Pose2(0.0, 0.0, float(other.normal(0.0, turned)))
            @ Pose2(0.202 + float(noise[3]), 0.0, turn + float(noise[5]))
        )
    return anchors


@pytest.mark.parametrize("seed", range(5))
def test_a_laser_that_is_mounted_elsewhere_is_found(seed: int) -> None:
    found = mounting_error(drive(Pose2(0.08, -0.06, 0.05), seed))
    assert found is not None
    assert found.is_significant
    apart = found.error.to_array() - (0.08, -0.06, 0.05)
    assert (np.abs(apart) < 4.0 * np.array(found.sigma) + 1e-3).all()
    errors = found.pose_errors(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2.0)]))
    np.testing.assert_allclose(errors, [(0.08, 0.06, 0.05), (0.06, 0.08, 0.05)], atol=0.025)


@pytest.mark.parametrize("seed", range(5))
def test_a_laser_that_is_where_it_is_said_to_be_is_not_reported(seed: int) -> None:
    found = mounting_error(drive(IDENTITY, seed))
    assert found is not None
    assert not found.is_significant
    assert not found.pose_errors(np.ones((2, 3))).any()


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_the_odometry_that_turns_its_steps_is_no_place_of_the_laser(seed: int) -> None:
    found = mounting_error(drive(IDENTITY, seed, turned=0.1))
    assert found is not None
    assert not found.is_displaced
    assert abs(found.error.x) < 0.035  # by the turns of the odometry it would be 0.05


def test_few_matches_say_nothing() -> None:
    assert mounting_error(drive(IDENTITY, 0)[:40]) is None
    assert mounting_error([]) is None


@pytest.mark.parametrize(
    ("x", "y", "is_displaced"), [(0.08, 0.0, True), (0.0, 0.25, True), (0.0, 0.1, False), (0.0, 0.0, False)]
)
def test_where_all_turns_go_to_one_side_a_place_aside_may_be_slip(x: float, y: float, is_displaced: bool) -> None:
    found = mounting_error(drive(Pose2(x, y, 0.05), 0, left=1.0))
    assert found is not None
    assert found.is_displaced == is_displaced
    assert isfinite(found.place_sigma) == is_displaced
    assert found.error.x == pytest.approx(x, abs=0.02)
    assert found.is_turned
    assert found.error.theta == pytest.approx(0.05, abs=0.01)
    # Where its place is not known it may be wrong as well.
    assert is_displaced or (found.pose_errors(np.zeros((1, 3)))[0, :2] > 0.05).all()


@pytest.mark.parametrize("left", [0.5, 1.0], ids=["both sides", "one side"])
def test_odometry_that_turns_too_far_is_no_place_of_the_laser(left: float) -> None:
    """Half of what an arc turns too far is in the direction of the odometry's step."""
    anchors = drive(IDENTITY, 0, left=left)
    odometry, turned = IDENTITY, [anchors[0]]
    for last, anchor in pairwise(anchors):
        step = last.T_odom_base.between(anchor.T_odom_base)
        odometry = odometry @ Pose2(step.x, step.y + 0.25 * step.theta * step.x, 1.5 * step.theta)
        turned.append(replace(anchor, T_odom_base=odometry))
    found = mounting_error(turned)
    assert found is not None
    assert not found.is_displaced
    assert abs(found.error.x) < 0.01
