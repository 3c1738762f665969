"""Branch and bound over boxes finds what a dense search finds, and its bound holds."""

from __future__ import annotations

import os
from math import pi
from typing import Any

import naive
import numpy as np
import pytest

from hsloc.kernels.box_search import BoxSearch, is_left_out, maximise
from hsloc.kernels.fitness import fitness_many
from hsloc.matching import LikelihoodField
from hsloc.matching.score_pyramid import score_pyramid
from hsloc.model import OccupancyGrid, Pose2

compiled = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="millions of poses need the compiler")

NOWHERE = np.empty((0, 3))


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
    places: Any = NOWHERE,
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
    points = np.array([(side, t) for t in range(-28, 29, 2)] + [(-side, t) for t in range(-28, 29, 2)])
    points = np.concatenate((points, points[:, ::-1])).astype(np.float32)
    box = np.array([[*middle[:2], 0.0, 20.0, 20.0, pi]])
    places = NOWHERE
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
