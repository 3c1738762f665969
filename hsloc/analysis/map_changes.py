"""What changed since a given map was made: things that the scans of a run show and the map does not, and the reverse.

Scans with a known pose are counted cell by cell. What stands in a place most of the times that it is seen, where the
map is free, appeared; a wall of the map through which beams pass to what is behind it vanished. People who walk by, and
other robots, are neither: most scans see the place free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot, radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.evaluation.maps import MIN_SIZE_M, TOLERANCE_M, MapChange, changed_things, largest_first
from hsloc.kernels.changed_cells import count_beams, count_scan
from hsloc.kernels.score_field import wall_distances
from hsloc.model.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from hsloc.model.pose2 import Pose2
from hsloc.model.verdict import spans_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.states import StateRows
    from hsloc.model.events import Scan

    F64 = NDArray[np.float64]
    Bools = NDArray[np.bool_]

_APART_M, _APART_RAD, _APART_NS = 0.3, radians(15.0), 2_000_000_000
"""A scan is counted when the robot has moved or turned this far since the last one, or after this time: at rest the
same view again would be a new witness ten times a second."""
_MOST_SCANS = 4000
"""Scans that are kept; of more every second one. Of 360 beams they take 12 MB, and 65,535 can be counted."""
_MOST_RANGE_M = 10.0
"""Beams are cut off there: a heading that is off by less than a degree moves the end of one by the tolerance."""
_MARGIN_M = 2.0 * TOLERANCE_M
"""A beam that ends this near behind a wall may have ended at it: both map and pose are off a little."""
_FEWEST_SCANS = 3
"""Scans that have to show a change: fewer are one person."""
_STANDS, _GONE = 0.5, 0.2
"""What stands is met by this part of the scans that see its place, or more; what is gone by the second, or less."""
_THIN = 3.0
"""What is this many times as long as wide is thin."""
_OUTLINE_M = 0.5
"""Length of the outline that a change shows, at least: that of a box of 0.3 m from two sides is 0.6 m."""
HIDDEN = 0.2
"""Part of a scan's beams that end at things the map does not have, from which on there is a warning: the usual
fitness of 0.93 is then below 0.75, where a match begins to be doubtful."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenChanges:
    """The changes that n scans showed, the largest first.

    `spans_ns` (k, 2) are the stamps of the first and the last scan that showed each. `hidden` (n,) is the part of the
    beams that end at things which appeared, of the scan at each of `stamps_ns` (n,). `layer` is an occupancy grid with
    the cells of the map: occupied where something appeared, free where something vanished, else unknown.
    """

    changes: tuple[MapChange, ...]
    spans_ns: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    hidden: F64
    gone: float
    """Part of the walls that scans saw which vanished, from 0 to 1."""
    layer: OccupancyGrid

    def hidden_spans_ns(self) -> list[tuple[int, int]]:
        """Stamps of the first and the last scan of each stretch of three and more with `HIDDEN` or more."""
        spans = spans_of(self.hidden >= HIDDEN)
        return [
            (int(self.stamps_ns[first]), int(self.stamps_ns[last]))
            for first, last in spans
            if last - first + 1 >= _FEWEST_SCANS
        ]


def with_changes(rows: StateRows, stamps_ns: NDArray[np.int64], changes: SeenChanges) -> StateRows:
    """The rows at n stamps (n,), of which those that are localised say where the map has changed, and how much."""
    reasons = list(rows.reason)
    for begin, end in changes.hidden_spans_ns():
        within = np.flatnonzero((stamps_ns >= begin) & (stamps_ns <= end) & rows.is_localised())
        shares = np.interp(stamps_ns[within], changes.stamps_ns, changes.hidden)
        for row, share in zip(within.tolist(), shares.tolist(), strict=True):
            text = f"the map has changed here: {100.0 * share:.0f} % of the beams end at things that it lacks"
            reasons[row] = f"{reasons[row]}; {text}" if reasons[row] else text
    return replace(rows, reason=tuple(reasons))


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    stamp_ns: int
    origin: F64
    """Where the laser is (2,), in cells of the map."""
    ends: NDArray[np.float32]
    """Where its beams end (n, 2), in cells."""
    is_hit: Bools
    """Whether they end there (n,), and are not cut off."""


class MapChangeFinder:
    """Takes the scans of a run with their poses, and finds what changed since the map was made; memory is bounded."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self._grid = grid
        self._T_grid_map = grid.origin.inverse()
        self._last: dict[str, tuple[int, Pose2]] = {}
        self._kept: list[_Kept] = []
        self._every, self._count = 1, 0

    def add(self, scan: Scan, points: F64, T_map_base: Pose2) -> None:
        """A scan with its points (n, 2), and the pose of the base at its stamp, which has to be known."""
        last = self._last.get(scan.frame_id)
        if last is not None:
            motion = last[1].between(T_map_base)
            is_far = hypot(motion.x, motion.y) >= _APART_M or abs(motion.theta) >= _APART_RAD
            if not is_far and scan.stamp_ns - last[0] < _APART_NS:
                return
        self._last[scan.frame_id] = scan.stamp_ns, T_map_base
        self._count += 1
        if self._count % self._every or len(points) == 0:
            return
        cell, T_grid_base = self._grid.resolution, self._T_grid_map @ T_map_base
        laser = T_grid_base @ scan.T_base_laser
        origin = np.array((laser.x, laser.y))
        beams = (T_grid_base @ points) - origin
        length = np.hypot(beams[:, 0], beams[:, 1])
        ends = origin + beams * np.minimum(1.0, _MOST_RANGE_M / np.maximum(length, 1e-9))[:, None]
        self._kept.append(_Kept(scan.stamp_ns, origin / cell, (ends / cell).astype(np.float32), length < _MOST_RANGE_M))
        if len(self._kept) > _MOST_SCANS:
            self._kept, self._every = self._kept[1::2], 2 * self._every

    def changes(self) -> SeenChanges | None:
        """What changed; None where fewer scans came than have to show a change."""
        if len(self._kept) < _FEWEST_SCANS:
            return None
        low, high = self._seen_box()
        grid = self._part(low, high)
        kept = [replace(one, origin=one.origin - low, ends=one.ends - low.astype(np.float32)) for one in self._kept]
        appeared, vanished, walls_seen = _changed_cells(grid, kept)
        labels, things = _things(grid, appeared, vanished)
        cells = np.argwhere(labels)
        of = labels[labels > 0]
        along = np.array([(0.0, 0.0), *(_along(cells[of == k]) for k in range(1, len(things) + 1))])
        is_new = np.array([False, *(each.kind == "appeared" for each in things)])
        shown, hidden = _when(labels, along, is_new, kept, _MARGIN_M / grid.resolution)
        often = shown[:, 0] >= _FEWEST_SCANS
        kinds = np.where(often, np.where(is_new, OCCUPIED, FREE), UNKNOWN).astype(np.int8)
        layer = np.full(self._grid.cells.shape, UNKNOWN, dtype=np.int8)
        layer[low[1] : high[1], low[0] : high[0]] = kinds[labels]
        order = sorted(np.flatnonzero(often).tolist(), key=lambda k: largest_first(things[k - 1]))
        return SeenChanges(
            changes=tuple(things[k - 1] for k in order),
            spans_ns=shown[order, 1:],
            stamps_ns=np.array([one.stamp_ns for one in kept], dtype=np.int64),
            hidden=hidden,
            gone=int((layer == FREE).sum()) / max(walls_seen, 1),
            layer=OccupancyGrid(layer, self._grid.resolution, self._grid.origin),
        )

    def _seen_box(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First column and row that beams reach, and those after the last."""
        height, width = self._grid.cells.shape
        low = np.min([np.minimum(one.ends.min(axis=0), one.origin) for one in self._kept], axis=0)
        high = np.max([np.maximum(one.ends.max(axis=0), one.origin) for one in self._kept], axis=0)
        size = np.array((width, height))
        # A rim, for a wall beside the last cell is as near as one in it.
        rim = int(np.ceil(_MARGIN_M / self._grid.resolution)) + 1
        first = np.clip(np.floor(low).astype(np.int64) - rim, 0, size)
        return first, np.clip(np.floor(high).astype(np.int64) + rim + 1, first, size)

    def _part(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> OccupancyGrid:
        corner = self._grid.origin @ (low.astype(np.float64) * self._grid.resolution)
        origin = Pose2(float(corner[0]), float(corner[1]), self._grid.origin.theta)
        return replace(self._grid, cells=self._grid.cells[low[1] : high[1], low[0] : high[0]], origin=origin)


def _changed_cells(grid: OccupancyGrid, kept: Sequence[_Kept]) -> tuple[Bools, Bools, int]:
    """Cells in which something appeared, or vanished, and the number of occupied cells of the map that were seen."""
    shape, margin = grid.cells.shape, _MARGIN_M / grid.resolution
    ended, seen = ((np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.uint16)) for _ in range(2))
    for number, one in enumerate(kept, start=1):
        count_scan(number, ended, seen, one.origin, one.ends.astype(np.float64), one.is_hit, margin)
    shown = seen[0] >= _FEWEST_SCANS
    part = ended[0] / np.maximum(seen[0], 1)
    stands = (ended[0] >= _FEWEST_SCANS) & (part >= _STANDS)
    before = grid.occupied()
    appeared = _far_from(before, stands & grid.free(), grid.resolution)
    is_through = before & shown & (part <= _GONE)
    vanished = _far_from((ended[0] > 0) & (part > _GONE), is_through, grid.resolution)
    return appeared, vanished, int((before & (seen[0] > 0)).sum())


def _far_from(walls: Bools, cells: Bools, resolution: float) -> Bools:
    """Those of the `cells` (h, w) that are farther than the tolerance from the centre of any of the `walls` (h, w)."""
    rows, columns = np.nonzero(cells)
    distances = np.full(len(rows), np.inf)
    if walls.any() and len(rows):
        wall_distances(walls, np.column_stack((columns, rows)).astype(np.float64), distances)
    far = distances * resolution > TOLERANCE_M
    found = np.zeros_like(cells)
    found[rows[far], columns[far]] = True
    return found


def _things(grid: OccupancyGrid, appeared: Bools, vanished: Bools) -> tuple[NDArray[np.int32], list[MapChange]]:
    """Things, and for each cell (h, w) the number of its thing from 1 on, or 0."""
    labels = np.zeros(grid.cells.shape, dtype=np.int32)
    things: list[MapChange] = []
    for kind, mask in (("appeared", appeared), ("vanished", vanished)):
        if int(mask.sum()) * grid.resolution < _OUTLINE_M:
            continue
        found, numbers = changed_things(grid, mask, kind, MIN_SIZE_M)  # type: ignore[arg-type]
        # A thing shows a line of cells across it, at least: what is scattered is the rim of something, or noise.
        dense = np.array([False, *(one.cells * grid.resolution >= max(one.size, _OUTLINE_M) for one in found)])
        number_of = np.cumsum(dense) * dense
        numbers = np.where(number_of > 0, number_of + len(things), 0)[numbers]
        labels[numbers > 0] = numbers[numbers > 0]
        things += [one for one, number in zip(found, number_of[1:], strict=True) if number]
    return labels, things


def _along(cells: NDArray[np.int64]) -> tuple[float, float]:
    """Unit vector (column, row) along cells (n, 2), row and column, that are far longer than wide; else zeros."""
    values, vectors = np.linalg.eigh(np.cov(cells.T[::-1], bias=True) + np.eye(2) / 12.0)
    return (float(vectors[0, 1]), float(vectors[1, 1])) if values[1] > _THIN**2 * values[0] else (0.0, 0.0)


def _when(
    labels: NDArray[np.int32], along: F64, is_new: Bools, kept: Sequence[_Kept], margin: float
) -> tuple[NDArray[np.int64], F64]:
    """By how many scans each thing was shown, and the stamps of the first and the last (k, 3); hidden parts (n,)."""
    shown, hidden = np.zeros((len(is_new), 3), dtype=np.int64), np.zeros(len(kept))
    if len(is_new) == 1:
        return shown, hidden
    for k, one in enumerate(kept):
        ended, crossed = np.zeros(len(is_new), dtype=np.int64), np.zeros(len(is_new), dtype=np.int64)
        count_beams(labels, along, one.origin, one.ends.astype(np.float64), margin, ended, crossed)
        hidden[k] = ended[is_new].sum() / len(one.ends)
        now = np.where(is_new, ended, crossed) > 0
        now[0] = False
        shown[now & (shown[:, 0] == 0), 1] = one.stamp_ns
        shown[now, 2] = one.stamp_ns
        shown[now, 0] += 1
    return shown, hidden
