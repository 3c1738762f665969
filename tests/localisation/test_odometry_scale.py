"""The scales of the odometry, from the innovations of a filter that takes their errors for noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hsloc.localisation.kalman_filter import difference, predict_covariance, update_with_information
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.localisation.odometry_scale import OdometryScale, OdometryScaleEstimator
from hsloc.model import Odometry, Pose2
from hsloc.model.pose2 import IDENTITY, rotated

SURE = OdometryScale(0.25, -0.1, 0.001, 0.001)


def driven(
    true: OdometryScale, *, along: float = 1e6, slips: tuple[int, ...] = (), mounting: Pose2 = IDENTITY
) -> OdometryScale | None:
    """What is found in a drive of 300 steps of the odometry, 0.2 m and up to 0.3 rad each.

    `along` is the information (1/m^2) that matches have along the heading; before the steps `slips` the wheels slip.
    The laser is at `mounting` from where it is stated, and so are the poses of the matches.
    """
    rng, noise, subject = np.random.default_rng(0), OdometryNoise(), OdometryScaleEstimator()
    place, pose = Pose2(), mounting
    covariance = 1e-6 * np.eye(3)
    for k in range(300):
        turn = 0.3 if k % 40 < 15 else 0.0
        motion = Pose2(0.2, 0.0, turn * (1.0 if k % 80 < 40 else -1.0))
        turned = true.turn * motion.theta + true.drift * motion.x
        half = 0.5 * turned
        length = (1.0 + true.way) * motion.x + (0.5 if k in slips else 0.0)
        place = place @ Pose2(length * np.cos(half), length * np.sin(half), motion.theta + turned)
        information = rotated(np.diag((along, 1e4, 1e5)), place.theta)
        seen = Pose2.from_array((place @ mounting).to_array() + rng.normal(0.0, (0.003, 0.003, 0.001)))
        moved = noise.covariance(motion)
        subject.predict(pose, motion)
        covariance, pose = predict_covariance(covariance, pose, motion, moved), pose @ motion
        weight = information @ np.linalg.inv(np.eye(3) + covariance @ information)
        subject.update(difference(seen, pose), covariance, weight)
        pose, covariance = update_with_information(pose, covariance, seen, information)
    return subject.estimate()


@pytest.mark.parametrize("along", [1e4, 100.0])
@pytest.mark.parametrize(("way", "turn"), [(0.25, -0.1), (-0.05, 0.0), (0.0, 0.2)])
def test_both_scales_are_found_also_where_walls_hold_the_poses_weakly(way: float, turn: float, along: float) -> None:
    found = driven(OdometryScale(way, turn), along=along)
    assert found is not None
    assert found.way == pytest.approx(way, abs=0.01)
    assert found.turn == pytest.approx(turn, abs=0.015)
    assert (found.of_way, found.of_turn) == (way != 0.0, turn != 0.0)


@pytest.mark.parametrize(("turn", "drift"), [(0.0, 0.05), (0.0, -0.03), (-0.1, 0.04)])
def test_turns_that_come_with_the_distance_are_no_scale_of_the_turns(turn: float, drift: float) -> None:
    found = driven(OdometryScale(0.0, turn, drift=drift))
    assert found is not None
    assert found.drift == pytest.approx(drift, abs=0.005)
    assert found.turn == pytest.approx(turn, abs=0.015)
    assert (found.of_way, found.of_turn, found.of_drift) == (False, turn != 0.0, True)


@pytest.mark.parametrize("mounting", [Pose2(0.05, 0.0, 0.0), Pose2(-0.1, 0.04, 0.0), Pose2(0.0, 0.0, 0.05)])
def test_a_laser_that_is_mounted_elsewhere_than_stated_is_no_error_of_the_odometry(mounting: Pose2) -> None:
    found = driven(OdometryScale(0.0, 0.0), mounting=mounting)
    assert found is not None
    assert not found.is_significant
    assert abs(found.turn) < 0.01
    both = driven(OdometryScale(0.1, 0.0), mounting=mounting)
    assert both is not None
    assert (both.of_way, both.of_turn, both.of_drift) == (True, False, False)
    assert both.way == pytest.approx(0.1, abs=0.01)


def test_odometry_that_counts_rightly_is_left_as_it_is() -> None:
    found = driven(OdometryScale(0.0, 0.0), slips=(50, 120, 190, 260))
    assert found is not None
    assert not found.is_significant


def test_nothing_is_said_of_a_short_drive_or_where_nothing_was_seen() -> None:
    subject = OdometryScaleEstimator()
    assert subject.estimate() is None
    for _ in range(300):
        subject.predict(Pose2(), Pose2(0.2, 0.0, 0.0))
        subject.update(np.array((0.1, 0.0, 0.0)), np.eye(3), np.zeros((3, 3)))
    blind = subject.estimate()
    assert blind is not None
    assert not blind.is_significant


def test_corrected_odometry_counts_rightly_from_where_it_began() -> None:
    poses = [Pose2(1.0, 2.0, 0.5), Pose2(1.0, 2.0, 0.5) @ Pose2(0.4, 0.0, 0.2)]
    poses.append(poses[1] @ Pose2(0.4, 0.0, 0.0))
    events = [Odometry(k, pose) for k, pose in enumerate(poses)]
    corrected = [event.T_odom_base for event in SURE.applied(events) if isinstance(event, Odometry)]
    assert corrected[0] == poses[0]
    step = corrected[0].between(corrected[1])
    # The chord of an arc that turns by 0.02 less points by half of that aside.
    assert (step.x, step.y, step.theta) == pytest.approx((0.5, -0.005, 0.18), abs=1e-4)
    assert corrected[1].between(corrected[2]).x == pytest.approx(0.5)
    of_way = replace(SURE, turn_sigma=1.0)  # a scale that may be 0 is left out
    turned = [event.T_odom_base for event in of_way.applied(events) if isinstance(event, Odometry)]
    assert turned[0].between(turned[1]).theta == pytest.approx(0.2)


def test_a_correction_is_kept_where_little_of_the_error_is_left() -> None:
    assert SURE.is_mended(OdometryScale(0.01, 0.01))
    assert not SURE.is_mended(OdometryScale(0.2, 0.01))
    assert not SURE.is_mended(OdometryScale(0.01, -0.09))
    assert not SURE.is_mended(None)
    assert "distances 0.800 times and turns 1.111 times" in SURE.warning().text
    assert "turns" not in replace(SURE, turn_sigma=1.0).warning().text
    drifting = replace(SURE, drift=0.1)
    assert "and misses turns of 5.73 deg with each metre" in drifting.warning().text
    assert not drifting.is_mended(OdometryScale(0.01, 0.01, drift=0.09))
    assert drifting.is_mended(OdometryScale(0.01, 0.01, drift=0.01))
