"""The scans of a run to be looked at: where each was taken, how far its points lie from the map, some with points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.events import Scan
    from hsloc.model.pose2 import Pose2

    Floats = NDArray[np.float64]

SHOWN_SCANS = 300
"""About this many scans, spread over the run, keep their points."""
SHOWN_NOT_MATCHED = 200
"""At most this many of the scans that were not matched keep them as well."""
SHOWN_POINTS = 120
"""Points of a scan that are kept, about."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanOverlay:
    """All n scans in the order of the log; of k of them the points."""

    stamps_ns: NDArray[np.int64]
    """Stamps (n,)."""
    poses: Floats
    """Pose of the base in the map (n, 3) at each."""
    far: Floats
    """Distance to the nearest wall of the map (n,) that nine of ten points stay below [m]; NaN without a point."""
    rows: NDArray[np.int64]
    """Rows (k,) of the scans with points."""
    points: tuple[Floats, ...]
    """Their points in the base frame, each (m, 2) [m]."""
    distances: tuple[Floats, ...]
    """Distance of each of these points to the nearest wall (m,) [m]."""


class ScanOverlayBuilder:
    """Collects a `ScanOverlay`; memory is bounded but for three numbers and a stamp for each scan."""

    def __init__(self, scans: int, not_matched_ns: NDArray[np.int64]) -> None:
        """`scans` is the number of scans to come, `not_matched_ns` the stamps of those that were not matched."""
        self._every = max(scans // SHOWN_SCANS, 1)
        step = max(-(-len(not_matched_ns) // SHOWN_NOT_MATCHED), 1)
        self._wanted = set(not_matched_ns[::step].tolist())
        self._stamps: list[int] = []
        self._poses: list[tuple[float, float, float]] = []
        self._far: list[float] = []
        self._rows: list[int] = []
        self._points: list[Floats] = []
        self._distances: list[Floats] = []

    def add(self, scan: Scan, T_map_base: Pose2, distance: NDArray[np.float32]) -> None:
        """A scan, the pose of the base at its stamp (maybe a guess), and the points' distances (n,) to the map [m]."""
        n = len(distance)
        if (len(self._stamps) % self._every == 0 or scan.stamp_ns in self._wanted) and n:
            step = max(n // SHOWN_POINTS, 1)
            self._rows.append(len(self._stamps))
            self._points.append(scan.points_base()[::step])
            self._distances.append(distance[::step].astype(np.float64))
        self._stamps.append(scan.stamp_ns)
        self._poses.append((T_map_base.x, T_map_base.y, T_map_base.theta))
        nine_of_ten = min(int(0.9 * n), n - 1)
        self._far.append(float(np.partition(distance, nine_of_ten)[nine_of_ten]) if n else float("nan"))

    def overlay(self) -> ScanOverlay:
        """What was collected."""
        return ScanOverlay(
            stamps_ns=np.array(self._stamps, dtype=np.int64),
            poses=np.array(self._poses, dtype=np.float64).reshape(-1, 3),
            far=np.array(self._far, dtype=np.float64),
            rows=np.array(self._rows, dtype=np.int64),
            points=tuple(self._points),
            distances=tuple(self._distances),
        )
