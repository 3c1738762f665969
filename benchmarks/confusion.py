"""Confusion table over worlds that are made from a seed: wrong poses called localised, right ones that are not.

    python benchmarks/confusion.py [--seeds N ...] [--shapes SHAPE ...] [--rows FILE] [KIND ...]

Three shapes of worlds: rooms of all sizes with furniture, a ring of corridors, and a hall with pillars. Each seed gives
other ones, and other drives. A pose is wrong by more than 0.25 m or 5 deg; on another building's map or a mirrored one
every pose is wrong (the mirror image of a hall is not tried: it has the same walls, and poses in it are right). A line
for each kind of run: the share of all poses that are wrong and called localised, the share of right poses called
anything else, each with its largest value of a run, and the mean squared error of the right poses by the variances in
states.csv (3 is expected) with the coverage at 95 %.
"""

from __future__ import annotations

import argparse
import json
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

import numpy as np
from false_certainty import NOISE_20, crowded, mirrored, same, scaled, scored
from scipy.ndimage import binary_closing, distance_transform_edt, find_objects, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from hsloc.benchmark.whole_map import floor
from hsloc.model import Event, OccupancyGrid, Pose2, Scan
from hsloc.simulation import presets
from hsloc.simulation.floor_plan import floor_plan, inset, notched_wall, pillar, polygon
from hsloc.simulation.odometer import OdometryNoise, Slip
from hsloc.simulation.scenario import Kidnap, Scenario
from hsloc.simulation.simulator import events
from hsloc.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

Point = tuple[float, float]
SECONDS = 60.0
CLEARANCE = 0.45
"""Least distance of a path from the walls (m)."""


def rooms(seed: int) -> World:
    """A floor of 300 to 1,200 square metres."""
    return routed(floor(Random(seed).uniform(300.0, 1200.0), seed), seed)


def ring(seed: int, *, is_plain: bool = False) -> World:
    """A ring of corridors 1.8 to 2.4 m wide, with recesses and pillars at irregular places unless it is plain."""
    random = Random(seed)
    corners = random.randint(5, 8)
    centre = []
    for k in range(corners):
        turn = 2.0 * np.pi * (k + random.uniform(-0.25, 0.25)) / corners
        radius = random.uniform(11.0, 20.0)
        centre.append((round(1.4 * radius * np.cos(turn), 3), round(radius * np.sin(turn), 3)))
    half = random.uniform(0.9, 1.2)
    walls = []
    for side, line in ((-1.0, inset(centre, -half)), (1.0, inset(centre, half))):
        walls.append(polygon(line if is_plain else _notched(line, random, side)))
    first, second = np.array(centre[0]), np.array(centre[1])
    start = (first + 0.4 * (second - first)).round(3)
    return World(f"ring {seed}", np.vstack(walls), np.array([tuple(start), *centre[1:], centre[0]]), closed=True)


def _notched(corners: list[Point], random: Random, side: float) -> list[Point]:
    result: list[Point] = []
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
        notches, at = [], random.uniform(0.8, 4.0)
        while at < np.hypot(x1 - x0, y1 - y0) - 2.0:
            width, depth = random.uniform(0.3, 1.3), random.choice((-0.12, 0.08, 0.15, 0.35))
            notches.append((at, width, side * depth))
            at += width + random.uniform(0.6, 6.0)
        result += notched_wall((x0, y0), (x1, y1), notches)
    return result


def hall(seed: int) -> World:
    """A hall of 25 to 50 m with bare walls, two gates, some solid blocks and pillars."""
    random = Random(seed)
    width, depth = round(random.uniform(25.0, 50.0), 3), round(random.uniform(18.0, 32.0), 3)
    gates = []
    for _ in range(2):
        x, w = random.uniform(3.0, width - 8.0), random.uniform(2.0, 5.0)
        y0 = random.choice((-random.uniform(0.5, 1.5), depth))
        gates.append((x, min(y0, depth), x + w, depth + random.uniform(0.5, 1.5) if y0 == depth else 0.0))
    blocks = []
    for _ in range(random.randint(3, 6)):
        x, y = random.uniform(0.0, width - 3.0), random.uniform(0.0, depth - 2.0)
        blocks.append((x, y, x + random.uniform(0.5, 3.0), y + random.uniform(0.4, 2.0)))
    pillars = [
        pillar(round(random.uniform(3.0, width - 3.0), 3), round(random.uniform(3.0, depth - 3.0), 3), 0.35)
        for _ in range(random.randint(3, 7))
    ]
    boxes = [tuple(round(v, 3) for v in box) for box in [(0.0, 0.0, width, depth), *gates]]
    solid = [tuple(round(v, 3) for v in box) for box in blocks]
    walls = np.vstack((floor_plan(boxes, solid), *pillars))  # type: ignore[arg-type]
    inside = np.array(((0.6, 0.6), (width - 0.6, depth - 0.6)))
    return routed(World(f"hall {seed}", walls, inside), seed, legs=14)


def routed(world: World, seed: int, legs: int = 9) -> World:
    """The world with a path that leads past random places of its largest free region."""
    rng = np.random.default_rng((seed, 77))
    grid = world.occupancy_grid(0.1)
    clear = distance_transform_edt(grid.free()) * grid.resolution
    regions, _ = label(clear > CLEARANCE)
    free = regions == np.argmax(np.bincount(regions.ravel())[1:]) + 1
    index = np.full(free.shape, -1)
    index[free] = np.arange(np.count_nonzero(free))
    v, u = np.nonzero(free)
    here, there, cost = [], [], []
    for dv, du in ((0, 1), (1, 0), (1, 1), (1, -1)):
        w, z = v + dv, u + du
        inside = (w >= 0) & (z >= 0) & (w < free.shape[0]) & (z < free.shape[1])
        k = np.flatnonzero(inside)
        k = k[index[w[k], z[k]] >= 0]
        here.append(k)
        there.append(index[w[k], z[k]])
        cost.append(np.hypot(dv, du) * (1.0 + 0.3 / clear[v[k], u[k]]))
    size = (len(v), len(v))
    graph = coo_array((np.concatenate(cost), (np.concatenate(here), np.concatenate(there))), shape=size).tocsr()
    stops = rng.choice(len(v), legs, replace=False)
    path: list[int] = [int(stops[0])]
    for a, b in zip(stops, [*stops[1:], stops[0]], strict=True):
        before = dijkstra(graph, directed=False, indices=b, return_predecessors=True)[1]
        at, leg = int(a), []
        while at != b:
            leg.append(at)
            at = int(before[at])
        path += leg[5::5]
    cells = np.column_stack((u[path], v[path])) + 0.5
    points = np.array([grid.origin @ point for point in cells * grid.resolution])
    return World(world.name, world.segments, points.round(3), closed=True)


def changed(seed: int) -> Callable[[OccupancyGrid], OccupancyGrid]:
    """In 30 % of the squares of a metre what stands there is gone from the map; elsewhere as many new boxes stand."""

    def change(grid: OccupancyGrid) -> OccupancyGrid:
        rng = np.random.default_rng((seed, 5))
        cells = grid.cells.copy()
        side = round(1.0 / grid.resolution)
        occupied = cells >= grid.occupied_threshold
        free = grid.free()
        for v in range(0, cells.shape[0], side):
            for u in range(0, cells.shape[1], side):
                square = np.s_[v : v + side, u : u + side]
                drawn = rng.random()
                if occupied[square].any() and drawn < 0.3:
                    cells[square][occupied[square]] = 0
                elif drawn < 0.03 and free[square].all():
                    cells[v + 4 : v + 14, u + 4 : u + 12] = 100
        return replace(grid, cells=cells)

    return change


def doors_closed(seed: int) -> Callable[[OccupancyGrid], OccupancyGrid]:
    """Every second door of the rooms is drawn closed: a gap of 0.6 to 1.4 m in a wall that is up to 0.2 m thick."""

    def change(grid: OccupancyGrid) -> OccupancyGrid:
        cells, rng = grid.cells.copy(), np.random.default_rng((seed, 6))
        occupied = cells >= grid.occupied_threshold
        reach = round(1.4 / grid.resolution)
        for axis in (0, 1):
            along = np.ones((reach, 1) if axis == 0 else (1, reach))
            closed = binary_closing(np.pad(occupied, reach), along)[reach:-reach, reach:-reach]
            gaps, _ = label(closed & ~occupied)
            for k, where in enumerate(find_objects(gaps), start=1):
                sides = [(part.stop - part.start) * grid.resolution for part in where]
                if sides[1 - axis] <= 0.2 and 0.6 <= sides[axis] <= 1.4 and rng.random() < 0.5:
                    cells[gaps == k] = 100
        return replace(grid, cells=cells)

    return change


def half(grid: OccupancyGrid) -> OccupancyGrid:
    """The map is known up to the middle of its longer side."""
    cells = grid.cells.copy()
    height, width = cells.shape
    if width >= height:
        cells[:, width // 2 :] = -1
    else:
        cells[height // 2 :] = -1
    return replace(grid, cells=cells)


def late(drive: list[Event]) -> Iterator[Event]:
    """Scans are stamped 0.2 s late."""
    moved = [replace(e, stamp_ns=e.stamp_ns + 200_000_000) if isinstance(e, Scan) else e for e in drive]
    yield from sorted(moved, key=lambda event: event.stamp_ns)


def remounted(drive: list[Event]) -> Iterator[Event]:
    """The laser is 10 cm and 3 deg from where it is said to be."""
    for event in drive:
        if isinstance(event, Scan):
            said = event.T_base_laser @ Pose2(0.08, -0.06, np.radians(3.0))
            yield replace(event, T_base_laser=said)
        else:
            yield event


def times(by: float) -> OdometryNoise:
    """The noise of `hsloc record`, as variances times the square of `by`; 20 is that of `false_certainty`."""
    if by == 20.0:
        return NOISE_20
    usual = OdometryNoise()
    part = by * by
    return OdometryNoise(usual.alpha1 * part, usual.alpha2 * part, usual.alpha3 * part, usual.alpha4 * part)


@dataclass(frozen=True)
class Kind:
    """What is changed in a run."""

    scenario: Callable[[Scenario], Scenario] = lambda s: s
    change: Callable[[int], Callable[[OccupancyGrid], OccupancyGrid]] = lambda _: same
    drive: Callable[[list[Event], int], Any] = lambda d, _: d
    is_wrong: bool = False
    start: str = "given"
    shapes: tuple[str, ...] = ("rooms", "ring", "hall")


_SLIPS = (Slip(12.0, 1.5, 1.6), Slip(27.0, 1.0, 1.2, 0.35), Slip(41.0, 2.0, 0.5), Slip(51.0, 1.0, 0.0, -0.5))
KINDS: dict[str, Kind] = {
    "right map": Kind(),
    "unknown start": Kind(start="unknown"),
    "wrong building": Kind(is_wrong=True),
    "wrong building, unknown": Kind(is_wrong=True, start="unknown"),
    "mirrored": Kind(change=lambda _: mirrored, is_wrong=True, shapes=("rooms", "ring")),
    "mirrored, unknown": Kind(change=lambda _: mirrored, is_wrong=True, start="unknown", shapes=("rooms", "ring")),
    "scaled 1.01": Kind(change=lambda _: scaled(1.01)),
    "scaled 1.02": Kind(change=lambda _: scaled(1.02)),
    "scaled 1.05": Kind(change=lambda _: scaled(1.05)),
    "scaled 0.97": Kind(change=lambda _: scaled(0.97)),
    "30 % changed": Kind(change=changed),
    "30 % changed, unknown": Kind(change=changed, start="unknown"),
    "doors closed": Kind(change=doors_closed, shapes=("rooms",)),
    "half map": Kind(change=lambda _: half),
    "half map, unknown": Kind(change=lambda _: half, start="unknown"),
    "people 50 %": Kind(drive=lambda d, seed: crowded(d, 0.5, seed)),
    "people 50 %, unknown": Kind(drive=lambda d, seed: crowded(d, 0.5, seed), start="unknown"),
    "kidnapped": Kind(lambda s: replace(s, kidnaps=(Kidnap(25.0, 20.0),))),
    "wrong start": Kind(start="wrong"),
    "slip": Kind(lambda s: replace(s, slips=_SLIPS)),
    "mounting 10 cm, 3 deg": Kind(drive=lambda d, _: remounted(d)),
    "lag 0.2 s": Kind(drive=lambda d, _: late(d)),
    "4 m lidar": Kind(lambda s: replace(s, sensor=replace(s.sensor, range_max=4.0)), shapes=("hall",)),
    "plain corridor": Kind(lambda s: replace(s, sensor=replace(s.sensor, range_max=8.0)), shapes=("plain",)),
    "noise x 2": Kind(lambda s: replace(s, odometry=times(2.0))),
    "noise x 5": Kind(lambda s: replace(s, odometry=times(5.0))),
    "noise x 20": Kind(lambda s: replace(s, odometry=times(20.0))),
    "noise x 20, unknown": Kind(lambda s: replace(s, odometry=times(20.0)), start="unknown"),
}
GOAL = (
    *("right map", "wrong building", "mirrored", "scaled 1.02", "30 % changed", "doors closed", "people 50 %"),
    *("kidnapped", "wrong start", "slip", "mounting 10 cm, 3 deg", "lag 0.2 s", "4 m lidar", "plain corridor"),
)
"""The kinds of which at most 0.5 % of all poses may be wrong and localised, and at most 5 % of the right ones anything
else. The others are harder, or the same from an unknown start."""
SHAPES: dict[str, Callable[[int], World]] = {
    "rooms": rooms,
    "ring": ring,
    "hall": hall,
    "plain": lambda seed: ring(seed, is_plain=True),
}
SENSORS = {"rooms": presets.AHEAD, "ring": presets.WIDE, "hall": presets.SIDEWAYS, "plain": presets.WIDE}


@lru_cache(4)
def world_of(shape: str, seed: int) -> World:
    return SHAPES[shape](seed)


@lru_cache(4)
def drive_of(scenario: Scenario, shape: str, seed: int) -> tuple[Event, ...]:
    return tuple(events(scenario, world_of(shape, seed)))


def start_of(kind: Kind, world: World, grid: OccupancyGrid, seed: int) -> Pose2 | None:
    """The given start, none, or one somewhere else on open ground."""
    if kind.start != "wrong":
        return world.start() if kind.start == "given" else None
    rng = np.random.default_rng((seed, 9))
    v, u = np.nonzero(distance_transform_edt(grid.free()) * grid.resolution > CLEARANCE)
    right = world.start()
    while True:
        k = rng.integers(len(v))
        x, y = grid.origin @ np.array(((u[k] + 0.5) * grid.resolution, (v[k] + 0.5) * grid.resolution))
        if right.distance(Pose2(float(x), float(y))) > 2.0:
            return Pose2(float(x), float(y), float(rng.uniform(-np.pi, np.pi)))


def measure(name: str, shape: str, seed: int) -> dict[str, Any]:
    kind, world = KINDS[name], world_of(shape, seed)
    scenario = Scenario(
        world.name, seed, robot=presets.BRISK, sensor=SENSORS[shape], scan_rate_hz=5.0, duration_s=SECONDS
    )
    drive = list(kind.drive(list(drive_of(kind.scenario(scenario), shape, seed)), seed))
    of_map = world_of(shape, seed + 1000) if "building" in name else world
    grid = kind.change(seed)(of_map.occupancy_grid(0.05))
    rng = np.random.default_rng((seed, zlib.crc32(name.encode())))
    found = scored(drive, grid, start_of(kind, of_map, grid, seed), rng, kind.is_wrong)
    wrong, states, squared = found.wrong, found.states, found.squared()
    doubts: dict[str, float] = {}
    for k in np.flatnonzero(~wrong & ~states.is_localised()).tolist():
        doubts[states.state[k].value] = doubts.get(states.state[k].value, 0.0) + 1.0 / len(wrong)
    return {
        "kind": name,
        "shape": shape,
        "seed": seed,
        "wrong": found.false(),
        "doubted": found.doubted(),
        "right": float((~wrong).mean()),
        "nees": float(np.mean(squared)) if len(squared) else float("nan"),
        "covered": float(np.mean(squared < 7.81)) if len(squared) else float("nan"),
        "doubts": {state: round(share, 4) for state, share in doubts.items()},
    }


def line(name: str, rows: list[dict[str, Any]]) -> str:
    """Means over the runs of a kind, and the largest values."""
    wrong, right = [row["wrong"] for row in rows], [row for row in rows if row["right"] > 0.02]
    text = f"{name:26s} {len(rows):3d} {100.0 * np.mean(wrong):6.2f} {100.0 * max(wrong):6.1f}"
    if right:
        doubted = [row["doubted"] for row in right]
        weight = [row["right"] for row in right]
        text += f"   {100.0 * np.average(doubted, weights=weight):6.2f} {100.0 * max(doubted):6.1f}"
        nees = [row["nees"] for row in right if np.isfinite(row["nees"])]
        if nees:
            covered = [row["covered"] for row in right if np.isfinite(row["nees"])]
            text += f"   {np.mean(nees):6.2f} {max(nees):6.1f} {100.0 * np.mean(covered):5.1f}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--shapes", nargs="+", default=list(SHAPES), choices=SHAPES)
    parser.add_argument("--rows", type=Path, help="a file to which a line of JSON is added for each run")
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {'; '.join(KINDS)}".replace("%", "%%"))
    arguments = parser.parse_args()
    print("kind, runs; wrong and localised: mean, largest; right, not localised: mean, largest; NEES: mean, largest,")
    print("coverage; all but NEES in %")
    every: list[dict[str, Any]] = []
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in arguments.kinds or KINDS}
    for seed in arguments.seeds:
        for shape in arguments.shapes:
            for name, found in rows.items():
                if shape in KINDS[name].shapes:
                    found.append(measure(name, shape, seed))
                    if arguments.rows:
                        with arguments.rows.open("a") as file:
                            file.write(json.dumps(found[-1]) + "\n")
    for name, found in rows.items():
        if found:
            print(line(name, found), flush=True)
            every += found
    goal = [row for row in every if row["kind"] in GOAL]
    if goal:
        print(line("those of the goal", goal))
    print(line("all", every))


if __name__ == "__main__":
    main()
