from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hsloc.kernels.fitness import pack
from hsloc.kernels.score_field_update import decay_table, splat

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
    table = decay_table(sigma, radius)
    count = sum(
        splat(scores, packed, np.ascontiguousarray(part, np.float32), table, radius, known)
        for part in np.array_split(points, batches)
    )
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
