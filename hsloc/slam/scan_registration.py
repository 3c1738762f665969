"""Registering a scan onto the last keyscans, point to line, and what that says of its pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.point_to_line import ScanArrays
from hsloc.kernels.registration import Prior, RegistrationParameters, Scene, register
from hsloc.kernels.surfels import choose_hits
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.slam.keyscans import KeyScan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.events import PairedScan

    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    I64 = NDArray[np.int64]

_BACK = (1, 2, 4, 8, 16)
"""Which of the last keyscans are compared: a long base line against drift, few scans against cost."""
_CHOSEN = 90
"""Hits of a scan that are compared, about."""
_POINT_SIGMA = 0.02
"""Standard deviation [m] of a point from a wall."""
_ROOM = 8
"""Room for scans, as a multiple of those of one registration, until the older ones are forgotten. Internal: time."""
_CORRELATED = 20.0
"""Number of points that count as one: neighbouring beams share their errors."""
_GATES = (0.3, 0.2, 0.15)
_SCALE_OF_GATE = 0.33
_PRIOR_SCALE = 3.0
"""Scale of the Cauchy weight on the chi of the odometry: a step that the scans refute loses its weight."""
_ROUNDS = 8
_REGISTRATION = RegistrationParameters(
    _GATES, _SCALE_OF_GATE, 1.0 / (_POINT_SIGMA**2 * _CORRELATED), _PRIOR_SCALE, _ROUNDS
)
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
    prior: F64
    """Information (3, 3) of the odometry's pose, without a weight."""

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


def moving_scans(paired: PairedScan, points: F64 | None = None) -> tuple[MovingScan, ...]:
    """The scan and its companions, as seen from the base at the scan's stamp; `points` are those of `points_base`."""
    if not paired.companions:
        return (MovingScan.of(KeyScan.of(paired.scan, points)),)
    parts = ((paired.scan, IDENTITY), *((other.scan, paired.to(other)) for other in paired.companions))
    return tuple(MovingScan.of(KeyScan.of(scan), pose) for scan, pose in parts)


class RecentScans:
    """State: the keyscans since the local map began, newest last, with their poses in the front end's map."""

    def __init__(self) -> None:
        self._kept: list[list[tuple[F64, MovingScan]]] = []
        self._stored = StoredScans()

    def __len__(self) -> int:
        return len(self._kept)

    def clear(self) -> None:
        """Forget all."""
        self._kept = []

    def start_with(self, known: list[tuple[F64, MovingScan]]) -> None:
        """Forget all but scans of a map at their poses (3,), the nearest last."""
        self._kept = [[each] for each in known[-_BACK[-1] :]]

    def move(self, T_new_old: Pose2) -> None:
        """Move all into another frame."""
        self._kept = [
            [((T_new_old @ Pose2.from_array(pose)).to_array(), scan) for pose, scan in kept] for kept in self._kept
        ]

    def hits(self, max_range: float) -> list[F64]:
        """Hits (n, 2) of each scan within `max_range` metres of the base, in the front end's map."""
        found = []
        for kept in self._kept:
            for pose, scan in kept:
                points = scan.scan.points[np.hypot(scan.scan.points[:, 0], scan.scan.points[:, 1]) < max_range]
                found.append(Pose2.from_array(pose) @ points.astype(np.float64))
        return found

    def add(self, pose: Pose2, scans: tuple[MovingScan, ...]) -> None:
        """Keep a scan with its companions."""
        base = pose.to_array()
        self._kept = [*self._kept[-(_BACK[-1] - 1) :], [(_composed(base, scan.pose), scan) for scan in scans]]

    def register(
        self, scans: tuple[MovingScan, ...], start: Pose2, predicted: Pose2, covariance: F64
    ) -> ScanRegistration:
        """Register a scan with its companions from `start` on; odometry has it at `predicted`, `covariance` (3, 3)."""
        still = [each for back in _BACK if back <= len(self._kept) for each in self._kept[-back]]
        return register_onto(still, scans, start, predicted, covariance, self._stored)


class StoredScans:
    """State: scans one after the other in arrays, so that the same scans are not joined again for each registration."""

    def __init__(self) -> None:
        self._scans: list[MovingScan] = []
        self._row: dict[int, int] = {}
        self._arrays: ScanArrays | None = None

    def rows(self, scans: list[MovingScan]) -> tuple[ScanArrays, I64]:
        """Arrays that hold these scans, and perhaps others, and the row of each."""
        new = [scan for scan in scans if id(scan) not in self._row]
        arrays = self._arrays
        if arrays is None or (new and not self._has_room(arrays, new)):
            arrays = self._start_with(scans)
        else:
            for scan in new:
                self._append(arrays, scan)
        return arrays, np.array([self._row[id(scan)] for scan in scans], dtype=np.int64)

    def _has_room(self, arrays: ScanArrays, new: list[MovingScan]) -> bool:
        n = len(self._scans)
        return (
            n + len(new) < len(arrays.start)
            and arrays.start[n] + sum(len(scan.scan.points) for scan in new) <= len(arrays.points)
            and arrays.table_start[n] + sum(len(scan.scan.ranges) for scan in new) <= len(arrays.ranges)
            and arrays.chosen_start[n] + sum(len(scan.chosen) for scan in new) <= len(arrays.chosen_hits)
        )

    def _start_with(self, scans: list[MovingScan]) -> ScanArrays:
        """Forget all but these, with room for more."""
        count = _ROOM * len(scans)
        points, beams, chosen = (
            _ROOM * sum(lengths)
            for lengths in zip(*((len(s.scan.points), len(s.scan.ranges), len(s.chosen)) for s in scans), strict=True)
        )
        arrays = ScanArrays(
            np.empty((points, 2), dtype=np.float32),
            np.empty((points, 2), dtype=np.float32),
            np.empty((points, 2), dtype=np.float32),
            np.zeros(count + 1, dtype=np.int64),
            np.empty(beams, dtype=np.int32),
            np.empty(beams, dtype=np.float32),
            np.zeros(count + 1, dtype=np.int64),
            np.empty((count, 5)),
            np.empty(chosen, dtype=np.int32),
            np.zeros(count + 1, dtype=np.int64),
        )
        self._arrays, self._scans, self._row = arrays, [], {}
        for scan in scans:
            self._append(arrays, scan)
        return arrays

    def _append(self, arrays: ScanArrays, scan: MovingScan) -> None:
        n, prepared = len(self._scans), scan.scan
        hits = slice(arrays.start[n], arrays.start[n] + len(prepared.points))
        beams = slice(arrays.table_start[n], arrays.table_start[n] + len(prepared.ranges))
        chosen = slice(arrays.chosen_start[n], arrays.chosen_start[n] + len(scan.chosen))
        arrays.points[hits], arrays.normals[hits] = prepared.points, prepared.normals
        arrays.centroids[hits] = prepared.centroids
        arrays.hit_of_beam[beams], arrays.ranges[beams] = prepared.hit_of_beam, prepared.ranges
        arrays.geometry[n], arrays.chosen_hits[chosen] = prepared.geometry, scan.chosen
        for start, part in ((arrays.start, hits), (arrays.table_start, beams), (arrays.chosen_start, chosen)):
            start[n + 1] = part.stop
        # The scan is kept as long as its number counts: another object could get it.
        self._scans.append(scan)
        self._row[id(scan)] = n


def register_onto(
    still: list[tuple[F64, MovingScan]],
    scans: tuple[MovingScan, ...],
    start: Pose2,
    predicted: Pose2,
    covariance: F64,
    stored: StoredScans | None = None,
) -> ScanRegistration:
    """Register a scan with its companions onto scans that stay at their poses (3,), from `start` on.

    Odometry has it at `predicted`, with `covariance` (3, 3) in the map. What is `stored` is not prepared again.
    """
    poses = np.array([pose for pose, _ in still] + [scan.pose for scan in scans])
    arrays, rows = (StoredScans() if stored is None else stored).rows([*(scan for _, scan in still), *scans])
    pose, information, counts = start.to_array(), np.zeros((3, 3)), np.zeros(5)
    prior = Prior(predicted.to_array(), np.asarray(np.linalg.inv(covariance), dtype=np.float64))
    chi = register(pose, Scene(len(still), poses, rows, arrays), prior, _REGISTRATION, information, counts)
    seen = max(float(counts[2]), 1.0)
    return ScanRegistration(
        Pose2.from_array(pose),
        information,
        float(counts[0]) / seen,
        float(counts[1]) / seen,
        int(counts[2]),
        float(chi),
        prior.information,
    )


def fused_covariance(found: ScanRegistration) -> F64:
    """Covariance (3, 3) of a registered pose: the pairs, and the odometry with the weight that its chi leaves it."""
    weight = _PRIOR_SCALE**2 / (_PRIOR_SCALE**2 + found.chi**2)
    fused: F64 = np.asarray(np.linalg.inv(found.information + weight * found.prior), dtype=np.float64)
    return 0.5 * (fused + fused.T)


def _composed(pose: F64, scan_pose: F64) -> F64:
    if not scan_pose.any():
        return pose
    return (Pose2.from_array(pose) @ Pose2.from_array(scan_pose)).to_array()
