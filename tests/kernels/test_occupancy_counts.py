from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hsloc.kernels.occupancy_counts import trace

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
