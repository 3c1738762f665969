"""Keyscans: what the mapper keeps of a scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.point_to_line import ScanArrays
from hsloc.kernels.surfels import choose_hits, fit_surfels, list_beams
from hsloc.model.events import Scan
from hsloc.model.pose2 import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    I64 = NDArray[np.int64]

_SURFEL_RADIUS = 0.2
"""Distance (m) of the hits to which a line is fitted. Internal: the size of the smallest walls, door frames."""
_HEADINGS = 8
"""Sectors of heading that count as different views. Internal: the `max_partners` of a keyscan is what is to be set."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyScan:
    """A scan prepared: its hits with surfels, and its beams for looking up (hsloc/kernels/point_to_line.py)."""

    points: F32
    normals: F32
    centroids: F32
    hit_of_beam: I32
    ranges: F32
    geometry: F64

    @staticmethod
    def of(scan: Scan, points: F64 | None = None) -> KeyScan:
        """Prepare a scan; hits are those of `Scan.hits`, at `points` (n, 2), if that is known."""
        n = len(scan.ranges)
        beams, hit_of_beam = np.empty((2, n), dtype=np.int32)
        ranges = np.empty(n, dtype=np.float32)
        limits = np.array((scan.range_min, scan.range_max)).astype(np.float32)
        count = list_beams(scan.ranges, limits, beams, hit_of_beam, ranges)
        points = scan.points_base() if points is None else points
        laser = scan.T_base_laser
        geometry = np.array((laser.x, laser.y, laser.theta, scan.angle_min, scan.angle_increment))
        return _fitted(np.ascontiguousarray(points, dtype=np.float32), beams[:count], hit_of_beam, ranges, geometry)

    @staticmethod
    def fitted(points: F32, hit_of_beam: I32, ranges: F32, geometry: F64) -> KeyScan:
        """A scan of which all is known but its surfels."""
        return _fitted(points, np.flatnonzero(hit_of_beam >= 0).astype(np.int32), hit_of_beam, ranges, geometry)


def _fitted(points: F32, beams: I32, hit_of_beam: I32, ranges: F32, geometry: F64) -> KeyScan:
    normals, centroids = np.empty_like(points), np.empty_like(points)
    fit_surfels(points, beams, abs(float(geometry[4])), _SURFEL_RADIUS, normals, centroids, geometry[:2])
    return KeyScan(points, normals, centroids, hit_of_beam, ranges, geometry)


@dataclass(frozen=True, slots=True, eq=False)
class KeyScans:
    """All keyscans of a log, one after the other."""

    points: F32
    normals: F32
    centroids: F32
    start: I64
    hit_of_beam: I32
    ranges: F32
    table_start: I64
    geometry: F64

    @staticmethod
    def from_scans(scans: list[KeyScan]) -> KeyScans:
        """Of at least one scan."""
        return KeyScans(
            np.concatenate([scan.points for scan in scans]),
            np.concatenate([scan.normals for scan in scans]),
            np.concatenate([scan.centroids for scan in scans]),
            starts_of([len(scan.points) for scan in scans]),
            np.concatenate([scan.hit_of_beam for scan in scans]),
            np.concatenate([scan.ranges for scan in scans]),
            starts_of([len(scan.ranges) for scan in scans]),
            np.array([scan.geometry for scan in scans]),
        )

    @staticmethod
    def fitted(points: F32, start: I64, hit_of_beam: I32, ranges: F32, table_start: I64, geometry: F64) -> KeyScans:
        """Scans of which all is known but their surfels, at least one."""
        scans = []
        for k in range(len(start) - 1):
            hits, beams = slice(start[k], start[k + 1]), slice(table_start[k], table_start[k + 1])
            scans.append(KeyScan.fitted(points[hits], hit_of_beam[beams], ranges[beams], geometry[k]))
        return KeyScans.from_scans(scans)

    @staticmethod
    def concatenate(first: KeyScans, second: KeyScans) -> KeyScans:
        """Those of two logs."""
        return KeyScans(
            np.concatenate((first.points, second.points)),
            np.concatenate((first.normals, second.normals)),
            np.concatenate((first.centroids, second.centroids)),
            np.concatenate((first.start, first.start[-1] + second.start[1:])),
            np.concatenate((first.hit_of_beam, second.hit_of_beam)),
            np.concatenate((first.ranges, second.ranges)),
            np.concatenate((first.table_start, first.table_start[-1] + second.table_start[1:])),
            np.concatenate((first.geometry, second.geometry)),
        )

    def __len__(self) -> int:
        return len(self.start) - 1

    def prepared(self, index: int) -> KeyScan:
        """One of them by itself; its arrays are views."""
        hits = slice(self.start[index], self.start[index + 1])
        beams = slice(self.table_start[index], self.table_start[index + 1])
        return KeyScan(
            self.points[hits], self.normals[hits], self.centroids[hits], self.hit_of_beam[beams], self.ranges[beams],
            self.geometry[index],
        )  # fmt: skip

    def scan(self, index: int) -> Scan:
        """The scan again, its hits where its beams ended; stamp, limits and corrections for motion are not kept."""
        x, y, theta, angle_min, increment = (float(value) for value in self.geometry[index])
        ranges = self.ranges[self.table_start[index] : self.table_start[index + 1]]
        return Scan(0, ranges, angle_min, increment, 0.0, float("inf"), T_base_laser=Pose2(x, y, theta))

    def hits(self, index: int) -> F32:
        """Hits of a scan in the base's frame, shape (n, 2)."""
        return self.points[self.start[index] : self.start[index + 1]]

    def arrays(self, most: int) -> ScanArrays:
        """All of it for the kernels, with about `most` chosen hits of each scan."""
        return ScanArrays(
            self.points, self.normals, self.centroids, self.start, self.hit_of_beam, self.ranges, self.table_start,
            self.geometry, *self.chosen(most),
        )  # fmt: skip

    def chosen(self, most: int) -> tuple[I32, I64]:
        """About `most` hits of each scan, evenly by the directions of their walls (`choose_hits`).

        Returns the rows within each scan, one scan after the other, and where each begins, shape (n + 1,).
        """
        row = np.empty(int(np.diff(self.start).max(initial=0)), dtype=np.int32)
        parts = []
        for k in range(len(self)):
            count = choose_hits(self.normals[self.start[k] : self.start[k + 1]], most, row)
            parts.append(row[:count].copy())
        return np.concatenate(parts), starts_of([len(part) for part in parts])


def starts_of(lengths: list[int]) -> I64:
    """Where each of n parts begins if they are stored one after the other, and the end of the last, shape (n + 1,)."""
    return np.concatenate(([0], np.cumsum(lengths))).astype(np.int64)


def views(poses: F64, side: float) -> I64:
    """A number (n,) for the square of `side` metres and the sector of heading of each pose (n, 3)."""
    sector = np.floor(poses[:, 2] / (2.0 * np.pi) * _HEADINGS).astype(np.int64) % _HEADINGS
    cell = np.floor(poses[:, :2] / side).astype(np.int64)
    return np.asarray((cell[:, 0] * 1000003 + cell[:, 1]) * _HEADINGS + sector)
