"""Rays against closed forms, and against the naive version."""

from __future__ import annotations

import os
import subprocess
import sys
from math import inf, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naive_raycasting
import numpy as np
import pytest

from hsloc.kernels.raycasting import cast_rays

if TYPE_CHECKING:
    from numpy.typing import NDArray

NOTHING = np.empty((0, 4))
NO_PEOPLE = np.empty((0, 3))


def cast(
    direction: NDArray[np.float64] | tuple[Any, ...],
    segments: NDArray[np.float64] | list[tuple[float, float, float, float]] = NOTHING,
    circles: NDArray[np.float64] | list[tuple[float, float, float]] = NO_PEOPLE,
    origin: Any = (0.0, 0.0),
) -> float:
    unit = np.array([direction]) / np.linalg.norm(direction)
    return float(cast_rays(np.array([origin]), unit, np.asarray(segments, float), np.asarray(circles, float))[0])


@pytest.mark.parametrize(
    ("direction", "distance"),
    [((1, 0), 2.0), ((1, 1), 2.0 * sqrt(2)), ((1, 1.0001), inf), ((-1, 0), inf), ((0, 1), inf)],
    ids=["square on", "through its end", "past its end", "behind", "parallel"],
)
def test_distance_to_one_wall(direction: tuple[Any, ...], distance: float) -> None:
    assert cast(direction, [(2.0, -2.0, 2.0, 2.0)]) == pytest.approx(distance, abs=1e-12)


def test_nearest_of_two_walls_counts_in_either_order() -> None:
    walls = [(2.0, -1.0, 2.0, 1.0), (3.0, -1.0, 3.0, 1.0)]
    assert cast((1, 0), walls) == cast((1, 0), walls[::-1]) == 2.0


def test_no_ray_slips_through_the_corners_of_a_room() -> None:
    corners = np.array([(-1.1, -2.3), (3.7, -1.9), (4.1, 2.2), (0.3, 3.3)])
    room = np.hstack((corners, np.roll(corners, -1, axis=0)))
    for corner in corners:
        assert cast(corner, room) == pytest.approx(np.linalg.norm(corner))


@pytest.mark.parametrize(
    ("direction", "distance"),
    [((1, 0), 4.0), ((4, 1), inf), ((-1, 0), inf)],
    ids=["through its centre", "beside", "behind"],
)
def test_distance_to_a_circle(direction: tuple[int, int], distance: float) -> None:
    assert cast(direction, circles=[(5.0, 0.0, 1.0)]) == pytest.approx(distance)


def test_circle_around_the_origin_is_not_seen() -> None:
    assert cast((1, 0), circles=[(0.5, 0.0, 1.0)]) == inf


def test_wall_before_a_circle_hides_it() -> None:
    assert cast((1, 0), [(2.0, -1.0, 2.0, 1.0)], [(5.0, 0.0, 1.0)]) == 2.0


@pytest.mark.parametrize("seed", range(5))
def test_equals_the_naive_version(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-4, 4, 40)
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    arguments = (rng.uniform(-3, 3, (40, 2)), directions, rng.uniform(-5, 5, (12, 4)))
    circles = np.column_stack((rng.uniform(-5, 5, (4, 2)), rng.uniform(0.1, 0.5, 4)))
    found, expected = cast_rays(*arguments, circles), naive_raycasting.cast_rays(*arguments, circles)
    assert np.isfinite(expected).sum() > 20
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_same_bits_without_the_compiler() -> None:
    """The kernel is plain Python as well: both ways give the same bits."""
    program = (
        "import numpy as np; from hsloc.kernels.raycasting import cast_rays; rng = np.random.default_rng(1);"
        "a = rng.uniform(-4, 4, 20); d = np.column_stack((np.cos(a), np.sin(a)));"
        "r = cast_rays(rng.uniform(-3, 3, (20, 2)), d, rng.uniform(-5, 5, (9, 4)), rng.uniform(0.1, 0.5, (3, 3)));"
        "print(r.tobytes().hex())"
    )
    outputs = [
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"NUMBA_DISABLE_JIT": switch},
            cwd=Path(__file__).parents[2],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for switch in "01"
    ]
    assert outputs[0] == outputs[1]
