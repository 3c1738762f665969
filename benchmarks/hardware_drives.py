"""Drives that go wrong as real hardware does: its body and people in view, cheap lidars, bad odometry, lost messages.

Each change takes a drive and gives another one. Used by `hardware.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.raycasting import cast_rays
from hsloc.model import IDENTITY, Odometry, Pose2, Scan, Trajectory, Truth, wrap_angles
from hsloc.model.pose2 import wrap_angle
from hsloc.simulation.sensors import SensorNoise

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.model import Event
    from hsloc.simulation.scenario import Scenario
    from hsloc.simulation.world import World

SECONDS = 60.0
STEP_NS = 20_000_000
"""Period of the odometry of the drives before something is changed (ns)."""


@dataclass(frozen=True, eq=False)
class Drive:
    """Events of a run, and what random changes of them are drawn from."""

    events: list[Event]
    world: World
    scenario: Scenario
    rng: np.random.Generator

    def scans(self, change: Callable[[Scan], Scan]) -> Drive:
        """The same with other scans."""
        return replace(self, events=[change(e) if isinstance(e, Scan) else e for e in self.events])

    def ranges(self, change: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]) -> Drive:
        """The same with other ranges: of the ranges and of the bearings in the base's frame."""
        return self.scans(
            lambda scan: replace(
                scan,
                ranges=change(
                    scan.ranges.astype(np.float64), wrap_angles(scan.angles() + scan.T_base_laser.theta)
                ).astype(np.float32),
            )
        )

    def truth(self) -> Trajectory:
        """Where the robot was."""
        return Trajectory.from_pairs([(e.stamp_ns, e.T_map_base) for e in self.events if isinstance(e, Truth)])

    def elapsed_s(self, event: Event) -> float:
        """Seconds since the first event."""
        return (event.stamp_ns - self.events[0].stamp_ns) * 1e-9

    def with_steps(self, change: Callable[[float, Pose2], Pose2]) -> Drive:
        """The same with other motions between odometry messages, by the time and the motion."""
        found: list[Event] = []
        last, now = None, IDENTITY
        for event in self.events:
            if isinstance(event, Odometry):
                if last is not None:
                    now = now @ change(self.elapsed_s(event), last.between(event.T_odom_base))
                last = event.T_odom_base
                found.append(replace(event, T_odom_base=now, covariance=None))
            else:
                found.append(event)
        return replace(self, events=found)

    def preceded(self, seconds: float, turn_rate: float) -> Drive:
        """The same after a time on the spot, standing or turning by whole turns; the odometry counts 1 % more."""
        start, period = self.world.start(), self.scenario.scan_period_ns
        turns = round(abs(turn_rate) * seconds / (2.0 * np.pi))
        rate = np.sign(turn_rate) * turns * 2.0 * np.pi / seconds
        noise = SensorNoise(self.rng, self.rng)
        first, count = self.events[0].stamp_ns, round(seconds * 1e9) // STEP_NS
        before: list[Event] = []
        for k in range(count):
            stamp, theta = first - (count - k) * STEP_NS, rate * k * STEP_NS * 1e-9
            pose = Pose2(start.x, start.y, wrap_angle(start.theta + theta))
            before.append(Truth(stamp, pose))
            before.append(Odometry(stamp, Pose2(0.0, 0.0, wrap_angle(1.01 * theta))))
            if k * STEP_NS % period == 0:
                at = pose.to_array()[None]
                scan = self.scenario.sensor.measure(self.world, stamp, period * 1e-9, at, np.empty((0, 3)), noise)
                before.append(scan)
        shift = Pose2(0.0, 0.0, wrap_angle(1.01 * rate * seconds))
        after = [replace(e, T_odom_base=shift @ e.T_odom_base) if isinstance(e, Odometry) else e for e in self.events]
        return replace(self, events=before + after)

    def among(self, circles: Callable[[float, Pose2], NDArray[np.float64]]) -> Drive:
        """The same with people, x y radius (k, 3; m) by the time and the robot's pose."""
        truth = self.truth()

        def seen(scan: Scan) -> Scan:
            (pose,) = truth.interpolated(np.array([scan.stamp_ns]))
            at = Pose2.from_array(pose) @ scan.T_base_laser
            angles = at.theta + scan.angles()
            distances = cast_rays(
                np.tile((at.x, at.y), (len(angles), 1)),
                np.column_stack((np.cos(angles), np.sin(angles))),
                np.empty((0, 4)),
                np.ascontiguousarray(circles(self.elapsed_s(scan), Pose2.from_array(pose))),
            )
            distances += self.rng.normal(0.0, 0.01, len(distances))
            return replace(scan, ranges=np.fmin(scan.ranges, distances.astype(np.float32)))

        return self.scans(seen)


def posts(drive: Drive) -> Drive:
    """Four posts of the robot's body, 3 to 8 deg wide and 0.12 to 0.3 m away, before each scan."""
    places = [
        (drive.rng.uniform(-np.pi, np.pi), drive.rng.uniform(0.026, 0.07), drive.rng.uniform(0.12, 0.3))
        for _ in range(4)
    ]

    def hidden(ranges: NDArray[np.float64], bearings: NDArray[np.float64]) -> NDArray[np.float64]:
        for bearing, width, at in places:
            inside = np.abs(wrap_angles(bearings - bearing)) < width
            ranges[inside] = at + drive.rng.normal(0.0, 0.004, int(inside.sum()))
        return ranges

    return drive.ranges(hidden)


def blocked(width: float) -> Callable[[Drive], Drive]:
    """A sector (rad) in which the body is seen, at the same range."""

    def change(drive: Drive) -> Drive:
        middle, at = drive.rng.uniform(-np.pi, np.pi), drive.rng.uniform(0.15, 0.3)

        def hidden(ranges: NDArray[np.float64], bearings: NDArray[np.float64]) -> NDArray[np.float64]:
            ranges[np.abs(wrap_angles(bearings - middle)) < width / 2.0] = at
            return ranges

        return drive.ranges(hidden)

    return change


def followed(drive: Drive) -> Drive:
    """A person 0.7 to 1.1 m behind the robot, and one beside it."""

    def circles(seconds: float, pose: Pose2) -> NDArray[np.float64]:
        sway, near = 0.3 * np.sin(0.7 * seconds), 0.9 + 0.2 * np.sin(0.4 * seconds)
        behind, beside = pose @ Pose2(-near, sway, 0.0), pose @ Pose2(-0.4, 0.8 + 0.1 * np.sin(seconds), 0.0)
        return np.array(((behind.x, behind.y, 0.2), (beside.x, beside.y, 0.2)))

    return drive.among(circles)


def queue(drive: Drive) -> Drive:
    """The robot stands for 40 s amidst 16 people who stand still, and drives away."""
    rng, start = drive.rng, drive.world.start()
    angles, radii = rng.uniform(-np.pi, np.pi, 16), rng.uniform(0.7, 2.2, 16)
    people = np.column_stack((start.x + radii * np.cos(angles), start.y + radii * np.sin(angles), np.full(16, 0.22)))

    def circles(seconds: float, pose: Pose2) -> NDArray[np.float64]:
        del seconds
        return people[np.hypot(people[:, 0] - pose.x, people[:, 1] - pose.y) > 0.5]

    return drive.preceded(40.0, 0.0).among(circles)


def noisy(part: float) -> Callable[[Drive], Drive]:
    """Noise of the ranges in proportion, rounded to a quarter of a per cent of the range, at least 1 cm."""

    def change(drive: Drive) -> Drive:
        def measured(ranges: NDArray[np.float64], _: NDArray[np.float64]) -> NDArray[np.float64]:
            noisy = ranges * (1.0 + part * drive.rng.standard_normal(len(ranges)))
            step = np.maximum(0.01, 0.0025 * np.where(np.isfinite(ranges), ranges, 1.0))
            return np.round(noisy / step) * step

        return drive.ranges(measured)

    return change


def missing(part: float, value: float) -> Callable[[Drive], Drive]:
    """Beams without a return at random."""

    def change(drive: Drive) -> Drive:
        return drive.ranges(lambda ranges, _: np.where(drive.rng.random(len(ranges)) < part, value, ranges))

    return change


def biased(by: float) -> Callable[[Drive], Drive]:
    return lambda drive: drive.ranges(lambda ranges, _: ranges + by)


def mixed(drive: Drive) -> Drive:
    """Beams at edges end somewhere between what stands before and behind."""

    def measured(ranges: NDArray[np.float64], _: NDArray[np.float64]) -> NDArray[np.float64]:
        after = np.roll(ranges, -1)
        with np.errstate(invalid="ignore"):
            edge = np.abs(after - ranges) > 0.2
        edge &= np.isfinite(ranges) & np.isfinite(after) & (drive.rng.random(len(ranges)) < 0.7)
        part = drive.rng.random(len(ranges))
        return np.where(edge, ranges + part * (after - ranges), ranges)

    return drive.ranges(measured)


def low_cost(drive: Drive) -> Drive:
    return missing(0.3, np.nan)(noisy(0.02)(biased(0.03)(mixed(drive))))


def steps(turn: float, way: float) -> Callable[[Drive], Drive]:
    """Scales of what the odometry counts."""
    return lambda drive: drive.with_steps(lambda _, m: Pose2(way * m.x, way * m.y, turn * m.theta))


def turning(per_metre: float) -> Callable[[Drive], Drive]:
    """A turn (rad) with each metre that the odometry misses: one wheel is larger than the other."""
    return lambda drive: drive.with_steps(lambda _, m: Pose2(m.x, m.y, m.theta - per_metre * np.hypot(m.x, m.y)))


def misled(begin: float, end: float, turn: float, way: float) -> Callable[[Drive], Drive]:
    """Scales of what the odometry counts between two times (s); -1 is the other way round."""

    def change(elapsed_s: float, motion: Pose2) -> Pose2:
        if not begin <= elapsed_s < end:
            return motion
        return Pose2(way * motion.x, way * motion.y, turn * motion.theta)

    return lambda drive: drive.with_steps(change)


def at_rate(every: int) -> Callable[[Drive], Drive]:
    """Only some of the odometry messages."""

    def change(drive: Drive) -> Drive:
        kept, k = [], 0
        for event in drive.events:
            if isinstance(event, Odometry):
                k += 1
                if k % every != 1:
                    continue
            kept.append(event)
        return replace(drive, events=kept)

    return change


def jittered(drive: Drive) -> Drive:
    """Stamps that are up to 30 ms early or late, of scans and of odometry."""
    moved: list[Event] = []
    for event in drive.events:
        by = 0 if isinstance(event, Truth) else round(drive.rng.uniform(-30e6, 30e6))
        moved.append(replace(event, stamp_ns=event.stamp_ns + by))
    return replace(drive, events=sorted(moved, key=lambda event: event.stamp_ns))


def freezing(seconds: float) -> Callable[[Drive], Drive]:
    """The odometry stands still for this time every 12 s, and then is where it would have been."""

    def change(drive: Drive) -> Drive:
        held: list[Event] = []
        last = None
        for event in drive.events:
            if isinstance(event, Odometry):
                if last is not None and drive.elapsed_s(event) % 12.0 > 12.0 - seconds:
                    event = replace(event, T_odom_base=last)
                last = event.T_odom_base
            held.append(event)
        return replace(drive, events=held)

    return change


def late(drive: Drive) -> Drive:
    """Odometry of 1.5 s comes at once, every 12 s, 50 us after each other and with the stamps of then."""
    found: list[Event] = []
    for event in drive.events:
        rest = 12.0 - drive.elapsed_s(event) % 12.0
        if isinstance(event, Odometry) and rest < 1.5:
            ticks = round(rest * 1e9 / STEP_NS)
            event = replace(event, stamp_ns=event.stamp_ns + ticks * (STEP_NS - 50_000))
        found.append(event)
    return replace(drive, events=sorted(found, key=lambda event: event.stamp_ns))


def jumping(drive: Drive) -> Drive:
    """The odometry jumps by 0.4 m and 15 deg five times."""
    at = {round(k * 50) for k in drive.rng.uniform(5.0, 55.0, 5)}

    def step(seconds: float, motion: Pose2) -> Pose2:
        jump = Pose2(0.3, -0.26, np.radians(15.0)) if round(seconds * 50) in at else IDENTITY
        return motion @ jump

    return drive.with_steps(step)


def reset(drive: Drive) -> Drive:
    """The odometry begins anew at 0 half way."""
    origin, found = None, []
    for event in drive.events:
        if isinstance(event, Odometry) and drive.elapsed_s(event) > SECONDS / 2.0:
            origin = event.T_odom_base if origin is None else origin
            event = replace(event, T_odom_base=origin.between(event.T_odom_base))
        found.append(event)
    return replace(drive, events=found)


def bursts(drive: Drive) -> Drive:
    """Scans are lost for 2 s every 6 s, and one of three in between."""
    kept = [
        e
        for e in drive.events
        if not isinstance(e, Scan) or (drive.elapsed_s(e) % 6.0 < 4.0 and drive.rng.random() > 0.33)
    ]
    return replace(drive, events=kept)


def paused(is_odometry_continuous: bool) -> Callable[[Drive], Drive]:
    """30 s of the log are missing, in which the robot was driven on, or carried: then the odometry is as before."""

    def change(drive: Drive) -> Drive:
        gap = [20.0 < drive.elapsed_s(e) < 50.0 for e in drive.events]
        if is_odometry_continuous:
            return replace(drive, events=[e for e, is_in in zip(drive.events, gap, strict=True) if not is_in])
        frozen = drive.with_steps(lambda s, m: IDENTITY if 20.0 < s < 50.1 else m)
        return replace(frozen, events=[e for e, is_in in zip(frozen.events, gap, strict=True) if not is_in])

    return change


def carried(begin: float, end: float) -> Callable[[Drive], Drive]:
    """The robot moves and the wheels do not, for a part of the drive."""
    return lambda drive: drive.with_steps(lambda s, m: IDENTITY if begin < s < end else m)
