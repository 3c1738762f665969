"""Parameters of the front end of the mapper."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import radians

from hsloc.localisation.motion_models import OdometryNoise
from hsloc.matching.hide import Hide
from hsloc.parameters import Angle, Count, NonNegative, Parameters, Positive, Ratio


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEndParameters(Parameters):
    """When a scan becomes a keyscan, what it is matched against and in which window."""

    keyscan_min_d: NonNegative = 0.1
    """Minimum translation between two keyscans [m]; a larger rotation alone makes a keyscan, too."""
    keyscan_min_a: NonNegative = 0.05
    """Minimum rotation between two keyscans [rad]; a larger translation alone makes a keyscan, too."""
    min_points: Count = 20
    """Minimum number of hits of a scan that is matched."""
    local_range: Positive = 30.0
    """Maximum range of the hits that the front end uses [m]."""
    resolution: Positive = 0.05
    """Distance of two nodes of the local likelihood field [m]."""
    sigma: Positive = 0.1
    """Decay length of a point's score with its distance from a wall of the local map [m]."""
    max_distance: Positive = 0.4
    """Distance from a wall of the local map beyond which a point scores zero [m]."""
    submap_length: Positive = 4.0
    """Path length after which a new local map begins [m]; it is matched against after the same length again."""
    turn_length: NonNegative = 0.3
    """Path length that a rotation of one radian counts as [m]."""
    window_sigmas: Positive = 3.0
    """Half-width of the search window in standard deviations of the prediction."""
    window_min: Positive = 0.1
    """Minimum half-width of the search window in x and y [m]."""
    window_min_angle: Angle = radians(4.0)
    """Minimum half-width of the search window in heading [rad]."""
    wide_window: Positive = 0.6
    """Half-width of the window that is searched after a refused registration [m]; the length of the step is added."""
    wide_window_angle: Angle = radians(90.0)
    """Half-width in heading of the window that is searched after a refused registration [rad]."""
    min_fitness: Ratio = 0.35
    """Minimum fitness of a match that contradicts the odometry."""
    min_fitness_ratio: Ratio = 0.9
    """Minimum ratio of the fitness of a match that contradicts the odometry to the usual fitness, a running mean."""
    restart_after: Count = 3
    """Number of refused matches in a row after which a new local map begins."""
    hide: Hide = field(default_factory=lambda: Hide(restarts=6, agreement=2, budget=200, memory_size=20))
    """Search of the window of the prediction."""
    hide_wide: Hide = field(default_factory=lambda: Hide(restarts=16, agreement=3, budget=400))
    """Search of the wide window."""
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)
    no_odometry_window: Positive = 0.6
    """Half-width of the window around the constant-velocity prediction where there is no odometry [m]."""
    no_odometry_window_angle: Angle = radians(45.0)
    """Half-width in heading of the window around the constant-velocity prediction [rad]."""
