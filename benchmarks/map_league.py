"""Maps of simulated drives: errors, verdicts, and whether the covariances hold.

    python benchmarks/map_league.py [--first SEED] [--count N] [--slips] [--random] [--camera] [--carried] [--large]

Each seed draws a world (one that is built in or, with --random, one of `random_worlds`), a range (8 to 20 m), a noise
of the ranges (1 to 3 cm), an odometry, a number of laps and, with --slips, one to six moments in which the odometry
counts 0.3 to 1 m, or 20 to 90 deg, that were not driven. With --random people walk about in a third of the drives, and
in a sixth a door is closed behind the robot. With --camera the random worlds are seen by a camera with depth, 70 deg
wide and 4 or 6 m deep. With --carried the robot drives twice round a random world, without slips,
and is carried on by 10 to 30 % of the drive at 0.7 to 1.5 m/s, of which nothing is recorded. With --large it drives
600 m in a building of 28 to 150 m, with odometry whose translations are wrong by up to 3 %, its rotations by up to 4 %,
and which drifts by up to 0.1 deg a metre. A line for each drive: error of the keyscans relative to the first (rmse and
largest), their standard deviation, the mean normalised error squared (3 is expected), and the verdict. Then means over
all drives, with the coverage of the ellipsoids.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from random_worlds import building, random_world

from hsloc.config import Config
from hsloc.evaluation.association import interpolate_poses
from hsloc.model import Odometry, Pose2, Scan, Trajectory, Truth, wrap_angles
from hsloc.model.pose2 import relative_poses
from hsloc.replay.engine import replay
from hsloc.simulation import presets
from hsloc.simulation.built_in import built_in
from hsloc.simulation.odometer import OdometryNoise, Slip
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events
from hsloc.slam.mapper import Mapper

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import Event
    from hsloc.simulation.world import World
    from hsloc.slam.result import MappingResult

WORLDS = ("corridor-loop", "corridor-loop", "figure-of-eight", "office", "hall", "symmetric-corridor")
CHI2 = {50: 2.366, 90: 6.251, 95: 7.815}
"""Quantiles (%) of the chi-squared distribution of three degrees of freedom."""
WRONG_M = 0.25
LARGE_M = 600.0
CAMERA = Lidar(beams=160, field_of_view=np.radians(70.0), range_min=0.4, mounting=presets.WIDE.mounting)
"""A camera with depth, of which a row is sent as scans."""


def scenario(seed: int, with_slips: bool) -> Scenario:
    random = np.random.default_rng(seed)
    world = WORLDS[random.integers(len(WORLDS))]
    base = presets.SCENARIOS[world]
    sensor = replace(
        base.sensor,
        range_max=float(random.choice([8.0, 12.0, 20.0])),
        range_noise=float(random.choice([0.01, 0.02, 0.03])),
    )
    odometry = (OdometryNoise(), presets.DRIFTING)[random.integers(2)]
    laps = float(random.choice([1.05, 1.05, 1.3, 2.05]))
    drive = replace(base, seed=seed, sensor=sensor, odometry=odometry, laps=laps, duration_s=None)
    duration = built_in(world).lap_length() * laps / drive.robot.speed
    if world in ("office", "hall"):
        duration = 90.0
        drive = replace(drive, duration_s=duration, laps=1.0)
    slips = tuple(slip(random, duration, drive.robot.speed) for _ in range(random.integers(1, 7))) if with_slips else ()
    return replace(drive, slips=slips)


def slip(random: np.random.Generator, duration: float, speed: float) -> Slip:
    seconds = random.uniform(0.5, 2.0)
    at = random.uniform(3.0, duration - 3.0)
    if random.random() < 0.5:
        metres = random.uniform(0.3, 1.0) * random.choice([-1, 1])
        return Slip(at, seconds, 1.0 + metres / (speed * seconds), 0.0)
    angle = np.radians(random.uniform(20.0, 90.0)) * random.choice([-1, 1])
    return Slip(at, seconds, 1.0, angle / seconds)


def random_scenario(seed: int, with_slips: bool) -> tuple[Scenario, World, float | None]:
    """A drive in a random world, and when in it a door is closed, if one is."""
    random = np.random.default_rng((seed, 1))
    world = random_world(random)
    sensor = replace(
        (presets.WIDE, presets.AHEAD)[random.integers(2)],
        range_max=float(random.choice([6.0, 8.0, 12.0, 20.0])),
        range_noise=float(random.choice([0.01, 0.02, 0.03])),
    )
    odometry = (OdometryNoise(), presets.DRIFTING)[random.integers(2)]
    laps = float(random.choice([0.9, 1.05, 1.3, 2.05]))
    robot = replace(presets.BRISK, speed=float(random.choice([0.6, 1.2])))
    duration = world.lap_length() * laps / robot.speed
    longest = 150.0
    if duration > longest:
        laps, duration = laps * longest / duration, longest
    slips = tuple(slip(random, duration, robot.speed) for _ in range(random.integers(1, 7))) if with_slips else ()
    people = int(random.choice([0, 0, 2]))
    closed_at = float(random.uniform(0.2, 0.7) * duration) if random.random() < 1.0 / 6.0 else None
    name = world.name
    drive = Scenario(
        name, seed=seed, robot=robot, sensor=sensor, odometry=odometry, laps=laps, people=people, slips=slips
    )
    return drive, world, closed_at


def with_a_door_closed(drive: Scenario, world: World, at_s: float) -> list[Event]:
    """The drive's events; from `at_s` on a door stands across the path where the robot was two seconds before."""
    log = list(events(drive, world))
    at_ns = drive.start_stamp_ns + round(at_s * 1e9)
    truths = [event for event in log if isinstance(event, Truth) and event.stamp_ns <= at_ns - 2_000_000_000]
    pose = truths[-1].T_map_base
    door = (pose @ np.array(((0.0, -0.48), (0.0, 0.48)))).reshape(1, 4)
    closed = replace(world, segments=np.vstack((world.segments, np.round(door, 6))))
    later = events(drive, closed)
    return [b if isinstance(a, Scan) and a.stamp_ns >= at_ns else a for a, b in zip(log, later, strict=True)]


def carried(seed: int) -> tuple[Scenario, list[Event]]:
    """Two laps of a random world, of which a part was not driven: the robot was carried."""
    random = np.random.default_rng((seed, 7))
    drive, world, _ = random_scenario(seed, False)
    duration = min(2.05 * world.lap_length() / drive.robot.speed, 200.0)
    drive = replace(drive, laps=duration * drive.robot.speed / world.lap_length(), people=0)
    at = random.uniform(0.35, 0.5) * duration
    until = at + random.uniform(0.1, 0.3) * duration
    log = list(events(drive, world))
    stamps = [(event.stamp_ns - drive.start_stamp_ns) * 1e-9 for event in log]
    counted = [event.T_odom_base if isinstance(event, Odometry) else None for event in log]
    lifted = [pose for pose, stamp in zip(counted, stamps, strict=True) if pose is not None and stamp <= at][-1]
    put_down = next(pose for pose, stamp in zip(counted, stamps, strict=True) if pose is not None and stamp >= until)
    truths = {round((e.stamp_ns - drive.start_stamp_ns) * 1e-9, 2): e.T_map_base for e in log if isinstance(e, Truth)}
    begin, end = (min(truths, key=lambda stamp: abs(stamp - wanted)) for wanted in (at, until))
    seconds = 1.0 + truths[begin].distance(truths[end]) / random.uniform(0.7, 1.5)
    shorter = round((until - at - seconds) * 1e9)
    kept: list[Event] = []
    for event, stamp in zip(log, stamps, strict=True):
        if stamp <= at:
            kept.append(event)
        elif stamp >= until:
            if isinstance(event, Odometry):
                event = replace(event, T_odom_base=lifted @ put_down.between(event.T_odom_base))
            kept.append(replace(event, stamp_ns=event.stamp_ns - shorter))
    return drive, kept


def large(seed: int) -> tuple[Scenario, list[Event]]:
    """A long drive in a large building, with an odometry that is systematically wrong."""
    random = np.random.default_rng((seed, 5))
    world = building(random, LARGE_M)
    sensor = replace(
        (presets.WIDE, presets.AHEAD)[random.integers(2)],
        range_max=float(random.choice([12.0, 20.0, 30.0])),
        range_noise=float(random.choice([0.01, 0.02, 0.03])),
    )
    robot = replace(presets.BRISK, speed=float(random.choice([0.6, 1.0])))
    odometry = (OdometryNoise(), presets.DRIFTING)[random.integers(2)]
    drive = Scenario(
        "building", seed=seed, robot=robot, sensor=sensor, odometry=odometry, scan_rate_hz=5.0, odometry_rate_hz=10.0
    )
    way, turn, drift = random.uniform(0.97, 1.03), random.uniform(0.96, 1.04), random.uniform(-0.002, 0.002)
    log: list[Event] = []
    last = counted = None
    for event in events(drive, world):
        if isinstance(event, Odometry):
            if last is None or counted is None:
                counted = event.T_odom_base
            else:
                step = last.between(event.T_odom_base)
                theta = turn * step.theta + drift * float(np.hypot(step.x, step.y))
                counted = counted @ Pose2(way * step.x, way * step.y, theta)
            last = event.T_odom_base
            event = replace(event, T_odom_base=counted)
        log.append(event)
    return drive, log


def recorded(seed: int, with_slips: bool, is_random: bool, by_camera: bool = False) -> tuple[Scenario, list[Event]]:
    """The drive of a seed, and its events."""
    if not (is_random or by_camera):
        drive = scenario(seed, with_slips)
        return drive, list(events(drive, built_in(drive.world)))
    drive, world, closed_at = random_scenario(seed, with_slips)
    if by_camera:
        depth = 4.0 if drive.sensor.range_max <= 8.0 else 6.0
        drive = replace(drive, sensor=replace(CAMERA, range_max=depth, range_noise=drive.sensor.range_noise))
    if closed_at is None:
        return drive, list(events(drive, world))
    return drive, with_a_door_closed(drive, world, closed_at)


def mapped(log: list[Event]) -> tuple[MappingResult, NDArray[np.float64]]:
    """The map, and the true poses of its keyscans (n, 3) relative to the first."""
    mapper = Mapper(Config().graph_mapper, np.random.default_rng(0))
    truth = [event for event in log if isinstance(event, Truth)]
    for _ in replay(log, mapper):
        pass
    result = mapper.finish()
    known = Trajectory(
        np.array([event.stamp_ns for event in truth]), np.array([event.T_map_base.to_array() for event in truth])
    )
    poses = interpolate_poses(known, result.keyscan_stamps_ns)
    return result, relative_poses(poses[:1].repeat(len(poses), 0), poses)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--slips", action="store_true")
    parser.add_argument("--random", action="store_true")
    parser.add_argument("--camera", action="store_true")
    parser.add_argument("--carried", action="store_true")
    parser.add_argument("--large", action="store_true")
    arguments = parser.parse_args()
    means, verdicts = [], Counter[tuple[str, str]]()
    for seed in range(arguments.first, arguments.first + arguments.count):
        begin = time.process_time()
        if arguments.large:
            drive, log = large(seed)
        elif arguments.carried:
            drive, log = carried(seed)
        else:
            drive, log = recorded(seed, arguments.slips, arguments.random, arguments.camera)
        result, truth = mapped(log)
        error = result.keyscan_poses - truth
        error[:, 2] = wrap_angles(error[:, 2])
        covariances = result.keyscan_covariances
        squared = np.einsum("ni,nij,nj->n", error[1:], np.linalg.inv(covariances[1:]), error[1:])
        distance, sigma = (
            np.hypot(error[:, 0], error[:, 1]),
            np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2)),
        )
        verdict = result.evidence.verdict
        verdicts["wrong" if distance.max() > WRONG_M else "right", verdict] += 1
        rmse = float(np.sqrt((distance**2).mean()))
        means.append((squared.mean(), rmse, sigma.mean(), *((squared < limit).mean() for limit in CHI2.values())))
        codes = ", ".join(reason.code for reason in result.evidence.reasons)
        print(
            f"{seed:4d} {drive.world:18s} {drive.sensor.range_max:4.0f} m, {len(drive.slips)} slips: rmse {rmse:.3f}, "
            f"max {distance.max():.3f}, sigma {sigma.mean():.3f} to {sigma.max():.3f} m, NEES {squared.mean():6.2f}, "
            f"{verdict} {codes} ({time.process_time() - begin:.1f} s)",
            flush=True,
        )
    nees, rmse, sigma, *coverage = np.mean(means, axis=0)
    print(
        f"NEES {nees:.2f} (median drive {np.median([row[0] for row in means]):.2f}), rmse {rmse:.3f}, sigma {sigma:.3f}"
    )
    print(
        "coverage "
        + ", ".join(f"{100.0 * share:.0f} % of {level}" for level, share in zip(CHI2, coverage, strict=True))
    )
    for (truth_word, verdict), count in sorted(verdicts.items()):
        print(f"{truth_word} ({WRONG_M} m) and called {verdict}: {count}")


if __name__ == "__main__":
    main()
