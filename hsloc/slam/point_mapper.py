"""The SLAM of [P] V: a map of points, each scan matched against the points so far.

The first scan is the map. Each later scan is localised against it inside the box of the prediction; where its fitness
is at least 0.5, the points farther than a threshold from the map are added. A scan with too few points leaves the
prediction. A bad pose spoils the map for good, as [P] states itself; the graph mapper corrects poses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError
from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.matching.window import Window
from hsloc.model.estimate import Estimate, Status
from hsloc.model.events import HELD, Odometry, PairedScan
from hsloc.model.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.parameters import Angle, Count, Parameters, Positive, Ratio
from hsloc.slam.local_map import LocalMap

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.match import Matcher

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class PointMapperParameters(Parameters):
    """Parameters of the mapper of [P] at its own scale, a site of some 190 m by 170 m."""

    sigma: Positive = 1.0
    """Decay length of a point's score with its distance from the map [m]."""
    threshold: Positive = 1.5
    """Distance from the map beyond which a point is added to it [m]."""
    min_fitness: Ratio = 0.5
    """Minimum fitness of a scan whose points are added to the map."""
    min_points: Count = 3
    """Minimum number of hits of a scan that is matched; [P] asks for more than 2."""
    window_sigmas: Positive = 3.0
    """Half-width of the search window in standard deviations of the prediction."""
    window_min: Positive = 0.3
    """Minimum half-width of the search window in x and y [m]."""
    window_min_angle: Angle = 0.035
    """Minimum half-width of the search window in heading [rad]."""
    resolution: Positive = 0.25
    """Distance of two nodes of the likelihood field [m]."""
    max_distance: Positive = 6.0
    """Distance from the map beyond which a point scores zero [m]; [P] has no such limit, but exp(-6) is 0.002."""
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)

    def check_relations(self) -> None:
        """The field must reach as far as the threshold."""
        if self.max_distance < self.threshold:
            raise ConfigError(
                f"PointMapperParameters.max_distance is {self.max_distance}; it must be at least the threshold, "
                f"{self.threshold}"
            )


_START = np.diag((1e-6, 1e-6, 1e-8))
"""Covariance of the first pose (m^2, rad^2). Internal: the map begins there, so that it is known by definition."""


class PointMapper:
    """An `Estimator`. State: the map of points, and the pose with its covariance at the last scan."""

    def __init__(
        self, matcher: Matcher, parameters: PointMapperParameters, rng: Generator, initial_pose: Pose2 = IDENTITY
    ) -> None:
        self._matcher = matcher
        self._parameters = parameters
        self._rng = rng
        self._map = LocalMap(parameters.resolution, parameters.sigma, parameters.max_distance)
        self._points: list[F64] = []
        self._T_map_base = initial_pose
        self._T_odom_base: Pose2 | None = None
        self._covariance = _START

    @property
    def points(self) -> F64:
        """The map, shape (n, 2), metres, in the order in which the points were added."""
        return np.concatenate(self._points) if self._points else np.zeros((0, 2))

    def update(self, event: Odometry | PairedScan) -> Estimate:
        """Take an event; the estimate at its stamp."""
        motion = IDENTITY if self._T_odom_base is None else self._T_odom_base.between(event.T_odom_base)
        predicted = self._T_map_base @ motion
        if self._T_odom_base is None:
            self._T_odom_base = event.T_odom_base
        if isinstance(event, Odometry):
            return Estimate(event.stamp_ns, predicted, Status.PREDICTED)
        if event.is_held:
            return Estimate(event.scan.stamp_ns, predicted, Status.PREDICTED, reason=HELD)
        noise = self._parameters.odometry_noise.covariance(motion)
        covariance = predict_covariance(self._covariance, self._T_map_base, motion, noise)
        estimate = self._localise(event, predicted, covariance)
        self._T_map_base, self._T_odom_base = estimate.T_map_base, event.T_odom_base
        self._covariance = covariance if estimate.covariance is None else estimate.covariance
        return estimate

    def grid(self, resolution: float = 0.1) -> OccupancyGrid:
        """The points as occupied cells; all else is unknown, for points do not show what is free."""
        points = self.points
        if len(points) == 0:
            return OccupancyGrid(np.full((1, 1), UNKNOWN, dtype=np.int8), resolution)
        corner = np.floor(points.min(axis=0) / resolution) - 1.0
        cells = np.floor(points / resolution - corner).astype(np.int64)
        width, height = cells.max(axis=0) + 2
        values = np.full((int(height), int(width)), UNKNOWN, dtype=np.int8)
        values[cells[:, 1], cells[:, 0]] = OCCUPIED
        return OccupancyGrid(values, resolution, Pose2(float(corner[0]) * resolution, float(corner[1]) * resolution))

    def _localise(self, paired: PairedScan, predicted: Pose2, covariance: F64) -> Estimate:
        p = self._parameters
        stamp = paired.scan.stamp_ns
        points = paired.points_base()
        if len(points) < p.min_points:
            return Estimate(stamp, predicted, Status.NO_RETURNS, covariance, reason=f"{len(points)} returns")
        if not self._points:
            self._add(predicted @ points)
            return Estimate(stamp, predicted, Status.MATCHED, covariance, 1.0, reason="the first scan is the map")
        window = Window.from_covariance(predicted, covariance, p.window_sigmas, (p.window_min, p.window_min_angle))
        match = self._matcher.match(points, self._map.field, window, self._rng)
        reason = ""
        if match.fitness >= p.min_fitness:
            far = self._map.field.distances(points, match.pose) > p.threshold
            self._add(match.pose @ points[far])
        else:
            reason = f"fitness {match.fitness:.2f} below {p.min_fitness:.2f}: nothing added to the map"
        return Estimate(stamp, match.pose, Status.MATCHED, match.covariance, match.fitness, match.evaluations, reason)

    def _add(self, points: F64) -> None:
        if len(points):
            self._points.append(points)
            self._map.add(points, saturation_score=2.0)
