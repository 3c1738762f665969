"""Where the robot may be when its odometry is wrong: wheels slip, and encoders may count backwards as forwards."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy.spatial import cKDTree

    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

_GAIN = 0.05
"""Least gain in fitness, scan to scan, of another motion over that of the odometry: fitness at the right place scatters
by 0.02, so that two of them differ by as much once in thirteen times."""

_MOST_M = 1.5
"""Distance (m) up to which places within reach are searched for at once: windows of up to 3 m each way. Beyond it the
pose is soon lost, and the whole map is searched."""


class _Known(NamedTuple):
    """A match that was trusted: poses by odometry and on the map, and the scan in the frame of the base (n, 2)."""

    T_odom_base: Pose2
    T_map_base: Pose2
    points: F64


class ContradictedOdometry:
    """How far from a prediction the robot may be, and whether the scans alone say that it moved elsewhere.

    The odometry counts a distance, but it need not lead where it says: the robot is within that distance of the place
    where it was known last. On a map that has changed or that looks alike along a corridor a match elsewhere says
    little; that the two scans overlap better than under the odometry says that the wheels were wrong, whatever the map.
    """

    def __init__(self, sigma: float) -> None:
        """`sigma` is that of the fitness (m), as on the map."""
        self._sigma = sigma
        self._known: _Known | None = None
        self._tree: cKDTree | None = None
        self._way = 0.0
        self.is_slipping = False
        """Whether the wheels slipped before the last match: they may go on."""

    def move(self, way: float) -> None:
        """The odometry counted `way` (m) more."""
        self._way += way

    def known(self, T_odom_base: Pose2, T_map_base: Pose2, points: F64) -> None:
        """A match with points (n, 2) is trusted."""
        self._known, self._tree, self._way = _Known(T_odom_base, T_map_base, points), None, 0.0

    def lost(self) -> None:
        """The pose is unknown from now on."""
        self._known, self._way, self.is_slipping = None, 0.0, False

    def slipped(self, may_be: bool, T_odom_base: Pose2, T_map_base: Pose2, points: F64) -> bool:
        """Whether the wheels slipped before a match where they may have, by what the scans show."""
        self.is_slipping = may_be and self.is_seen(T_odom_base, T_map_base, points)
        return self.is_slipping

    def half_widths(self, predicted: Pose2) -> tuple[float, float]:
        """Half-widths (m) of the window around a prediction that has all places within reach; 0 if these are many."""
        if self._known is None or self._way > _MOST_M:
            return 0.0, 0.0
        at = self._known.T_map_base
        return abs(predicted.x - at.x) + self._way, abs(predicted.y - at.y) + self._way

    def is_seen(self, T_odom_base: Pose2, T_map_base: Pose2, points: F64) -> bool:
        """Whether a scan with points (m, 2) fits the last known one better from this place than by the odometry."""
        if self._known is None or len(self._known.points) == 0:
            return False
        tree = self._tree
        if tree is None:
            from scipy.spatial import cKDTree  # Here: it takes a fifth of a second, and few runs need it.

            tree = self._tree = cKDTree(self._known.points)

        def fitness(motion: Pose2) -> float:
            distance, _ = tree.query(motion @ points)
            return float(np.mean(np.exp(-distance / self._sigma)))

        by_odometry = self._known.T_odom_base.between(T_odom_base)
        return fitness(self._known.T_map_base.between(T_map_base)) >= fitness(by_odometry) + _GAIN
