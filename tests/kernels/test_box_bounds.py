"""No pose of a box is fitter than its bound: on a simulated field, on random ones, and on a real one."""

from __future__ import annotations

import os
from math import pi
from typing import Any

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsloc.benchmark.cases import read_cases
from hsloc.kernels.box_bounds import MAX_SQUARES, largest_score, pooled_bound, slope_bound
from hsloc.kernels.fitness import fitness_many
from hsloc.kernels.levenberg_marquardt import polish
from hsloc.matching import LikelihoodField
from hsloc.matching.score_pyramid import SIZES, make_pyramid, score_pyramid
from hsloc.model import Pose2

compiled = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="millions of poses need the compiler")

TOLERANCE = 1e-6
"""Of the fitness: the rounding of float32."""


def poses_in(box: Any, rng: Any, count: Any) -> Any:
    """The corners and the centre of a box, and poses within it."""
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    inner = rng.uniform(-1.0, 1.0, (count, 3))
    return box[:3] + np.concatenate((np.zeros((1, 3)), signs, inner)) * box[3:]


def fittest_in(field: Any, scaled: Any, box: Any, rng: Any) -> Any:
    """The greatest fitness that dense sampling and a climb from the best sample find in a box."""
    poses = poses_in(box, rng, 60)
    fitness = fitness_many(field.packed, scaled, poses)
    pose = poses[np.argmax(fitness)].copy()
    polish(field.packed, scaled, pose, box[:3] - box[3:], box[:3] + box[3:], 10, np.empty((3, 3)))
    return max(fitness.max(), fitness_many(field.packed, scaled, pose[None, :])[0])


def excess_of_the_fittest(field: Any, scans: Any, count: Any, seed: Any) -> Any:
    """By how much the fittest pose found exceeds the lower of the bounds, for `count` random boxes."""
    rng = np.random.default_rng(seed)
    pyramid = score_pyramid(field)
    height, width = field.packed.shape[:2]
    worst = -np.inf
    for _ in range(count):
        scaled = field.scale(scans[rng.integers(len(scans))])
        half = 10.0 ** rng.uniform(-3.0, 1.6)
        box = np.array(
            (
                rng.uniform(-5.0, width + 5.0),
                rng.uniform(-5.0, height + 5.0),
                rng.uniform(-4.0, 4.0),
                half * rng.uniform(0.3, 1.0),
                half * rng.uniform(0.3, 1.0),
                min(10.0 ** rng.uniform(-5.0, 0.2), 0.5 * pi),
            )
        )
        n = len(scaled)
        bounds = [pooled_bound(pyramid, scaled, box, -2.0), slope_bound(pyramid, field.packed, scaled, box, -2.0)[0]]
        worst = max(worst, fittest_in(field, scaled, box, rng) - min(bounds) / n)
    return worst


@compiled
def test_no_pose_of_5000_boxes_in_a_room_is_fitter_than_the_bound() -> None:
    grid, walls = naive.room()
    field = LikelihoodField.from_grid(grid)
    scans = [naive.scan_points(walls, pose) for pose in (Pose2(1.3, 0.4, 0.7), Pose2(5.0, 2.0, -2.0))]
    assert excess_of_the_fittest(field, scans, 5000, 1) <= TOLERANCE


@compiled
@pytest.mark.data
def test_no_pose_of_5000_boxes_in_a_real_building_is_fitter_than_the_bound(data: Any) -> None:
    cases = read_cases(data / "match-cases" / "intel.npz")
    field = LikelihoodField.from_grid(cases.grid)
    assert excess_of_the_fittest(field, cases.scans, 5000, 2) <= TOLERANCE


numbers = st.floats(-12.0, 12.0, width=32)


@st.composite
def small_fields(draw: Any) -> Any:
    """A field of random scores, zeros and ones among them, a few points, and a box."""
    height, width = draw(st.integers(2, 9)), draw(st.integers(2, 9))
    scores = draw(st.lists(st.sampled_from((0.0, 0.3, 0.9, 1.0)), min_size=height * width, max_size=height * width))
    points = draw(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=6))
    box = [draw(st.floats(-3.0, 12.0)), draw(st.floats(-3.0, 12.0)), draw(st.floats(-4.0, 4.0))]
    box += [draw(st.floats(0.0, 6.0)), draw(st.floats(0.0, 6.0)), draw(st.floats(0.0, 0.5 * pi))]
    return np.array(scores).reshape(height, width), np.array(points, dtype=np.float32), np.array(box)


@settings(max_examples=300)
@given(small_fields(), st.integers(0, 2))
def test_no_pose_is_fitter_than_the_bound_on_any_field(drawn: Any, shift: Any) -> None:
    scores, points, box = drawn
    field = LikelihoodField.from_scores(scores.astype(np.float32), 1.0, Pose2(), 1.0)
    pyramid = make_pyramid(field.packed, shift)
    fittest = fitness_many(field.packed, points, poses_in(box, np.random.default_rng(0), 200)).max()
    assert fittest <= pooled_bound(pyramid, points, box, -2.0) / len(points) + TOLERANCE
    assert fittest <= slope_bound(pyramid, field.packed, points, box, -2.0)[0] / len(points) + TOLERANCE


@pytest.mark.parametrize("shift", [0, 1, 2])
def test_the_tables_hold_the_greatest_node_under_a_rectangle(shift: Any, rng: Any) -> None:
    scores = rng.random((23, 31)).astype(np.float32)
    pyramid = make_pyramid(LikelihoodField.from_scores(scores, 1.0, Pose2(), 1.0).packed, shift)
    for _ in range(300):
        u, v = rng.uniform(-8.0, 36.0), rng.uniform(-8.0, 30.0)
        width, height = rng.uniform(0.0, 12.0, 2)
        found = largest_score(pyramid, u, u + width, v, v + height)
        assert found == naive.largest_score(scores, u, u + width, v, v + height, SIZES, 1 << shift)


def test_the_score_at_the_centre_comes_with_the_bound(rng: Any) -> None:
    grid, walls = naive.room()
    field = LikelihoodField.from_grid(grid)
    scaled = field.scale(naive.scan_points(walls, Pose2(1.3, 0.4, 0.7)))
    pose = field.to_cells(Pose2(1.31, 0.42, 0.69))
    box = np.concatenate((pose, (0.4, 0.3, 0.002)))
    bound, centre = slope_bound(score_pyramid(field), field.packed, scaled, box, -2.0)
    assert centre / len(scaled) == pytest.approx(fitness_many(field.packed, scaled, pose[None, :])[0], abs=1e-5)
    assert bound >= centre


def test_the_bound_of_slopes_converges_with_the_square_of_the_box(rng: Any) -> None:
    """Halving a small box where slopes cancel halves the excess of the maxima, and quarters that of the slopes."""
    slope = np.abs(np.linspace(-1.0, 1.0, 101))
    field = LikelihoodField.from_scores(np.tile(1.0 - slope, (40, 1)).astype(np.float32), 1.0, Pose2(), 1.0)
    # A wall on either side, both seen 10 cells short of it: one slope up, one down.
    points = np.array([(x, y) for x in (-10.5, 10.5) for y in range(-10, 11)], dtype=np.float32)
    boxes = [np.array((50.0, 20.0, 0.0, size, size, 1e-9)) for size in (0.4, 0.2)]
    pyramid = score_pyramid(field)
    value = fitness_many(field.packed, points, boxes[0][None, :3])[0]
    pooled = [pooled_bound(pyramid, points, box, -2.0) / len(points) - value for box in boxes]
    slopes = [slope_bound(pyramid, field.packed, points, box, -2.0)[0] / len(points) - value for box in boxes]
    assert slopes[0] < 1e-5 < pooled[0]
    assert slopes[1] < 1e-5 < pooled[1]


def test_a_bound_that_cannot_exceed_what_is_needed_is_given_up(rng: Any) -> None:
    grid, walls = naive.room()
    field = LikelihoodField.from_grid(grid)
    scaled = field.scale(naive.scan_points(walls, Pose2(1.3, 0.4, 0.7)))
    box = np.concatenate((field.to_cells(Pose2(3.0, 1.0, 2.0)), (0.5, 0.5, 0.01)))
    bound = pooled_bound(score_pyramid(field), scaled, box, -2.0)
    assert pooled_bound(score_pyramid(field), scaled, box, bound + 0.01) == -1.0
    assert pooled_bound(score_pyramid(field), scaled, box, bound - 0.01) == bound
    assert slope_bound(score_pyramid(field), field.packed, scaled, box, float(len(scaled))) == (-1.0, 0.0)
    assert MAX_SQUARES >= 2
