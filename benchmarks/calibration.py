"""Calibration of simulated robots whose truth is known: errors, and how often the 95 % intervals hold.

    python benchmarks/calibration.py --seeds 20

Each seed draws its own errors: scale and rotation scale of the odometry, unequal wheels, place and heading of the
lidar, and the lag of its stamps. The log states a mounting that is off by up to 3 cm and 3 deg. Lidars of odd seeds
measure each beam at a time of its own, over the 0.2 s of a turn. The noise of the odometry is that of `hsloc record`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np

from hsloc.calibration.calibrate import calibrate
from hsloc.calibration.estimator import NAMES
from hsloc.log import LogWriter, Transform3
from hsloc.model import Odometry, Pose2, Scan
from hsloc.model.calibration import OdometryCorrection, corrected_odometry
from hsloc.request import RunRequest
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world

LIMITS = {
    "scale": 0.002, "rotation_scale": np.inf, "track": 0.005, "turn_per_metre": np.inf, "x": 0.005, "y": 0.005,
    "yaw": radians(0.1), "time_offset": 0.005,
}  # fmt: skip


def write_log(path: Path, seed: int, seconds: float, world: str) -> dict[str, float]:
    """A log with errors that the seed draws; returns what is true of it."""
    rng = np.random.default_rng((seed, 41))
    truth = OdometryCorrection(1.0 + rng.uniform(-0.03, 0.03), 1.0 + rng.uniform(-0.04, 0.04), rng.uniform(-0.01, 0.01))
    mounting = Pose2(rng.uniform(-0.3, 0.3), rng.uniform(-0.15, 0.15), rng.uniform(-np.pi, np.pi))
    stated = Pose2(*(mounting.to_array() + rng.uniform(-1.0, 1.0, 3) * (0.03, 0.03, radians(3.0))))
    lag = float(rng.uniform(-0.15, 0.15))
    lidar = Lidar(mounting=mounting, motion_distortion=bool(seed % 2))
    scenario = Scenario(world, seed=seed, sensor=lidar, duration_s=seconds, scan_rate_hz=5.0)
    with LogWriter(path) as writer:
        writer.transforms(scenario.start_stamp_ns, [("base_link", "laser", Transform3.from_pose2(stated))], static=True)
        for event in corrected_odometry(events(scenario, load_world(world)), truth.inverse()):
            if isinstance(event, Scan):
                late = replace(event, stamp_ns=event.stamp_ns + round(lag * 1e9))
                writer.scan(late)
            elif isinstance(event, Odometry):
                writer.odometry(event.stamp_ns, event.T_odom_base, covariance=event.covariance)
    return {
        "scale": truth.scale, "rotation_scale": truth.rotation_scale, "track": truth.track_factor,
        "turn_per_metre": truth.turn_per_metre, "x": mounting.x, "y": mounting.y, "yaw": mounting.theta,
        "time_offset": -lag,
    }  # fmt: skip


def compare(path: Path, truth: dict[str, float]) -> dict[str, tuple[float, float]]:
    """Error and half of the 95 % interval of each value."""
    found = calibrate(RunRequest(logs=(path,)))
    estimate = found.estimate
    values = dict(zip(NAMES, estimate.values.tolist(), strict=True))
    sigmas = dict(zip(NAMES, estimate.sigmas.tolist(), strict=True))
    values["track"], sigmas["track"] = estimate.track
    values["time_offset"] = found.time_offset_s
    apart = {name: values[name] - truth[name] for name in LIMITS}
    apart["yaw"] = float(np.angle(np.exp(1j * apart["yaw"])))
    return {name: (apart[name], estimate.quantile * sigmas[name]) for name in LIMITS}


def main() -> None:
    """Print a line for each seed, and a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--world", default="office")
    arguments = parser.parse_args()
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in LIMITS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        for seed in range(arguments.first, arguments.first + arguments.seeds * arguments.step, arguments.step):
            begin = time.perf_counter()
            truth = write_log(path, seed, arguments.seconds, arguments.world)
            for name, each in compare(path, truth).items():
                errors[name].append(each)
            path.unlink()
            line = "  ".join(f"{name} {rows[-1][0]:+.5f}" for name, rows in errors.items())
            print(f"seed {seed} ({time.perf_counter() - begin:.0f} s): {line}", flush=True)
    print(f"{'':<16}{'rms':>10}{'largest':>10}{'limit':>10}{'half width':>12}{'inside':>10}")
    for name, rows in errors.items():
        apart, half = np.array(rows).T
        rms, inside = float(np.sqrt(np.mean(apart**2))), int((np.abs(apart) <= half).sum())
        print(
            f"{name:<16}{rms:>10.5f}{np.abs(apart).max():>10.5f}{LIMITS[name]:>10.5f}{half.mean():>12.5f}"
            f"{inside:>7}/{len(rows)}"
        )


if __name__ == "__main__":
    main()
