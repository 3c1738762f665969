"""Odometry noise as in *Probabilistic Robotics*, Table 5.6, and a covariance that is true to it."""

from __future__ import annotations

from itertools import pairwise
from math import cos, pi, radians, sin
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.model import Pose2
from hsloc.model.pose2 import wrap_angle
from hsloc.simulation.odometer import Odometer, OdometryNoise, Slip, SteeringNoise, decompose

if TYPE_CHECKING:
    from numpy.typing import NDArray

STEP_S = 0.1
NO_NOISE = OdometryNoise(0.0, 0.0, 0.0, 0.0)


def curve(steps: int = 200) -> list[Pose2]:
    """A drive with bends to both sides."""
    poses = [Pose2(3.0, -1.0, 2.0)]
    for i in range(steps):
        poses.append(poses[-1] @ Pose2(0.09, 0.0, 0.1 * sin(i / 15)))
    return poses


def run(
    noise: OdometryNoise | SteeringNoise, poses: list[Pose2], seed: int = 0, slips: tuple[Slip, ...] = ()
) -> Odometer:
    odometer = Odometer(noise, np.random.default_rng(seed), STEP_S, slips)
    for before, after in pairwise(poses):
        odometer.step(before, after)
    return odometer


def errors(
    noise: OdometryNoise | SteeringNoise, poses: list[Pose2], seeds: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors (n, 3) in the odometry's frame, and the covariance of each."""
    truth = poses[0].between(poses[-1])
    runs = [run(noise, poses, seed) for seed in range(seeds)]
    off = [run_.T_odom_base.to_array() - truth.to_array() for run_ in runs]
    return np.array([(x, y, wrap_angle(t)) for x, y, t in off]), np.array([run_.covariance for run_ in runs])


def test_without_noise_odometry_is_the_truth() -> None:
    poses = curve()
    odometer = run(NO_NOISE, poses)
    truth = poses[0].between(poses[-1])
    # half a micrometre of rounding a step
    assert odometer.T_odom_base.distance(truth) < 200 * 1e-6
    assert wrap_angle(odometer.T_odom_base.theta - truth.theta) == pytest.approx(0.0, abs=200 * 1e-6)
    assert odometer.twist[0] == pytest.approx(0.9, rel=1e-2)


def test_motion_comes_apart_into_turn_way_turn() -> None:
    before, after = Pose2(1.0, 2.0, 0.3), Pose2(1.0 + 2.0 * cos(0.7), 2.0 + 2.0 * sin(0.7), -0.5)
    assert decompose(before, after) == pytest.approx((0.4, 2.0, -1.2))
    assert decompose(before, Pose2(1.0, 2.0, 1.3)) == pytest.approx((0.0, 0.0, 1.0))


def test_deviations_are_those_of_the_book() -> None:
    rot1, trans, rot2 = 0.5, 2.0, -0.25
    noise = OdometryNoise(alpha1=0.1, alpha2=0.01, alpha3=0.2, alpha4=0.02)
    first, way, second = noise.deviations(rot1, trans, rot2, STEP_S)
    assert first**2 == pytest.approx(0.1 * 0.25 + 0.01 * 4.0)
    assert way**2 == pytest.approx(0.2 * 4.0 + 0.02 * (0.25 + 0.0625))
    assert second**2 == pytest.approx(0.1 * 0.0625 + 0.01 * 4.0)


@pytest.mark.parametrize(
    ("alphas", "motion", "axis", "sigma"),
    [
        ((0, 0, 0.04, 0), Pose2(1.0, 0.0, 0.0), 0, 0.2),
        ((0, 0.0025, 0, 0), Pose2(1.0, 0.0, 0.0), 2, 0.05 * 2**0.5),
        ((0.01, 0, 0, 0), Pose2(0.0, 0.0, 0.5), 2, 0.05),
        ((0, 0, 0, 0.01), Pose2(0.0, 0.0, 0.5), 0, 0.05),
    ],
    ids=["alpha3", "alpha2", "alpha1", "alpha4"],
)
def test_each_alpha_gives_its_noise(
    alphas: tuple[float, float, float, float], motion: Pose2, axis: int, sigma: float
) -> None:
    """One step: the standard deviation over 4,000 draws within 5 %, 4.5 times its own deviation of 1.1 %."""
    off, _ = errors(OdometryNoise(*alphas, interval_s=0.0), [Pose2(), motion], 4000)
    assert off[:, axis].std() == pytest.approx(sigma, rel=0.05)
    assert off[:, axis].mean() == pytest.approx(0.0, abs=5 * sigma / 4000**0.5)


def test_a_draw_is_held_so_that_the_interval_has_the_books_noise() -> None:
    """1 m in ten steps within one interval: as noisy as 1 m in one step. With fresh draws it would be a third."""
    ten_steps = [Pose2(0.1 * i, 0.0, 0.0) for i in range(11)]
    held, _ = errors(OdometryNoise(0, 0, 0.01, 0, interval_s=1.0), ten_steps, 2000)
    fresh, _ = errors(OdometryNoise(0, 0, 0.01, 0, interval_s=0.0), ten_steps, 2000)
    assert held[:, 0].std() == pytest.approx(0.1, rel=0.07)
    assert fresh[:, 0].std() == pytest.approx(0.1 / 10**0.5, rel=0.07)


@pytest.mark.unmeasured
@pytest.mark.parametrize(
    "noise",
    [OdometryNoise(), OdometryNoise(interval_s=0.0, alpha2=1e-4), SteeringNoise(steering=radians(0.2))],
    ids=["held", "fresh", "the report's"],
)
def test_the_covariance_is_that_of_the_errors(noise: OdometryNoise | SteeringNoise) -> None:
    """Mahalanobis distances squared are chi-square of 3 degrees: mean 3, and over 400 runs within 15 %."""
    off, covariances = errors(noise, curve(), 400)
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off)
    assert squared.mean() == pytest.approx(3.0, rel=0.15)


def test_covariance_is_definite_and_grows_all_along() -> None:
    odometer = Odometer(OdometryNoise(), np.random.default_rng(0), STEP_S)
    last = 0.0
    poses = curve(100)
    for before, after in pairwise(poses):
        odometer.step(before, after)
        covariance = odometer.covariance
        assert np.array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
        assert np.sqrt(covariance[2, 2]) > last * 0.999
        last = np.sqrt(covariance[2, 2])


def test_steering_noise_is_the_reports() -> None:
    noise = SteeringNoise(speed=0.1, steering=radians(0.5))
    assert noise.deviations(0.3, 0.075, 0.0, 0.025) == pytest.approx((radians(0.5), 0.0025, 0.0))


def test_slipping_wheels_count_ways_and_turns_that_were_not_made() -> None:
    poses = [Pose2(0.1 * i, 0.0, 0.0) for i in range(51)]
    odometer = run(NO_NOISE, poses, slips=(Slip(at_s=1.0, duration_s=2.0, factor=1.5),))
    assert odometer.T_odom_base.x == pytest.approx(5.0 + 0.5 * 2.0, abs=1e-4)
    turned = run(NO_NOISE, poses, slips=(Slip(at_s=1.0, duration_s=2.0, factor=1.0, turn_rate=pi / 8),))
    assert turned.T_odom_base.theta == pytest.approx(pi / 4, abs=1e-4)
    unaware = run(NO_NOISE, poses)
    np.testing.assert_allclose(np.diag(odometer.covariance)[[0, 2]], np.diag(unaware.covariance)[[0, 2]])
