"""Kernels of beams against their naive versions, and walls against written-out covariances."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING, Any

import naive
import numpy as np
import pytest

from hsloc.kernels.beams import (
    DOUBTFUL_WEIGHT,
    FITS,
    SHORT,
    THROUGH,
    UNMAPPED,
    classify_beams,
    count_seen,
    trace,
    wall_information,
    wall_normals,
    wall_rows,
)
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

CELLS = np.array(
    [
        [-1, -1, -1, -1, -1, -1, -1, -1],
        [-1, 0, 0, 0, 100, 0, 0, -1],
        [-1, 0, 0, 0, 100, 0, 0, -1],
        [-1, 0, 0, 0, 0, 0, 0, -1],
        [-1, -1, -1, -1, -1, -1, -1, -1],
    ],
    dtype=np.int8,
)

GAP, NOISE = 0.2, 1e-4


def test_each_scan_counts_once_in_each_cell_that_it_saw(rng: np.random.Generator) -> None:
    counts, work = np.zeros((12, 15), dtype=np.int32), (np.ones((12, 15), np.int32), np.ones((12, 15), np.int32))
    expected = np.zeros((12, 15), dtype=np.int32)
    pose, side = Pose2(1.5, 1.2, 0.4), 0.25
    for _ in range(3):
        points = rng.uniform(-2.0, 2.0, (20, 2))
        count_seen(counts, work, points, (pose.x, pose.y, cos(pose.theta), sin(pose.theta)), (1.6, 1.3), side)
        hits, misses = np.zeros((12, 15), dtype=np.int32), np.zeros((12, 15), dtype=np.int32)
        origins = np.full((20, 2), (1.6, 1.3)) / side
        trace(hits, misses, origins, (pose @ points) / side, np.ones(20, dtype=np.uint8))
        expected += hits + misses > 0
    assert np.array_equal(counts, expected)
    assert counts.max() == 3


def traced(
    origins: list[Any], ends: list[Any], is_hit: list[int], shape: Any = (8, 10)
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    hits, misses = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    trace(hits, misses, np.array(origins, float), np.array(ends, float), np.array(is_hit, np.uint8))
    return hits, misses


def crosses(origin: NDArray[np.float64], end: NDArray[np.float64], u: int, v: int) -> bool:
    """Whether a beam has a part within a cell, by clipping it to the cell's square."""
    low, high = 0.0, 1.0
    for start, step, edge in ((origin[0], end[0] - origin[0], u), (origin[1], end[1] - origin[1], v)):
        near, far = sorted(((edge - start) / step, (edge + 1 - start) / step))
        low, high = max(low, near), min(high, far)
    return low < high


def test_a_beam_along_a_row() -> None:
    hits, misses = traced([(0.5, 2.5)], [(4.2, 2.5)], [1])
    assert hits[2].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert misses[2].tolist() == [1, 1, 1, 1, 0, 0, 0, 0, 0, 0]
    assert hits.sum() == 1
    assert misses.sum() == 4


def test_beams_visit_the_cells_they_cross() -> None:
    random = np.random.default_rng(2)
    for _ in range(60):
        origin, end = random.uniform((0, 0), (10, 8), (2, 2))
        hits, misses = traced([origin], [end], [1])
        visited = {(int(v), int(u)) for v, u in np.argwhere(hits + misses)}
        assert visited == {(v, u) for v in range(8) for u in range(10) if crosses(origin, end, u, v)}
        assert hits.sum() == 1
        assert hits[int(end[1]), int(end[0])] == 1
        assert misses.max() <= 1


def test_a_beam_without_a_hit_leaves_its_last_cell_alone() -> None:
    hits, misses = traced([(1.5, 1.5)], [(5.5, 1.5)], [0])
    assert hits.sum() == 0
    assert misses[1].tolist() == [0, 1, 1, 1, 1, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("end", [(-7.0, 3.0), (25.0, 3.0), (4.0, 30.0), (4.0, -30.0)])
def test_beams_that_leave_the_grid(end: tuple[float, float]) -> None:
    hits, misses = traced([(4.5, 3.5)], [end], [1])
    assert hits.sum() == 0
    assert misses.sum() > 0


def test_a_hit_in_the_lasers_own_cell() -> None:
    hits, misses = traced([(4.5, 3.5)], [(4.6, 3.4)], [1])
    assert hits[3, 4] == 1
    assert misses.sum() == 0


def classes(ends: list[tuple[float, float]], scores: list[float], margin: float = 0.0) -> list[int]:
    found = np.empty(len(ends), dtype=np.int8)
    origin = np.array((1.5, 1.5))
    classify_beams(CELLS, np.array(ends), origin, np.array(scores, dtype=np.float32), 0.3, margin, 65, found)
    return list(found)


def test_a_beam_ends_at_a_wall_before_it_behind_it_or_where_nothing_is_mapped() -> None:
    ends = [(4.2, 1.5), (3.2, 1.5), (6.2, 1.5), (1.5, 4.5), (1.5, 40.0)]
    assert classes(ends, [0.9, 0.1, 0.1, 0.1, 0.1]) == [FITS, SHORT, THROUGH, UNMAPPED, UNMAPPED]


def test_a_wall_just_before_the_end_is_the_one_it_ends_at() -> None:
    assert classes([(5.2, 1.5)], [0.1]) == [THROUGH]
    assert classes([(5.2, 1.5)], [0.1], margin=1.5) == [SHORT]


def test_is_the_naive_walk() -> None:
    rng = np.random.default_rng(0)
    cells = rng.choice(np.array([-1, 0, 0, 0, 100], dtype=np.int8), (30, 40))
    ends = rng.uniform(-5.0, 45.0, (400, 2))
    scores = rng.uniform(0.0, 0.6, 400).astype(np.float32)
    origin = np.array((20.3, 15.7))
    found = np.empty(400, dtype=np.int8)
    classify_beams(cells, ends, origin, scores, 0.3, 2.0, 65, found)
    np.testing.assert_array_equal(found, naive.beam_classes(cells, ends, origin, scores, 0.3, 2.0))


def normals_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    normals = np.empty_like(points)
    wall_normals(points, GAP, NOISE, normals)
    return normals


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, 2.5])
def test_the_normal_of_a_noisy_wall_is_across_it(angle: float) -> None:
    rng = np.random.default_rng(0)
    along, across = np.array((np.cos(angle), np.sin(angle))), np.array((-np.sin(angle), np.cos(angle)))
    points = np.arange(-1.0, 1.0, 0.03)[:, None] * along + (2.0 + rng.normal(0.0, 0.01, 67))[:, None] * across
    normals = normals_of(points)
    assert np.abs(normals @ along).max() < 0.01
    np.testing.assert_allclose(np.hypot(*normals.T), 1.0, atol=1e-12)


def test_scattered_and_lonely_points_have_no_wall() -> None:
    rng = np.random.default_rng(1)
    cloud = rng.uniform((0.85, -0.15), (1.15, 0.15), (40, 2))
    assert (np.abs(normals_of(cloud)).sum(axis=1) == 0.0).mean() > 0.6
    np.testing.assert_array_equal(normals_of(np.array([(1.0, 0.0), (5.0, 0.0), (9.0, 3.0)])), 0.0)


def test_walls_around_a_corner_have_normals_of_their_own() -> None:
    first = np.column_stack((np.full(30, 2.0), np.linspace(0.0, 1.0, 30)))
    second = np.column_stack((np.linspace(1.97, 1.0, 30), np.full(30, 1.0)))
    normals = normals_of(np.vstack((first, second)))
    # The line through the last points of a wall leans around the corner, and takes part in the wall's mean.
    assert np.abs(normals[:20, 1]).max() < np.sin(np.radians(2.0))
    assert np.abs(normals[45:, 0]).max() < np.sin(np.radians(2.0))


def test_information_is_that_of_the_covariance_written_out() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-5.0, 5.0, (60, 2))
    angles = rng.uniform(0.0, 2.0 * np.pi, 60)
    normals = np.column_stack((np.cos(angles), np.sin(angles)))
    normals[::7] = 0.0
    weights = rng.uniform(0.1, 1.0, 60)
    rows = rng.integers(0, 9, 60)
    order = np.argsort(rows, kind="stable")
    variances = (4e-4, 2e-4)
    # Points far apart: the spacing of beams does not reduce their weight.
    found = wall_information(points, normals, weights, np.zeros(3), 1e-6, np.array(variances), rows, order)
    expected = naive.wall_information(points, normals, weights, variances, rows, DOUBTFUL_WEIGHT)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-6)


def test_points_of_one_wall_lie_in_one_row_of_cells() -> None:
    points = np.column_stack((np.full(20, 2.01), np.linspace(-1.0, 1.0, 20)))
    normals = np.tile((1.0, 0.0), (20, 1))
    rows = np.empty(20, dtype=np.int64)
    wall_rows(points, normals, np.array((0.3, 0.0, 0.0)), 0.05, rows)
    assert len(set(rows)) == 1
    turned = np.empty(20, dtype=np.int64)
    wall_rows(points, normals, np.array((0.3, 0.0, 0.4)), 0.05, turned)
    assert len(set(turned)) > 10


def test_an_oblique_wall_counts_as_one_along_the_cells() -> None:
    cell, variances = 0.05, np.array((4e-4, 0.0))
    points = np.column_stack((np.linspace(-3.0, 3.0, 121), np.full(121, 2.0)))
    normals, weights = np.tile((0.0, 1.0), (121, 1)), np.ones(121)
    held = []
    for angle in (0.0, 0.6):
        pose, rows = np.array((0.0, 0.0, angle)), np.empty(121, dtype=np.int64)
        wall_rows(points, normals, pose, cell, rows)
        order = np.argsort(rows, kind="stable")
        information = wall_information(points, normals, weights, pose, cell, variances, rows, order)
        across = np.array((-np.sin(angle), np.cos(angle), 0.0))
        held.append(across @ information @ across)
    assert held[1] == pytest.approx(held[0], rel=0.01)
