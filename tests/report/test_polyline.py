"""Paths as they are drawn: nothing that can be seen is lost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsloc.report.png_panels import joined, pieces_of

NAN = float("nan")


def test_pieces_end_where_the_path_breaks_and_keep_their_ends() -> None:
    xy = np.array([(NAN, NAN), (0, 0), (0.1, 0), (0.2, 0), (NAN, 1), (NAN, NAN), (5, 5), (5, 9), (5, 9.1)])
    assert [piece.tolist() for piece in pieces_of(xy, 1.0)] == [[[0, 0], [0.2, 0]], [[5, 5], [5, 9], [5, 9.1]]]
    assert np.array_equal(
        joined(pieces_of(xy, 1.0)), [(0, 0), (0.2, 0), (NAN, NAN), (5, 5), (5, 9), (5, 9.1)], equal_nan=True
    )


@pytest.mark.parametrize("xy", [np.zeros((0, 2)), np.full((3, 2), NAN)])
def test_nothing_to_draw(xy: np.ndarray) -> None:
    assert pieces_of(xy, 1.0) == []
    assert joined([]).shape == (0, 2)


@settings(max_examples=50)
@given(st.integers(0, 1000), st.integers(1, 10_000), st.floats(0.01, 5.0))
def test_every_point_is_near_a_kept_one_and_kept_ones_are_points(seed: int, n: int, finest: float) -> None:
    rng = np.random.default_rng(seed)
    xy = np.cumsum(rng.normal(scale=0.1, size=(n, 2)), axis=0)
    xy[rng.random(n) < 0.001] = NAN
    kept = pieces_of(xy, finest)
    known = xy[~np.isnan(xy).any(axis=1)]
    points = {tuple(point) for point in known.tolist()}
    rows = [tuple(row) for piece in kept for row in piece.tolist()]
    assert set(rows) <= points
    assert len(rows) <= len(known) + 1
    for piece in kept:
        steps = np.abs(np.diff(piece, axis=0)).sum(axis=1)
        assert (steps[:-1] >= finest).all()  # all but the last, which only closes the piece
    if len(known):
        tree_distance = np.abs(known[:: max(n // 50, 1), None] - np.array(rows)[None]).sum(axis=2).min(axis=1)
        assert tree_distance.max() < finest
