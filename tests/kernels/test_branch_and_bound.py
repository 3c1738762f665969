"""Branch and bound on a lattice and over boxes against exhaustive search."""

from __future__ import annotations

import os
from math import pi
from typing import TYPE_CHECKING, Any

import naive
import numpy as np
import pytest

from hsloc.kernels.branch_and_bound import BoxSearch, Excluded, Lattice, best_on_lattice, is_left_out, maximise, pool
from hsloc.kernels.fitness import fitness_many
from hsloc.matching import LikelihoodField
from hsloc.matching.score_pyramid import score_pyramid
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

NOWHERE = np.array((-1.0, -1.0, -1.0))
ALL = Excluded(NOWHERE, NOWHERE)

compiled = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="millions of poses need the compiler")
NO_PLACES = np.empty((0, 3))


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
    expected, where = naive_best(scores, points, centre, half, 0.1, excluded, np.array(exclusion))
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
    assert found == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(pose, where, atol=1e-9)
    assert visits > 0


def test_nothing_better_than_what_is_needed_is_reported(
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


@pytest.fixture(scope="module")
def scene() -> Any:
    grid, walls = naive.room()
    return LikelihoodField.from_grid(grid), walls


def search(epsilon: Any, n: Any, max_boxes: Any = 200_000) -> Any:
    return BoxSearch(epsilon * n, 6.0, 0.05, 40.0, 0.01, max_boxes)


def run(
    field: Any,
    scaled: Any,
    box: Any,
    places: Any = NO_PLACES,
    *,
    epsilon: Any = 0.01,
    best: Any = 0.0,
    max_boxes: Any = 200_000,
) -> Any:
    pose = np.full(3, np.nan)
    found = maximise(
        score_pyramid(field), field.packed, scaled, box, places, search(epsilon, len(scaled), max_boxes), best, pose
    )
    return pose, *found


@compiled
@pytest.mark.parametrize("seed", range(6))
def test_no_pose_of_a_dense_search_is_fitter_than_the_bound(scene: Any, seed: Any) -> None:
    field, walls = scene
    rng = np.random.default_rng(seed)
    true = Pose2(rng.uniform(0.0, 5.0), rng.uniform(0.0, 2.5), rng.uniform(-pi, pi))
    scaled = field.scale(naive.scan_points(walls, true, 90))
    n = len(scaled)
    half = np.array((20.0, 12.0, 0.6))
    centre = field.to_cells(true) + rng.uniform(-0.9, 0.9, 3) * half
    pose, best, bound, boxes, is_found = run(field, scaled, np.concatenate((centre, half))[None, :])
    dense = centre + rng.uniform(-1.0, 1.0, (20_000, 3)) * half
    assert fitness_many(field.packed, scaled, dense).max() <= bound / n + 1e-6
    assert best <= bound <= best + 0.0100001 * n
    assert is_found
    assert boxes > 0
    assert fitness_many(field.packed, scaled, pose[None, :])[0] == pytest.approx(best / n, abs=1e-6)
    assert np.hypot(*(pose - field.to_cells(true))[:2]) < 1.0
    assert (np.abs(pose - centre) <= half + 1e-9).all()


def test_what_is_left_out_does_not_count_and_the_next_place_is_found(scene: Any) -> None:
    """A square room looks the same from four headings: each is found once those before are left out."""
    cells = np.zeros((80, 80), dtype=np.int8)
    cells[10, 10:70] = cells[69, 10:70] = cells[10:70, 10] = cells[10:70, 69] = 100
    field = LikelihoodField.from_grid(OccupancyGrid(cells, 0.05, Pose2()))
    middle = field.to_cells(Pose2(2.0, 2.0, 0.3))
    side = 29.5
    points = np.array([(end, t) for end in (side, -side) for t in range(-28, 29, 4)])
    points = np.concatenate((points, points[:, ::-1])).astype(np.float32)
    box = np.array([[*middle[:2], 0.0, 20.0, 20.0, pi]])
    places = NO_PLACES
    for _ in range(4):
        pose, best, _, _, is_found = run(field, points, box, places, best=0.9 * len(points))
        assert is_found
        assert best > 0.97 * len(points)
        assert not is_left_out(places, np.array((*pose, 0.0, 0.0, 0.0)), 6.0, 0.05)
        places = np.vstack((places, pose))
    turns = np.sort((places[:, 2] + 2 * pi) % (0.5 * pi))
    assert np.minimum(turns, 0.5 * pi - turns).max() < 0.01
    _, best, bound, _, is_found = run(field, points, box, places, best=0.9 * len(points))
    assert not is_found
    assert bound <= 0.9100001 * len(points)


def test_too_little_work_leaves_a_bound_that_still_holds(scene: Any, rng: Any) -> None:
    field, walls = scene
    true = Pose2(1.3, 0.4, 0.7)
    scaled = field.scale(naive.scan_points(walls, true) + rng.normal(0.0, 0.05, (180, 2)))
    box = np.array([[*field.to_cells(true), 20.0, 20.0, 0.5]])
    _, best, bound, boxes, _ = run(field, scaled, box, max_boxes=50)
    assert boxes < 60
    assert bound > best + 0.01 * len(scaled)
    at_truth = fitness_many(field.packed, scaled, field.to_cells(true)[None, :])[0]
    assert bound >= at_truth * len(scaled)


def test_the_same_search_gives_the_same_bytes(scene: Any) -> None:
    field, walls = scene
    true = Pose2(1.3, 0.4, 0.7)
    scaled = field.scale(naive.scan_points(walls, true))
    box = np.array([[*field.to_cells(true) + 3.0, 20.0, 20.0, 4.0]])
    first, second = run(field, scaled, box), run(field, scaled, box)
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1:] == second[1:]


def test_a_box_is_left_out_only_where_all_of_it_is_near() -> None:
    places = np.array([[10.0, 10.0, 3.1]])
    assert is_left_out(places, np.array((11.0, 10.0, -3.12, 1.0, 1.0, 0.02)), 6.0, 0.1)
    assert not is_left_out(places, np.array((11.0, 10.0, -3.12, 5.5, 1.0, 0.02)), 6.0, 0.1)
    assert not is_left_out(places, np.array((11.0, 10.0, -3.12, 1.0, 1.0, 0.08)), 6.0, 0.1)
