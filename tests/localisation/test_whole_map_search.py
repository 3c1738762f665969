"""The search of a whole map finds every place where a scan fits; its proof holds for poses it never looked at."""

from __future__ import annotations

from math import pi
from typing import Any

import naive
import numpy as np
import pytest

from hsloc.benchmark.whole_map import floor, random_pose, scan_at
from hsloc.errors import ConfigError
from hsloc.kernels.fitness import fitness_many
from hsloc.localisation.whole_map_search import WholeMapParameters, WholeMapSearch, join_scans
from hsloc.matching import LikelihoodField
from hsloc.matching.score_pyramid import make_pyramid
from hsloc.model import OccupancyGrid, Pose2, wrap_angle


@pytest.fixture(scope="module")
def building() -> Any:
    world = floor(300.0, 3)
    grid = world.occupancy_grid(0.05)
    field = LikelihoodField.from_grid(grid)
    return world, grid, field, WholeMapSearch(grid, field)


def is_near(mode: Any, pose: Any, metres: Any = 0.1, angle: Any = 0.05) -> Any:
    return mode.pose.distance(pose) < metres and abs(wrap_angle(mode.pose.theta - pose.theta)) < angle


@pytest.mark.parametrize("seed", range(8))
def test_a_scan_from_anywhere_is_found_and_nothing_else_within_the_margin(building: Any, seed: Any) -> None:
    world, grid, field, search = building
    rng = np.random.default_rng(seed)
    true = random_pose(grid, rng)
    points = scan_at(world, true, rng, blocked=0.1 if seed % 2 else 0.0)
    result = search.search(points)
    assert result.is_complete
    assert any(is_near(mode, true) for mode in result.modes)
    assert result.bound <= result.modes[0].fitness - 0.05 + 1e-6
    assert result.modes[0].fitness >= field.fitness(points, true) - 0.005
    for mode in result.modes:
        assert mode.fitness == pytest.approx(field.fitness(points, mode.pose), abs=1e-5)


def test_a_scan_is_found_where_no_table_is_larger_than_the_squares_that_the_search_begins_with() -> None:
    world = floor(40.0, 3)
    grid = world.occupancy_grid(0.01)
    rng = np.random.default_rng(0)
    true = random_pose(grid, rng)
    result = WholeMapSearch(grid, LikelihoodField.from_grid(grid)).search(scan_at(world, true, rng))
    assert result.is_complete
    assert is_near(result.modes[0], true)


@pytest.mark.parametrize("seed", range(3))
def test_no_pose_of_a_dense_search_contradicts_the_proof(building: Any, seed: Any) -> None:
    """Random poses all over the floor, and around the modes: above the bound only in the radius of a mode."""
    world, grid, field, search = building
    rng = np.random.default_rng(10 + seed)
    true = random_pose(grid, rng)
    points = scan_at(world, true, rng)
    result = search.search(points)
    places = grid.centres(grid.free())
    poses = np.column_stack((places[rng.integers(len(places), size=200_000)], rng.uniform(-pi, pi, 200_000)))
    around = [mode.pose for mode in result.modes] + [true]
    poses = np.concatenate(
        [poses, *(np.array((p.x, p.y, p.theta)) + rng.normal(0.0, (0.3, 0.3, 0.05), (20_000, 3)) for p in around)]
    )
    free = grid.free()
    local = np.floor((poses[:, :2] - (grid.origin.x, grid.origin.y)) / grid.resolution).astype(int)
    inside = ((local >= 0) & (local < free.shape[::-1])).all(axis=1)
    poses, local = poses[inside], local[inside]
    poses = poses[free[local[:, 1], local[:, 0]]]
    cells = np.array([field.to_cells(Pose2(*pose)) for pose in poses[:1]])
    cells = np.column_stack(
        ((poses[:, 0] - field.T_map_field.x) / 0.05, (poses[:, 1] - field.T_map_field.y) / 0.05, poses[:, 2])
    )
    fitness = fitness_many(field.packed, field.scale(points), cells)
    better = poses[fitness > result.bound + 1e-6]
    assert len(better) > 0
    for x, y, theta in better:
        assert any(is_near(mode, Pose2(x, y, theta), 0.3, np.radians(3.0)) for mode in result.modes)


@pytest.mark.parametrize("shift", [1, 2])
def test_coarser_tables_give_the_same_places(building: Any, monkeypatch: Any, shift: Any) -> None:
    world, grid, field, search = building
    rng = np.random.default_rng(5)
    points = scan_at(world, random_pose(grid, rng), rng)
    expected = search.search(points)
    monkeypatch.setattr(
        "hsloc.localisation.whole_map_search.score_pyramid", lambda field: make_pyramid(field.packed, shift)
    )
    found = WholeMapSearch(grid, field).search(points)
    assert found.is_complete
    assert len(found.modes) == len(expected.modes)
    for one, other in zip(found.modes, expected.modes, strict=True):
        assert one.pose.distance(other.pose) < 0.03
        assert one.fitness == pytest.approx(other.fitness, abs=0.006)


def two_rooms() -> Any:
    """Two rooms that look the same, side by side, seen from a third of the way into one of them."""
    cells = np.zeros((120, 250), dtype=np.int8)
    for left in (10, 130):
        cells[10:110, left] = cells[10:110, left + 100] = 100
        cells[10, left : left + 101] = cells[110 - 1, left : left + 101] = 100
        cells[10:50, left + 60] = 100
    return OccupancyGrid(cells, 0.05, Pose2())


def test_rooms_that_look_alike_are_both_named() -> None:
    grid = two_rooms()
    field = LikelihoodField.from_grid(grid)
    # Walls of the left room as segments through the centres of its cells, in metres.
    x0, x1, xm, y0, y1, ym = (0.05 * (cell + 0.5) for cell in (10, 110, 70, 10, 109, 49))
    walls = np.array([(x0, y0, x0, y1), (x1, y0, x1, y1), (x0, y0, x1, y0), (x0, y1, x1, y1), (xm, y0, xm, ym)])
    true = Pose2(2.0, 1.5, 0.4)
    points = naive.scan_points(walls, true, 180)
    result = WholeMapSearch(grid, field).search(points)
    assert result.is_complete
    assert not result.is_unique
    assert len(result.modes) == 2
    shifted = Pose2(true.x + 6.0, true.y, true.theta)
    for pose in (true, shifted):
        assert any(is_near(mode, pose) for mode in result.modes)


def test_a_scan_of_another_building_is_nowhere(building: Any) -> None:
    _, grid, field, _ = building
    rng = np.random.default_rng(2)
    other = floor(300.0, 77)
    points = scan_at(other, random_pose(other.occupancy_grid(0.05), rng), rng)
    search = WholeMapSearch(grid, field, WholeMapParameters(min_fitness=0.8))
    result = search.search(points)
    assert result.is_complete
    assert result.modes == ()
    assert result.bound <= 0.8 + 1e-6


def test_too_little_work_is_admitted(building: Any) -> None:
    world, grid, field, _ = building
    rng = np.random.default_rng(0)
    points = scan_at(world, random_pose(grid, rng), rng)
    result = WholeMapSearch(grid, field, WholeMapParameters(max_boxes=1000)).search(points)
    assert not result.is_complete
    assert not result.is_unique
    assert result.bound == 1.0


def test_a_map_without_ground_or_a_scan_without_points_proves_nothing(building: Any) -> None:
    _, grid, field, search = building
    assert not search.search(np.empty((0, 2))).is_complete
    walls_only = OccupancyGrid(np.where(grid.free(), -1, grid.cells).astype(np.int8), 0.05, grid.origin)
    assert not WholeMapSearch(walls_only, field).search(np.ones((5, 2))).is_complete


def test_a_map_that_is_turned_is_searched_alike(building: Any) -> None:
    world, grid, field, search = building
    rng = np.random.default_rng(1)
    points = scan_at(world, random_pose(grid, rng), rng)
    expected = search.search(points)
    turned = OccupancyGrid(grid.cells, grid.resolution, Pose2(3.0, -2.0, 0.7))
    # The field in the frame of the map and not along the cells, as that of a set of points is.
    again = LikelihoodField(
        field.packed, field.resolution, turned.origin @ grid.origin.inverse() @ field.T_map_field, 0.2
    )
    found = WholeMapSearch(turned, again).search(points)
    assert len(found.modes) == len(expected.modes)
    move = turned.origin @ grid.origin.inverse()
    for one, other in zip(found.modes, expected.modes, strict=True):
        assert one.pose.distance(move @ other.pose) < 0.02


def test_the_same_search_gives_the_same_result(building: Any) -> None:
    world, grid, field, search = building
    rng = np.random.default_rng(4)
    points = scan_at(world, random_pose(grid, rng), rng)
    assert search.search(points) == WholeMapSearch(grid, field).search(points)


def test_scans_are_joined_at_the_last_pose() -> None:
    poses = [Pose2(1.0, 0.0, 0.0), Pose2(3.0, 0.0, 0.5 * pi)]
    joined = join_scans([np.array([[1.0, 0.0]]), np.array([[0.0, 2.0]])], poses)
    assert np.allclose(joined, [[0.0, 1.0], [0.0, 2.0]])


def test_parameters_out_of_range_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="margin"):
        WholeMapParameters(margin=-1.0)
    with pytest.raises(ConfigError, match="max_modes"):
        WholeMapParameters(max_modes=0)
