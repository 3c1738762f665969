"""An unknown start at random places: is the first claim right, after how many metres, and at which cost.

    python benchmarks/unknown_starts.py [--starts N] [--seed N] [--crowd METRES] office
    python benchmarks/unknown_starts.py --starts 4 10000        # a floor of so many square metres

A robot that avoids the walls wanders from a random pose. "right" claims are within 0.25 m and 5 deg of the truth. A run
without a claim is "alive" if the truth is among the hypotheses; with `--crowd`, half of the beams are blocked over the
first so many metres. Seconds are processor time up to the claim, the preparation of the map not counted.
"""

from __future__ import annotations

import argparse
import time
from math import hypot, pi
from resource import RUSAGE_SELF, getrusage
from typing import TYPE_CHECKING

import numpy as np

from hsloc.benchmark.whole_map import floor, random_pose
from hsloc.config import Config
from hsloc.kernels.raycasting import cast_rays
from hsloc.localisation.localiser import Localiser
from hsloc.matching import LikelihoodField
from hsloc.model import OccupancyGrid, PairedScan, Pose2, Scan, Status, wrap_angle
from hsloc.simulation.built_in import built_in

if TYPE_CHECKING:
    from hsloc.simulation.world import World

STEP = 0.1
BEAMS = 360
RANGE = 12.0


def wander(grid: OccupancyGrid, metres: float, rng: np.random.Generator) -> list[Pose2]:
    """Poses 0.1 m apart; the robot turns away from what is not free within 0.45 m ahead."""
    free = grid.free()
    inverse = grid.origin.inverse()

    def is_clear(pose: Pose2) -> bool:
        ahead = pose @ np.array([(x, y) for x in np.arange(0.1, 0.5, 0.05) for y in (-0.2, 0.0, 0.2)])
        cells = np.floor((inverse @ ahead) / grid.resolution).astype(np.int64)
        inside = (cells >= 0).all(axis=1) & (cells < np.array(free.shape)[::-1]).all(axis=1)
        return bool(inside.all()) and bool(free[cells[:, 1], cells[:, 0]].all())

    pose = random_pose(grid, rng, 0.4)
    poses, turn, curve = [pose], 0.1, 0.0
    while len(poses) < metres / STEP:
        if is_clear(pose):
            turn = 0.1 if rng.random() < 0.5 else -0.1
            curve = float(np.clip(curve + rng.normal(0.0, 0.01), -0.04, 0.04))
            pose = pose @ Pose2(STEP, 0.0, curve)
        else:
            pose = pose @ Pose2(0.0, 0.0, turn)
        poses.append(pose)
    return poses


def scan_of(world: World, pose: Pose2, stamp_ns: int, crowd: float, rng: np.random.Generator) -> Scan:
    angles = -pi + 2.0 * pi * np.arange(BEAMS) / BEAMS
    directions = np.column_stack((np.cos(pose.theta + angles), np.sin(pose.theta + angles)))
    corners = world.segments.reshape(-1, 2, 2)
    here = np.array((pose.x, pose.y))
    near = (corners.min(axis=1) < here + RANGE).all(axis=1) & (corners.max(axis=1) > here - RANGE).all(axis=1)
    segments = np.ascontiguousarray(world.segments[near])
    ranges = cast_rays(np.tile(here, (BEAMS, 1)), directions, segments, np.empty((0, 3)))
    ranges += rng.normal(0.0, 0.01, BEAMS)
    blocked = np.repeat(rng.random(BEAMS // 15) < crowd, 15)
    ranges = np.where(blocked, np.minimum(ranges, np.repeat(rng.uniform(0.5, 2.5, BEAMS // 15), 15)), ranges)
    ranges[~(ranges <= RANGE)] = np.inf
    return Scan(stamp_ns, ranges.astype(np.float32), -pi, 2.0 * pi / BEAMS, 0.05, RANGE)


def is_near(pose: Pose2, true: Pose2) -> bool:
    return pose.distance(true) <= 0.25 and abs(wrap_angle(pose.theta - true.theta)) <= np.radians(5.0)


def run(localiser: Localiser, world: World, path: list[Pose2], crowd: float, rng: np.random.Generator) -> str:
    """Wander until there is a claim; how it ended, metres, seconds."""
    T_odom_base, length = Pose2(0.0, 0.0, float(rng.uniform(-pi, pi))), 0.0
    before = path[0]
    seconds = 0.0
    for k, true in enumerate(path):
        motion = before.between(true)
        length += hypot(motion.x, motion.y)
        noise = rng.normal(0.0, (0.02 * abs(motion.x), 0.005 * abs(motion.x), 0.03 * abs(motion.theta) + 0.001))
        T_odom_base = T_odom_base @ motion @ Pose2(*noise)
        before = true
        scan = scan_of(world, true, round(k * 2e8), 0.5 if length < crowd else 0.0, rng)
        began = time.process_time()
        estimate = localiser.update(PairedScan(scan, T_odom_base))
        seconds += time.process_time() - began
        if estimate.status is Status.RELOCALISED:
            how = "right" if is_near(estimate.T_map_base, true) else "WRONG"
            return f"{how:8s} {length:6.1f} {seconds:7.2f}"
    poses = getattr(localiser, "_global_search").places()  # noqa: B009
    how = "alive" if any(is_near(pose, path[-1]) for pose in poses) else "MISSED"
    return f"{how:8s} {length:6.1f} {seconds:7.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--crowd", type=float, default=0.0, metavar="METRES")
    parser.add_argument("--metres", type=float, default=25.0)
    parser.add_argument("world", help="a built-in world, or the area of a floor in square metres")
    arguments = parser.parse_args()
    area = arguments.world
    world = floor(float(area), arguments.seed) if area.isdigit() else built_in(area)
    grid = world.occupancy_grid(0.05)
    field, config = LikelihoodField.from_grid(grid), Config()
    rows = []
    for start in range(arguments.starts):
        rng = np.random.default_rng((arguments.seed, start))
        localiser = Localiser.from_parameters(grid, field, config.make_matcher(), config.localiser, rng)
        row = run(localiser, world, wander(grid, arguments.metres, rng), arguments.crowd, rng)
        rows.append(row.split())
        if rows[-1][0] in ("WRONG", "MISSED"):
            print(f"start {start}: {row}")
    count = {how: sum(row[0] == how for row in rows) for how in ("right", "alive", "WRONG", "MISSED")}
    metres, seconds = (np.array([float(row[k]) for row in rows]) for k in (1, 2))
    print(f"{area}: {count}; metres median {np.median(metres):.1f}, max {metres.max():.1f};", end=" ")
    print(f"seconds median {np.median(seconds):.2f}, max {seconds.max():.2f};", end=" ")
    print(f"peak {getrusage(RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
