"""Robots that follow a path of waypoints: a differential drive, and the course report's steered vehicle.

A robot is a frozen set of limits; `drive` yields where its base truly is, one pose a step, until the path ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, ceil, cos, hypot, radians, sin, sqrt
from typing import TYPE_CHECKING, Annotated, Protocol, TypeAlias

import numpy as np

from hsloc.model import Pose2, wrap_angle
from hsloc.parameters import NonNegative, Parameters, Range
from hsloc.simulation.lattice import snap_pose

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


Limit: TypeAlias = Annotated[float, Range(1e-3, 100)]
"""Speeds and accelerations: with smaller ones a path never ends."""


class Robot(Protocol):
    """Follows a path. The first pose is `start`; each later one is `step_s` seconds of driving further on."""

    def drive(self, start: Pose2, path: NDArray[np.float64], step_s: float) -> Iterator[Pose2]:
        """True poses of the base along `path`, waypoints of shape (n, 2) in metres. Ends where the path ends."""
        ...


@dataclass(frozen=True, slots=True)
class DifferentialDrive(Parameters):
    """Two driven wheels; steered by pure pursuit of a point ahead on the path: by `lookahead` metres and what it
    drives in `foresight_s` seconds.

    `speed` (m/s), `turn_rate` (rad/s), `acceleration` (m/s^2) and `turn_acceleration` (rad/s^2) are limits. It
    slows down for bends, turns on the spot where the path turns back, stops at the end, and stands `pause_s`
    seconds before it starts.
    """

    speed: Limit = 0.9
    """Largest speed [m/s]."""
    turn_rate: Limit = 1.2
    """Largest rate of turn [rad/s]."""
    acceleration: Limit = 0.8
    """Largest acceleration and deceleration [m/s^2]."""
    turn_acceleration: Limit = 3.0
    """Largest angular acceleration [rad/s^2]."""
    lookahead: Limit = 0.45
    """Distance of the pursued point on the path at standstill [m]."""
    foresight_s: NonNegative = 0.3
    """Time of driving that is added to that distance [s]."""
    pause_s: Annotated[float, Range(0, 1e6)] = 1.0
    """Time for which the robot stands before it starts [s]."""

    def drive(self, start: Pose2, path: NDArray[np.float64], step_s: float) -> Iterator[Pose2]:
        """See `Robot`."""
        route = _Route(path)
        pose, v, w = snap_pose(start), 0.0, 0.0
        yield pose
        for _ in range(ceil(self.pause_s / step_s - 1e-9)):
            yield pose
        while not route.is_done() or v > self.acceleration * step_s:
            v_wanted, w_wanted = self._command(route, pose, v, w)
            v += min(max(v_wanted - v, -self.acceleration * step_s), self.acceleration * step_s)
            w += min(max(w_wanted - w, -self.turn_acceleration * step_s), self.turn_acceleration * step_s)
            # the chord of the arc points along the middle of the turn, and is a little shorter than the arc
            turn = w * step_s
            chord = v * step_s * (1.0 - turn * turn / 24.0)
            middle = pose.theta + turn / 2.0
            pose = snap_pose(
                Pose2(pose.x + chord * cos(middle), pose.y + chord * sin(middle), wrap_angle(pose.theta + turn))
            )
            yield pose

    def _command(self, route: _Route, pose: Pose2, v: float, w: float) -> tuple[float, float]:
        """The velocities (m/s, rad/s) that pure pursuit asks for, at the present velocities `v` and `w`."""
        ahead = route.pursue(pose, self.lookahead + self.foresight_s * v)
        distance = hypot(ahead[0] - pose.x, ahead[1] - pose.y)
        error = wrap_angle(atan2(ahead[1] - pose.y, ahead[0] - pose.x) - pose.theta)
        if abs(error) > 1.0:
            # what the turn will still add while it is being braked
            braking = w * abs(w) / (2.0 * self.turn_acceleration)
            return 0.0, min(max(4.0 * (error - braking), -self.turn_rate), self.turn_rate)
        curvature = 2.0 * sin(error) / max(distance, self.lookahead / 2.0)
        wanted = min(self.speed, self.turn_rate / max(abs(curvature), 1e-9), self.speed * cos(error) ** 2)
        wanted = min(wanted, max(sqrt(2.0 * 0.7 * self.acceleration * route.remaining()), 0.03))
        return wanted, min(max(max(wanted, 0.2) * curvature, -self.turn_rate), self.turn_rate)


@dataclass(frozen=True, slots=True)
class SteeredVehicle(Parameters):
    """The vehicle of [P] V: constant speed, heading `g + theta`, x += v dt cos(g + theta), theta += g.

    Reading: [P] limits g "to a rate of 20 deg/s". Taken as g = the bearing of the next waypoint, clipped to
    +-rate * dt each step, and a waypoint as reached within 1 m, the course report's path of six waypoints takes 119.7 s
    and 359.2 m; published are 119.8 s and 359 m. (Taken as a limit on the change of g from step to step, with
    theta += g, the heading swings about its aim and the figures are 119.3 s and 358.0 m.)
    """

    speed: Limit = 3.0
    """Speed [m/s]."""
    turn_rate: Limit = radians(20.0)
    """Largest rate of turn [rad/s]."""
    reached: Limit = 1.0
    """Distance from a waypoint within which it counts as reached [m]."""

    def drive(self, start: Pose2, path: NDArray[np.float64], step_s: float) -> Iterator[Pose2]:
        """See `Robot`."""
        pose, target = snap_pose(start), 0
        yield pose
        while True:
            while target < len(path) and self._is_at(pose, path[target]):
                target += 1
            if target == len(path):
                return
            bearing = wrap_angle(atan2(path[target, 1] - pose.y, path[target, 0] - pose.x) - pose.theta)
            g = min(max(bearing, -self.turn_rate * step_s), self.turn_rate * step_s)
            advance, heading = self.speed * step_s, g + pose.theta
            pose = snap_pose(
                Pose2(pose.x + advance * cos(heading), pose.y + advance * sin(heading), wrap_angle(heading))
            )
            yield pose

    def _is_at(self, pose: Pose2, waypoint: NDArray[np.float64]) -> bool:
        return hypot(waypoint[0] - pose.x, waypoint[1] - pose.y) < self.reached


class _Route:
    """How far along the path the robot has come. Its progress only grows, so crossings do not confuse it."""

    ARRIVED = 0.03
    """This close (metres) to the end of a leg counts as there."""

    def __init__(self, path: NDArray[np.float64]) -> None:
        steps = np.hypot(*np.diff(path, axis=0).T)
        self._path = path[np.concatenate(((True,), steps > 1e-6))]
        delta = np.diff(self._path, axis=0)
        lengths = np.hypot(*delta.T)
        self._along = np.concatenate(((0.0,), np.cumsum(lengths)))
        self._tangents = delta / lengths[:, None]
        turns = (self._tangents[:-1] * self._tangents[1:]).sum(axis=1)
        # legs whose end the robot must reach before it goes on: a sharp turn would be cut short, or skipped
        self._stops = np.append(turns < -1e-3, True)
        self._leg = 0
        self._progress = 0.0

    def pursue(self, pose: Pose2, lookahead: float) -> tuple[float, float]:
        """Take note of the robot's pose; returns the point of the path `lookahead` metres ahead of it."""
        while True:
            end = float(self._along[self._leg + 1])
            self._progress = min(max(self._progress, self._projection(pose, self._leg)), end)
            left = end - self._progress
            is_bend = not self._stops[self._leg]
            is_over = left < self.ARRIVED or (
                is_bend and left < lookahead and self._projection(pose, self._leg + 1) > end
            )
            if not is_over or self._leg + 2 == len(self._along):
                break
            self._leg += 1
            self._progress = end
        return self._at(min(self._progress + lookahead, self._stop()))

    def remaining(self) -> float:
        """Metres of path up to the next place where the robot must stop: a sharp turn, or the end."""
        return self._stop() - self._progress

    def is_done(self) -> bool:
        """Whether the end of the path is reached."""
        return float(self._along[-1]) - self._progress < self.ARRIVED

    def _stop(self) -> float:
        leg = self._leg + int(np.argmax(self._stops[self._leg :]))
        return float(self._along[leg + 1])

    def _projection(self, pose: Pose2, leg: int) -> float:
        (x0, y0), (tx, ty) = self._path[leg], self._tangents[leg]
        return float(self._along[leg] + (pose.x - x0) * tx + (pose.y - y0) * ty)

    def _at(self, along: float) -> tuple[float, float]:
        leg = min(int(np.searchsorted(self._along, along, side="right")) - 1, len(self._tangents) - 1)
        x, y = self._path[leg] + (along - self._along[leg]) * self._tangents[leg]
        return float(x), float(y)
