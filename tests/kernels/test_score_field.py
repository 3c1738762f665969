"""Score fields of a map, and those that grow, against their naive versions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from hsloc.kernels.fitness import fitness_many, pack
from hsloc.kernels.score_field import (
    GrowingField,
    column_distances,
    decay_table,
    mean_score,
    pack_stale,
    splat,
    squared_distances,
    thinned_cloud,
    wall_distances,
)
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray


def columns_of(occupied: Any, kind: Any, margin: int = 0) -> Any:
    shape = tuple(size + 2 * margin for size in occupied.shape)
    columns = np.empty(shape, dtype=kind)
    column_distances(occupied, margin, sum(shape), columns)
    return columns


@settings(max_examples=200)
@given(st.integers(1, 14), st.integers(1, 14), st.integers(0, 2**32 - 1), st.floats(0.01, 0.9), st.integers(0, 3))
def test_distances_are_those_to_the_nearest_occupied_cell(
    height: Any, width: Any, seed: Any, share: Any, margin: Any
) -> None:
    rng = np.random.default_rng(seed)
    inner = rng.random((height, width)) < share
    inner[rng.integers(height), rng.integers(width)] = True
    found = squared_distances(columns_of(inner, np.uint16, margin))
    occupied = np.pad(inner, margin)
    for row in range(height + 2 * margin):
        for column in range(width + 2 * margin):
            expected = naive.distance_to_nearest(occupied, row, column)
            assert found[row, column] == round(expected**2)


@pytest.mark.parametrize("kind", [np.uint16, np.int32])
@pytest.mark.parametrize("share", [1e-4, 0.01, 0.3])
def test_a_map_gets_the_bits_of_scipy_whether_in_one_go_or_in_rows(rng: Any, share: Any, kind: Any) -> None:
    occupied = rng.random((200, 313)) < share
    occupied[17, 5] = True
    columns = columns_of(occupied, kind)
    expected = distance_transform_edt(~occupied)
    parts = [squared_distances(columns[row : row + 64]) for row in range(0, 200, 64)]
    assert np.array_equal(np.sqrt(np.concatenate(parts)), expected)
    assert np.array_equal(np.sqrt(squared_distances(columns)), expected)


def drawn(
    points: NDArray[np.float64],
    *,
    shape: Any = (24, 30),
    sigma: float = 2.0,
    radius: float = 5.0,
    known: float = 2.0,
    batches: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
    scores, packed = np.zeros(shape, np.float32), np.zeros((shape[0] - 1, shape[1] - 1, 4), np.float32)
    table, corner = decay_table(sigma, radius), np.array((-13, 5))
    field = GrowingField(scores, np.zeros((5, 5), np.uint8), corner, 0.5)
    count = 0
    for part in np.array_split(points, batches):
        count += splat(field, (part + corner) * 0.5, table, radius, known)
        pack_stale(field, packed)
    return scores, packed, count


def naive_scores(
    points: NDArray[np.float64], shape: tuple[int, int], sigma: float, radius: float
) -> NDArray[np.float64]:
    scores = np.zeros(shape)
    for v in range(shape[0]):
        for u in range(shape[1]):
            nearest = min(np.hypot(u - x, v - y) for x, y in points)
            if nearest <= radius:
                scores[v, u] = np.exp(-nearest / sigma)
    return scores


@pytest.mark.parametrize(
    ("shape", "share"), [((12, 17), 0.1), ((1, 20), 0.1), ((20, 1), 0.1), ((290, 230), 0.0001), ((290, 230), 0.0)]
)
def test_a_point_anywhere_has_the_distance_to_the_nearest_occupied_cell(
    rng: Any, shape: tuple[int, int], share: float
) -> None:
    occupied = rng.random(shape) < share
    occupied[-1, -1] = True
    points = rng.uniform(-15.0, 10.0 + max(shape), size=(300, 2))
    distances = np.empty(300)
    wall_distances(occupied, points, distances)
    centres = np.argwhere(occupied)[:, ::-1]
    expected = np.linalg.norm(points[:, None] - centres, axis=2).min(axis=1)
    np.testing.assert_allclose(distances, expected, rtol=1e-12)
    wall_distances(np.zeros(shape, dtype=bool), points, distances)
    assert np.isinf(distances).all()


def test_scores_are_the_decay_of_the_distance_to_the_nearest_point() -> None:
    points = np.random.default_rng(3).uniform((8, 8), (20, 15), (12, 2))
    scores, _, count = drawn(points)
    assert count == 12
    # The table is entered at 1/64 of a squared cell: near a point that is up to 1/8 of a cell.
    np.testing.assert_allclose(scores, naive_scores(points, scores.shape, 2.0, 5.0), atol=0.065)
    far = naive_scores(points, scores.shape, 2.0, 5.0) < np.exp(-1.0)
    np.testing.assert_allclose(scores[far], naive_scores(points, scores.shape, 2.0, 5.0)[far], atol=0.011)


def test_the_packed_field_is_that_of_all_scores_however_the_points_came() -> None:
    points = np.random.default_rng(4).uniform((8, 8), (20, 15), (20, 2))
    scores, packed, _ = drawn(points, batches=5)
    afresh = np.empty_like(packed)
    pack(scores, afresh, 0, packed.shape[0], 0, packed.shape[1])
    np.testing.assert_array_equal(packed, afresh)
    np.testing.assert_array_equal(scores, drawn(points)[0])
    scaled = np.random.default_rng(5).normal(0.0, 6.0, (40, 2))
    for pose in np.array([(14.0, 11.0, 0.3), (2.0, 20.0, -2.0)]):
        field = GrowingField(scores, np.zeros((5, 5), np.uint8), np.zeros(2, np.int64), 0.5)
        expected = fitness_many(packed, scaled.astype(np.float32), pose[None])[0]
        assert mean_score(field, 0.5 * scaled, pose) == expected > 0.0


def test_a_point_that_the_map_has_is_spared() -> None:
    scores, packed, count = drawn(np.array([(12.0, 12.0), (12.1, 12.0), (16.0, 12.0)]), known=0.9)
    assert count == 2
    assert scores[12, 12] == 1.0
    assert scores[12, 16] == 1.0
    assert packed.any()


@pytest.mark.parametrize("point", [(-3.0, 5.0), (2.0, 12.0), (28.9, 12.0), (12.0, 100.0), (np.nan, 3.0)])
def test_points_at_the_border_or_outside_are_left_out(point: tuple[float, float]) -> None:
    scores, packed, count = drawn(np.array([point]))
    assert count == 0
    assert not scores.any()
    assert not packed.any()


def test_a_cloud_has_the_first_point_of_each_cell_that_is_near_enough(rng: Any) -> None:
    points = rng.normal(0.0, 2.0, (60, 2)).astype(np.float32)
    start, poses = np.array([0, 25, 25, 60]), rng.normal(size=(3, 3))
    expected: dict[tuple[int, int], list[float]] = {}
    for k in range(3):
        for x, y in points[start[k] : start[k + 1]].astype(np.float64):
            if np.hypot(x, y) < 3.0:
                moved = Pose2.from_array(poses[k]) @ np.array((x, y))
                expected.setdefault((int(moved[0] // 0.5), int(moved[1] // 0.5)), moved.tolist())
    cloud = np.empty((60, 2))
    count = thinned_cloud(points, start, poses, 3.0, 0.5, cloud)
    assert 10 < count < 60
    np.testing.assert_allclose(cloud[:count], list(expected.values()))
