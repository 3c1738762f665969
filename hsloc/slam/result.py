"""What mapping a log gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2
    from hsloc.slam.calibration import OdometryCalibration
    from hsloc.slam.evidence import Evidence
    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.map_state import MapState
    from hsloc.slam.pose_graph import PoseGraph

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MappingQuality:
    """How good a map is, as far as it can be told without the truth. NaN where nothing can be said.

    `residual_*` (m): distance of the scans' points to the nearest occupied cell of the final map. `scan_rms` (m):
    of points to the walls of other scans, robustly weighted. `conflict`: part of the points that lie where
    another scan looked through (people, doors, and wrong poses). `loop_*`: what the accepted loops measured against
    where the final map has it (m, deg).
    """

    residual_median: float
    residual_p95: float
    scan_rms: float
    conflict: float
    loops: int
    loops_refused: int
    loop_median: float
    loop_max: float
    loop_angle_median_deg: float
    loop_angle_max_deg: float
    keyscans: int
    passes: int
    moved: float
    """What 99 of 100 keyscans moved less than in the last round (m; rad: a fifth)."""

    def to_dict(self) -> dict[str, float | int | None]:
        """For JSON: NaN becomes None."""
        from dataclasses import asdict
        from math import isfinite

        return {name: value if isfinite(value) else None for name, value in asdict(self).items()}


@dataclass(frozen=True, slots=True, eq=False)
class MappingResult:
    """The map, and the whole trajectory as it is known at the end.

    `odometry_poses` (k, 3) and `scan_poses` (m, 3) are the base in the map at every odometry message and at every
    scan, in the order of the log. `revision` says the same as pairs (k, T_map_odom), each valid from the k-th odometry
    message (from 0) on; empty without odometry. `keyscan_poses` (n, 3) are the nodes of `graph`.
    """

    odometry_poses: F64
    scan_poses: F64
    revision: tuple[tuple[int, Pose2], ...]
    keyscan_stamps_ns: NDArray[np.int64]
    keyscan_poses: F64
    grid: OccupancyGrid
    graph: PoseGraph
    loops: tuple[Loop, ...]
    """All that were searched for, accepted or not."""
    quality: MappingQuality
    calibration: OdometryCalibration
    """What the map says of the odometry."""
    state: MapState | None
    """What is saved to go on from; None if no scan had a return."""
    evidence: Evidence
    """Whether the map is right, as far as what was recorded tells."""
