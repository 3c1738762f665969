"""The built-in worlds, and worlds from files."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.errors import ConfigError
from hsloc.maps import save_map
from hsloc.model import OccupancyGrid, Pose2
from hsloc.simulation.built_in import WORLDS, built_in
from hsloc.simulation.floor_plan import floor_plan, inset, polygon
from hsloc.simulation.presets import SCENARIOS
from hsloc.simulation.world import World
from hsloc.simulation.world_files import load_world, read_rows

if TYPE_CHECKING:
    from pathlib import Path

ROBOT_RADIUS = 0.25
ROOM = "# a room with a wall in it\n0 0 10 0\n10,0,10,8\n10 8 0 8\n0 8 0 0\n5 0 5 5\n"


@pytest.mark.parametrize("name", [name for name in SCENARIOS if name != "paper"])
def test_the_robot_never_comes_near_a_wall(name: str) -> None:
    scenario = SCENARIOS[name]
    world = built_in(scenario.world)
    path = world.path(scenario.laps_needed(world.lap_length()))
    poses = np.array([(pose.x, pose.y) for pose in scenario.robot.drive(world.start(), path, 0.1)])
    assert world.distance_to_walls(poses).min() > ROBOT_RADIUS


@pytest.mark.parametrize("name", ["office", "corridor-loop", "hall", "figure-of-eight", "symmetric-corridor"])
def test_the_map_has_free_space_along_the_way_and_walls_around_it(name: str) -> None:
    world = built_in(name)
    grid = world.occupancy_grid()
    assert grid.cells[0].max() == grid.cells[-1].max() == -1  # the rim is unknown: nothing leaks out
    assert grid.cells[:, 0].max() == grid.cells[:, -1].max() == -1
    cells = np.floor((world.path() - (grid.origin.x, grid.origin.y)) / grid.resolution).astype(int)
    assert (grid.cells[cells[:, 1], cells[:, 0]] == 0).all()


def test_the_corridor_loop_is_long_and_nothing_in_it_repeats() -> None:
    world = built_in("corridor-loop")
    assert world.lap_length() > 100.0
    lengths = np.round(np.hypot(*(world.segments[:, 2:] - world.segments[:, :2]).T), 4)
    notches = lengths[lengths < 1.5]
    assert len(np.unique(notches)) > 0.45 * len(notches)  # each notch has two equal sides


@pytest.mark.parametrize("name", WORLDS)
def test_no_long_wall_falls_on_the_grid(name: str) -> None:
    """Axis-parallel walls at multiples of the map's 5 cm would flatter whoever matches against it."""
    segments = built_in(name).segments
    vertical = segments[(segments[:, 0] == segments[:, 2]) & (np.abs(segments[:, 1] - segments[:, 3]) > 2.0)]
    offsets = np.abs(vertical[:, 0] / 0.05 - np.round(vertical[:, 0] / 0.05))
    assert (offsets > 1e-6).sum() >= 0.9 * len(offsets)


def test_a_floor_plan_shows_the_faces_of_what_is_not_room() -> None:
    two_rooms_and_a_door = floor_plan([(0, 0, 4, 4), (4.2, 0, 8, 4), (4, 1, 4.2, 2)])
    total = np.hypot(*(two_rooms_and_a_door[:, 2:] - two_rooms_and_a_door[:, :2]).T).sum()
    assert total == pytest.approx(16 + 15.6 - 2 * 1 + 2 * 0.2)


def test_inset_moves_the_sides_of_a_polygon() -> None:
    assert np.allclose(inset([(0, 0), (4, 0), (4, 3), (0, 3)], 1.0), [(1, 1), (3, 1), (3, 2), (1, 2)])


def test_path_of_laps() -> None:
    triangle = World(
        "t", polygon([(0, 0), (9, 0), (0, 9)]), np.array([(1.0, 1.0), (4.0, 1.0), (4.0, 5.0)]), closed=True
    )
    assert triangle.lap_length() == 12.0
    np.testing.assert_allclose(triangle.path(), [(1, 1), (4, 1), (4, 5), (1, 1)])
    np.testing.assert_allclose(triangle.path(1.25), [(1, 1), (4, 1), (4, 5), (1, 1), (4, 1)])
    np.testing.assert_allclose(triangle.path(0.5), [(1, 1), (4, 1), (4, 4)])
    there_and_back = World("l", np.empty((0, 4)), np.array([(0.0, 0.0), (3.0, 0.0)]))
    np.testing.assert_allclose(there_and_back.path(2), [(0, 0), (3, 0), (0, 0)])
    assert there_and_back.start() == Pose2(0.0, 0.0, 0.0)


def test_a_world_of_segments_gets_a_way_that_keeps_clear(tmp_path: Path) -> None:
    file = tmp_path / "room.txt"
    file.write_text(ROOM)
    world = load_world(file)
    assert world.name == "room"
    np.testing.assert_array_equal(world.segments[1], (10, 0, 10, 8))
    path = world.path()
    dense = np.concatenate([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in pairwise(path)])
    assert world.distance_to_walls(dense).min() > 0.3
    assert path[:, 0].min() < 3.0  # it visits both sides of the wall
    assert path[:, 0].max() > 7.0


def test_a_world_from_a_map_has_the_borders_of_its_cells_for_walls(tmp_path: Path) -> None:
    cells = np.full((80, 120), 0, dtype=np.int8)
    cells[0, :] = cells[-1, :] = cells[:, 0] = cells[:, -1] = 100
    cells[0:40, 60] = 100
    grid = OccupancyGrid(cells, 0.1, Pose2(-3.0, 2.0, 0.5))
    world = load_world(save_map(grid, tmp_path / "hall"))
    assert world.name == "hall"
    corners = (np.array([(0, 0), (120, 0), (120, 80), (0, 80), (1, 1), (60, 40), (61, 40)]) * 0.1).astype(float)
    assert world.distance_to_walls(grid.origin @ corners).max() < 1e-9
    assert world.distance_to_walls(grid.origin @ np.array([(6.05, 4.5)]))[0] == pytest.approx(0.5)
    np.testing.assert_array_equal(world.occupancy_grid(0.05).cells, cells)  # the map stays the map
    path = world.path()
    dense = np.concatenate([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in pairwise(path)])
    assert world.distance_to_walls(dense).min() > 0.3


def test_a_map_that_marks_unknown_as_free_has_a_note(tmp_path: Path) -> None:
    grid = OccupancyGrid(np.pad(np.zeros((40, 40), dtype=np.int8), 10, constant_values=-1), 0.1)
    grid.cells[10, 10:50] = 100
    yaml = save_map(grid, tmp_path / "m")
    assert load_world(yaml).warnings == ()
    yaml.write_text(yaml.read_text().replace("0.196", "0.25"))
    assert "free_thresh" in str(load_world(yaml).warnings[0])


def test_a_map_without_room_for_the_robot_is_refused(tmp_path: Path) -> None:
    yaml = save_map(OccupancyGrid(np.full((5, 5), 100, dtype=np.int8), 0.1), tmp_path / "m")
    with pytest.raises(ConfigError, match="no free place is"):
        load_world(yaml)


def test_waypoints_replace_the_way(tmp_path: Path) -> None:
    (tmp_path / "room.txt").write_text(ROOM)
    (tmp_path / "way.csv").write_text("x_m,y_m\n1,1\n1,7\n9,7\n1,1\n")
    with pytest.raises(ConfigError, match=r"way\.csv: the way from waypoint 3 to the next runs into a wall"):
        load_world(tmp_path / "room.txt", tmp_path / "way.csv")
    (tmp_path / "way.csv").write_text("x_m,y_m\n1,1\n1,7\n4,7\n1,1\n")
    world = load_world(tmp_path / "room.txt", tmp_path / "way.csv")
    assert world.closed
    np.testing.assert_array_equal(world.waypoints, [(1, 1), (1, 7), (4, 7)])


def test_a_world_of_points_is_seen_through_walls(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("x_m,y_m\n1,2\n3,4\n5,6\n")
    with pytest.raises(ConfigError, match="give --waypoints FILE"):
        load_world(tmp_path / "map.csv")
    (tmp_path / "way.csv").write_text("0,0\n9,0\n")
    world = load_world(tmp_path / "map.csv", tmp_path / "way.csv")
    np.testing.assert_array_equal(world.points, [(1, 2), (3, 4), (5, 6)])
    assert world.start().theta == 0.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no numbers"),
        ("0 0 1 1\n0 0 1\n", r"line 2: 3 numbers, but 4 are wanted"),
        ("0 0 1\n", r"line 1: 3 numbers, but 2 or 4 are wanted"),
        ("0 0 1 1\n0 0 one 1\n", r"line 2: '0 0 one 1' is not a row of numbers"),
        ("0 0 nan 1\n", r"line 1: .* not finite"),
    ],
)
def test_a_text_that_is_no_world_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "w.txt"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_rows(file, (2, 4))
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_unknown_worlds_are_named_with_the_choice() -> None:
    with pytest.raises(ConfigError, match=r"'moon' is neither built in .*office"):
        load_world("moon")


def test_a_binary_file_is_no_world(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read as text"):
        load_world(tmp_path / "x.txt")
