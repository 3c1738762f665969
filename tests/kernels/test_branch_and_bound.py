from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.kernels.branch_and_bound import Excluded, Lattice, best_on_lattice, pool

if TYPE_CHECKING:
    from numpy.typing import NDArray

NOWHERE = np.array((-1.0, -1.0, -1.0))
ALL = Excluded(NOWHERE, NOWHERE)


def naive_best(
    scores: NDArray[np.float32],
    points: NDArray[np.float32],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    step: float,
    excluded: NDArray[np.float64],
    exclusion: NDArray[np.float64],
) -> tuple[np.float32, tuple[int, int, float]]:
    """Every pose of the lattice, one after the other."""
    best, pose = 0.0, None
    turns = int(np.ceil(half[2] / step))
    for turn in range(-turns, turns + 1):
        theta = centre[2] + turn * step
        c, s = np.cos(theta), np.sin(theta)
        cells = np.floor(points @ np.array(((c, s), (-s, c))) + 0.5).astype(int)
        for v in range(int(np.floor(centre[1] - half[1] + 0.5)), int(np.floor(centre[1] + half[1] + 0.5)) + 1):
            for u in range(int(np.floor(centre[0] - half[0] + 0.5)), int(np.floor(centre[0] + half[0] + 0.5)) + 1):
                away = np.abs((u - excluded[0], v - excluded[1], theta - excluded[2]))
                if exclusion[0] >= 0 and (away <= exclusion).all():
                    continue
                moved = cells + np.array((u, v))
                inside = ((moved >= 0) & (moved < scores.shape[::-1])).all(axis=1)
                fitness = scores[moved[inside, 1], moved[inside, 0]].sum() / len(points)
                if fitness > best:
                    best, pose = fitness, (u, v, theta)
    return best, pose  # type: ignore[return-value]


@pytest.fixture
def case() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    random = np.random.default_rng(5)
    scores = random.random((19, 23)).astype(np.float32) ** 4
    points = random.uniform(-4, 4, (7, 2)).astype(np.float32)
    return scores, points, np.array((9.3, 8.1, 0.4)), np.array((6.0, 5.0, 0.3))


def test_a_level_pools_the_squares_from_each_node_on() -> None:
    scores = np.random.default_rng(0).random((9, 11)).astype(np.float32)
    pooled = pool(scores, 3)
    for k in range(4):
        for v in range(9):
            for u in range(11):
                assert pooled[k, v, u] == scores[v : v + 2**k, u : u + 2**k].max()


@pytest.mark.parametrize("exclusion", [(-1.0, -1.0, -1.0), (2.0, 2.0, 0.15)])
@pytest.mark.parametrize("levels", [0, 2, 4])
def test_the_answer_is_that_of_trying_them_all(
    case: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]],
    levels: int,
    exclusion: tuple[float, float, float],
) -> None:
    scores, points, centre, half = case
    excluded = np.array(naive_best(scores, points, centre, half, 0.1, NOWHERE, NOWHERE)[1])
    want, where = naive_best(scores, points, centre, half, 0.1, excluded, np.array(exclusion))
    pose = np.empty(3)
    found, visits = best_on_lattice(
        pool(scores, levels),
        points,
        Lattice(centre, half, 0.1),
        Excluded(excluded, np.array(exclusion)),
        0.0,
        10**7,
        pose,
    )
    assert found == pytest.approx(want, abs=1e-6)
    np.testing.assert_allclose(pose, where, atol=1e-9)
    assert visits > 0


def test_nothing_better_than_what_is_needed_is_said_so(
    case: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]],
) -> None:
    scores, points, centre, half = case
    found, _ = best_on_lattice(pool(scores, 3), points, Lattice(centre, half, 0.1), ALL, 0.99, 10**7, np.empty(3))
    assert found == pytest.approx(0.99)


def test_out_of_visits_is_not_an_answer(
    case: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]],
) -> None:
    scores, points, centre, half = case
    found, visits = best_on_lattice(pool(scores, 3), points, Lattice(centre, half, 0.1), ALL, 0.0, 60, np.empty(3))
    assert found == -1.0
    assert visits > 60


def test_bounds_save_work(
    case: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]],
) -> None:
    scores, points, centre, half = case
    every = 13 * 11 * 7
    _, visits = best_on_lattice(pool(scores, 3), points, Lattice(centre, half, 0.1), ALL, 0.3, 10**7, np.empty(3))
    assert visits < every
