"""The kernels of the whole map's search, in one room: small enough to run without the compiler, too."""

from __future__ import annotations

from math import pi
from typing import Any

import naive
import pytest

from hsloc.localisation.whole_map_search import WholeMapSearch
from hsloc.matching import LikelihoodField
from hsloc.model import Pose2, wrap_angle

TRUE = Pose2(1.3, 0.4, 0.7)


@pytest.fixture(scope="module")
def found() -> Any:
    grid, walls = naive.room()
    field = LikelihoodField.from_grid(grid)
    points = naive.scan_points(walls, TRUE, 60)
    return grid, field, points, WholeMapSearch(grid, field).search(points)


def test_the_place_of_the_scan_is_the_best(found: Any) -> None:
    _, field, points, result = found
    assert result.is_complete
    best = result.modes[0]
    assert best.pose.distance(TRUE) < 0.05
    assert abs(wrap_angle(best.pose.theta - TRUE.theta)) < 0.02
    assert best.fitness == pytest.approx(field.fitness(points, best.pose), abs=1e-5)


def test_no_other_place_is_fitter_than_the_bound(found: Any, rng: Any) -> None:
    grid, field, points, result = found
    places = grid.centres(grid.free())
    for x, y in places[rng.integers(len(places), size=2000)]:
        pose = Pose2(x, y, rng.uniform(-pi, pi))
        if all(pose.distance(mode.pose) > 0.3 for mode in result.modes):
            assert field.fitness(points, pose) <= result.bound + 1e-6


def test_a_scan_of_nothing_like_the_room_fits_worse_than_its_own(found: Any, rng: Any) -> None:
    grid, field, points, result = found
    noise = rng.uniform(-2.0, 2.0, points.shape)
    other = WholeMapSearch(grid, field).search(noise)
    assert other.modes[0].fitness < result.modes[0].fitness if other.modes else other.bound < result.modes[0].fitness
