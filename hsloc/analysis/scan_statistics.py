"""The scans of a finished run: fit to the map, mounting of each laser, convergence of the search, scans to be shown.

Each class takes the scans whose pose is known, one by one with their poses, in bounded memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, degrees, hypot, radians, sin
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.beams import count_seen, look_up
from hsloc.matching.harmony_search import HarmonySearch
from hsloc.matching.likelihood_field import distances_to_walls
from hsloc.matching.window import Window
from hsloc.model.pose2 import Pose2
from hsloc.run_metrics import LaserResiduals, ResidualMetrics
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Matcher
    from hsloc.model.events import Scan
    from hsloc.model.occupancy_grid import OccupancyGrid

    Floats = NDArray[np.float64]

_BIN_M = 0.005
_MAX_DISTANCE_M = 5.0
_BINS = int(_MAX_DISTANCE_M / _BIN_M) + 1
_COUNTED_AT_ONCE = 100
"""Scans whose points are counted together: one by one most of the time goes into the calls."""
NEAR_WALL_M = 0.15
"""A point within this distance of an occupied cell is explained by the map."""
_MISFIT_RATIO = 0.8
"""A laser with less than this part of the best laser's explained points has another mounting, or is broken."""

MIN_POINTS = 30
"""A scan with fewer points is not matched here: its pose is not determined."""
CHECKED_SCANS = 60
"""Scans of each laser that are matched alone to check its mounting."""
_MIN_CHECKED_SCANS = 10
_CHECK_HALF_M, _CHECK_HALF_RAD = 0.6, radians(20.0)
_CHECK_MIN_FITNESS = 0.5
MOUNTING_ERROR_M, MOUNTING_ERROR_RAD = 0.1, radians(2.0)
"""Smaller errors of a mounting are not reported."""
_MIN_SIGMAS = 4.0
"""Errors of a mounting are reported from this multiple of their standard error on."""

CONVERGENCE_SCANS = 25
CONVERGENCE_HALF_M, CONVERGENCE_HALF_RAD = 0.5, radians(20.0)
"""Half-widths of the window: that of a search after a rejected match."""

SHOWN_SCANS = 300
"""About this many scans, spread over the run, keep their points."""
SHOWN_NOT_MATCHED = 200
"""At most this many of the scans that were not matched keep them as well."""
SHOWN_POINTS = 120
"""Points of a scan that are kept, about."""

COVERAGE_CELL_M, COVERAGE_CELLS = 0.25, 256
"""Least side of a cell in which scans are counted: narrower than a door; and cells along the map, at most."""


class Residuals:
    """Distances to the nearest occupied cell, counted in bins of 5 mm, so that memory does not grow."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self._grid = grid
        self._distance = np.empty(grid.cells.shape, dtype=np.float32)
        for row, distance in distances_to_walls(grid.occupied()):
            self._distance[row : row + len(distance)] = distance * grid.resolution
        self._T_grid_map = grid.origin.inverse()
        self._by_laser: dict[str, NDArray[np.int64]] = {}
        self._waiting: dict[str, list[NDArray[np.float32]]] = {}

    def distances(self, points: Floats, T_map_base: Pose2) -> NDArray[np.float32]:
        """Distance of each of a scan's points (n, 2) to the nearest occupied cell [m]; beyond the map, the largest."""
        pose = (self._T_grid_map @ T_map_base).to_array()
        distance = np.empty(len(points), dtype=np.float32)
        look_up(self._distance, points, pose, self._grid.resolution, _MAX_DISTANCE_M, distance)
        return distance

    def add(self, scan: Scan, distance: NDArray[np.float32]) -> None:
        """Count the points of a scan with their `distances` (n,); those outside the map count as far from any wall."""
        waiting = self._waiting.setdefault(scan.frame_id, [])
        waiting.append(distance)
        if len(waiting) >= _COUNTED_AT_ONCE:
            self._count()

    def _count(self) -> None:
        for frame, distances in self._waiting.items():
            bins = np.minimum(np.concatenate(distances) / _BIN_M, _BINS - 1).astype(np.int64)
            counts = self._by_laser.setdefault(frame, np.zeros(_BINS, dtype=np.int64))
            counts += np.bincount(bins, minlength=_BINS)
        self._waiting = {}

    def metrics(self) -> ResidualMetrics:
        """The figures over all lasers; where there are several, also those of each."""
        self._count()
        whole = _figures(sum(self._by_laser.values(), np.zeros(_BINS, dtype=np.int64)))
        by_laser = None
        if len(self._by_laser) > 1:
            by_laser = {frame: _figures(counts) for frame, counts in sorted(self._by_laser.items())}
        return ResidualMetrics(
            points=whole.points,
            median=whole.median,
            p95=whole.p95,
            within_15_cm=whole.within_15_cm,
            by_laser=by_laser,
        )

    def warnings(self) -> list[RunWarning]:
        """A warning for each laser whose scans fit the map far worse than those of the best one."""
        self._count()
        near = {frame: _figures(counts).within_15_cm for frame, counts in sorted(self._by_laser.items())}
        known = {frame: part for frame, part in near.items() if part is not None}
        if len(known) < 2:
            return []
        best = max(known, key=lambda frame: known[frame])
        return [
            RunWarning(
                WarningCode.LASER_MISFIT,
                f"{100.0 * part:.0f} % of the points of the laser {frame} lie at a wall of the map, but "
                f"{100.0 * known[best]:.0f} % of those of {best}",
                f"check the mounting of {frame} in /tf_static, or leave it out with --scan-topic",
            )
            for frame, part in known.items()
            if part < _MISFIT_RATIO * known[best]
        ]


def _figures(counts: NDArray[np.int64]) -> LaserResiduals:
    total = int(counts.sum())
    if total == 0:
        return LaserResiduals(points=0, median=None, p95=None, within_15_cm=None)
    part = np.cumsum(counts) / total
    return LaserResiduals(
        points=total,
        median=float(np.searchsorted(part, 0.5) * _BIN_M),
        p95=float(np.searchsorted(part, 0.95) * _BIN_M),
        within_15_cm=float(part[int(NEAR_WALL_M / _BIN_M)]),
    )


class ExtrinsicsCheck:
    """Whether several lasers are mounted where the log states: each is matched alone on the map of the run.

    A laser that is mounted elsewhere, by five degrees or ten centimetres, bends a map and biases a pose without any
    other sign, since the pose is a compromise between the lasers. The median of what two lasers disagree in, in the
    frame of the base, is the error of a mounting.
    """

    def __init__(self, likelihood: LikelihoodField | None, matcher: Matcher, scans: int, lasers: int) -> None:
        """`scans` is the number of scans to come, of `lasers` lasers.

        With one laser, or without a likelihood field (a map without walls), there is nothing to compare.
        """
        self._every = max(scans // (max(lasers, 1) * CHECKED_SCANS), 1)
        self._field = likelihood if lasers > 1 else None
        self._matcher = matcher
        self._rng = np.random.default_rng(0)
        self._seen: dict[str, int] = {}
        self._mounted: dict[str, Pose2] = {}
        self._offsets: dict[str, list[NDArray[np.float64]]] = {}

    def add(self, scan: Scan, T_map_base: Pose2) -> None:
        """A scan, and the pose of the base at its stamp."""
        frame = scan.frame_id
        number = self._seen[frame] = self._seen.get(frame, -1) + 1
        self._mounted.setdefault(frame, scan.T_base_laser)
        if self._field is None or number % self._every:
            return
        points = scan.points_base()
        if len(points) < MIN_POINTS:
            return
        window = Window(T_map_base, _CHECK_HALF_M, _CHECK_HALF_M, _CHECK_HALF_RAD)
        match = self._matcher.match(points, self._field, window, self._rng)
        if match.fitness >= _CHECK_MIN_FITNESS:
            self._offsets.setdefault(frame, []).append(T_map_base.between(match.pose).to_array())

    def warnings(self) -> list[RunWarning]:
        """A warning for each laser that disagrees with the first in the order of names."""
        offsets_of = {
            frame: np.array(rows) for frame, rows in sorted(self._offsets.items()) if len(rows) >= _MIN_CHECKED_SCANS
        }
        warnings = []
        for other, offsets in list(offsets_of.items())[1:]:
            first = next(iter(offsets_of))
            a, sigma_a = _median(offsets_of[first])
            b, sigma_b = _median(offsets)
            off = a.between(b)
            sigma = np.hypot(sigma_a, sigma_b)
            far = hypot(off.x, off.y) > max(MOUNTING_ERROR_M, _MIN_SIGMAS * float(np.hypot(*sigma[:2])))
            if far or abs(off.theta) > max(MOUNTING_ERROR_RAD, _MIN_SIGMAS * float(sigma[2])):
                stated, found = self._mounted[other], off @ self._mounted[other]
                warnings.append(
                    RunWarning(
                        WarningCode.EXTRINSICS_DISAGREE,
                        f"the laser {other} does not fit {first}: /tf_static states {_text(stated)}, by the map it is "
                        f"at about {_text(found)}",
                        f"measure how {other} and {first} are mounted and correct /tf_static",
                    )
                )
        return warnings


def _median(offsets: NDArray[np.float64]) -> tuple[Pose2, NDArray[np.float64]]:
    """The median, and its standard error from the spread about it."""
    middle = np.median(offsets, axis=0)
    spread = 1.4826 * np.median(np.abs(offsets - middle), axis=0)
    return Pose2.from_array(middle), 1.25 * spread / np.sqrt(len(offsets))


def _text(pose: Pose2) -> str:
    return f"{pose.x:.2f}, {pose.y:.2f} m, {degrees(pose.theta):.1f} deg"


class ConvergenceSample:
    """Searches about `CONVERGENCE_SCANS` scans of a run again and keeps the best fitness after each evaluation."""

    def __init__(self, likelihood: LikelihoodField | None, matcher: Matcher, scans: int) -> None:
        """`scans` is the number of scans to come.

        Nothing is sampled for a matcher that does not search (ICP), or without a likelihood field: no walls.
        """
        self._matcher = replace(matcher, restarts=1) if isinstance(matcher, HarmonySearch) else None
        self._field = likelihood
        self._every = max(scans // CONVERGENCE_SCANS, 1)
        self._seen = -1
        self._rng = np.random.default_rng(0)
        self._curves: list[NDArray[np.float64]] = []

    def add(self, scan: Scan, T_map_base: Pose2) -> None:
        """A scan, and the pose of the base at its stamp."""
        self._seen += 1
        full = len(self._curves) >= CONVERGENCE_SCANS
        if self._matcher is None or self._field is None or self._seen % self._every or full:
            return
        points = scan.points_base()
        if len(points) < MIN_POINTS:
            return
        # The window is not centred on the answer.
        half = (CONVERGENCE_HALF_M, CONVERGENCE_HALF_M, CONVERGENCE_HALF_RAD)
        off = Pose2(*(self._rng.uniform(-0.5, 0.5, 3) * half).tolist())
        window = Window(T_map_base @ off, *half)
        history = self._matcher.match(points, self._field, window, self._rng, keep_history=True).history
        if history is not None and len(history):
            self._curves.append(history)

    def curves(self, name: str) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """(evaluations, best fitness), the median over the scans, under a heading; empty where nothing was sampled."""
        if not self._curves:
            return {}
        length = min(len(curve) for curve in self._curves)
        middle = np.median([curve[:length] for curve in self._curves], axis=0)
        window = f"±{CONVERGENCE_HALF_M:g} m, ±{degrees(CONVERGENCE_HALF_RAD):.0f}°"
        return {f"{name}, {len(self._curves)} scans, {window}": (np.arange(1.0, length + 1.0), middle)}


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


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """By how many scans each place of the map was seen: a beam passed through the cell, or ended in it."""

    counts: NDArray[np.int32]
    """Scans (h, w) for each cell, the row at the lower edge of the map first."""
    side: float
    """Side of a cell [m]."""
    T_map_corner: Pose2
    """The lower left corner, and the direction of the rows."""


class CoverageCounter:
    """Counts a `Coverage` of the map's extent, over all beams with a return; what they saw beyond it is left out."""

    def __init__(self, grid: OccupancyGrid) -> None:
        height, width = (n * grid.resolution for n in grid.cells.shape)
        self._side = max(COVERAGE_CELL_M, max(height, width) / COVERAGE_CELLS)
        shape = (max(int(np.ceil(height / self._side)), 1), max(int(np.ceil(width / self._side)), 1))
        self._counts = np.zeros(shape, dtype=np.int32)
        self._work = np.zeros(shape, dtype=np.int32), np.zeros(shape, dtype=np.int32)
        self._T_map_corner = grid.origin
        self._T_corner_map = grid.origin.inverse()

    def add(self, scan: Scan, points: Floats, T_map_base: Pose2) -> None:
        """A scan with its points (n, 2), and the pose of the base at its stamp."""
        T_corner_base = self._T_corner_map @ T_map_base
        laser = T_corner_base @ scan.T_base_laser
        pose = (T_corner_base.x, T_corner_base.y, cos(T_corner_base.theta), sin(T_corner_base.theta))
        count_seen(self._counts, self._work, points, pose, (laser.x, laser.y), self._side)

    def coverage(self) -> Coverage:
        """What was counted."""
        return Coverage(self._counts, self._side, self._T_map_corner)
