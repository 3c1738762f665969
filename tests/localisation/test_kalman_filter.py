"""The Kalman filter over poses: prediction, update and smoothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.errors import ConfigError
from hsloc.localisation.between_matches import between_matches, bridge_variances
from hsloc.localisation.interpolated_odometry import AtStamp, motion_variances
from hsloc.localisation.kalman_filter import (
    Anchor,
    Innovations,
    SmoothedMatches,
    fuse,
    predict_covariance,
    smooth_matches,
)
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.model import Pose2, wrap_angle
from hsloc.model.events import Interpolation

angles = st.floats(-3.0, 3.0)


def test_covariance_is_that_of_many_sampled_motions() -> None:
    rng = np.random.default_rng(0)
    noise = OdometryNoise(alpha1=0.01, alpha2=0.002, alpha3=0.01, alpha4=0.001)
    rot1, trans, rot2 = 0.3, 1.2, -0.2
    motion = Pose2(trans * np.cos(rot1), trans * np.sin(rot1), rot1 + rot2)
    n = 200_000
    turn = np.sqrt(0.01 * rot1**2 + 0.002 * trans**2), np.sqrt(0.01 * rot2**2 + 0.002 * trans**2)
    way = np.sqrt(0.01 * trans**2 + 0.001 * (rot1**2 + rot2**2))
    first, length, second = rng.normal(rot1, turn[0], n), rng.normal(trans, way, n), rng.normal(rot2, turn[1], n)
    samples = np.stack((length * np.cos(first), length * np.sin(first), first + second))
    np.testing.assert_allclose(noise.covariance(motion), np.cov(samples), rtol=0.1, atol=2e-4)


def test_prediction_is_that_of_many_sampled_poses() -> None:
    rng = np.random.default_rng(1)
    covariance = np.array([[0.004, 0.001, 0.0005], [0.001, 0.006, 0.0], [0.0005, 0.0, 0.003]])
    pose, motion = Pose2(1.0, 2.0, 0.8), Pose2(0.7, 0.1, 0.2)
    moved = OdometryNoise(alpha1=0.01, alpha2=0.001, alpha3=0.01, alpha4=0.0).covariance(motion)
    starts = rng.multivariate_normal(pose.to_array(), covariance, 40_000)
    motions = rng.multivariate_normal(motion.to_array(), moved, 40_000)
    ends = np.array([(Pose2(*a) @ Pose2(*b)).to_array() for a, b in zip(starts, motions, strict=True)])
    np.testing.assert_allclose(
        predict_covariance(covariance, pose, motion, moved), np.cov(ends.T), rtol=0.08, atol=3e-4
    )


def test_driving_backwards_is_no_turn() -> None:
    noise = OdometryNoise(alpha1=0.1, alpha2=0.0, alpha3=0.0, alpha4=0.0)
    assert np.abs(noise.covariance(Pose2(-0.5, 0.0, 0.0))).max() < 1e-20


def test_standing_still_is_certain() -> None:
    assert np.abs(OdometryNoise().covariance(Pose2())).max() == 0.0


@given(angles, angles)
def test_fusing_ends_between_prediction_and_measurement(theta: Any, measured: Any) -> None:
    covariance = np.diag((0.04, 0.01, 0.02))
    pose, updated = fuse(Pose2(0.0, 0.0, theta), covariance, Pose2(1.0, 1.0, measured), covariance)
    assert pose.x == pytest.approx(0.5)
    assert pose.y == pytest.approx(0.5)
    difference = wrap_angle(measured - theta)
    if abs(difference) < 3.0:
        assert wrap_angle(pose.theta - theta) == pytest.approx(difference / 2.0, abs=1e-9)
    np.testing.assert_allclose(updated, covariance / 2.0, atol=1e-12)


def test_a_sure_measurement_wins() -> None:
    pose, updated = fuse(Pose2(), np.eye(3), Pose2(1.0, 2.0, 0.3), np.eye(3) * 1e-9)
    assert pose.distance(Pose2(1.0, 2.0, 0.3)) < 1e-6
    assert np.diag(updated).max() < 1e-6


def test_negative_noise_is_refused() -> None:
    with pytest.raises(ConfigError, match="alpha2 is -1"):
        OdometryNoise(alpha2=-1.0)


SURE = np.diag((1e-6, 1e-6, 1e-6))


def anchor(
    count: int,
    odometry: Pose2,
    place: Pose2,
    covariance: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    *,
    begins: bool = False,
) -> Anchor:
    return Anchor(count, odometry, place, covariance, begins)


def as_matched(anchors: list[Anchor]) -> SmoothedMatches:
    """Matches that are not smoothed."""
    n = len(anchors)
    poses = np.array([a.T_map_base.to_array() for a in anchors])
    return SmoothedMatches(poses, np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3)))


def straight(n: int, step: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.column_stack((step * np.arange(n), np.zeros(n), np.zeros(n)))


@pytest.mark.parametrize("at", [0.4, 0.9], ids=["at the last message", "in a gap after it"])
def test_between_two_matches_an_error_of_the_odometry_is_shared_out(at: float) -> None:
    odometry = straight(5, 0.1)  # a robot that in truth went 20 % farther
    true = odometry * (1.2, 1.0, 1.0)
    first = anchor(1, Pose2(), Pose2(), SURE, begins=True)
    last = anchor(5, Pose2(at, 0.0, 0.0), Pose2(1.2 * at, 0.0, 0.0), SURE)
    matched = as_matched([first, last])
    smoothed = between_matches(odometry, odometry, [first, last], matched)
    assert smoothed == pytest.approx(true, abs=1e-6)


def test_poses_before_the_first_match_lead_to_it_where_it_is_that_of_the_start() -> None:
    odometry = straight(5, 0.1)
    guessed = odometry + np.array((0.0, 0.3, 0.0))
    anchors = [anchor(3, Pose2(0.2, 0.0, 0.0), Pose2(0.2, 0.0, 0.0), SURE, begins=True)]
    anchors.append(anchor(5, Pose2(0.4, 0.0, 0.0), Pose2(0.4, 0.0, 0.0), SURE))
    matched = as_matched(anchors)
    assert between_matches(guessed, odometry, anchors, matched, leads_to_first=True)[:3] == pytest.approx(odometry[:3])
    assert (between_matches(guessed, odometry, anchors, matched)[:3] == guessed[:3]).all()


def test_over_the_begin_of_another_track_nothing_is_shared_out() -> None:
    odometry = straight(5, 0.1)
    anchors = [
        anchor(1, Pose2(), Pose2(), SURE, begins=True),
        anchor(4, Pose2(0.3, 0.0, 0.0), Pose2(9.0, 0.0, 0.0), SURE, begins=True),
    ]
    matched = as_matched(anchors)
    assert (between_matches(odometry, odometry, anchors, matched) == odometry).all()
    assert (smooth_matches(anchors, OdometryNoise())[0] == matched.poses).all()


def test_what_the_end_of_a_corridor_shows_corrects_the_poses_before() -> None:
    # Along x nothing was measured until the last match; the filter had drifted by 0.2 m.
    along = np.diag((0.04, 1e-6, 1e-6))
    places = [Pose2(0.5 * k + 0.05 * k, 0.0, 0.0) for k in range(4)]
    anchors = [anchor(k, Pose2(0.55 * k, 0.0, 0.0), places[k], along, begins=k == 0) for k in range(4)]
    anchors.append(anchor(4, Pose2(2.2, 0.0, 0.0), Pose2(2.0, 0.0, 0.0), SURE))
    smoothed, covariances, *_ = smooth_matches(anchors, OdometryNoise())
    before = abs(places[3].x - 1.5)
    assert abs(smoothed[3, 0] - 1.5) < 0.5 * before
    assert np.abs(smoothed[:, 1:]).max() < 1e-9
    # The end holds the poses before it: the nearest best, by the noise of the odometry in between.
    assert 0.05 < np.sqrt(covariances[3, 0, 0]) < 0.06
    assert (np.diff(covariances[:, 0, 0]) < 0.0).all()
    assert covariances[0, 0, 0] < along[0, 0]


def test_a_slip_is_not_taken_for_noise() -> None:
    anchors = [
        anchor(0, Pose2(), Pose2(), SURE, begins=True),
        anchor(1, Pose2(0.3, 0.0, 0.0), Pose2(1.3, 0.0, 0.0), SURE),
    ]
    assert (smooth_matches(anchors, OdometryNoise())[0][0] == 0.0).all()


def test_the_noise_of_the_odometry_is_taken_from_the_innovations() -> None:
    rng = np.random.default_rng(0)
    before, information = 1e-9 * np.eye(3), np.diag((1e6, 1e6, 1e6))
    noise = OdometryNoise().covariance(Pose2(0.2, 0.0, 0.05)) + before
    for true, low, high in ((9.0, 5.0, 15.0), (1.0, 0.6, 1.6), (0.1, 0.04, 0.2)):
        found = Innovations()
        for _ in range(200):
            found.add(rng.multivariate_normal(np.zeros(3), true * noise), information, before, noise)
        assert low <= found.noise_scale <= high
        assert found.excess < 2.0


def test_one_slip_is_no_noise() -> None:
    found, none, noise, information = Innovations(), np.zeros((3, 3)), 1e-4 * np.eye(3), 1e6 * np.eye(3)
    found.add(np.array((0.5, 0.0, 0.0)), information, none, noise)
    assert found.noise_scale < 3.0
    before = found.noise_scale
    found.add(np.array((9.0, 9.0, 9.0)), none, none, noise)
    assert found.noise_scale == before


def test_matches_that_fit_worse_than_usual_before_a_jump_may_be_off_by_as_much() -> None:
    anchors = [anchor(k, Pose2(0.2 * k, 0.0, 0.0), Pose2(0.2 * k, 0.0, 0.0), SURE, begins=k == 0) for k in range(6)]
    anchors[3:5] = [replace(each, fits_as_usual=False) for each in anchors[3:5]]
    anchors[5] = replace(anchors[5], T_map_base=Pose2(1.5, 0.0, 0.0))
    covariances = smooth_matches(anchors, OdometryNoise()).covariances
    assert np.sqrt(covariances[3:5, 0, 0]) == pytest.approx(0.5, abs=0.05)
    assert np.sqrt(covariances[:3, 0, 0]).max() < 0.05
    assert np.sqrt(covariances[:, 1, 1]).max() < 0.05


def test_what_a_match_may_be_off_by_is_not_forgotten_at_a_smaller_jump() -> None:
    anchors = [anchor(k, Pose2(0.2 * k, 0.0, 0.0), Pose2(0.2 * k, 0.0, 0.0), SURE, begins=k == 0) for k in range(7)]
    anchors[2:6] = [replace(each, fits_as_usual=False) for each in anchors[2:6]]
    anchors[4:6] = [replace(each, T_map_base=each.T_map_base @ Pose2(0.3, 0.0, 0.0)) for each in anchors[4:6]]
    anchors[6] = replace(anchors[6], T_map_base=Pose2(4.2, 0.0, 0.0))
    sigma = np.sqrt(smooth_matches(anchors, OdometryNoise()).covariances[:, 0, 0])
    assert sigma[4:6] == pytest.approx(2.7, abs=0.1)
    assert sigma[2:4].min() > 2.7
    assert sigma[:2].max() < 0.05


def test_between_two_matches_the_odometry_adds_its_noise() -> None:
    odometry = straight(7, 0.1)
    anchors = [
        anchor(1, Pose2(), Pose2(), SURE, begins=True),
        anchor(5, Pose2(0.4, 0.0, 0.0), Pose2(0.4, 0.0, 0.0), SURE),
    ]
    matched = smooth_matches(anchors, OdometryNoise())
    motion = matched.motion
    assert motion[1, 0] == pytest.approx(0.01 * 0.4**2)
    found, unsure = bridge_variances(odometry, anchors, matched, OdometryNoise())
    assert not unsure.any()
    assert found[2:4].min() > 0.0
    np.testing.assert_allclose(found[2, 0], motion[1, 0] / 4.0)
    assert (found[[0, 5, 6]] == 0.0).all()


def test_over_a_long_gap_the_errors_of_the_odometry_are_a_walk() -> None:
    odometry, noise = straight(21, 0.1), OdometryNoise()
    anchors = [
        anchor(1, Pose2(), Pose2(), SURE, begins=True),
        anchor(21, Pose2(2.0, 0.0, 0.0), Pose2(2.0, 0.0, 0.0), SURE),
    ]
    found, _ = bridge_variances(odometry, anchors, smooth_matches(anchors, noise), noise)
    # Ten motions of 0.2 m: half-way a quarter of what they add up to is left, along, and of the heading.
    expected = np.array((0.01, 2.0 * 0.02)) * 10.0 * 0.2**2 / 4.0
    np.testing.assert_allclose(found[10, [0, 2]], expected, rtol=0.1)
    # Aside, what is left of walks of the heading of which both ends, places and headings, are known.
    walks = np.cumsum(np.random.default_rng(0).normal(0.0, np.sqrt(0.04) * 0.2, (20_000, 10)), axis=1)
    ends, middle = np.column_stack((0.2 * walks.sum(axis=1), walks[:, -1])), 0.2 * walks[:, :5].sum(axis=1)
    aside = np.var(middle - ends @ np.linalg.lstsq(ends, middle, rcond=None)[0])
    assert aside < found[10, 1] < 10.0 * aside


def test_of_a_slip_between_two_matches_it_is_not_known_when_it_was() -> None:
    odometry = straight(5, 0.1)
    first = anchor(1, Pose2(), Pose2(), SURE, begins=True)
    anchors = [first, anchor(5, Pose2(0.4, 0.0, 0.0), Pose2(1.0, 0.0, 0.0), SURE)]
    found, unsure = bridge_variances(odometry, anchors, smooth_matches(anchors, OdometryNoise()), OdometryNoise())
    # 0.6 m, at any time: where half of it is taken, the pose is off by 0.3 m at most.
    assert np.sqrt(found[2, 0]) == pytest.approx(0.6 / np.sqrt(12.0), abs=0.01)
    assert 0.6 / np.sqrt(12.0) < np.sqrt(found[3, 0]) < 0.6 / np.sqrt(3.0)
    assert unsure.tolist() == [False, True, True, True, True]


def test_a_robot_goes_no_farther_beside_its_mean_speed_than_it_can_accelerate() -> None:
    odometry = straight(5, 0.1)
    first = replace(anchor(1, Pose2(), Pose2(), SURE, begins=True), at=AtStamp(0))

    def sigma(seconds: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Along the path, at even times in a slip of 0.6 m."""
        stamps = np.round(np.arange(5) * seconds / 4.0 * 1e9).astype(np.int64)
        last = replace(anchor(5, Pose2(0.4, 0.0, 0.0), Pose2(1.0, 0.0, 0.0), SURE), at=AtStamp(int(stamps[-1])))
        matched = smooth_matches([first, last], OdometryNoise())
        variances, _ = bridge_variances(odometry, [first, last], matched, OdometryNoise(), stamps_ns=stamps)
        return np.asarray(np.sqrt(variances[:, 0]))

    assert sigma(10.0)[2] == pytest.approx(0.6 / np.sqrt(12.0), abs=0.01), "there is time for all of it"
    # 5 m/s^2 over 0.1 s to either side: 2.5 cm by the robot, and as much by the odometry.
    expected = np.hypot(0.05 / np.sqrt(3.0), 0.02)
    assert sigma(0.2)[2] == pytest.approx(expected, abs=0.01)
    assert sigma(0.2)[1:4].max() < 0.05


GAP = Interpolation(0, 1_000_000_000, 0.01, 0.04)


def test_a_measured_pose_keeps_to_the_match_whose_odometry_was_measured_too() -> None:
    # The robot began to turn after the message at 0 s; half-way to the next the odometry is off by 0.2 rad.
    odometry = np.array([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.1, 0.0, 0.4)])
    first = anchor(1, Pose2(), Pose2(), SURE, begins=True)
    second = replace(anchor(2, Pose2(0.1, 0.0, 0.2), Pose2(0.1, 0.0, 0.0), SURE), at=AtStamp(500_000_000, GAP))
    matched = smooth_matches([first, second], OdometryNoise())
    smoothed = between_matches(odometry, odometry, [first, second], matched)
    assert abs(smoothed[1, 2]) < 0.01
    variances, unsure = bridge_variances(odometry, [first, second], matched, OdometryNoise())
    assert unsure.tolist() == [False, True, False]
    assert np.sqrt(variances[1, 2]) < 0.04


def test_an_interpolated_pose_is_as_uncertain_as_the_time_between_matches_makes_it() -> None:
    odometry, none = straight(11, 0.1), OdometryNoise(alpha1=0.0, alpha2=0.0, alpha3=0.0, alpha4=0.0)
    stamps = [100_000_000 * k for k in range(11)]
    interpolated = {k: AtStamp(stamps[k], GAP) for k in range(1, 10)}

    def sigma(last: int) -> float:
        """Of the heading half-way between matches at the second message and at another one."""
        anchors = [
            replace(anchor(k + 1, Pose2(0.1 * k, 0.0, 0.0), Pose2(0.1 * k, 0.0, 0.0), SURE), at=AtStamp(stamps[k], GAP))
            for k in (1, last)
        ]
        variances, unsure = bridge_variances(odometry, anchors, smooth_matches(anchors, none), none, interpolated)
        assert unsure[1:10].all()
        return float(np.sqrt(variances[(1 + last) // 2, 2]))

    assert sigma(9) == pytest.approx(0.2 * 0.8**1.5)
    assert sigma(3) == pytest.approx(0.2 * 0.2**1.5)


def test_a_motion_between_two_interpolated_poses_is_off_by_both_errors_or_by_a_wrong_speed() -> None:
    measured, half = AtStamp(0), AtStamp(500_000_000, GAP)
    np.testing.assert_allclose(motion_variances(measured, half), (0.01, 0.01, 0.04))
    other = AtStamp(1_500_000_000, GAP._replace(before_ns=1_000_000_000, after_ns=2_000_000_000))
    np.testing.assert_allclose(motion_variances(half, other), (0.02, 0.02, 0.08))
    near = AtStamp(600_000_000, GAP)
    np.testing.assert_allclose(motion_variances(half, near), np.array((0.01, 0.01, 0.04)) * 0.2**2)
