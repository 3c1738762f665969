"""Simulate a scenario in order of time: the robot, its wheels and lidar, and the people in its way."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import islice, pairwise
from math import ceil, tau
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Event, Odometry, Pose2, Scan, Truth
from hsloc.model.pose2 import wrap_angles
from hsloc.simulation.odometer import Odometer
from hsloc.simulation.sensors import SensorNoise

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.simulation.scenario import Scenario
    from hsloc.simulation.world import World

    Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """One step of the robot: where it is, and where its odometry believes it to be.

    `covariance` (3, 3) is that of `T_odom_base` since the start, m^2 and rad^2; `twist` (vx, vy, wz) is measured.
    """

    stamp_ns: int
    T_map_base: Pose2
    T_odom_base: Pose2
    covariance: Array
    twist: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Step:
    """Where the base is at the start of a step, and where its motion takes it by the end of it."""

    before: Pose2
    after: Pose2


def simulate(scenario: Scenario, world: World) -> Iterator[Tick | Scan]:
    """Ticks at the rate of the odometry and scans at theirs, in order of stamps; a tick before a scan.

    Memory does not grow with the length of the drive.
    """
    odometry_rng, ranges_rng, dropouts_rng, people_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(scenario.seed).spawn(4)
    )
    period = scenario.odometry_period_ns
    odometer = Odometer(scenario.odometry, odometry_rng, period * 1e-9, scenario.slips)
    eye = _Eye(scenario, world, SensorNoise(ranges_rng, dropouts_rng), people_rng)
    for index, steps in enumerate(_windows(_true_steps(scenario, world), eye.steps_needed)):
        stamp = scenario.start_stamp_ns + index * period
        here = steps[0]
        yield Tick(stamp, here.before, odometer.T_odom_base, odometer.covariance, odometer.twist)
        yield from eye.look(index * period, steps)
        odometer.step(here.before, here.after)


def events(scenario: Scenario, world: World) -> Iterator[Event]:
    """The simulation as an estimator gets it from a log: `Truth`, `Odometry` and `Scan`, without a file between."""
    for item in simulate(scenario, world):
        if isinstance(item, Scan):
            yield item
        else:
            yield Truth(item.stamp_ns, item.T_map_base)
            yield Odometry(item.stamp_ns, item.T_odom_base, item.covariance)


class _Eye:
    """The sensor, the clock of its scans, and the people before it."""

    def __init__(self, scenario: Scenario, world: World, noise: SensorNoise, people_rng: np.random.Generator) -> None:
        self._scenario, self._world, self._noise = scenario, world, noise
        self._people = Walkers(world.path(), scenario.people, people_rng) if scenario.people else None
        self._next_ns = round(scenario.scan_offset_s * 1e9)
        sweep = scenario.scan_period_ns if scenario.sensor.motion_distortion else 0
        self.steps_needed = 1 + ceil(sweep / scenario.odometry_period_ns)
        """How many steps from the present one on must be known for a scan that begins in it."""

    def look(self, elapsed_ns: int, steps: deque[_Step]) -> Iterator[Scan]:
        """The scans that begin during the first of `steps`, which begins `elapsed_ns` after the start."""
        while self._next_ns < elapsed_ns + self._scenario.odometry_period_ns:
            yield self._measure(self._next_ns, elapsed_ns, steps)
            self._next_ns += self._scenario.scan_period_ns

    def _measure(self, at_ns: int, elapsed_ns: int, steps: deque[_Step]) -> Scan:
        sensor, period = self._scenario.sensor, self._scenario.scan_period_ns
        sweep = period * np.arange(sensor.beams) / sensor.beams if sensor.motion_distortion else np.zeros(1)
        poses = _poses_at((at_ns - elapsed_ns + sweep) / self._scenario.odometry_period_ns, steps)
        legs = self._people.legs(at_ns * 1e-9, poses[0, :2]) if self._people else np.empty((0, 3))
        stamp = self._scenario.start_stamp_ns + at_ns
        return sensor.measure(self._world, stamp, period * 1e-9, poses, legs, self._noise)


def _true_steps(scenario: Scenario, world: World) -> Iterator[_Step]:
    """The steps of the drive; where the robot is kidnapped, those in between are left out."""
    path = world.path(scenario.laps_needed(world.lap_length()))
    step_s = scenario.odometry_period_ns * 1e-9
    drive = (_Step(a, b) for a, b in pairwise(scenario.robot.drive(world.start(), path, step_s)))
    skips = {round(kidnap.at_s / step_s): round(kidnap.skip_s / step_s) for kidnap in scenario.kidnaps}
    count = None if scenario.duration_s is None else round(scenario.duration_s / step_s) + 1
    index = 0
    while index != count:
        step = next(islice(drive, skips.get(index, 0), None), None)
        if step is None:
            return
        yield step
        index += 1


def _windows(steps: Iterable[_Step], size: int) -> Iterator[deque[_Step]]:
    """Each step with the `size - 1` that follow it; ends where fewer follow."""
    window: deque[_Step] = deque(maxlen=size)
    for step in steps:
        window.append(step)
        if len(window) == size:
            yield window


def _poses_at(times: Array, steps: deque[_Step]) -> Array:
    """Poses T_map_base (n, 3) at `times` (n,), counted in steps from the start of the first."""
    index = np.minimum(times.astype(int), len(steps) - 1)
    before = np.array([step.before.to_array() for step in steps])
    motion = np.array([step.after.to_array() for step in steps]) - before
    motion[:, 2] = wrap_angles(motion[:, 2])
    poses: Array = before[index] + (times - index)[:, None] * motion[index]
    return poses


LEG_RADIUS = 0.07
STANCE = 0.1
"""Metres from the middle of the body to each leg, sideways."""
STRIDE = 0.22
"""Metres that a leg swings forwards and backwards."""
STEPS_PER_METRE = 0.75
PERSONAL_SPACE = 0.4
"""Minimum distance of a walking person from the laser [m]: nearer ones have stepped aside and are not seen."""


class Walkers:
    """`count` people on the world's path, there and back without end, each with a pace and a side of their own."""

    def __init__(self, path: Array, count: int, rng: np.random.Generator) -> None:
        self._path = path
        self._along = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
        length = float(self._along[-1])
        self._start = rng.uniform(0.0, 2.0 * length, count)
        self._pace = rng.uniform(0.7, 1.4, count)
        self._aside = rng.uniform(-0.22, 0.22, count)

    def legs(self, time_s: float, laser: Array) -> Array:
        """Circles x y radius (metres), shape (k, 3), at `time_s` seconds; `laser` (2,) is the robot's place."""
        length = float(self._along[-1])
        walked = self._start + self._pace * time_s
        there = np.mod(walked, 2.0 * length)
        along = np.where(there < length, there, 2.0 * length - there)
        leg = np.clip(np.searchsorted(self._along, along, side="right") - 1, 0, len(self._path) - 2)
        delta = self._path[leg + 1] - self._path[leg]
        forward = delta / np.hypot(delta[:, 0], delta[:, 1])[:, None]
        left = np.column_stack((-forward[:, 1], forward[:, 0]))
        body = self._path[leg] + (along - self._along[leg])[:, None] * forward + self._aside[:, None] * left
        swing = STRIDE * np.sin(tau * STEPS_PER_METRE * walked)[:, None]
        feet = np.concatenate((body + STANCE * left + swing * forward, body - STANCE * left - swing * forward))
        feet = feet[np.hypot(feet[:, 0] - laser[0], feet[:, 1] - laser[1]) > PERSONAL_SPACE]
        return np.column_stack((feet, np.full(len(feet), LEG_RADIUS)))
