"""Where a single scan fits on a whole floor: how long the search takes, and whether it is right.

The floors have a given size: rooms and halls of all sizes with doors, furniture and pillars.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import ceil, exp, log, pi, sqrt, tau
from random import Random
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.raycasting import cast_rays
from hsloc.localisation.whole_map_search import WholeMapSearch
from hsloc.matching import LikelihoodField
from hsloc.model import Pose2
from hsloc.model.pose2 import wrap_angle
from hsloc.simulation.floor_plan import box_at, floor_plan, pillar
from hsloc.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid
    from hsloc.simulation.floor_plan import Box

    F64 = NDArray[np.float64]

_WALL = 0.15
_DOOR = 1.1
_SMALLEST_ROOM, _LARGEST_ROOM = 12.0, 500.0
"""Square metres; sizes between are equally likely on a logarithmic scale."""

AREAS = (2_000.0, 10_000.0, 40_000.0)
"""Square metres of the floors."""
BLOCKED = (0.0, 0.1)
"""Shares of the beams that end at something that is not on the map."""
SEED = 1
_RIGHT = (0.3, np.radians(3.0))


def floor(area: float, seed: int) -> World:
    """A square floor of `area` square metres, cut into rooms at random; each wall has a door."""
    random = Random(seed)
    side = round(sqrt(area), 3)
    rooms: list[Box] = []
    walls: list[Box] = []
    _cut((0.0, 0.0, side, side), random, rooms, walls)
    doors = [door for wall in walls for door in _doors(wall, rooms, random)]
    blocks: list[Box] = []
    loose = []
    for room in rooms:
        for _ in range(round((room[2] - room[0]) * (room[3] - room[1]) / random.uniform(6.0, 25.0))):
            length, width = random.uniform(0.3, 2.2), random.uniform(0.3, 1.0)
            x, y = random.uniform(room[0], room[2]), random.uniform(room[1], room[3])
            kind = random.random()
            if kind < 0.5:
                if random.random() < 0.5:
                    length, width = width, length
                blocks.append((x, y, min(x + length, room[2]), min(y + width, room[3])))
            elif kind < 0.8:
                loose.append(box_at(x, y, length, width, random.uniform(0.0, 90.0)))
            else:
                loose.append(pillar(x, y, random.uniform(0.1, 0.35)))
    segments = np.concatenate((floor_plan(_rounded(rooms + doors), _rounded(blocks)), *loose))
    x0, y0, x1, y1 = rooms[0]
    inside = np.array(((x0 + 0.1, y0 + 0.1), (x1 - 0.1, y1 - 0.1)))
    return World(f"floor of {area:g} square metres", segments, inside)


def _rounded(boxes: list[Box]) -> list[Box]:
    """To the millimetre, so that sides that should meet do."""
    return [(round(x0, 3), round(y0, 3), round(x1, 3), round(y1, 3)) for x0, y0, x1, y1 in boxes]


def _cut(box: Box, random: Random, rooms: list[Box], walls: list[Box]) -> None:
    x0, y0, x1, y1 = box
    largest = exp(random.uniform(log(_SMALLEST_ROOM), log(_LARGEST_ROOM)))
    if (x1 - x0) * (y1 - y0) <= largest or max(x1 - x0, y1 - y0) < 5.0:
        rooms.append(box)
        return
    share = random.uniform(0.3, 0.7)
    if x1 - x0 > y1 - y0:
        x = x0 + share * (x1 - x0)
        walls.append((x - _WALL / 2, y0, x + _WALL / 2, y1))
        parts = ((x0, y0, x - _WALL / 2, y1), (x + _WALL / 2, y0, x1, y1))
    else:
        y = y0 + share * (y1 - y0)
        walls.append((x0, y - _WALL / 2, x1, y + _WALL / 2))
        parts = ((x0, y0, x1, y - _WALL / 2), (x0, y + _WALL / 2, x1, y1))
    for part in parts:
        _cut(part, random, rooms, walls)


def _doors(wall: Box, rooms: list[Box], random: Random) -> list[Box]:
    """One door for each 12 m of a wall, where there is one room on either side of it."""
    x0, y0, x1, y1 = wall
    is_upright = x1 - x0 < y1 - y0
    low, high = (y0, y1) if is_upright else (x0, x1)
    doors: list[Box] = []
    for _ in range(1 + int((high - low) / 12.0)):
        for _ in range(30):
            at = random.uniform(low, high - _DOOR)
            door = (x0, at, x1, at + _DOOR) if is_upright else (at, y0, at + _DOOR, y1)
            if sum(_touches(door, room, is_upright) for room in rooms) == 2:
                doors.append(door)
                break
    return doors


def _touches(door: Box, room: Box, is_upright: bool) -> bool:
    if is_upright:
        beside = abs(door[0] - room[2]) < 1e-6 or abs(door[2] - room[0]) < 1e-6
        return beside and room[1] <= door[1] and door[3] <= room[3]
    above = abs(door[1] - room[3]) < 1e-6 or abs(door[3] - room[1]) < 1e-6
    return above and room[0] <= door[0] and door[2] <= room[2]


def random_pose(grid: OccupancyGrid, rng: np.random.Generator, clearance: float = 0.3) -> Pose2:
    """A pose in free space, at least `clearance` metres from what is not, with any heading."""
    cells = max(ceil(clearance / grid.resolution), 0)
    height, width = grid.cells.shape
    while True:
        row, column = int(rng.integers(height)), int(rng.integers(width))
        around = grid.cells[max(row - cells, 0) : row + cells + 1, max(column - cells, 0) : column + cells + 1]
        # Free as in OccupancyGrid.free: known, and below 20.
        if ((around >= 0) & (around < 20)).all():
            break
    offset = rng.random(2)
    place = grid.origin @ (np.array(((column + offset[0], row + offset[1]),)) * grid.resolution)
    return Pose2(float(place[0, 0]), float(place[0, 1]), float(rng.uniform(-pi, pi)))


def scan_at(
    world: World,
    pose: Pose2,
    rng: np.random.Generator,
    *,
    beams: int = 360,
    range_max: float = 25.0,
    noise: float = 0.01,
    blocked: float = 0.0,
) -> F64:
    """End points, seen from the pose, of the beams that hit; a share `blocked` of them at some nearer range."""
    angles = tau * np.arange(beams) / beams
    directions = np.column_stack((np.cos(pose.theta + angles), np.sin(pose.theta + angles)))
    origin = np.tile((pose.x, pose.y), (beams, 1))
    segments = world.segments
    corners = segments.reshape(-1, 2, 2)
    near = (corners.min(axis=1) < origin[0] + range_max).all(axis=1)
    near &= (corners.max(axis=1) > origin[0] - range_max).all(axis=1)
    ranges = cast_rays(origin, directions, np.ascontiguousarray(segments[near]), np.empty((0, 3)))
    ranges = ranges + rng.normal(0.0, noise, beams)
    short = rng.random(beams) < blocked
    ranges = np.where(short, ranges * rng.random(beams), ranges)
    seen = np.isfinite(ranges) & (ranges < range_max) & (ranges > 0.05)
    points: F64 = (ranges[:, None] * np.column_stack((np.cos(angles), np.sin(angles))))[seen]
    return points


@dataclass(frozen=True, slots=True)
class WholeMapTiming:
    """Searches from random places on one floor, one scan each, in processor time; the preparation of the map
    is not counted.

    `right`: the share in which the true place is among the modes; `unique`: in which it was proven to be the only one;
    `wrong`: in which one place was proven to be the only one and is another; `complete`: in which the work sufficed.
    """

    area: float
    blocked: float
    scans: int
    right: float
    unique: float
    wrong: float
    complete: float
    median_s: float
    p95_s: float
    worst_s: float
    prepare_s: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def measure_whole_map(
    areas: Sequence[float], scans: int, progress: Callable[[float], None] = lambda share: None
) -> tuple[WholeMapTiming, ...]:
    """Search each floor with `scans` scans of 360 beams for each share of blocked beams."""
    results: list[WholeMapTiming] = []
    for area in areas:
        world = floor(area, SEED)
        grid = world.occupancy_grid(0.05)
        field = LikelihoodField.from_grid(grid)
        begin = process_time()
        search = WholeMapSearch(grid, field)
        prepared = process_time() - begin
        for blocked in BLOCKED:
            rows = []
            for index in range(scans):
                rng = np.random.default_rng((SEED, index))
                true = random_pose(grid, rng)
                points = scan_at(world, true, rng, blocked=blocked)
                if index == 0:
                    search.search(points)
                begin = process_time()
                result = search.search(points)
                seconds = process_time() - begin
                right = any(
                    mode.pose.distance(true) <= _RIGHT[0] and abs(wrap_angle(mode.pose.theta - true.theta)) <= _RIGHT[1]
                    for mode in result.modes
                )
                rows.append((right, result.is_unique, result.is_unique and not right, result.is_complete, seconds))
                progress((len(results) + (index + 1) / scans) / (len(areas) * len(BLOCKED)))
            table = np.array(rows, dtype=np.float64)
            right_share, unique, wrong, complete = (float(share) for share in table[:, :4].mean(axis=0))
            results.append(
                WholeMapTiming(
                    area=area,
                    blocked=blocked,
                    scans=scans,
                    right=right_share,
                    unique=unique,
                    wrong=wrong,
                    complete=complete,
                    median_s=float(np.median(table[:, 4])),
                    p95_s=float(np.percentile(table[:, 4], 95)),
                    worst_s=float(table[:, 4].max()),
                    prepare_s=prepared,
                )
            )
    return tuple(results)
