"""What mapping a log gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.dataclass_json import Measured

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.slam.calibration import OdometryCalibration
    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.map_state import MapState
    from hsloc.slam.plan_alignment import PlanFit
    from hsloc.slam.pose_graph import PoseGraph
    from hsloc.slam.verdict import Evidence

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MappingQuality:
    """Consistency of a map, measured without the truth; NaN (null in JSON) where it cannot be measured."""

    residual_median: Measured
    """Median distance from scan points to the nearest occupied cell of the map [m]."""
    residual_p95: Measured
    """Distance to the nearest occupied cell that 95 of 100 scan points stay below [m]."""
    scan_rms: Measured
    """Root mean square distance from points to the walls of other scans, robustly weighted [m]."""
    conflict: Measured
    """Fraction of the points that lie where another scan looked through, from 0 to 1."""
    loops: int
    """Number of loops that were closed."""
    loops_refused: int
    """Number of loop candidates that were rejected."""
    loop_median: Measured
    """Median distance between a loop's measurement and the final map [m]."""
    loop_max: Measured
    """Largest distance between a loop's measurement and the final map [m]."""
    loop_angle_median_deg: Measured
    """Median angle between a loop's measurement and the final map [deg]."""
    loop_angle_max_deg: Measured
    """Largest angle between a loop's measurement and the final map [deg]."""
    sigma_median: Measured
    """Median standard deviation of a keyscan's position relative to the first one [m]."""
    sigma_max: Measured
    """Largest standard deviation of a keyscan's position relative to the first one [m]."""
    sigma_angle_max_deg: Measured
    """Largest standard deviation of a keyscan's heading relative to the first one [deg]."""
    keyscans: int
    """Number of scans that the map was built from."""
    followed: int
    """Number of scans that were localised on the map so far, which explains them, and added nothing to it."""
    passes: int
    """Number of rounds of the joint registration."""
    moved: Measured
    """Distance that 99 of 100 keyscans moved less than in the last round [m; a rad counts as 5 m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryErrors:
    """Systematic errors of the odometry by the scans: what was added to it, and how well that is known."""

    translation: float
    """Part of each translation that was added [m/m]."""
    translation_sigma: float
    """Its standard deviation [m/m]."""
    rotation: float
    """Part of each rotation that was added [rad/rad]."""
    rotation_sigma: float
    """Its standard deviation [rad/rad]."""
    drift: float
    """Rotation that was added for each metre [rad/m]."""
    drift_sigma: float
    """Its standard deviation [rad/m]."""


@dataclass(frozen=True, slots=True, eq=False)
class MappingResult:
    """The map, and the whole trajectory as it is known at the end.

    `odometry_poses` (k, 3) and `scan_poses` (m, 3) are the base in the map at every odometry message and at every
    scan, in the order of the log. `keyscan_poses` (n, 3) are the nodes of `graph`.

    Covariances (…, 3, 3) are over (x, y, theta) in the map frame (m^2, m rad, rad^2), relative to the first keyscan's
    pose: marginals of the solved graph at the keyscans (`hsloc.slam.marginals`), interpolated at scans and odometry.
    """

    odometry_poses: F64
    scan_poses: F64
    keyscan_stamps_ns: NDArray[np.int64]
    keyscan_poses: F64
    keyscan_covariances: F64
    odometry_covariances: F64
    scan_covariances: F64
    grid: OccupancyGrid
    graph: PoseGraph
    loops: tuple[Loop, ...]
    """All that were searched for, accepted or not: pairs of submaps."""
    submap_references: NDArray[np.int64]
    """Row of `keyscan_poses` that is the frame of each submap, shape (m,)."""
    quality: MappingQuality
    calibration: OdometryCalibration
    """What the map says of the odometry."""
    state: MapState | None
    """What is saved to go on from; None if no scan had a return."""
    evidence: Evidence
    """Whether the map is right, as far as what was recorded shows."""
    odometry_errors: OdometryErrors | None = None
    """Systematic errors of the odometry that were taken out; None where the drive was too short to show any."""
    plan: PlanFit | None = None
    """Where the map lies on the floor plan that was given."""

    def loop_ends(self) -> NDArray[np.int64]:
        """Rows of `keyscan_poses` (k, 2) that the k loops join, accepted or not: the frames of their submaps."""
        pairs = [(loop.first, loop.second) for loop in self.loops]
        return self.submap_references[np.array(pairs, dtype=np.int64).reshape(-1, 2)]
