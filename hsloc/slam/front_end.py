"""The front end: each scan against the keyscans just before it.

Odometry predicts, and the scan is registered onto the last keyscans, point to line, with the prediction as prior.
Where that is refused, or the prediction is too uncertain to begin at, HIDE searches on the field of the local map. A
step that contradicts the odometry, or through whose walls scans have looked, is doubtful. A scan that moved far enough
becomes a keyscan. Drift is left to the loop closer, precision to the joint registration. Where the map was solved while
the log is read, a scan that it explains is followed on it and is no keyscan (`hsloc.slam.known_map`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.gates import MatchGate, MatchLimits, MotionGate, RestGate, StandingOdometry
from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.matching.window import Window
from hsloc.model.estimate import Status
from hsloc.model.pose2 import IDENTITY, Pose2, rotated, wrap_angle
from hsloc.slam.calibration import FLOOR, WeighedOdometry
from hsloc.slam.known_map import KnownMap, KnownMapTracker
from hsloc.slam.local_map import LocalMap
from hsloc.slam.scan_registration import SURPRISE, RecentScans, fused_covariance, moving_scans

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.model.events import PairedScan
    from hsloc.slam.front_end_parameters import FrontEndParameters
    from hsloc.slam.known_map import Anchor
    from hsloc.slam.scan_registration import MovingScan, ScanRegistration

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LocalMatch:
    """What the front end made of a scan.

    `pose` is in the drifting frame of the front end. `motion` and `covariance` (3, 3, in the frame of the last
    keyscan) give the motion since the last keyscan. `is_keyscan`: the scan is to be kept.
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
    scans: tuple[MovingScan, ...] = ()
    """The scan and its companions, prepared; of a keyscan."""
    anchor: Anchor | None = None
    """Where the scan is in the known map: of one that was followed on it, and of the first keyscan after such scans."""


_FORGET = 0.05
"""Weight of a new period in the mean of the periods."""
_SPARSER = 2.0
"""A scan on the known map is matched after this multiple of the motion between keyscans: nothing is built from it."""
_LONGEST_PREDICTION = 2.0
"""Periods of the scans for which a velocity is trusted."""
_KNOWN = 0.85
"""A point is spared whose nearest node scores as much: the local map has one within a part of a cell."""
_CONVINCING = 0.8
"""A pose that contradicts the odometry must be this consistent."""
_CONVINCING_PAIRED = 0.3
"""And this part of the points that both sides could see must be paired."""
_OBSERVED = 0.1
"""Information along the offset from the prediction, as a part of that across the best wall. Of poses that HIDE found
away from the odometry on five logs 95 of 100 right ones have 0.3 and more, slides along corridors 0.03 and less."""
_BETTER = 0.03
"""A pose that HIDE found replaces the registered prediction if this much more of the points agree, or fit."""
_HEADING_DRIFT = 0.02
"""Drift of a heading [rad/s]: the zero-rate offset of common gyroscopes at rest, one degree per second."""
_USUAL, _USUAL_IN_SLIP = 0.9, 0.95
"""Ratio to the usual fitness below which a registration may have ended beside the right place, and after a step that
contradicts the odometry: then the prediction is wrong, and the nearest walls are others than those that are seen."""
_SLIP = 0.3
"""Standard deviation [m] of a motion that the scans contradict, without saying what it was."""
_SLIP_ANGLE = 0.3
"""And of its turn [rad]."""
_OF_SLIP = np.diag((_SLIP**2, _SLIP**2, _SLIP_ANGLE**2))
_LONGEST_SLIP_M = 5.0
"""Way [m] that wheels may slip in a step, at most. Scans may be 2.8 m apart in logs of which only some were kept (ACES,
every fourth scan: with 2.5 m its map is lost); over gaps of 10 m and more look-alikes were taken for the same place."""
_BASIN = 0.3
"""Half-width [m] of a window from whose centre the registration finds its way: its first gate."""
_BASIN_ANGLE = 0.2
"""And in theta [rad]."""


class FrontEnd:
    """State: the last keyscan's pose and odometry, and two local maps that overlap."""

    def __init__(self, parameters: FrontEndParameters, rng: Generator, use_odometry: bool = True) -> None:
        self._parameters = parameters
        self._rng = rng
        self._use_odometry = use_odometry
        self._T_map_key = IDENTITY
        self._T_odom_key: Pose2 | None = None
        self._maps: list[tuple[LocalMap, float]] = []
        self._recent = RecentScans()
        self._hidden = np.zeros((3, 3))
        self._way = 0.0
        p = parameters
        self._motion_gate = MotionGate(p.keyscan_min_d, p.keyscan_min_a)
        self._rest_gate = RestGate()
        self._standing = StandingOdometry()
        self._slips = False
        self._known_map_gate = MotionGate(_SPARSER * p.keyscan_min_d, _SPARSER * p.keyscan_min_a)
        ratio = p.min_fitness_ratio
        self._match_gate = MatchGate(
            MatchLimits(min_fitness=p.min_fitness, min_fitness_ratio=ratio, recovery_fitness_ratio=ratio)
        )
        self._last: tuple[int, Pose2] | None = None
        self._last_heading: float | None = None
        self._velocity = np.zeros(3)
        self._period = float("inf")
        self._odometry = WeighedOdometry(p.odometry_noise)
        self._tracker: KnownMapTracker | None = None
        self._covariance = np.zeros((3, 3))

    @property
    def covariance(self) -> F64:
        """Covariance (3, 3) of the last keyscan's pose, or of the last followed scan's, since the map was solved."""
        return self._covariance

    @property
    def is_far_from_known_map(self) -> bool:
        """Whether there is a known map, and only a loop leads back to it."""
        return self._tracker is not None and self._tracker.is_far(self._way)

    def go_on(self, known: KnownMap, T_map_key: Pose2) -> None:
        """Go on in the frame of a map that was solved, in which the last keyscan is at `T_map_key`."""
        self._recent.move(T_map_key @ self._T_map_key.inverse())
        self._T_map_key, self._covariance = T_map_key, np.zeros((3, 3))
        self._tracker = KnownMapTracker(known, self._way)
        self._redraw()

    def update(self, paired: PairedScan) -> LocalMatch:
        """Take a scan."""
        p = self._parameters
        if self._T_odom_key is None:
            points = paired.points_base()
            if len(points) < p.min_points:
                return LocalMatch(IDENTITY, IDENTITY, FLOOR, Status.NO_RETURNS, False, reason=f"{len(points)} returns")
            first = LocalMatch(IDENTITY, IDENTITY, FLOOR, Status.MATCHED, True, 1.0)
            return self._keep(paired, points, self._near(points), first)
        motion, covariance = self._predict(paired)
        for each in (self._rest_gate, self._standing):
            each.follow(paired.T_odom_base)
        predicted, tracker = self._T_map_key @ motion, self._tracker
        gate = self._known_map_gate if tracker is not None and tracker.is_following else self._motion_gate
        if self._use_odometry and not gate.is_open(motion):
            if not self._is_moved(paired, predicted):
                return LocalMatch(predicted, motion, covariance, Status.PREDICTED, False, reason="motion gate")
            covariance = covariance + _OF_SLIP
        points = paired.points_base()
        near = self._near(points)
        if len(points) < p.min_points:
            found = LocalMatch(predicted, motion, covariance, Status.NO_RETURNS, False, reason=f"{len(points)} returns")
        else:
            scans = moving_scans(paired, points)
            on_map = self._followed(paired, near, scans, motion, covariance)
            if on_map is not None:
                return on_map
            found = replace(self._matched(near, scans, motion, covariance), scans=scans)
        if not self._use_odometry:
            found = self._without_odometry(paired, found)
        return self._keep(paired, points, near, found) if found.is_keyscan else found

    def _is_moved(self, paired: PairedScan, predicted: Pose2) -> bool:
        """Whether a scan shows that a robot moves whose odometry counts no way: pushed, or with frozen wheels."""
        is_on_map = self._tracker is not None and self._tracker.is_following
        if is_on_map or not self._standing.counts_no_way:
            return False
        points = paired.points_base()
        near = self._near(points)
        if len(points) < self._parameters.min_points:
            return False
        if not self._rest_gate.is_open(self._maps[0][0].fitness(near, predicted)):
            return False
        found, _ = self._search(near, moving_scans(paired, points), predicted, _OF_SLIP)
        off = predicted.between(found.pose)
        turn = off.theta if self._standing.counts_no_turn else 0.0
        is_moved = not found.refusal() and self._motion_gate.is_open(Pose2(off.x, off.y, turn))
        self._rest_gate.searched(is_moved)
        return is_moved

    def _near(self, points: F64) -> F64:
        """The points (n, 2) within the range that is used."""
        near: F64 = points[np.hypot(points[:, 0], points[:, 1]) < self._parameters.local_range]
        return near

    def _predict(self, paired: PairedScan) -> tuple[Pose2, F64]:
        """The motion since the last keyscan and its covariance in the keyscan's frame."""
        p = self._parameters
        if self._use_odometry and self._T_odom_key is not None:
            motion = self._T_odom_key.between(paired.T_odom_base)
            return motion, self._odometry.scale**2 * p.odometry_noise.covariance(motion) + FLOOR
        stamp, pose = self._last if self._last is not None else (paired.scan.stamp_ns, self._T_map_key)
        seconds = max((paired.scan.stamp_ns - stamp) * 1e-9, 0.0)
        periods = min(seconds / self._period, _LONGEST_PREDICTION)
        # A clock that jumps makes wild velocities: no step is predicted longer than the window is wide.
        most = np.array((p.no_odometry_window, p.no_odometry_window, p.no_odometry_window_angle))
        step = np.clip(self._velocity * periods, -most, most)
        covariance = np.diag((most / p.window_sigmas) ** 2)
        if paired.heading is not None and self._last_heading is not None:
            step[2] = wrap_angle(paired.heading - self._last_heading)
            of_turn = p.odometry_noise.covariance(Pose2(0.0, 0.0, float(step[2])))
            covariance[2, 2] = of_turn[2, 2] + (_HEADING_DRIFT * seconds) ** 2 + FLOOR[2, 2]
        motion = self._T_map_key.between(pose @ Pose2(float(step[0]), float(step[1]), float(step[2])))
        return motion, covariance

    def _followed(
        self, paired: PairedScan, points: F64, scans: tuple[MovingScan, ...], motion: Pose2, covariance: F64
    ) -> LocalMatch | None:
        """The scan on the known map; None without one, or where it does not explain the scan."""
        tracker, key = self._tracker, self._T_map_key
        if tracker is None:
            return None
        in_map = predict_covariance(self._covariance, key, motion, covariance)
        found = tracker.follow(self._way, scans, points, key @ motion, in_map)
        if found is None:
            if tracker.is_following:
                self._recent.start_with(tracker.leave(self._way, key))
                self._redraw()
            return None
        step = key.between(found.pose)
        if self._use_odometry:
            self._odometry.add(motion, step)
        self._covariance = fused_covariance(found) + FLOOR
        self._way += self._length(step)
        self._T_map_key, self._T_odom_key = found.pose, paired.T_odom_base
        self._match_gate.restart(self._match_gate.usual)
        self._hidden = np.zeros((3, 3))
        anchor = tracker.anchor(found.pose, self._covariance)
        return LocalMatch(found.pose, step, covariance, Status.MATCHED, False, found.paired, 1, anchor=anchor)

    def _length(self, motion: Pose2) -> float:
        return hypot(motion.x, motion.y) + self._parameters.turn_length * abs(wrap_angle(motion.theta))

    def _redraw(self) -> None:
        """Draw the local map of the scans that are kept, and of no other."""
        p = self._parameters
        self._maps = [(LocalMap(p.resolution, p.sigma, p.max_distance), self._way)]
        for hits in self._recent.hits(p.local_range):
            self._maps[0][0].add(hits, _KNOWN)

    def _matched(self, points: F64, scans: tuple[MovingScan, ...], motion: Pose2, covariance: F64) -> LocalMatch:
        key = self._T_map_key
        predicted = key @ motion
        in_map = rotated(covariance, key.theta)
        found, evaluations = self._search(points, scans, predicted, in_map)
        fitness = self._maps[0][0].fitness(points, found.pose)
        if reason := found.refusal():
            self._match_gate.refuse()
            if found.is_contradicted():
                covariance = covariance + _OF_SLIP
            return LocalMatch(predicted, motion, covariance, Status.REJECTED, True, fitness, evaluations, reason, True)
        # What is measured is the pose in the local map; the step to it also holds what the refused steps may hide.
        after_refusal = self._match_gate.refusals > 0
        self._match_gate.accept(fitness)
        self._rest_gate.matched(fitness)
        self._slips = found.chi * self._odometry.scale > SURPRISE
        fused = rotated(fused_covariance(found), -key.theta) + FLOOR
        if self._use_odometry:
            self._odometry.add(motion, key.between(found.pose))
        return LocalMatch(
            found.pose,
            key.between(found.pose),
            fused + self._hidden if after_refusal else fused,
            Status.MATCHED,
            True,
            fitness,
            evaluations,
            is_doubtful=found.is_doubtful() or after_refusal,
        )

    def _search(
        self, points: F64, scans: tuple[MovingScan, ...], predicted: Pose2, covariance: F64
    ) -> tuple[ScanRegistration, int]:
        """Registration from the prediction, and from what HIDE finds in the prediction's window and in a wide one.

        HIDE is asked where the prediction is too uncertain for the registration to begin at, or where that is refused.
        It is asked, too, where one that is not refused fits less than usual; then another one has to fit as usual.
        """
        p = self._parameters
        best = self._recent.register(scans, predicted, predicted, covariance)
        evaluations = 1
        window = Window.from_covariance(predicted, covariance, p.window_sigmas, (p.window_min, p.window_min_angle))
        certain = max(window.half_x, window.half_y) <= _BASIN and window.half_theta <= _BASIN_ANGLE
        fitness = self._maps[0][0].fitness(points, best.pose)
        is_accepted = certain and not best.refusal()
        if is_accepted and self._is_usual(fitness):
            return best, evaluations
        local = self._maps[0][0].field
        # Wheels may have slipped all the way. Farther away are other places, which may look alike after a gap.
        slip = max(p.wide_window, p.no_odometry_window) + min(self._T_map_key.distance(predicted), _LONGEST_SLIP_M)
        window = replace(window, half_x=min(window.half_x, slip), half_y=min(window.half_y, slip))
        wide = Window(predicted, slip, slip, max(window.half_theta, p.wide_window_angle))
        for hide, box in ((p.hide, window), (p.hide_wide, wide)):
            (start,), _, spent = hide.match_boxes(points, local, [box], self._rng)
            evaluations += spent
            found = self._recent.register(scans, start, predicted, covariance)
            fits = local.fitness(points, found.pose)
            more = found.agreement > best.agreement + _BETTER, fits > fitness + _BETTER
            is_doubted = is_accepted or (box is wide and not best.refusal())
            better = all(more) and self._is_usual(fits) if is_doubted else any(more)
            credible = not found.refusal() and self._is_credible(found, fits, predicted, best.is_contradicted())
            if (better or best.refusal()) and credible:
                best, fitness = found, fits
            may_be_wrong = (is_accepted or self._slips) and not self._is_usual(fitness)
            if not best.refusal() and not may_be_wrong:
                break
        return best, evaluations

    def _is_usual(self, fitness: float) -> bool:
        """Whether a registration of this fitness is where it should be; where wheels slip others fit nearly as well."""
        usual = self._match_gate.usual
        return usual is None or fitness >= (_USUAL_IN_SLIP if self._slips else _USUAL) * usual

    def _is_credible(self, found: ScanRegistration, fitness: float, predicted: Pose2, refuted: bool) -> bool:
        """Whether a pose is evidence against the prediction, where it contradicts it.

        Along a direction that no wall fixes another pose is none: the score of HIDE prefers the pose at which the scans
        overlap most. Nor is another heading than the odometry's, unless the scans have `refuted` that: a camera that
        turns in a corner sees one wall after the other, and each fits the one before.
        """
        p = self._parameters
        if found.chi * self._odometry.scale <= SURPRISE:
            return True
        offset = np.array((found.pose.x - predicted.x, found.pose.y - predicted.y))
        if np.hypot(*offset) > p.window_min and found.observed(offset) < _OBSERVED:
            return False
        turned = abs(wrap_angle(found.pose.theta - predicted.theta))
        if self._use_odometry and not refuted and turned > p.window_min_angle:
            return False
        agrees = found.paired >= _CONVINCING_PAIRED and found.consistency >= _CONVINCING
        return agrees and not self._match_gate.refusal(fitness)

    def _without_odometry(self, paired: PairedScan, found: LocalMatch) -> LocalMatch:
        """Remember the velocity, and apply the motion gate to the match."""
        p = self._parameters
        stamp = paired.scan.stamp_ns
        if found.status is Status.MATCHED and self._last is not None and stamp > self._last[0]:
            step = self._last[1].between(found.pose).to_array()
            seconds = (stamp - self._last[0]) * 1e-9
            self._period = seconds if self._period == np.inf else self._period + _FORGET * (seconds - self._period)
            # In metres and radians per period. Two stamps that nearly coincide are a clock's fault: their scans do not.
            self._velocity = step / max(seconds / self._period, 0.5)
        elif found.status is not Status.MATCHED:
            self._velocity = np.zeros(3)
        self._last, self._last_heading = (stamp, found.pose), paired.heading
        long_refused = self._match_gate.refusals >= p.restart_after
        keep = found.is_keyscan and (long_refused or self._motion_gate.is_open(found.motion))
        return replace(found, is_keyscan=keep)

    def _keep(self, paired: PairedScan, points: F64, near: F64, found: LocalMatch) -> LocalMatch:
        """Make the scan a keyscan: add it to the local maps."""
        p = self._parameters
        scans = found.scans or moving_scans(paired, points)
        self._way += self._length(found.motion)
        if self._match_gate.refusals >= p.restart_after:
            self._maps = []
            self._match_gate.restart(self._match_gate.usual)
            self._recent.clear()
        if not self._maps or self._way - self._maps[-1][1] > p.submap_length:
            self._maps = [*self._maps[-1:], (LocalMap(p.resolution, p.sigma, p.max_distance), self._way)]
        self._hidden = self._hidden + found.covariance if found.status is not Status.MATCHED else np.zeros((3, 3))
        self._covariance = predict_covariance(self._covariance, self._T_map_key, found.motion, found.covariance)
        self._T_map_key, self._T_odom_key = found.pose, paired.T_odom_base
        if self._tracker is not None:
            found = replace(found, anchor=self._tracker.tie(found.pose, self._covariance))
        if self._last is None:
            self._last, self._last_heading = (paired.scan.stamp_ns, found.pose), paired.heading
        if found.status is Status.MATCHED or len(self._maps) == 1:
            moved = found.pose @ near
            for local, _ in self._maps:
                local.add(moved, _KNOWN)
            self._recent.add(found.pose, scans)
        return replace(found, scans=scans)
