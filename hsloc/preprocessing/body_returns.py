"""Returns from the robot itself: posts, legs, a cable, a part of the chassis in the plane of the lidar.

They move with the robot, so that matched they say that it stands still, and drawn they follow it as a wall. What the
lidar sees of the robot is what does not change while everything else does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.events import Odometry, Scan
from hsloc.model.pose2 import wrap_angle
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from hsloc.model.events import Event

    F64 = NDArray[np.float64]
    Bools = NDArray[np.bool_]

_REACH_M = 1.0
"""Range (m) up to which a return may be the robot's own: lidars are mounted on it."""
_VIEWS = 20
"""Number of views that must have a return at one range. Each differs from the one before, so that no wall is in all."""
_TURNED = np.pi
"""Rotation (rad) within them: a robot that follows a wall has it at one range for as long as it drives straight."""
_CHANGED_M, _CHANGED_PART, _CHANGED_SHARE = 0.1, 0.05, 0.5
"""A view is another one where half of the other beams changed by more than this (m), and this part of the range, which
are several times the noise of common lidars."""
_SPREAD_M = 0.03
"""Standard deviation (m) of such returns, at most: noise of cheap lidars."""
_VARIED_M = 0.3
"""Difference (m) between two returns of a beam that their noise does not make."""
_SEEN_SHARE = 0.9
"""Part of the views that must have such a return."""
_FEWEST = 20
"""Number of beams that are compared, at least."""


def body_beams(events: Iterable[Event]) -> dict[str, Bools]:
    """Which beams (n,) see the robot itself, by the frame of a laser; lasers without any are left out.

    Reads on until it is settled: in most logs until the robot has moved.
    """
    lasers: dict[str, _Views] = {}
    heading, turned = None, 0.0
    for event in events:
        if isinstance(event, Odometry):
            turned += 0.0 if heading is None else abs(wrap_angle(event.T_odom_base.theta - heading))
            heading = event.T_odom_base.theta
        elif isinstance(event, Scan):
            lasers.setdefault(event.frame_id, _Views(event)).add(event, turned)
            if all(views.is_settled for views in lasers.values()):
                break
    found = {frame: views.unchanged() for frame, views in lasers.items()}
    return {frame: beams for frame, beams in found.items() if beams.any()}


def without_beams(events: Iterable[Event], beams: Mapping[str, Bools]) -> Iterator[Event]:
    """The events, the scans without those beams (n,), by the frame of the laser."""
    for event in events:
        own = beams.get(event.frame_id) if isinstance(event, Scan) else None
        if isinstance(event, Scan) and own is not None and len(own) == len(event.ranges):
            yield replace(event, ranges=np.where(own, np.float32(np.nan), event.ranges))
        else:
            yield event


def body_warnings(beams: Mapping[str, Bools]) -> tuple[RunWarning, ...]:
    """What was left out."""
    return tuple(
        RunWarning(
            WarningCode.SCAN_BODY_RETURNS,
            f"{int(own.sum())} of {len(own)} beams of {frame} see the robot itself: their short ranges do not change "
            "while it moves, and are left out",
            "raise the lidar, or filter its driver's scans by the robot's outline",
        )
        for frame, own in beams.items()
    )


def changed_share(ranges: F64, before: F64, compared: Bools) -> float:
    """Which part of the beams that are `compared` (n,) sees something else than before; 0 where too few hit twice."""
    both = np.isfinite(ranges) & np.isfinite(before) & compared
    apart = np.abs(ranges - before)[both]
    changed = apart > np.maximum(_CHANGED_M, _CHANGED_PART * before[both])
    return float(changed.mean()) if len(changed) >= _FEWEST else 0.0


class _Views:
    """Scans of a laser, each of which sees something else than the one before."""

    def __init__(self, first: Scan) -> None:
        self._ranges = [first.hit_ranges()]
        with np.errstate(invalid="ignore"):
            self._possible = self._ranges[0] < _REACH_M
        self._turned = (0.0, 0.0)

    @property
    def _are_enough(self) -> bool:
        return len(self._ranges) >= _VIEWS and self._turned[1] - self._turned[0] >= _TURNED

    @property
    def is_settled(self) -> bool:
        """Whether more scans are of no use."""
        return self._are_enough or (len(self._ranges) > 1 and not self._possible.any())

    def add(self, scan: Scan, turned: float) -> None:
        """Take in a scan, at which the robot had turned so far (rad)."""
        if self.is_settled or len(scan.ranges) != len(self._possible):
            return
        ranges, before = scan.hit_ranges(), self._ranges[-1]
        if changed_share(ranges, before, ~self._possible) <= _CHANGED_SHARE:
            return
        self._turned = (turned if len(self._ranges) == 1 else self._turned[0], turned)
        self._ranges.append(ranges)
        with np.errstate(invalid="ignore"):
            self._possible &= ~(np.abs(ranges - self._ranges[0]) > _VARIED_M)

    def unchanged(self) -> Bools:
        """Beams (n,) that saw the same in all views, with their neighbours, which see its edge."""
        own = np.zeros(len(self._possible), dtype=np.bool_)
        possible = np.flatnonzero(self._possible)
        if not self._are_enough or len(possible) == 0:
            return own
        ranges = np.array(self._ranges)[:, possible]
        seen = np.isfinite(ranges).mean(axis=0) >= _SEEN_SHARE
        own[possible[seen & (np.nanstd(ranges, axis=0) <= _SPREAD_M)]] = True
        own[1:-1] |= own[:-2] | own[2:]
        return own
