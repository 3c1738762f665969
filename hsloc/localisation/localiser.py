"""The localiser: where a robot is on a known map, scan by scan.

Predict with odometry as in an EKF, match inside the window that the predicted covariance gives, test, update ([P] V).
While the pose is unknown the relocaliser decides.
"""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.fitness import fitness_many
from hsloc.localisation.contradicted_odometry import ContradictedOdometry
from hsloc.localisation.gates import MatchGate, MotionGate, RestGate
from hsloc.localisation.interpolated_odometry import AtStamp, motion_variances
from hsloc.localisation.kalman_filter import (
    Innovations,
    difference,
    fuse_match,
    innovation_weight,
    is_far,
    is_slip,
    predict_covariance,
)
from hsloc.localisation.map_scale import MapScale, MapScaleEstimator
from hsloc.localisation.odometry_scale import OdometryScale, OdometryScaleEstimator
from hsloc.localisation.place_check import PlaceCheck
from hsloc.localisation.relocaliser import Relocaliser
from hsloc.localisation.track_evidence import TrackMonitor
from hsloc.localisation.track_matcher import TrackMatcher
from hsloc.matching.covariance import match_information
from hsloc.matching.exact import heuristic
from hsloc.matching.window import Window
from hsloc.model.estimate import Estimate, Evidence, Revised, Status
from hsloc.model.events import HELD, Odometry, PairedScan
from hsloc.model.pose2 import IDENTITY, Pose2, rotated

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.localisation.global_search import GlobalSearch, RelocaliserResult
    from hsloc.localisation.motion_models import MotionModel
    from hsloc.localisation.parameters import LocaliserParameters
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Match, Matcher
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]


_MOVED_WINDOW = 2.0
"""Half-width of the window in which a robot that was moved is searched for, by the wide one: two scans at 2 m/s."""
_UNSURE = 2.0
"""Standard deviations by which a motion may be longer than interpolated odometry states, for the motion gate."""
_MOST_ASTRAY = 0.2
"""Share of beams that end behind walls or where nothing is mapped, at most, while people hide the map around a robot
that stands; noise of 2.5 % of the range makes 0.15 of them. Assumed."""


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
        self._matched_at = AtStamp()
        self._T_map_odom = IDENTITY
        self._T_map_match = IDENTITY if initial_pose is None else initial_pose
        self._covariance = np.diag(
            (parameters.initial_sigma**2, parameters.initial_sigma**2, parameters.initial_sigma_angle**2)
        )
        self._innovations = Innovations()
        self._odometry_scale = OdometryScaleEstimator()
        self._rest_gate = RestGate()
        self._motion_gate = MotionGate(parameters.update_min_d, parameters.update_min_a)
        self._match_gate = MatchGate(parameters.match_limits())
        self._searching = initial_pose is None
        self._contradicted = ContradictedOdometry(likelihood.sigma)
        self._track_matcher = TrackMatcher(likelihood, matcher, parameters, self._match_gate, self._contradicted, rng)

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

    @property
    def odometry_scale(self) -> OdometryScale | None:
        """By how much the odometry counts wrongly; None while too little is seen."""
        return self._odometry_scale.estimate()

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
        self._rest_gate.follow(odometry.T_odom_base)
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
        # The prediction does not get these variances: along corridors matches would then slide (28 % of one run wrong).
        interpolated = motion_variances(self._matched_at, AtStamp(scan.stamp_ns, paired.interpolation))
        unsure = _UNSURE * sqrt(interpolated[0]), _UNSURE * sqrt(interpolated[2])
        if not self._match_gate.is_fresh and not self._motion_gate.is_open(motion, unsure):
            if not self._is_moved(paired, predicted):
                return Estimate(scan.stamp_ns, predicted, Status.PREDICTED, reason="motion gate")
            self._covariance = self._covariance + self._parameters.slip_covariance(_MOVED_WINDOW)
        propagated = predict_covariance(self._covariance, self._T_map_match, motion, np.zeros((3, 3)))
        noise = rotated(self._motion_model.covariance(motion), self._T_map_match.theta)
        covariance = propagated + max(self._innovations.noise_scale, 1.0) * noise
        points = paired.points_base()
        self._odometry_scale.predict(self._T_map_match, motion)
        for each in (self._monitor, self._map_scale, self._contradicted):
            if each is not None:
                each.move(hypot(motion.x, motion.y))
        if len(points) < p.min_points:
            self._take(predicted, covariance, paired)
            reason = f"{len(points)} returns"
            evidence = None if self._monitor is None else self._monitor.skipped()
            covariance = self._reported(covariance)
            return Estimate(scan.stamp_ns, predicted, Status.NO_RETURNS, covariance, reason=reason, evidence=evidence)
        match, evaluations = self._track_matcher.match(points, T_odom_base, predicted, covariance)
        reason = self._match_gate.refusal(match.fitness)
        is_hidden = bool(reason) and self._is_hidden(paired, match)
        if reason and not is_hidden:
            return self._refuse(paired, predicted, covariance, match, evaluations, reason)
        is_usual = self._match_gate.fits_as_usual(match.fitness)
        information = match_information(points, self._field, match.pose, self._wall_variance())
        if p.fuse:
            off = difference(match.pose, predicted)
            if information is None:
                weight: F64 = np.asarray(np.linalg.inv(covariance + match.covariance), dtype=np.float64)
            else:
                information = self._match_gate.trust(match.fitness) * information
                weight = self._innovations.add(off, information, propagated, noise)
            self._odometry_scale.update(off, covariance, weight)
            may_slip = is_usual and is_far(off) and is_slip(off, weight)
            if self._contradicted.slipped(may_slip, T_odom_base, match.pose, points):
                covariance = covariance + np.outer(off, off)  # a mean of prediction and match would be neither
            pose, covariance = fuse_match(predicted, covariance, match, information)
        else:
            pose, covariance = match.pose, match.covariance
        if is_usual:
            self._contradicted.known(T_odom_base, pose, points)
        if is_hidden:
            self._match_gate.accept_hidden()
        else:
            self._match_gate.accept(match.fitness)
        self._rest_gate.matched(match.fitness)
        self._take(pose, covariance, paired)
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

    def _is_moved(self, paired: PairedScan, predicted: Pose2) -> bool:
        """Whether a scan shows that a robot moves whose odometry hardly does: pushed, carried, or with frozen wheels.

        It then fits elsewhere nearby, or nowhere, and beams end behind walls: those that people hide do not.
        """
        p, points = self._parameters, paired.points_base()
        if len(points) < p.min_points:
            return False
        found = fitness_many(self._field.packed, self._field.scale(points), self._field.to_cells(predicted)[None])
        fitness = float(found[0])
        if not self._rest_gate.is_open(fitness):
            return False
        half = _MOVED_WINDOW * p.wide_window
        window = Window(predicted, half, half, _MOVED_WINDOW * p.wide_window_angle)
        match = self._matcher.match(points, self._field, window, self._rng)
        if self._match_gate.is_elsewhere(fitness, match.fitness):
            off = difference(match.pose, predicted)
            information = match_information(points, self._field, match.pose, self._wall_variance())
            weight = None if information is None else innovation_weight(self._covariance, information)
            is_moved = is_far(off) and weight is not None and is_slip(off, weight)
        else:
            is_moved = bool(self._match_gate.refusal(match.fitness)) and self._is_astray(paired, match.pose)
        self._rest_gate.searched(is_moved)
        return is_moved

    def _is_astray(self, paired: PairedScan, pose: Pose2) -> bool:
        """Whether more beams end behind walls or where nothing is mapped than with people around the robot."""
        return self._monitor is not None and self._monitor.astray(paired, pose) > _MOST_ASTRAY

    def _wall_variance(self) -> float | None:
        """What the scans so far show of how walls are drawn (m^2)."""
        return None if self._map_scale is None else self._map_scale.wall_variance

    def _lose(self) -> None:
        """The pose is unknown from now on: search."""
        self._searching = True
        self._contradicted.lost()
        self._search_began = self._count
        self._global_search.start(None if self._monitor is None else self._monitor.usual_explained)

    def _reported(self, covariance: F64) -> F64:
        """A covariance with the scale of the innovations; never smaller than the filter's."""
        return self._innovations.excess * covariance

    def _refuse(
        self, paired: PairedScan, predicted: Pose2, covariance: F64, match: Match, evaluations: int, reason: str
    ) -> Estimate:
        """The prediction stands; after too many refusals the pose is lost."""
        refusals = self._match_gate.refuse()
        covariance = covariance + self._parameters.slip_covariance()
        self._take(predicted, covariance, paired)
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
            self._rest_gate.matched(result.fitness or 0.0)
            self._odometry_scale.restart()
            if self._monitor is not None:
                self._monitor.begin()
            status = Status.RELOCALISED
        self._take(pose, self._covariance if result.covariance is None else result.covariance, paired)
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

    def _revision(self, result: RelocaliserResult) -> tuple[Revised, ...]:
        """The winner's way since the search began; its first pose holds back to that moment, if it goes back so far."""
        if not result.track or not result.track_is_whole:
            return result.track
        return Revised(self._search_began, result.track[0].T_map_odom), *result.track

    def _take(self, pose: Pose2, covariance: F64, paired: PairedScan) -> None:
        self._covariance = covariance
        self._matched_at = AtStamp(paired.scan.stamp_ns, paired.interpolation)
        self._anchor(pose, paired.T_odom_base)

    def _anchor(self, T_map_base: Pose2, T_odom_base: Pose2) -> None:
        self._T_map_match = T_map_base
        self._T_odom_match = T_odom_base
        self._T_map_odom = T_map_base @ T_odom_base.inverse()
