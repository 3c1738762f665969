"""The front end: each scan against the scans just before it.

Odometry predicts, HIDE searches the box of the prediction on a field drawn from the recent keyscans, and prediction
and match are weighed by their covariances. A scan that moved far enough becomes a keyscan. Drift is left to the loop
closer, precision to the refinement.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import hypot, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError
from hsloc.localisation.motion import OdometryNoise, fuse
from hsloc.matching.hide import Hide
from hsloc.matching.window import Window
from hsloc.model.estimate import Status
from hsloc.model.pose2 import IDENTITY, Pose2, wrap_angle
from hsloc.slam.local_map import LocalMap

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.match import Match
    from hsloc.model.events import PairedScan

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalMatchingParameters:
    """When a scan becomes a keyscan, what it is matched against and in which window."""

    keyscan_min_d: float = 0.1
    """A scan becomes a keyscan after so many metres (m)."""
    keyscan_min_a: float = 0.05
    """Or after so much turning (rad)."""
    min_points: int = 20
    """A scan with fewer hits is not matched."""
    local_range: float = 30.0
    """Hits farther away are neither drawn nor matched here (m)."""
    resolution: float = 0.05
    """Of the local field (m)."""
    sigma: float = 0.1
    """Decay of the score with the distance from a wall (m)."""
    reach: float = 0.4
    """Beyond it the score is zero (m)."""
    submap_length: float = 4.0
    """A local map begins after so many metres of the way, and another one later it takes over (m)."""
    turn_length: float = 0.3
    """A turn of one radian counts as so many metres of the way (m)."""
    window_sigmas: float = 3.0
    """Half-width of the window in standard deviations of the prediction."""
    window_min: float = 0.1
    """But at least so many metres (m)."""
    window_min_angle: float = radians(4.0)
    """And so much of an angle (rad)."""
    wide_window: float = 0.6
    """Half-width [m] of the window that is searched where the match in the first window is doubtful."""
    wide_window_angle: float = radians(90.0)
    """Half-width [rad] of that window: turns are missed by odometry more often than translations."""
    min_fitness: float = 0.35
    """A match below is refused."""
    usual_fraction: float = 0.7
    """And so is one below this part of the usual fitness."""
    doubtful_fraction: float = 0.85
    """A match below this part of the usual fitness is doubtful: its step is not trusted by the pose graph."""
    match_trust: float = 0.05
    """A match's covariance is taken times this: against the scans just before, errors of the map hardly count."""
    restart_after: int = 3
    """A new local map begins after so many refused matches in a row."""
    hide: Hide = field(default_factory=lambda: Hide(restarts=6, agreement=2, budget=200, memory_size=20))
    hide_wide: Hide = field(default_factory=lambda: Hide(restarts=16, agreement=3, budget=400))
    """The search of the wide window."""
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)
    no_odometry_window: float = 0.6
    """Without odometry: half-width of the window around the constant-velocity prediction (m)."""
    no_odometry_window_angle: float = radians(45.0)
    """And in theta (rad)."""

    def __post_init__(self) -> None:
        for name in ("keyscan_min_d", "keyscan_min_a"):
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"local_matching: {name} is {getattr(self, name)}; it must be 0 or more")
        for name in ("local_range", "resolution", "sigma", "reach", "submap_length", "window_min", "window_min_angle"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"local_matching: {name} is {getattr(self, name)}; it must be positive")


@dataclass(frozen=True, slots=True, eq=False)
class LocalMatch:
    """What the front end made of a scan.

    `pose` is in the drifting frame of the front end. `motion` and `covariance` (3, 3, in the frame of the last
    keyscan) tell the motion since the last keyscan. `is_keyscan`: the scan is to be kept.
    """

    pose: Pose2
    motion: Pose2
    covariance: F64
    status: Status
    is_keyscan: bool
    fitness: float | None = None
    evaluations: int = 0
    reason: str = ""
    is_doubtful: bool = False


FLOOR = np.diag((0.005**2, 0.005**2, 0.002**2))
"""No motion is known better than this (m^2, rad^2)."""
_FORGET = 0.05
"""Weight of a new match in the usual fitness."""
_KNOWN = 0.85
"""A point is spared whose nearest node scores as much: the local map has one within a part of a cell."""
_CONVINCING = 0.9
"""A match in the wide window must reach this part of the usual fitness."""


class LocalMatcher:
    """State: the last keyscan's pose and odometry, and two local maps that overlap."""

    def __init__(self, parameters: LocalMatchingParameters, rng: Generator, use_odometry: bool = True) -> None:
        self._parameters = parameters
        self._rng = rng
        self._use_odometry = use_odometry
        self._T_map_key = IDENTITY
        self._T_odom_key: Pose2 | None = None
        self._maps: list[tuple[LocalMap, float]] = []
        self._way = 0.0
        self._usual: float | None = None
        self._refused = 0
        self._last: tuple[int, Pose2] | None = None
        self._velocity = np.zeros(3)

    def update(self, paired: PairedScan, points: F64) -> LocalMatch:
        """Take a scan and its hits (n, 2) in the base's frame."""
        p = self._parameters
        enough = len(points) >= p.min_points
        if self._T_odom_key is None:
            if not enough:
                return LocalMatch(IDENTITY, IDENTITY, FLOOR, Status.NO_RETURNS, False, reason=f"{len(points)} returns")
            return self._keep(paired, points, LocalMatch(IDENTITY, IDENTITY, FLOOR, Status.MATCHED, True, 1.0))
        motion, covariance = self._predict(paired)
        predicted = self._T_map_key @ motion
        small = hypot(motion.x, motion.y) < p.keyscan_min_d and abs(motion.theta) < p.keyscan_min_a
        if small and self._use_odometry:
            return LocalMatch(predicted, motion, covariance, Status.PREDICTED, False, reason="motion gate")
        if not enough:
            found = LocalMatch(predicted, motion, covariance, Status.NO_RETURNS, False, reason=f"{len(points)} returns")
        else:
            found = self._matched(points[np.hypot(points[:, 0], points[:, 1]) < p.local_range], motion, covariance)
        if not self._use_odometry:
            found = self._without_odometry(paired, found)
        return self._keep(paired, points, found) if found.is_keyscan else found

    def _predict(self, paired: PairedScan) -> tuple[Pose2, F64]:
        """The motion since the last keyscan and its covariance in the keyscan's frame."""
        p = self._parameters
        if self._use_odometry and self._T_odom_key is not None:
            motion = self._T_odom_key.between(paired.T_odom_base)
            return motion, p.odometry_noise.covariance(motion) + FLOOR
        stamp, pose = self._last if self._last is not None else (paired.scan.stamp_ns, self._T_map_key)
        seconds = min(max((paired.scan.stamp_ns - stamp) * 1e-9, 0.0), 1.0)
        # A clock that jumps makes wild velocities: no step is predicted longer than the window is wide.
        most = np.array((p.no_odometry_window, p.no_odometry_window, p.no_odometry_window_angle))
        step = np.clip(self._velocity * seconds, -most, most)
        motion = self._T_map_key.between(pose @ Pose2(float(step[0]), float(step[1]), float(step[2])))
        return motion, np.diag((most / p.window_sigmas) ** 2)

    def _matched(self, points: F64, motion: Pose2, covariance: F64) -> LocalMatch:
        p = self._parameters
        key = self._T_map_key
        predicted = key @ motion
        turn = _turn(key.theta)
        in_map = turn @ covariance @ turn.T
        match, evaluations = self._search(points, predicted, in_map)
        reason = self._refusal(match)
        if reason:
            self._refused += 1
            return LocalMatch(
                predicted, motion, covariance, Status.REJECTED, True, match.fitness, evaluations, reason, True
            )
        doubtful = self._is_doubtful(match)
        self._refused = 0
        self._usual = match.fitness if self._usual is None else self._usual + _FORGET * (match.fitness - self._usual)
        pose, fused = fuse(predicted, in_map, match.pose, p.match_trust * match.covariance)
        return LocalMatch(
            pose,
            key.between(pose),
            turn.T @ fused @ turn + FLOOR,
            Status.MATCHED,
            True,
            match.fitness,
            evaluations,
            is_doubtful=doubtful,
        )

    def _search(self, points: F64, predicted: Pose2, covariance: F64) -> tuple[Match, int]:
        """HIDE in the window of the prediction; where that is doubtful, in a wide one."""
        p = self._parameters
        local = self._maps[0][0].field
        window = Window.from_covariance(predicted, covariance, p.window_sigmas, (p.window_min, p.window_min_angle))
        best = p.hide.match(points, local, window, self._rng)
        evaluations = best.evaluations
        if self._is_doubtful(best):
            wide = Window(
                predicted,
                max(window.half_x, p.wide_window),
                max(window.half_y, p.wide_window),
                max(window.half_theta, p.wide_window_angle),
            )
            match = p.hide_wide.match(points, local, wide, self._rng)
            evaluations += match.evaluations
            usual = p.min_fitness if self._usual is None else self._usual
            if match.fitness >= max(best.fitness + 0.1, _CONVINCING * usual):
                best = match
        return best, evaluations

    def _is_doubtful(self, match: Match) -> bool:
        p = self._parameters
        usual = p.min_fitness if self._usual is None else p.doubtful_fraction * self._usual
        return match.fitness < max(p.min_fitness, usual)

    def _refusal(self, match: Match) -> str:
        p = self._parameters
        if match.fitness < p.min_fitness:
            return f"fitness {match.fitness:.2f} below {p.min_fitness:.2f}"
        if self._usual is not None and match.fitness < p.usual_fraction * self._usual:
            return f"fitness {match.fitness:.2f} far below the usual {self._usual:.2f}"
        return ""

    def _without_odometry(self, paired: PairedScan, found: LocalMatch) -> LocalMatch:
        """Remember the velocity, and apply the motion gate to the match."""
        p = self._parameters
        stamp = paired.scan.stamp_ns
        if found.status is Status.MATCHED and self._last is not None and stamp > self._last[0]:
            step = self._last[1].between(found.pose).to_array()
            self._velocity = step / ((stamp - self._last[0]) * 1e-9)
        elif found.status is not Status.MATCHED:
            self._velocity = np.zeros(3)
        self._last = (stamp, found.pose)
        motion = found.motion
        moved = hypot(motion.x, motion.y) >= p.keyscan_min_d or abs(motion.theta) >= p.keyscan_min_a
        keep = found.is_keyscan and (moved or self._refused >= p.restart_after)
        return LocalMatch(
            found.pose,
            motion,
            found.covariance,
            found.status,
            keep,
            found.fitness,
            found.evaluations,
            found.reason,
            found.is_doubtful,
        )

    def _keep(self, paired: PairedScan, points: F64, found: LocalMatch) -> LocalMatch:
        """Make the scan a keyscan: draw it into the local maps."""
        p = self._parameters
        self._way += hypot(found.motion.x, found.motion.y) + p.turn_length * abs(wrap_angle(found.motion.theta))
        if self._refused >= p.restart_after:
            self._maps, self._refused = [], 0
        if not self._maps or self._way - self._maps[-1][1] > p.submap_length:
            self._maps = [*self._maps[-1:], (LocalMap(p.resolution, p.sigma, p.reach), self._way)]
        self._T_map_key, self._T_odom_key = found.pose, paired.T_odom_base
        if self._last is None:
            self._last = (paired.scan.stamp_ns, found.pose)
        moved = found.pose @ points[np.hypot(points[:, 0], points[:, 1]) < p.local_range]
        if found.status is Status.MATCHED or len(self._maps) == 1:
            for local, _ in self._maps:
                local.draw(moved, _KNOWN)
        return found


def _turn(theta: float) -> F64:
    c, s = np.cos(theta), np.sin(theta)
    return np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
