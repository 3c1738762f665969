"""Worlds from files: a text of segments, the course report's points and waypoints, or a nav2 map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError
from hsloc.kernels.raycasting import cast_rays
from hsloc.maps import read_map
from hsloc.simulation.built_in import WORLDS, built_in
from hsloc.simulation.planning import interior, plan_round_trip
from hsloc.simulation.rasterise import outline
from hsloc.simulation.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

MAPS = (".yaml", ".yml", ".pgm", ".png", ".bmp")
"""Suffixes of nav2 maps; all else is read as text."""


def load_world(source: str | Path, waypoints: str | Path | None = None) -> World:
    """A built-in world by name, or one from a file.

    The file is a nav2 map (`.yaml`: the borders of its occupied cells become walls), or a text of numbers, a row
    a line, separated by blanks or commas, `#` for comments: four columns are segments x0 y0 x1 y1, two are
    points seen through walls, all in metres. `waypoints` is such a text of two columns, and replaces the world's;
    it is a closed tour where the last point is the first. Without it a tour is planned, but for points.
    Raises ConfigError, or MapError for a map that cannot be read.
    """
    path = Path(source)
    if str(source).replace("_", "-") in WORLDS and not path.is_file():
        world = built_in(str(source))
    elif not path.exists():
        raise ConfigError(f"world {str(source)!r} is neither built in ({', '.join(WORLDS)}) nor a file")
    elif path.suffix.lower() in MAPS:
        world = _from_map(path)
    else:
        world = _from_text(path, is_route_given=waypoints is not None)
    return world if waypoints is None else _with_waypoints(world, Path(waypoints))


def read_rows(path: Path, columns: tuple[int, ...]) -> Array:
    """Numbers of a text file, shape (n, c), c one of `columns`. A first line of words is a heading.

    Raises ConfigError naming file and line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}); give a file of numbers") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            if rows or number > 1:
                raise ConfigError(f"{path}, line {number}: {line.strip()!r} is not a row of numbers") from None
            continue
        if len(row) not in columns or (rows and len(row) != len(rows[0])):
            wanted = " or ".join(map(str, columns)) if not rows else str(len(rows[0]))
            raise ConfigError(f"{path}, line {number}: {len(row)} numbers, but {wanted} are wanted")
        if not np.isfinite(row).all():
            raise ConfigError(f"{path}, line {number}: {line.strip()!r} has a number that is not finite")
        rows.append(row)
    if not rows:
        raise ConfigError(f"{path}: holds no numbers; give a row x y, or x0 y0 x1 y1, on each line")
    return np.array(rows, dtype=np.float64)


def _from_text(path: Path, is_route_given: bool) -> World:
    rows = read_rows(path, (2, 4))
    if rows.shape[1] == 2:
        if not is_route_given:
            raise ConfigError(f"{path}: a world of points has no walls to plan a way between; give --waypoints FILE")
        return World(path.stem, np.empty((0, 4)), np.zeros((2, 2)), points=rows, start_heading=0.0)
    # with a route given, a planned one would be thrown away
    tour = np.zeros((2, 2)) if is_route_given else plan_round_trip(*interior(rows))
    return World(path.stem, rows, tour, closed=True)


def _from_map(path: Path) -> World:
    loaded = read_map(path)
    grid = loaded.grid
    height, width = grid.cells.shape
    # a rim of open cells, so that occupied cells at the edge of the map have a border as well
    occupied = np.pad(grid.occupied(), 1)
    xs, ys = (np.arange(-1, count + 2) * grid.resolution for count in (width, height))
    corners = outline(occupied, xs, ys).reshape(-1, 2)
    segments = np.asarray(grid.origin @ corners).reshape(-1, 4)
    return World(
        path.stem, segments, plan_round_trip(grid.free(), grid), closed=True, grid=grid, warnings=loaded.warnings
    )


def _with_waypoints(world: World, path: Path) -> World:
    waypoints = read_rows(path, (2,))
    closed = len(waypoints) > 2 and bool((waypoints[0] == waypoints[-1]).all())
    waypoints = waypoints[:-1] if closed else waypoints
    if len(waypoints) < 2:
        raise ConfigError(f"{path}: {len(waypoints)} waypoint; a way needs two at least")
    result = replace(world, waypoints=waypoints, closed=closed)
    legs = result.path()
    delta = np.diff(legs, axis=0)
    lengths = np.hypot(*delta.T)
    if not (lengths > 1e-3).all():
        at = int(np.argmin(lengths))
        raise ConfigError(f"{path}: waypoints {at + 1} and {at + 2} are the same place; leave one out")
    clear = cast_rays(legs[:-1].copy(), delta / lengths[:, None], world.segments, np.empty((0, 3)))
    if (clear < lengths).any():
        leg = int(np.argmax(clear < lengths))
        raise ConfigError(f"{path}: the way from waypoint {leg + 1} to the next runs into a wall; lead it around")
    return result
