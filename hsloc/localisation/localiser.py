"""The localiser: where a robot is on a known map, scan by scan.

Predict with odometry as in an EKF, match inside the window that the predicted covariance gives, test, update ([P] V).
While the pose is unknown the relocaliser decides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import hypot, radians
from typing import TYPE_CHECKING, Annotated

import numpy as np

from hsloc.localisation.gates import MatchGate, MatchLimits, MotionGate
from hsloc.localisation.kalman_filter import Innovations, difference, fuse_match, predict_covariance
from hsloc.localisation.map_scale import MapScale, MapScaleEstimator
from hsloc.localisation.motion_models import MOTION_MODELS, AckermannNoise, OdometryNoise, OmnidirectionalNoise
from hsloc.localisation.place_check import PlaceCheck, PlaceCheckParameters
from hsloc.localisation.relocaliser import Relocaliser, RelocaliserParameters
from hsloc.localisation.track_evidence import TrackMonitor
from hsloc.matching.certificate import CertificateParameters, certify
from hsloc.matching.covariance import match_information
from hsloc.matching.exact import heuristic
from hsloc.matching.local_refinement import refine
from hsloc.matching.window import Window
from hsloc.model.estimate import Estimate, Evidence, Status
from hsloc.model.events import HELD, Odometry, PairedScan
from hsloc.model.pose2 import IDENTITY, Pose2, rotated
from hsloc.parameters import Angle, Count, NonNegative, OneOf, Parameters, Positive, Ratio

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.localisation.global_search import GlobalSearch, RelocaliserResult
    from hsloc.localisation.motion_models import MotionModel
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
    refine_first: bool = True
    """Whether the optimum next to the prediction is taken where it fits as well as usual; otherwise always a search."""
    fuse: bool = True
    """Whether match and prediction are weighted by their covariances (EKF); otherwise the match is taken, as in [P]."""
    smooth: bool = True
    """Whether the poses of the trajectory also use the scans after them, as an offline run can."""
    initial_sigma: Positive = 0.5
    """Standard deviation of a given initial pose in x and y [m]."""
    initial_sigma_angle: Positive = radians(15.0)
    """Standard deviation of a given initial pose in heading [rad]."""
    correct_map_scale: bool = True
    """Whether a map whose resolution is wrong, as lidar and odometry agree, is corrected and the log replayed again."""
    certify: bool = False
    """Whether each match is followed by a proof that no pose of its window is fitter."""
    certificate: CertificateParameters = field(default_factory=CertificateParameters)
    motion_model: Annotated[str, OneOf(MOTION_MODELS)] = "differential"
    """How the base moves, which chooses its odometry noise: differential drive, car-like, or in any direction."""
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)
    ackermann_noise: AckermannNoise = field(default_factory=AckermannNoise)
    omnidirectional_noise: OmnidirectionalNoise = field(default_factory=OmnidirectionalNoise)
    relocaliser: RelocaliserParameters = field(default_factory=RelocaliserParameters)
    place_check: PlaceCheckParameters = field(default_factory=PlaceCheckParameters)
    lost_probability: Ratio = 0.99
    """Probability of having gone astray from which the whole map is searched, where another place fits as well."""

    def noise(self) -> MotionModel:
        """The noise of the motion model that is chosen."""
        models: dict[str, MotionModel] = {
            "differential": self.odometry_noise,
            "ackermann": self.ackermann_noise,
            "omnidirectional": self.omnidirectional_noise,
        }
        return models[self.motion_model]

    def smoothing_model(self) -> MotionModel | None:
        """The noise for smoothing backwards; None where the poses are not smoothed."""
        return self.noise() if self.smooth else None

    def match_limits(self) -> MatchLimits:
        """The limits of the match gate."""
        return MatchLimits(
            min_fitness=self.min_fitness,
            min_fitness_ratio=self.min_fitness_ratio,
            recovery_fitness_ratio=self.recovery_fitness_ratio,
        )


_AS_USUAL = 0.98
"""Ratio to the usual fitness from which the optimum next to the prediction is taken without a search."""


class Localiser:
    """State: `T_map_odom`, the covariance, and the odometry at the last match. An `Estimator`.

    Matcher, motion model and global search are what their protocols ask for; `from_parameters` makes the usual ones.
    """

    def __init__(
        self,
        likelihood: LikelihoodField,
        matcher: Matcher,
        search: GlobalSearch,
        motion_model: MotionModel,
        parameters: LocaliserParameters,
        rng: Generator,
        initial_pose: Pose2 | None = None,
        *,
        place_check: PlaceCheck | None = None,
        map_scale: MapScaleEstimator | None = None,
    ) -> None:
        self._map_scale = map_scale
        self._monitor = None if place_check is None else TrackMonitor(place_check)
        self._field = likelihood
        self._matcher = matcher
        self._global_search = search
        self._motion_model = motion_model
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
        self._innovations = Innovations()
        # Where a proof is asked for, the optimum next to the prediction has none.
        proves = parameters.certify or heuristic(matcher) is not matcher
        self._refines = parameters.refine_first and not proves
        self._motion_gate = MotionGate(parameters.update_min_d, parameters.update_min_a)
        self._match_gate = MatchGate(parameters.match_limits())
        self._searching = initial_pose is None

    @classmethod
    def from_parameters(
        cls,
        grid: OccupancyGrid,
        likelihood: LikelihoodField,
        matcher: Matcher,
        parameters: LocaliserParameters,
        rng: Generator,
        initial_pose: Pose2 | None = None,
    ) -> Localiser:
        """With the relocaliser and the motion model that the parameters name; `initial_pose` None is unknown."""
        noise = parameters.noise()
        p = parameters.place_check
        check = PlaceCheck(grid, likelihood, p) if p.interval > 0.0 else None
        search = Relocaliser(
            grid, likelihood, heuristic(matcher), parameters.relocaliser, noise, rng, place_check=check
        )
        scale = MapScaleEstimator(likelihood, (grid.origin.x, grid.origin.y))
        return cls(
            likelihood, matcher, search, noise, parameters, rng, initial_pose, place_check=check, map_scale=scale
        )

    @property
    def T_map_odom(self) -> Pose2:
        """The transform that a ROS localiser would publish."""
        return self._T_map_odom

    @property
    def map_scale(self) -> MapScale | None:
        """Length on the map by length as the lidar measures it; None while too little is seen, or without estimator."""
        return None if self._map_scale is None else self._map_scale.estimate()

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
        if not self._match_gate.is_fresh and not self._motion_gate.is_open(motion):
            return Estimate(scan.stamp_ns, predicted, Status.PREDICTED, reason="motion gate")
        propagated = predict_covariance(self._covariance, self._T_map_match, motion, np.zeros((3, 3)))
        noise = rotated(self._motion_model.covariance(motion), self._T_map_match.theta)
        covariance = propagated + max(self._innovations.noise_scale, 1.0) * noise
        points = paired.points_base()
        for each in (self._monitor, self._map_scale):
            if each is not None:
                each.move(hypot(motion.x, motion.y))
        if len(points) < p.min_points:
            self._take(predicted, covariance, T_odom_base)
            reason = f"{len(points)} returns"
            evidence = None if self._monitor is None else self._monitor.skipped()
            covariance = self._reported(covariance)
            return Estimate(scan.stamp_ns, predicted, Status.NO_RETURNS, covariance, reason=reason, evidence=evidence)
        match, evaluations = self._match(points, predicted, covariance)
        reason = self._match_gate.refusal(match.fitness)
        is_hidden = bool(reason) and self._is_hidden(paired, match)
        if reason and not is_hidden:
            return self._refuse(paired, predicted, covariance, match, evaluations, reason)
        information = match_information(points, self._field, match.pose, self._wall_variance())
        if p.fuse:
            if information is not None:
                information = self._match_gate.trust(match.fitness) * information
                self._innovations.add(difference(match.pose, predicted), information, propagated, noise)
            pose, covariance = fuse_match(predicted, covariance, match, information)
        else:
            pose, covariance = match.pose, match.covariance
        is_usual = self._match_gate.fits_as_usual(match.fitness)
        if is_hidden:
            self._match_gate.accept_hidden()
        else:
            self._match_gate.accept(match.fitness)
        self._take(pose, covariance, T_odom_base)
        evidence = None if self._monitor is None else self._monitor.matched(paired, pose, points)
        if self._map_scale is not None:
            self._map_scale.matched(paired, pose)
        status, reason = Status.MATCHED, ""
        if self._monitor is not None and evidence is not None and self._monitor.is_astray(evidence, p.lost_probability):
            status = Status.SEARCHING
            reason = f"lost: the map explains {evidence.explained:.2f}, another place fits {evidence.rival:.2f} times"
            self._lose()
        return Estimate(
            scan.stamp_ns,
            pose,
            status,
            self._reported(covariance),
            match.fitness,
            evaluations,
            reason,
            evidence=evidence,
            certificate=match.certificate,
            noise_scale=self._innovations.noise_scale,
            fits_as_usual=is_usual,
        )

    def _is_hidden(self, paired: PairedScan, match: Match) -> bool:
        """Whether a match that would be refused is right but for what hides the walls."""
        if self._monitor is None or match.fitness < self._parameters.min_fitness:
            return False
        return self._monitor.is_hidden(paired, match.pose)

    def _wall_variance(self) -> float | None:
        """What the scans so far show of how walls are drawn (m^2)."""
        return None if self._map_scale is None else self._map_scale.wall_variance

    def _lose(self) -> None:
        """The pose is unknown from now on: search."""
        self._searching = True
        self._search_began = self._count
        self._global_search.start(None if self._monitor is None else self._monitor.usual_explained)

    def _reported(self, covariance: F64) -> F64:
        """A covariance with the scale of the innovations; never smaller than the filter's."""
        return self._innovations.excess * covariance

    def _match(self, points: F64, predicted: Pose2, covariance: F64) -> tuple[Match, int]:
        """Match in the window of the prediction; a match that is not as fit as usual may give way in a wider window."""
        p = self._parameters
        window = Window.from_covariance(predicted, covariance, p.window_sigmas, (p.window_min, p.window_min_angle))
        usual = self._match_gate.usual
        evaluations = 0
        if self._refines and usual is not None:
            refined = refine(points, self._field, window)
            if refined.fitness >= _AS_USUAL * usual and self._match_gate.refusals == 0:
                return refined, refined.evaluations
            evaluations = refined.evaluations
        best = self._match_in(points, window)
        evaluations += best.evaluations
        if not self._match_gate.fits_as_usual(best.fitness):
            wide = Window(
                predicted,
                max(window.half_x, p.wide_window),
                max(window.half_y, p.wide_window),
                max(window.half_theta, p.wide_window_angle),
            )
            match = self._match_in(points, wide)
            evaluations += match.evaluations
            is_refused = bool(self._match_gate.refusal(best.fitness))
            takes = self._match_gate.is_recovered if is_refused else self._match_gate.is_regained
            if takes(best.fitness, match.fitness):
                best = match
        return best, evaluations

    def _match_in(self, points: F64, window: Window) -> Match:
        match = self._matcher.match(points, self._field, window, self._rng)
        if self._parameters.certify and match.certificate is None:
            return certify(match, points, self._field, window, self._parameters.certificate)
        return match

    def _refuse(
        self, paired: PairedScan, predicted: Pose2, covariance: F64, match: Match, evaluations: int, reason: str
    ) -> Estimate:
        """The prediction stands; after too many refusals the pose is lost."""
        refusals = self._match_gate.refuse()
        p = self._parameters
        # The window for slip is taken for three standard deviations of a slip.
        covariance = covariance + np.diag((p.wide_window**2, p.wide_window**2, p.wide_window_angle**2)) / 9.0
        self._take(predicted, covariance, paired.T_odom_base)
        status = Status.REJECTED
        if refusals >= self._parameters.max_consecutive_rejections:
            self._lose()
            status, reason = Status.SEARCHING, f"lost: {reason}"
        covariance = self._reported(covariance)
        evidence = None if self._monitor is None else self._monitor.refused()
        return Estimate(
            paired.scan.stamp_ns, predicted, status, covariance, match.fitness, evaluations, reason, evidence=evidence
        )

    def _search(self, paired: PairedScan) -> Estimate:
        """Let the relocaliser see the scan; take its answer when it is sure."""
        scan, T_odom_base = paired.scan, paired.T_odom_base
        result = self._global_search.update(paired, self._count)
        pose = self._T_map_odom @ T_odom_base if result.pose is None else result.pose
        status = Status.SEARCHING
        if result.is_sure:
            self._searching = False
            self._match_gate.restart(result.fitness)
            if self._monitor is not None:
                self._monitor.begin()
            status = Status.RELOCALISED
        self._take(pose, self._covariance if result.covariance is None else result.covariance, T_odom_base)
        return Estimate(
            scan.stamp_ns,
            pose,
            status,
            result.covariance,
            result.fitness,
            result.evaluations,
            result.reason,
            self._revision(result),
            None if result.is_sure else result.state,
            None if self._monitor is None else result.evidence or Evidence(0.0),
            places=result.places,
        )

    def _revision(self, result: RelocaliserResult) -> tuple[tuple[int, Pose2], ...]:
        """The winner's way since the search began; its first pose holds back to that moment, if it goes back so far."""
        if not result.track or not result.track_is_whole:
            return result.track
        (_, first), *rest = result.track
        return ((self._search_began, first), *rest)

    def _take(self, pose: Pose2, covariance: F64, T_odom_base: Pose2) -> None:
        self._covariance = covariance
        self._anchor(pose, T_odom_base)

    def _anchor(self, T_map_base: Pose2, T_odom_base: Pose2) -> None:
        self._T_map_match = T_map_base
        self._T_odom_match = T_odom_base
        self._T_map_odom = T_map_base @ T_odom_base.inverse()
