"""The search kernel against a plain reading of the papers, and its laws."""

from __future__ import annotations

from math import exp, log
from typing import TYPE_CHECKING, Any

import naive
import numpy as np
import pytest

from hsloc.kernels.fitness import pack, score_sum
from hsloc.kernels.search import (
    STOPPED_AGREEMENT,
    STOPPED_BUDGET,
    Box,
    Found,
    Memory,
    SearchParameters,
    improve_memory,
    search,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

NONE = np.empty(0)


def parameters(**changes: bool | int) -> SearchParameters:
    values: dict[str, Any] = {
        "memory_size": 8, "consideration_rate": 0.88, "par_min": 0.55, "par_max": 0.98,
        "bandwidth_max": (2.0, 2.0, 0.2), "bandwidth_ratio": 0.01, "improvisations_per_pass": 5, "attraction": 0.7,
        "differential_weight": 0.44, "budget": 60, "count_improvisations": False, "restarts": 1, "agreement": 1,
        "polish_iterations": 0,
    }  # fmt: skip
    return SearchParameters(**{**values, **changes})


@pytest.fixture
def scene() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(5)
    smooth = np.exp(-(((np.arange(40)[:, None] - 20) ** 2) + (np.arange(50)[None, :] - 25) ** 2) / 60.0)
    scores = (0.8 * smooth + 0.2 * rng.random((40, 50))).astype(np.float32)
    packed = np.empty((39, 49, 4), dtype=np.float32)
    pack(scores, packed, 0, 39, 0, 49)
    points = rng.uniform(-4.0, 4.0, (20, 2)).astype(np.float32)
    return scores, packed, points


def naive_hide(
    score: Callable[..., Any],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    p: SearchParameters,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """HS and HIDE as in the papers; draws from `rng` in the same order as the kernel."""
    low, high = centre - half, centre + half
    memory = np.empty((p.memory_size, 3))
    for i in range(p.memory_size):
        for j in range(3):
            memory[i, j] = centre[j] if i == 0 else low[j] + rng.random() * (high[j] - low[j])
    fitness = np.array([score(row) for row in memory])
    evaluations, improvisations = p.memory_size, 0

    def spent() -> Any:
        return improvisations if p.count_improvisations else evaluations

    while spent() < p.budget:
        in_a_row = p.improvisations_per_pass or p.budget
        for _ in range(in_a_row):
            if spent() >= p.budget:
                break
            progress = min((spent() + 1) / p.budget, 1.0)
            par = p.par_min + (p.par_max - p.par_min) * progress
            shrunk = exp(log(p.bandwidth_ratio) * progress)
            new = np.empty(3)
            for j in range(3):
                if rng.random() < p.consideration_rate:
                    new[j] = memory[int(rng.random() * p.memory_size), j]
                    if rng.random() < par:
                        new[j] += (2.0 * rng.random() - 1.0) * (p.bandwidth_max[j] * shrunk)
                    new[j] = min(max(new[j], low[j]), high[j])
                else:
                    new[j] = low[j] + rng.random() * (high[j] - low[j])
            improvisations += 1
            evaluations += 1
            worst = int(np.argmin(fitness))
            if score(new) > fitness[worst]:
                memory[worst], fitness[worst] = new, score(new)
        if not p.improvisations_per_pass:
            break
        for i in range(p.memory_size):
            if spent() >= p.budget:
                break
            r1, r2 = int(rng.random() * p.memory_size), int(rng.random() * p.memory_size)
            best = int(np.argmax(fitness))
            new = memory[i] + p.attraction * (memory[best] - memory[i])
            new = np.clip(new + p.differential_weight * (memory[r1] - memory[r2]), low, high)
            evaluations += 1
            if score(new) > fitness[i]:
                memory[i], fitness[i] = new, score(new)
    return memory, fitness, evaluations


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"improvisations_per_pass": 0},
        {"count_improvisations": True},
        {"count_improvisations": True, "improvisations_per_pass": 0, "budget": 33},
        {"budget": 9},
        {"budget": 3},
    ],
)
def test_hs_and_hide_are_the_plain_reading_of_the_papers(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]], changes: dict[str, Any]
) -> None:
    _, packed, points = scene
    p = parameters(**changes)
    centre, half = np.array([22.0, 17.0, 0.1]), np.array([6.0, 6.0, 0.5])
    memory, sums = np.empty((p.memory_size, 3)), np.empty(p.memory_size)
    best, evaluations = improve_memory(
        packed, points, Box(centre, half), p, np.random.default_rng(7), Memory(memory, sums), NONE, True
    )

    def score(pose: Any) -> Any:
        return score_sum(packed, points, pose[0], pose[1], pose[2], -2.0)

    expected, fitness, spent = naive_hide(score, centre, half, p, np.random.default_rng(7))
    np.testing.assert_array_equal(memory, expected)
    np.testing.assert_array_equal(sums, fitness)
    assert evaluations == spent
    assert sums[best] == sums.max()


def test_the_memory_stays_in_the_box_and_never_gets_worse(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    scores, packed, points = scene
    p = parameters(budget=200)
    centre, half = np.array([20.0, 20.0, 3.0]), np.array([3.0, 5.0, 0.2])
    memory, sums, history = np.empty((8, 3)), np.empty(8), np.full(200, np.nan)
    best, evaluations = improve_memory(
        packed, points, Box(centre, half), p, np.random.default_rng(0), Memory(memory, sums), history, True
    )
    assert evaluations == 200
    assert (np.abs(memory - centre) <= half + 1e-12).all()
    assert (np.diff(history) >= 0).all()
    assert history[-1] == sums[best]
    assert sums[best] == pytest.approx(naive.score_sum(scores, points, *memory[best]), abs=1e-3)


def test_search_is_repeatable_and_returns_why_it_stopped(
    scene: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    _, packed, points = scene
    centre, half = np.array([22.0, 18.0, 0.0]), np.array([5.0, 5.0, 0.4])

    def run(seed: Any, **changes: Any) -> Any:
        pose, information = np.empty(3), np.zeros((3, 3))
        result = search(
            packed,
            points,
            points[:10],
            Box(centre, half),
            parameters(**changes),
            np.random.default_rng(seed),
            Found(pose, information, NONE),
        )
        return pose, result

    many = {"restarts": 10, "agreement": 2, "polish_iterations": 10}
    first, second = run(1, **many), run(1, **many)
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1] == second[1]
    fitness, evaluations, restarts, stopped = first[1]
    assert stopped == STOPPED_AGREEMENT
    assert 2 <= restarts <= 10
    assert evaluations > restarts * 60
    assert fitness == pytest.approx(score_sum(packed, points, *first[0], -2.0) / 20, abs=1e-6)  # type: ignore[call-arg]
    assert (np.abs(first[0] - centre) <= half).all()
    assert run(1)[1][3] == STOPPED_BUDGET
    assert not np.array_equal(run(1)[0], run(2)[0])
