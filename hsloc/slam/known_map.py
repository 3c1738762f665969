"""The solved map while the log is still read: what a scan is compared with where the robot has been before.

A scan that keyscans of the solved map explain needs no keyscan of its own: its pose is kept as seen from the nearest of
them (an anchor) and follows it when the map is solved again. So the map grows with the area that was seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, rotated
from hsloc.slam.keyscans import views
from hsloc.slam.scan_registration import MovingScan, register_onto

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans
    from hsloc.slam.scan_registration import ScanRegistration

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_PLACE_M = 0.5
"""Side [m] of the squares of which one keyscan for each heading is compared: as far apart as those before a scan."""
_METRES_OF_A_HALF_TURN = 4.0
"""Distance [m] between two keyscans of one place that face opposite ways, where the nearest are chosen."""
_REACH_M = 1.2
"""Distance [m] of the nearest keyscan beyond which a place is not known: two squares, or a turn of 35 deg."""
_CELL_M = 0.1
"""Side [m] of the cells that hits are looked up in: that of a hit or one of its eight neighbours is to have a hit."""
_ROW = 1 << 24
"""Cells in a row of the numbering of cells. Internal: more than any map has."""
_COMPARED = 5
"""Keyscans that a scan is compared with: as many as where it is compared with those before it."""
_SEEDS = 16
"""Keyscans that the front end goes on from where it leaves the map: as many as it keeps."""
_EXPLAINED = 0.9
"""Share of a scan's hits that the map is to explain: a person 2 m away covers 0.04 of a lidar's circle."""
_UNEXPLAINED = 2
"""Scans in a row that may show more: who walks past is not mapped."""
_SHORTEST_M = 4.0
"""Path length [m] over which keyscans are made once the map does not explain a scan: a submap, so that it is a place
with which loops can be closed."""
_LONGEST_M = 12.0
"""Path length [m] after which a return to the map is a loop: its closing is left to the loop closer."""


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where a scan is, seen from a keyscan: row `keyscan`, with the covariance (3, 3) in the keyscan's frame."""

    keyscan: int
    T_key_scan: Pose2
    covariance: F64


class KnownMap:
    """Keyscans at solved `poses` (n, 3)."""

    def __init__(self, scans: KeyScans, poses: F64, max_range: float) -> None:
        """Hits beyond `max_range` (m) are left out."""
        from scipy.spatial import cKDTree

        self._scans = scans
        self._poses = poses
        _, first = np.unique(views(poses, _PLACE_M), return_index=True)
        self._rows = np.sort(first)
        self._tree = cKDTree(_embedded(poses[self._rows]))
        self._cells = _cells_with_hits(scans, poses, max_range)
        self._moving: dict[int, MovingScan] = {}

    def near(self, pose: Pose2, most: int) -> list[int]:
        """Rows of the keyscans with the nearest views, the nearest first; none where the place is not known."""
        distances, found = self._tree.query(_embedded(pose.to_array()[None])[0], k=min(most, len(self._rows)))
        distances, found = np.atleast_1d(distances), np.atleast_1d(found)
        return [] if distances[0] > _REACH_M else [int(row) for row in self._rows[found]]

    def pose(self, row: int) -> Pose2:
        """The solved pose of a keyscan."""
        return Pose2.from_array(self._poses[row])

    def anchor(self, row: int, pose: Pose2, covariance: F64) -> Anchor:
        """A scan at `pose`, with `covariance` (3, 3) in the map, as seen from a keyscan."""
        at = self.pose(row)
        return Anchor(row, at.between(pose), rotated(covariance, -at.theta))

    def posed(self, row: int) -> tuple[F64, MovingScan]:
        """A keyscan and its solved pose (3,), for a scan to be registered onto."""
        if row not in self._moving:
            self._moving[row] = MovingScan.of(self._scans.prepared(row))
        return self._poses[row], self._moving[row]

    def explained(self, points: F64) -> float:
        """Share of points (n, 2) in the map (m) that lie where keyscans had hits; n at least 1."""
        wanted = _number(points)
        at = np.minimum(np.searchsorted(self._cells, wanted), len(self._cells) - 1)
        return float((self._cells[at] == wanted).mean())


class KnownMapTracker:
    """State: which keyscans the last scan was followed on, or since when keyscans are made again."""

    def __init__(self, known: KnownMap, path_length: float) -> None:
        self.map = known
        self._near: list[int] = []
        self._unexplained = 0
        self._left_at: float | None = path_length - _SHORTEST_M
        self._left_from: int | None = None

    @property
    def is_following(self) -> bool:
        """Whether the last scan was followed on the map."""
        return self._left_at is None

    def is_far(self, path_length: float) -> bool:
        """Whether the robot left the map so long ago that only a loop leads back, at a path length (m)."""
        return self._left_at is not None and path_length - self._left_at > _LONGEST_M

    def follow(
        self, path_length: float, scans: tuple[MovingScan, ...], points: F64, predicted: Pose2, covariance: F64
    ) -> ScanRegistration | None:
        """Where the map has a scan that it explains; None if it does not, and the scan is to be a keyscan.

        `points` (n, 2) are its hits in the base's frame. Odometry has it at `predicted`, with `covariance` (3, 3) in
        the map.
        """
        if self._left_at is not None and not _SHORTEST_M <= path_length - self._left_at <= _LONGEST_M:
            return None
        near = self.map.near(predicted, _COMPARED)
        if not near:
            return None
        found = register_onto([self.map.posed(row) for row in near], scans, predicted, predicted, covariance)
        if found.refusal() or found.is_doubtful():
            return None
        if self.map.explained(found.pose @ points) >= _EXPLAINED:
            self._unexplained = 0
        elif self._left_at is None and self._unexplained < _UNEXPLAINED:
            self._unexplained += 1
        else:
            return None
        self._near, self._left_at = near, None
        return found

    def leave(self, path_length: float, pose: Pose2) -> list[tuple[F64, MovingScan]]:
        """Keyscans are made from now on, at a path length (m); those of the map around `pose`, the nearest last."""
        self._left_at, self._left_from, self._unexplained = path_length, self._near[0], 0
        rows = self.map.near(pose, _SEEDS) or self._near
        return [self.map.posed(row) for row in reversed(rows)]

    def anchor(self, pose: Pose2, covariance: F64) -> Anchor:
        """The last scan that was followed, at `pose` with `covariance` (3, 3), seen from the keyscan nearest to it."""
        return self.map.anchor(self._near[0], pose, covariance)

    def tie(self, pose: Pose2, covariance: F64) -> Anchor | None:
        """The same of a new keyscan, if it is the first since the map was left."""
        row, self._left_from = self._left_from, None
        return None if row is None else self.map.anchor(row, pose, covariance)


def _embedded(poses: F64) -> F64:
    """Poses (n, 3) as points (n, 4) whose distance grows with that of the headings."""
    radius = 0.5 * _METRES_OF_A_HALF_TURN
    embedded: F64 = np.column_stack((poses[:, :2], radius * np.cos(poses[:, 2]), radius * np.sin(poses[:, 2])))
    return embedded


def _number(points: F64) -> I64:
    cells = np.floor(points / _CELL_M).astype(np.int64)
    numbers: I64 = cells[:, 0] * _ROW + cells[:, 1]
    return numbers


def _cells_with_hits(scans: KeyScans, poses: F64, max_range: float) -> I64:
    """Numbers of the cells that have a hit, and of their neighbours, ascending."""
    found = np.zeros(0, dtype=np.int64)
    parts: list[I64] = []
    for k in range(len(scans)):
        hits = scans.hits(k).astype(np.float64)
        near = hits[np.hypot(hits[:, 0], hits[:, 1]) < max_range]
        parts.append(np.unique(_number(Pose2.from_array(poses[k]) @ near)))
        if len(parts) == 500 or k == len(scans) - 1:
            found, parts = np.unique(np.concatenate((found, *parts))), []
    around = [found + dx * _ROW + dy for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    return np.unique(np.concatenate(around))
