"""Normals of walls, and the information of distances to them, against matrices written out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import naive
import numpy as np
import pytest

from hsloc.kernels.wall_information import DOUBTFUL_WEIGHT, wall_information, wall_normals, wall_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

GAP, NOISE = 0.2, 1e-4


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
