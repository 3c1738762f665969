"""The kernels against their slow versions; the same tests run without the compiler (NUMBA_DISABLE_JIT=1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import naive
import numpy as np
import pytest

from hsloc.kernels.fitness import (
    fitness_many,
    normal_equations,
    pack,
    point_scores,
    range_noise,
    score_sum,
    score_with_noise,
)
from hsloc.kernels.levenberg_marquardt import polish, solve_damped

if TYPE_CHECKING:
    from numpy.typing import NDArray


@pytest.fixture
def scene() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(3)
    scores = rng.random((30, 40)).astype(np.float32)
    packed = np.empty((29, 39, 4), dtype=np.float32)
    pack(scores, packed, 0, 29, 0, 39)
    points = rng.uniform(-12.0, 12.0, (37, 2)).astype(np.float32)
    return scores, packed, points


@pytest.mark.parametrize("pose", [(20.0, 15.0, 0.3), (2.0, 27.5, -2.0), (-5.0, 3.0, 1.0), (500.0, 500.0, 0.0)])
def test_the_sum_is_that_of_the_naive_version_points_outside_count_nothing(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]], pose: tuple[float, float, float]
) -> None:
    scores, packed, points = scene
    expected = naive.score_sum(scores, points, *pose)
    assert score_sum(packed, points, *pose, -2.0) == pytest.approx(expected, abs=2e-4)
    assert fitness_many(packed, points, np.array([pose]))[0] == pytest.approx(expected / 37, abs=1e-5)


def test_scores_of_the_points_add_up(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    _, packed, points = scene
    each = np.empty(37, dtype=np.float32)
    point_scores(packed, points, 20.0, 15.0, 0.3, each)
    assert each.sum() == pytest.approx(score_sum(packed, points, 20.0, 15.0, 0.3, -2.0), abs=1e-4)


def test_a_candidate_is_dropped_only_if_it_cannot_win(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    _, packed, points = scene
    total = score_sum(packed, points, 20.0, 15.0, 0.3, -2.0)
    assert score_sum(packed, points, 20.0, 15.0, 0.3, total - 1e-9) == total
    assert score_sum(packed, points, 20.0, 15.0, 0.3, total) == -1.0
    assert score_sum(packed, points, 20.0, 15.0, 0.3, 36.9) == -1.0


def test_packing_part_of_a_field_touches_that_part_alone(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    scores, packed, _ = scene
    changed = scores.copy()
    changed[10:12, 10:12] = 0.0
    again = packed.copy()
    pack(changed, again, 9, 12, 9, 12)
    whole = np.empty_like(packed)
    pack(changed, whole, 0, 29, 0, 39)
    assert np.array_equal(again, whole)


def test_the_gradient_is_that_of_finite_differences(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    scores, packed, points = scene
    pose = np.array([20.3, 14.6, 0.4])
    information, gradient = np.empty((3, 3)), np.empty(3)
    total = normal_equations(packed, points, *pose, information, gradient)  # type: ignore[call-arg]
    # Single precision, and the two kernels add in another order.
    assert total == pytest.approx(score_sum(packed, points, *pose, -2.0), abs=1e-4)  # type: ignore[call-arg]
    jacobian = np.empty((37, 3))
    inside = np.empty(37)
    for i, point in enumerate(points):
        inside[i] = naive.score_sum(scores, [point], *pose)
        for j in range(3):
            step = np.zeros(3)
            step[j] = 1e-6
            ahead, behind = (naive.score_sum(scores, [point], *(pose + sign * step)) for sign in (1, -1))
            jacobian[i, j] = (ahead - behind) / 2e-6
    used = inside > 0.0
    np.testing.assert_allclose(information, jacobian[used].T @ jacobian[used], rtol=2e-3, atol=1e-3)
    np.testing.assert_allclose(gradient, jacobian[used].T @ (1.0 - inside[used]), rtol=2e-3, atol=2e-3)


def test_the_damped_step_solves_the_equations() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(3, 3))
    information, gradient, step = factor @ factor.T + np.eye(3), rng.normal(size=3), np.empty(3)
    solve_damped(information, gradient, 0.1, step)
    damped = information + 0.1 * np.diag(np.diag(information))
    np.testing.assert_allclose(damped @ step, gradient, atol=1e-6)


def test_a_singular_system_gives_no_step() -> None:
    step = np.ones(3)
    solve_damped(np.zeros((3, 3)), np.ones(3), 0.0, step)
    assert np.isfinite(step).all()


def test_polish_climbs_and_stays_in_the_box(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    _, packed, points = scene
    rng = np.random.default_rng(1)
    for _ in range(20):
        start = np.array([rng.uniform(5, 35), rng.uniform(5, 25), rng.uniform(-3, 3)])
        before = score_sum(packed, points, *start, -2.0)  # type: ignore[call-arg]
        pose = start.copy()
        half = np.array((0.5, 0.5, 0.05))
        low, high = start - half, start + half
        total, evaluations = polish(packed, points, pose, low, high, 15, np.zeros((3, 3)))
        assert total >= before - 1e-4
        assert total == pytest.approx(score_sum(packed, points, *pose, -2.0), abs=1e-4)  # type: ignore[call-arg]
        assert (pose >= low).all()
        assert (pose <= high).all()
        assert 1 <= evaluations <= 16


@pytest.mark.parametrize(("noise", "part"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.025)])
def test_what_noise_leaves_of_the_scores_shows_in_the_scan_itself(noise: float, part: float) -> None:
    rng = np.random.default_rng(5)
    angles = np.radians(np.arange(360.0))
    with np.errstate(divide="ignore"):  # a room of 8 x 6 m, from its middle
        true = np.minimum(4.0 / np.abs(np.cos(angles)), 3.0 / np.abs(np.sin(angles)))
    across = np.where(true * np.abs(np.cos(angles)) > 3.999, np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    off = (noise + part * true) * rng.standard_normal(360)
    ranges = (true + off).astype(np.float32)
    ranges[rng.random(360) < 0.2] = np.nan
    expected = float(np.exp(-np.abs(off) * across / 0.2).mean())
    found = score_with_noise(ranges, 0.1, 30.0, np.radians(1.0), 0.2)
    assert found == pytest.approx(expected, abs=0.03)
    ranges[20:40] *= 0.3  # somebody stands there
    assert score_with_noise(ranges, 0.1, 30.0, np.radians(1.0), 0.2) == pytest.approx(found, abs=0.02)


@pytest.mark.parametrize(("noise", "part"), [(0.01, 0.0), (0.0, 0.025)])
def test_each_range_shows_its_noise_by_those_around_it(noise: float, part: float) -> None:
    rng = np.random.default_rng(5)
    angles = np.radians(np.arange(0.0, 360.0, 0.5))
    with np.errstate(divide="ignore"):  # a hall of 18 x 6 m, from its middle
        true = np.minimum(9.0 / np.abs(np.cos(angles)), 3.0 / np.abs(np.sin(angles)))
    clear, found = np.empty(720), np.empty((12, 720))
    range_noise(true.astype(np.float32), 0.1, 30.0, np.radians(0.5), clear)
    assert np.median(clear) < 1e-5  # straight walls have none, at any angle
    assert clear.max() < 0.005  # and corners hardly any
    for row in found:
        ranges = (true + (noise + part * true) * rng.standard_normal(720)).astype(np.float32)
        ranges[rng.random(720) < 0.1] = np.nan
        range_noise(ranges, 0.1, 30.0, np.radians(0.5), row)
    near, far = found[:, true < 3.2], found[:, np.abs(np.cos(angles)) > 0.98]
    assert near.mean() == pytest.approx(noise + 3.1 * part, rel=0.1)
    assert far.mean() == pytest.approx(noise + 9.1 * part, rel=0.1)


def test_too_few_returns_do_not_show_the_noise() -> None:
    ranges = np.full(360, np.inf, dtype=np.float32)
    ranges[:9] = 2.0
    assert score_with_noise(ranges, 0.1, 30.0, np.radians(1.0), 0.2) == 1.0
    noise = np.ones(360)
    range_noise(ranges, 0.1, 30.0, np.radians(1.0), noise)
    assert not noise.any()
