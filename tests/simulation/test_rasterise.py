"""Cells of walls, by hand, and by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from hsloc.simulation.rasterise import crossed_cells, outline, rasterise

SQUARE = np.array([(0.5, 0.5, 5.5, 0.5), (5.5, 0.5, 5.5, 4.5), (5.5, 4.5, 0.5, 4.5), (0.5, 4.5, 0.5, 0.5)])


def cells_of(*segment: float) -> set[tuple[int, int]]:
    return {tuple(cell) for cell in crossed_cells(np.array(segment, dtype=float)).tolist()}


@pytest.mark.parametrize(
    ("segment", "cells"),
    [
        ((0.2, 0.5, 2.7, 0.5), {(0, 0), (1, 0), (2, 0)}),
        ((0.5, 2.2, 0.5, 0.1), {(0, 0), (0, 1), (0, 2)}),
        ((0.5, 0.7, 1.5, 1.7), {(0, 0), (0, 1), (1, 1)}),
        ((0.3, 0.3, 0.6, 0.6), {(0, 0)}),
        ((0.4, 0.4, 0.4, 0.4), {(0, 0)}),
        ((-0.5, -0.5, 0.5, -0.5), {(-1, -1), (0, -1)}),
    ],
)
def test_cells_a_segment_passes_through(
    segment: tuple[float, float, float, float], cells: set[tuple[int, int]]
) -> None:
    assert cells_of(*segment) == cells


def test_a_wall_on_a_border_occupies_both_sides() -> None:
    assert cells_of(1.0, 0.2, 1.0, 1.8) == {(0, 0), (1, 0), (0, 1), (1, 1)}


def test_a_diagonal_through_corners_touches_its_neighbours_only_in_a_point() -> None:
    assert cells_of(0.5, 0.5, 1.5, 1.5) == {(0, 0), (1, 1)}


@pytest.mark.parametrize("seed", range(20))
def test_cells_equal_those_of_fine_sampling(seed: int) -> None:
    start, end = np.random.default_rng(seed).uniform(-6, 6, (2, 2))
    fractions = np.linspace(0, 1, 200_001)[:, None]
    sampled = {
        tuple(cell) for cell in np.unique(np.floor(start + fractions * (end - start)), axis=0).astype(int).tolist()
    }
    found = cells_of(*start, *end)
    assert sampled <= found
    assert len(found - sampled) <= 1  # a corner cut by less than the sampling sees


def test_map_of_a_room() -> None:
    grid = rasterise(SQUARE, np.array([(3.0, 2.0)]), 1.0, margin=1.0)
    expected = np.array(
        [
            [-1, -1, -1, -1, -1, -1, -1, -1],
            [-1, 100, 100, 100, 100, 100, 100, -1],
            [-1, 100, 0, 0, 0, 0, 100, -1],
            [-1, 100, 0, 0, 0, 0, 100, -1],
            [-1, 100, 0, 0, 0, 0, 100, -1],
            [-1, 100, 100, 100, 100, 100, 100, -1],
            [-1, -1, -1, -1, -1, -1, -1, -1],
        ]
    )
    np.testing.assert_array_equal(grid.cells, expected)
    assert (grid.origin.x, grid.origin.y) == (-1.0, -1.0)


def test_walls_through_cell_centres_leave_no_bias() -> None:
    """A wall at the centre of a cell is drawn by that cell alone: its centre is the wall."""
    wall = np.array([(0.025, 0.0, 0.025, 2.0), (0.025, 0.0, 2.0, 0.0)])
    grid = rasterise(wall, np.array([(1.0, 1.0)]), 0.05)
    centres = grid.centres(grid.occupied())
    upper = centres[centres[:, 1] > 0.5]
    np.testing.assert_allclose(upper[:, 0], 0.025, atol=1e-9)


def test_walls_on_borders_leave_no_bias() -> None:
    grid = rasterise(np.array([(1.0, 0.0, 1.0, 2.0)]), np.array([(0.5, 1.0)]), 0.05)
    centres = grid.centres(grid.occupied())
    assert centres[:, 0].mean() == pytest.approx(1.0, abs=1e-9)


def test_outline_joins_straight_runs_and_is_closed() -> None:
    solid = np.ones((5, 6), dtype=bool)
    solid[1:4, 1:5] = False
    solid[2, 2] = True
    segments = outline(solid, np.arange(7.0), np.arange(6.0))
    assert len(segments) == 8  # the room's four walls, and the pillar's
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    assert lengths.sum() == 2 * (4 + 3) + 4
    ends, counts = np.unique(segments.reshape(-1, 2), axis=0, return_counts=True)
    assert len(ends) == 8
    assert (counts == 2).all()
