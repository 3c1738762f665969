"""The prediction and update of the EKF, against sampling and against algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.errors import ConfigError
from hsloc.localisation.motion import OdometryNoise, fuse, predict_covariance
from hsloc.model import Pose2, wrap_angle

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
