"""The localiser: where a robot is on a known map, scan by scan.

Predict with odometry as in an EKF, match inside the window that the predicted covariance gives, test, update ([P] V).
While the pose is unknown the relocaliser has the word.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.motion import OdometryNoise, fuse, predict_covariance
from hsloc.localisation.relocaliser import Relocaliser, RelocaliserParameters, Verdict
from hsloc.matching.window import Window
from hsloc.model.estimate import Estimate, Status
from hsloc.model.events import HELD, Odometry, PairedScan
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.parameters import Angle, Count, NonNegative, Parameters, Positive, Ratio

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Match, Matcher
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class LocaliserParameters(Parameters):
    """When a scan is matched, in which window, and which match is accepted; where AMCL has it, by AMCL's name."""

    update_min_d: NonNegative = 0.2
    """Minimum translation between two matched scans [m]; a larger rotation alone is enough, too."""
    update_min_a: NonNegative = 0.2
    """Minimum rotation between two matched scans [rad]; a larger translation alone is enough, too."""
    min_points: Count = 10
    """Minimum number of hits of a scan that is matched; [P] asks for more than 5."""
    window_sigmas: Positive = 3.0
    """Half-width of the search window in standard deviations of the prediction."""
    window_min: Positive = 0.15
    """Minimum half-width of the search window in x and y [m]."""
    window_min_angle: Angle = radians(5.0)
    """Minimum half-width of the search window in heading [rad]."""
    min_fitness: Ratio = 0.3
    """Minimum fitness of an accepted match."""
    min_fitness_ratio: Ratio = 0.7
    """Minimum ratio of an accepted match's fitness to the usual fitness, the running mean of accepted matches."""
    recovery_fitness_ratio: Ratio = 0.9
    """Minimum ratio to the usual fitness of a match in the wide window that is searched after a refused match."""
    wide_window: Positive = 0.5
    """Half-width of the window that is searched after a refused match [m]; wheels may slip by as much."""
    wide_window_angle: Angle = radians(20.0)
    """Half-width in heading of the window that is searched after a refused match [rad]."""
    max_consecutive_rejections: Count = 5
    """Number of refused matches in a row after which the pose counts as lost and the whole map is searched."""
    fuse: bool = True
    """Whether match and prediction are weighted by their covariances (EKF); otherwise the match is taken, as in [P]."""
    initial_sigma: Positive = 0.5
    """Standard deviation of a given initial pose in x and y [m]."""
    initial_sigma_angle: Positive = radians(15.0)
    """Standard deviation of a given initial pose in heading [rad]."""
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)
    relocaliser: RelocaliserParameters = field(default_factory=RelocaliserParameters)


_BETTER = 0.1
"""So much fitter must a match outside the window of the prediction be: ambiguous places look alike."""
_FORGET = 0.05
"""Weight of a new match in the usual fitness."""


class Localiser:
    """State: `T_map_odom`, the covariance, and the odometry at the last match. An `Estimator`."""

    def __init__(
        self,
        grid: OccupancyGrid,
        likelihood: LikelihoodField,
        matcher: Matcher,
        parameters: LocaliserParameters,
        rng: Generator,
        initial_pose: Pose2 | None = None,
    ) -> None:
        self._field = likelihood
        self._matcher = matcher
        self._parameters = parameters
        self._rng = rng
        self._count = 0
        self._search_began = 0
        self._T_odom_match: Pose2 | None = None
        self._T_map_odom = IDENTITY
        self._T_map_match = IDENTITY if initial_pose is None else initial_pose
        self._covariance = np.diag(
            (parameters.initial_sigma**2, parameters.initial_sigma**2, parameters.initial_sigma_angle**2)
        )
        self._usual: float | None = None
        self._rejected = 0
        self._start_given = initial_pose is not None
        self._relocaliser = Relocaliser(
            grid, likelihood, matcher, parameters.relocaliser, parameters.odometry_noise, rng
        )
        self._searching = initial_pose is None

    @property
    def T_map_odom(self) -> Pose2:
        """The transform that a ROS localiser would publish."""
        return self._T_map_odom

    def update(self, event: Odometry | PairedScan) -> Estimate:
        """Take an event; the estimate at its stamp."""
        if self._T_odom_match is None:
            self._anchor(self._T_map_match, event.T_odom_base)
        if isinstance(event, Odometry):
            return self._follow(event)
        if event.is_held:
            return self._hold(event)
        return self._search(event) if self._searching else self._localise(event)

    def _follow(self, odometry: Odometry) -> Estimate:
        """Between matches: compose with the odometry."""
        self._count += 1
        status = Status.SEARCHING if self._searching else Status.PREDICTED
        return Estimate(odometry.stamp_ns, self._T_map_odom @ odometry.T_odom_base, status)

    def _hold(self, paired: PairedScan) -> Estimate:
        """A scan that is matched with a later one."""
        status = Status.SEARCHING if self._searching else Status.PREDICTED
        return Estimate(paired.scan.stamp_ns, self._T_map_odom @ paired.T_odom_base, status, reason=HELD)

    def _localise(self, paired: PairedScan) -> Estimate:
        scan, T_odom_base = paired.scan, paired.T_odom_base
        p = self._parameters
        motion = (self._T_odom_match or T_odom_base).between(T_odom_base)
        predicted = self._T_map_match @ motion
        first = self._usual is None and self._rejected == 0
        if not first and np.hypot(motion.x, motion.y) < p.update_min_d and abs(motion.theta) < p.update_min_a:
            return Estimate(scan.stamp_ns, predicted, Status.PREDICTED, reason="motion gate")
        covariance = predict_covariance(
            self._covariance, self._T_map_match, motion, p.odometry_noise.covariance(motion)
        )
        points = paired.points_base()
        if len(points) < p.min_points:
            self._take(predicted, covariance, T_odom_base)
            return Estimate(scan.stamp_ns, predicted, Status.NO_RETURNS, covariance, reason=f"{len(points)} returns")
        match, evaluations = self._match(points, predicted, covariance)
        reason = self._refusal(match)
        if reason:
            return self._refuse(paired, predicted, covariance, match, evaluations, reason)
        pose, covariance = (
            fuse(predicted, covariance, match.pose, match.covariance) if p.fuse else (match.pose, match.covariance)
        )
        self._rejected = 0
        self._usual = match.fitness if self._usual is None else self._usual + _FORGET * (match.fitness - self._usual)
        self._take(pose, covariance, T_odom_base)
        return Estimate(scan.stamp_ns, pose, Status.MATCHED, covariance, match.fitness, evaluations)

    def _match(self, points: F64, predicted: Pose2, covariance: F64) -> tuple[Match, int]:
        """Match in the window of the prediction; a refused match may give way to one in a wider window."""
        p = self._parameters
        window = Window.from_covariance(predicted, covariance, p.window_sigmas, (p.window_min, p.window_min_angle))
        best = self._matcher.match(points, self._field, window, self._rng)
        evaluations = best.evaluations
        if self._usual is not None and self._refusal(best):
            wide = Window(
                predicted,
                max(window.half_x, p.wide_window),
                max(window.half_y, p.wide_window),
                max(window.half_theta, p.wide_window_angle),
            )
            match = self._matcher.match(points, self._field, wide, self._rng)
            evaluations += match.evaluations
            if match.fitness >= max(best.fitness + _BETTER, p.recovery_fitness_ratio * self._usual):
                best = match
        return best, evaluations

    def _refusal(self, match: Match) -> str:
        """Why a match is not believed; empty if it is."""
        p = self._parameters
        if match.fitness < p.min_fitness:
            return f"fitness {match.fitness:.2f} below {p.min_fitness:.2f}"
        if self._usual is not None and match.fitness < p.min_fitness_ratio * self._usual:
            return f"fitness {match.fitness:.2f} far below the usual {self._usual:.2f}"
        return ""

    def _refuse(
        self,
        paired: PairedScan,
        predicted: Pose2,
        covariance: F64,
        match: Match,
        evaluations: int,
        reason: str,
    ) -> Estimate:
        """The prediction stands; after too many refusals the pose is lost."""
        self._rejected += 1
        self._take(predicted, covariance, paired.T_odom_base)
        status = Status.REJECTED
        if self._rejected >= self._parameters.max_consecutive_rejections:
            self._searching = True
            self._search_began = self._count
            self._relocaliser.start()
            status, reason = Status.SEARCHING, f"lost: {reason}"
        return Estimate(paired.scan.stamp_ns, predicted, status, covariance, match.fitness, evaluations, reason)

    def _search(self, paired: PairedScan) -> Estimate:
        """Let the relocaliser see the scan; take its answer when it is sure."""
        scan, T_odom_base = paired.scan, paired.T_odom_base
        verdict = self._relocaliser.update(paired, self._count)
        pose = self._T_map_odom @ T_odom_base if verdict.pose is None else verdict.pose
        status = Status.SEARCHING
        if verdict.is_sure:
            self._searching = False
            self._rejected = 0
            self._usual = verdict.fitness
            status = Status.RELOCALISED
        self._take(pose, self._covariance if verdict.covariance is None else verdict.covariance, T_odom_base)
        return Estimate(
            scan.stamp_ns,
            pose,
            status,
            verdict.covariance,
            verdict.fitness,
            verdict.evaluations,
            verdict.reason,
            self._revision(verdict),
        )

    def _revision(self, verdict: Verdict) -> tuple[tuple[int, Pose2], ...]:
        """The winner's way since the search began; its first pose holds back to that moment, if it goes back so far."""
        if not verdict.track or not verdict.track_is_whole:
            return verdict.track
        (_, first), *rest = verdict.track
        return ((self._search_began, first), *rest)

    def _take(self, pose: Pose2, covariance: F64, T_odom_base: Pose2) -> None:
        self._covariance = covariance
        self._anchor(pose, T_odom_base)

    def _anchor(self, T_map_base: Pose2, T_odom_base: Pose2) -> None:
        self._T_map_match = T_map_base
        self._T_odom_match = T_odom_base
        self._T_map_odom = T_map_base @ T_odom_base.inverse()
