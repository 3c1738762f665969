"""Changes of a map that a run finds, against those that were made: python benchmarks/map_changes.py --seeds 1 2 3

Simulated drives in rooms, rings of corridors and halls. From the map of each, what stands in 30 % of the squares of a
metre is removed, so that it appears to the robot; boxes of 0.5 m are drawn that are not there, and vanish. Poses are
the true ones with an error that changes along the way, of 3 cm and 0.3 deg. Of the changes that at least three scans
show, from 0.3 m on, the share that is found; and of those that are found, the share that was not made.
"""

from __future__ import annotations

import argparse
from collections import Counter
from math import radians
from typing import TYPE_CHECKING

import numpy as np
from confusion import SECONDS, SENSORS, changed, drive_of, world_of

from hsloc.analysis.map_changes import MapChangeFinder
from hsloc.evaluation.maps import changed_things
from hsloc.kernels.changed_cells import count_beams
from hsloc.model import Pose2, Scan, Truth
from hsloc.simulation import presets
from hsloc.simulation.scenario import Scenario

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid

_ERROR_M, _ERROR_RAD = 0.03, radians(0.3)
_SMOOTH = 50
"""Scans over which an error keeps about its size."""
_NEAR_M = 0.5
"""A change within this distance of one that was made is the same."""
_SHAPES = ("rooms", "ring", "hall")


def errors(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Errors (n, 3) in m, m, rad that change slowly."""
    kernel = np.hanning(_SMOOTH)
    white = rng.standard_normal((n + _SMOOTH, 3))
    smooth = np.array([np.convolve(column, kernel / np.sqrt((kernel**2).sum()), "same") for column in white.T]).T
    return smooth[:n] * (_ERROR_M, _ERROR_M, _ERROR_RAD)


def measure(shape: str, seed: int) -> Counter[str]:
    """Counts of a run: made, found, of each kind, and how many of those found were not made."""
    world = world_of(shape, seed)
    scenario = Scenario(
        world.name, seed, robot=presets.BRISK, sensor=SENSORS[shape], scan_rate_hz=5.0, duration_s=SECONDS
    )
    truth = world.occupancy_grid(0.05)
    given = changed(seed)(truth)
    scans: list[tuple[Scan, Pose2]] = []
    waiting: list[Scan] = []
    poses: dict[int, Pose2] = {}
    for event in drive_of(scenario, shape, seed):
        if isinstance(event, Truth):
            poses[event.stamp_ns] = event.T_map_base
        elif isinstance(event, Scan):
            waiting.append(event)
    scans = [(scan, poses[scan.stamp_ns]) for scan in waiting if scan.stamp_ns in poses]
    finder = MapChangeFinder(given)
    off = errors(len(scans), np.random.default_rng((seed, 11)))
    for (scan, pose), error in zip(scans, off, strict=True):
        finder.add(scan, scan.points_base(), Pose2(pose.x + error[0], pose.y + error[1], pose.theta + error[2]))
    found = finder.changes()
    counts: Counter[str] = Counter()
    for kind in ("appeared", "vanished"):
        made = _made(given, truth, kind, scans)
        mine = [] if found is None else [(one.x, one.y) for one in found.changes if one.kind == kind]
        counts[f"{kind} made"] = len(made)
        counts[f"{kind} missed"] = sum(not _is_near(cells, mine) for cells in made)
        every = np.concatenate([np.zeros((0, 2)), _cells(given, truth, kind)])
        counts[f"{kind} found"] = len(mine)
        counts[f"{kind} false"] = sum(not _is_near(every, [one]) for one in mine)
    return counts


def _mask(given: OccupancyGrid, truth: OccupancyGrid, kind: str) -> NDArray[np.bool_]:
    first, second = (truth, given) if kind == "appeared" else (given, truth)
    return first.occupied() & ~second.occupied()


def _cells(given: OccupancyGrid, truth: OccupancyGrid, kind: str) -> NDArray[np.float64]:
    return given.centres(_mask(given, truth, kind))


def _made(
    given: OccupancyGrid, truth: OccupancyGrid, kind: str, scans: list[tuple[Scan, Pose2]]
) -> list[NDArray[np.float64]]:
    """Cells (n, 2) of each change that at least three of every fifth scan show: beams end in it, or cross it."""
    mask = _mask(given, truth, kind)
    things, numbers = changed_things(given, mask, kind, 0.3)  # type: ignore[arg-type]
    shown = np.zeros(len(things) + 1, dtype=np.int64)
    none = np.zeros((len(things) + 1, 2))
    for scan, pose in scans[::5]:
        ended, crossed = np.zeros(len(things) + 1, dtype=np.int64), np.zeros(len(things) + 1, dtype=np.int64)
        points = scan.points_base()
        points = points[np.hypot(points[:, 0], points[:, 1]) < 9.5]
        cell, T_grid_base = given.resolution, given.origin.inverse() @ pose
        laser = T_grid_base @ scan.T_base_laser
        count_beams(
            numbers, none, np.array((laser.x, laser.y)) / cell, (T_grid_base @ points) / cell, 6.0, ended, crossed
        )
        shown += (ended if kind == "appeared" else crossed) >= 2
    return [given.centres(numbers == k) for k in range(1, len(things) + 1) if shown[k] >= 3]


def _is_near(cells: NDArray[np.float64], places: list[tuple[float, float]]) -> bool:
    return any((np.hypot(*(cells - place).T) <= _NEAR_M).any() for place in places)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    for shape in _SHAPES:
        total: Counter[str] = Counter()
        for seed in parser.parse_args().seeds:
            total += measure(shape, seed)
        print(shape, ", ".join(f"{name} {total[name]}" for kind in ("appeared", "vanished") for name in
              (f"{kind} made", f"{kind} missed", f"{kind} found", f"{kind} false")), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
