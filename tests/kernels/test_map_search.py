"""The kernels of the whole map's search, in one room: small enough to run without the compiler, too."""

from __future__ import annotations

from math import pi
from typing import Any

import naive
import numpy as np
import pytest

from hsloc.localisation import whole_map_search
from hsloc.localisation.whole_map_search import WholeMapSearch
from hsloc.matching import LikelihoodField
from hsloc.model import OccupancyGrid, Pose2, wrap_angle

TRUE = Pose2(1.3, 0.4, 0.7)


@pytest.fixture(scope="module")
def found() -> Any:
    grid, walls = naive.room()
    field = LikelihoodField.from_grid(grid)
    points = naive.scan_points(walls, TRUE, 40)
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


def test_coarser_levels_leave_the_same_places_for_less_work(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    cells = np.zeros((160, 140), dtype=np.int8)
    v, u = rng.integers(8, 132, size=(2, 14))
    cells[v, u] = 100
    grid = OccupancyGrid(cells, 0.2)
    field = LikelihoodField.from_grid(grid)
    posts = np.column_stack((u + 0.5, v + 0.5)) * 0.2
    at = Pose2(12.3, 15.1, 2.1)
    points = at.inverse() @ posts[np.hypot(*(posts - (at.x, at.y)).T) < 11.0]
    found = []
    for coarser in (0, 1, 2):
        monkeypatch.setattr(whole_map_search, "_COARSER", coarser)
        found.append(WholeMapSearch(grid, field).places_above(points, 0.7, 10_000_000))
    usual, *others = found
    best = field.from_cells(usual.poses[np.argmax(usual.fitness)])
    assert usual.is_complete
    assert best.distance(at) < 0.2
    assert abs(wrap_angle(best.theta - at.theta)) < 0.05
    boxes = usual.boxes
    for each in others:
        assert each.is_complete
        np.testing.assert_allclose(np.unique(each.poses, axis=0), np.unique(usual.poses, axis=0))
        assert each.boxes < boxes / 3
        boxes = each.boxes
