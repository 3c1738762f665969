"""The mounting of a laser is found from the steps between matches and those of the odometry, with its uncertainty."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np
import pytest
from mounting_drives import drive

from hsloc.localisation.mounting_error import MountingError, mounting_error, steps_of_anchors
from hsloc.model.pose2 import IDENTITY, Pose2

if TYPE_CHECKING:
    from hsloc.localisation.kalman_filter import Anchor


def by_matches(anchors: list[Anchor]) -> MountingError | None:
    steps = steps_of_anchors(anchors)
    return None if steps is None else mounting_error(steps)


@pytest.mark.parametrize("seed", range(5))
def test_a_laser_that_is_mounted_elsewhere_is_found(seed: int) -> None:
    found = by_matches(drive(Pose2(0.08, -0.06, 0.05), seed))
    assert found is not None
    assert found.is_significant
    apart = found.error.to_array() - (0.08, -0.06, 0.05)
    assert (np.abs(apart) < 4.0 * np.array(found.sigma) + 1e-3).all()
    errors = found.pose_errors(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2.0)]))
    np.testing.assert_allclose(errors, [(0.08, 0.06, 0.05), (0.06, 0.08, 0.05)], atol=0.025)


@pytest.mark.parametrize("seed", range(5))
def test_a_laser_that_is_where_it_is_said_to_be_is_not_reported(seed: int) -> None:
    found = by_matches(drive(IDENTITY, seed))
    assert found is not None
    assert not found.is_significant
    assert not found.pose_errors(np.ones((2, 3))).any()


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_the_odometry_that_turns_its_steps_is_no_place_of_the_laser(seed: int) -> None:
    found = by_matches(drive(IDENTITY, seed, turned=0.1))
    assert found is not None
    assert not found.is_displaced
    assert abs(found.error.x) < 0.035  # by the turns of the odometry it would be 0.05


def test_few_matches_say_nothing() -> None:
    assert steps_of_anchors(drive(IDENTITY, 0)[:40]) is None
    assert steps_of_anchors([]) is None


@pytest.mark.parametrize(
    ("x", "y", "is_displaced"), [(0.08, 0.0, True), (0.0, 0.25, True), (0.0, 0.1, False), (0.0, 0.0, False)]
)
def test_where_all_turns_go_to_one_side_a_place_aside_may_be_slip(x: float, y: float, is_displaced: bool) -> None:
    found = by_matches(drive(Pose2(x, y, 0.05), 0, left=1.0))
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
    found = by_matches(turned)
    assert found is not None
    assert not found.is_displaced
    assert abs(found.error.x) < 0.01
