"""Parameters of the localiser, composed of those of its parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import radians
from typing import TYPE_CHECKING, Annotated

import numpy as np

from hsloc.localisation.gates import MatchLimits
from hsloc.localisation.motion_models import MOTION_MODELS, AckermannNoise, OdometryNoise, OmnidirectionalNoise
from hsloc.localisation.place_check import PlaceCheckParameters
from hsloc.localisation.relocaliser import RelocaliserParameters
from hsloc.matching.certificate import CertificateParameters
from hsloc.parameters import Angle, Count, NonNegative, OneOf, Parameters, Positive, Ratio

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel


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

    def slip_covariance(self, times: float = 1.0) -> NDArray[np.float64]:
        """What a slip adds to the covariance (3, 3): the window for it, `times` as wide, is 3 standard deviations."""
        half = np.array((self.wide_window, self.wide_window, self.wide_window_angle))
        return np.diag((times / 3.0 * half) ** 2)
