"""Keyscans: what the mapper keeps of a scan, the last ones of the front end, and registering a new scan onto them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.point_to_line import ScanArrays, choose_hits, fit_surfels
from hsloc.kernels.registration import Prior, RegistrationParameters, Scene, register
from hsloc.model.events import Scan
from hsloc.model.pose2 import IDENTITY, Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.events import PairedScan

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    I64 = NDArray[np.int64]

_SURFEL_RADIUS = 0.2
"""Distance (m) of the hits to which a line is fitted. Internal: the size of the smallest walls, door frames."""
_HEADINGS = 8
"""Sectors of heading that count as different views. Internal: the `max_partners` of a keyscan is what is to be set."""

_BACK = (1, 2, 4, 8, 16)
"""Which of the last keyscans are compared: a long base line against drift, few scans against cost."""
_CHOSEN = 90
"""Hits of a scan that are compared, about."""
_POINT_SIGMA = 0.02
"""Standard deviation [m] of a point from a wall."""
_CORRELATED = 20.0
"""Number of points that count as one: neighbouring beams share their errors."""
_GATES = (0.3, 0.2, 0.15)
_SCALE_OF_GATE = 0.33
_PRIOR_SCALE = 3.0
"""Scale of the Cauchy weight on the chi of the odometry: a step that the scans refute loses its weight."""
_ROUNDS = 8
SURPRISE = 3.0
"""Chi of a step against the odometry above which the two contradict each other."""
_FEWEST_PAIRED = 30.0
"""Paired points, of all scans compared and in both directions, without which nothing is known."""
_LEAST_PAIRED = 0.05
"""And the part of the points that both sides could see."""
_CONSISTENT = 0.75
"""Consistency without which a pose is refused: of 20,000 steps of five real logs and their degradations the right ones
have 0.82 and more (5th percentile, log by log), wrong ones that do not slide along a corridor a median of 0 to 0.46."""
_SURELY_CONSISTENT = 0.85
"""Below it a pose is doubtful."""


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
    def of(scan: Scan) -> KeyScan:
        """Prepare a scan; hits are those of `Scan.hits`."""
        hits = scan.hits()
        points = np.ascontiguousarray(scan.points_base(), dtype=np.float32)
        beams = np.flatnonzero(hits).astype(np.int32)
        hit_of_beam = np.full(len(scan.ranges), -1, dtype=np.int32)
        hit_of_beam[beams] = np.arange(len(beams), dtype=np.int32)
        ranges = np.where(hits | scan.no_returns(), scan.ranges, np.nan).astype(np.float32)
        laser = scan.T_base_laser
        geometry = np.array((laser.x, laser.y, laser.theta, scan.angle_min, scan.angle_increment))
        return KeyScan.fitted(points, hit_of_beam, ranges, geometry)

    @staticmethod
    def fitted(points: F32, hit_of_beam: I32, ranges: F32, geometry: F64) -> KeyScan:
        """A scan of which all is known but its surfels."""
        beams = np.flatnonzero(hit_of_beam >= 0).astype(np.int32)
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


@dataclass(frozen=True, slots=True, eq=False)
class MovingScan:
    """A keyscan with the hits that are compared, at `pose` as seen from the base (of a companion, otherwise zero)."""

    scan: KeyScan
    chosen: I32
    pose: F64

    @staticmethod
    def of(scan: KeyScan, T_base_scan: Pose2 = IDENTITY) -> MovingScan:
        """Choose the hits of a scan, evenly by the directions of their walls."""
        row = np.empty(len(scan.points), dtype=np.int32)
        count = choose_hits(scan.normals, _CHOSEN, row)
        return MovingScan(scan, row[:count].copy(), T_base_scan.to_array())


@dataclass(frozen=True, slots=True, eq=False)
class ScanRegistration:
    """Where a scan was registered.

    `information` (3, 3) is that of the pairs alone, in the map. `paired` and `conflict` are parts of the points that
    both sides could see: on walls of the other side, and where the other side looked through. `chi` is that of the pose
    against the odometry.
    """

    pose: Pose2
    information: F64
    paired: float
    conflict: float
    seen: int
    chi: float

    @property
    def consistency(self) -> float:
        """Of the points that are paired or in conflict the part that is paired; 0 where there are none."""
        return self.paired / (self.paired + self.conflict) if self.paired > 0.0 else 0.0

    @property
    def agreement(self) -> float:
        """Paired points less those in conflict, a part of the points that both sides could see."""
        return self.paired - self.conflict

    def observed(self, direction: F64) -> float:
        """Information along a direction (2,) in the map, as a part of that along the best one; theta is left free."""
        h = self.information
        across = h[:2, :2] - np.outer(h[:2, 2], h[2, :2]) / max(h[2, 2], 1e-9)
        best = float(np.linalg.eigvalsh(across)[-1])
        unit = direction / max(float(np.hypot(*direction)), 1e-9)
        return float(unit @ across @ unit) / best if best > 0.0 else 0.0

    def refusal(self) -> str:
        """Why the pose is not believed; empty if it is."""
        if self.paired * self.seen < _FEWEST_PAIRED or self.paired < _LEAST_PAIRED:
            return f"only {self.paired * self.seen:.0f} of {self.seen} points lie on walls of the scans before"
        if self.consistency < _CONSISTENT:
            return f"{100.0 * self.conflict:.0f} % of the points lie where the scans before saw free space"
        return ""

    def is_contradicted(self) -> bool:
        """Whether the scans speak against the pose, rather than not at all."""
        return self.conflict * self.seen >= _FEWEST_PAIRED and self.consistency < _CONSISTENT

    def is_doubtful(self) -> bool:
        """Whether the pose may be wrong: it contradicts the odometry, or walls are looked through."""
        return self.chi > SURPRISE or self.consistency < _SURELY_CONSISTENT


def moving_scans(paired: PairedScan) -> tuple[MovingScan, ...]:
    """The scan and its companions, as seen from the base at the scan's stamp."""
    parts = ((paired.scan, IDENTITY), *((other.scan, paired.to(other)) for other in paired.companions))
    return tuple(MovingScan.of(KeyScan.of(scan), pose) for scan, pose in parts)


class RecentScans:
    """State: the keyscans since the local map began, newest last, with their poses in the front end's map."""

    def __init__(self) -> None:
        self._kept: list[tuple[F64, tuple[MovingScan, ...]]] = []

    def __len__(self) -> int:
        return len(self._kept)

    def clear(self) -> None:
        """Forget all."""
        self._kept = []

    def start_with(self, known: list[tuple[F64, MovingScan]]) -> None:
        """Forget all but scans of a map at their poses (3,), the nearest last."""
        self._kept = [(pose, (scan,)) for pose, scan in known[-_BACK[-1] :]]

    def move(self, T_new_old: Pose2) -> None:
        """Move all into another frame."""
        self._kept = [((T_new_old @ Pose2.from_array(pose)).to_array(), scans) for pose, scans in self._kept]

    def hits(self, max_range: float) -> list[F64]:
        """Hits (n, 2) of each scan within `max_range` metres of the base, in the front end's map."""
        found = []
        for pose, scans in self._kept:
            for scan in scans:
                points = scan.scan.points[np.hypot(scan.scan.points[:, 0], scan.scan.points[:, 1]) < max_range]
                found.append(Pose2.from_array(_composed(pose, scan.pose)) @ points.astype(np.float64))
        return found

    def add(self, pose: Pose2, scans: tuple[MovingScan, ...]) -> None:
        """Keep a scan with its companions."""
        self._kept = [*self._kept[-(_BACK[-1] - 1) :], (pose.to_array(), scans)]

    def register(
        self, scans: tuple[MovingScan, ...], start: Pose2, predicted: Pose2, covariance: F64
    ) -> ScanRegistration:
        """Register a scan with its companions from `start` on; odometry has it at `predicted`, `covariance` (3, 3)."""
        fixed = [self._kept[-back] for back in _BACK if back <= len(self._kept)]
        still = [(_composed(pose, scan.pose), scan) for pose, kept in fixed for scan in kept]
        return register_onto(still, scans, start, predicted, covariance)


def register_onto(
    still: list[tuple[F64, MovingScan]],
    scans: tuple[MovingScan, ...],
    start: Pose2,
    predicted: Pose2,
    covariance: F64,
) -> ScanRegistration:
    """Register a scan with its companions onto scans that stay at their poses (3,), from `start` on.

    Odometry has it at `predicted`, with `covariance` (3, 3) in the map.
    """
    poses = np.array([pose for pose, _ in still] + [scan.pose for scan in scans])
    arrays = _arrays([*(scan for _, scan in still), *scans])
    parameters = RegistrationParameters(
        _GATES, _SCALE_OF_GATE, 1.0 / (_POINT_SIGMA**2 * _CORRELATED), _PRIOR_SCALE, _ROUNDS
    )
    pose, information, counts = start.to_array(), np.zeros((3, 3)), np.zeros(5)
    prior = Prior(predicted.to_array(), np.asarray(np.linalg.inv(covariance), dtype=np.float64))
    chi = register(pose, Scene(len(still), poses, arrays), prior, parameters, information, counts)
    seen = max(float(counts[2]), 1.0)
    return ScanRegistration(
        Pose2.from_array(pose),
        information,
        float(counts[0]) / seen,
        float(counts[1]) / seen,
        int(counts[2]),
        float(chi),
    )


def fused_covariance(found: ScanRegistration, covariance: F64) -> F64:
    """Covariance (3, 3) of a registered pose: the pairs, and the odometry with the weight that its chi leaves it."""
    weight = _PRIOR_SCALE**2 / (_PRIOR_SCALE**2 + found.chi**2)
    fused: F64 = np.linalg.inv(found.information + weight * np.linalg.inv(covariance))
    return 0.5 * (fused + fused.T)


def _composed(pose: F64, scan_pose: F64) -> F64:
    if not scan_pose.any():
        return pose
    return (Pose2.from_array(pose) @ Pose2.from_array(scan_pose)).to_array()


def _arrays(scans: list[MovingScan]) -> ScanArrays:
    return ScanArrays(
        np.concatenate([scan.scan.points for scan in scans]),
        np.concatenate([scan.scan.normals for scan in scans]),
        np.concatenate([scan.scan.centroids for scan in scans]),
        starts_of([len(scan.scan.points) for scan in scans]),
        np.concatenate([scan.scan.hit_of_beam for scan in scans]),
        np.concatenate([scan.scan.ranges for scan in scans]),
        starts_of([len(scan.scan.ranges) for scan in scans]),
        np.array([scan.scan.geometry for scan in scans]),
        np.concatenate([scan.chosen for scan in scans]),
        starts_of([len(scan.chosen) for scan in scans]),
    )
