"""The distance transform against scipy's, bit by bit, and against looking at all cells."""

from __future__ import annotations

from typing import Any

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from hsloc.kernels.distance_transform import column_distances, squared_distances


def columns_of(occupied: Any, kind: Any) -> Any:
    columns = np.empty(occupied.shape, dtype=kind)
    column_distances(occupied, sum(occupied.shape), columns)
    return columns


@settings(max_examples=200, deadline=None)
@given(st.integers(1, 14), st.integers(1, 14), st.integers(0, 2**32 - 1), st.floats(0.01, 0.9))
def test_distances_are_those_to_the_nearest_occupied_cell(height: Any, width: Any, seed: Any, share: Any) -> None:
    rng = np.random.default_rng(seed)
    occupied = rng.random((height, width)) < share
    occupied[rng.integers(height), rng.integers(width)] = True
    found = squared_distances(columns_of(occupied, np.uint16))
    for row in range(height):
        for column in range(width):
            wanted = naive.distance_to_nearest(occupied, row, column)
            assert found[row, column] == round(wanted**2)


@pytest.mark.parametrize("kind", [np.uint16, np.int32])
@pytest.mark.parametrize("share", [1e-4, 0.01, 0.3])
def test_a_map_gets_the_bits_of_scipy_whether_in_one_go_or_in_rows(rng: Any, share: Any, kind: Any) -> None:
    occupied = rng.random((200, 313)) < share
    occupied[17, 5] = True
    columns = columns_of(occupied, kind)
    wanted = distance_transform_edt(~occupied)
    parts = [squared_distances(columns[row : row + 64]) for row in range(0, 200, 64)]
    assert np.array_equal(np.sqrt(np.concatenate(parts)), wanted)
    assert np.array_equal(np.sqrt(squared_distances(columns)), wanted)
