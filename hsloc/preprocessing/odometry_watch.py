"""Odometry that is not odometry: it stands still, or never states a heading, while the scans say that the robot moves.

A fixed transform that was published to satisfy another node, a dead encoder, a pose that is never filled in: estimating
with it is worse than estimating without. The watch looks at odometry and scans as they pass, and raises
`UnusableOdometry` as soon as it is sure.
"""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.events import Odometry, Scan

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.model.events import Event

FROZEN_S = 3.0
"""Odometry that does not change by a bit for so long (s) while the scans change is frozen. A robot at 0.1 m/s
has gone 0.3 m by then, more than scans can hide; wheel encoders tick many times."""
_COMPARED_S = 1.0
"""Scans are compared with one that is at least so old (s)."""
_CHANGED_M = 0.1
"""A beam has changed if its range differs by more than this (m), several times the noise of common lidars ..."""
_CHANGED_PART = 0.05
"""... and by more than this part of it."""
_CHANGED_SHARE = 0.6
"""The robot moves if more than this part of the beams changed: crowds around a robot at rest change fewer, since most
beams meet walls, and never for seconds."""
_MIN_BEAMS = 20
_UNSET_WAY = 0.3
"""Metres of driving without any heading after which it will not come any more."""


class UnusableOdometry(Exception):
    """The odometry cannot be used; the text says why. Internal: whoever replays goes on without it."""


class OdometryWatch:
    """Passes events on until the odometry proves unusable. To be gone through once."""

    def __init__(self, events: Iterable[Event]) -> None:
        self._events = events
        self._pose: tuple[float, float, float] | None = None
        self._told_ns = 0
        self._since_ns = 0
        self._old: tuple[int, NDArray[np.float32]] | None = None
        self._moving_ns = 0
        self._last_scan_ns = 0
        self._unset = True
        self._start: tuple[float, float] | None = None

    def __iter__(self) -> Iterator[Event]:
        for event in self._events:
            if isinstance(event, Odometry):
                self._follow(event)
            elif isinstance(event, Scan):
                self._compare(event)
            yield event

    def _follow(self, event: Odometry) -> None:
        pose = event.T_odom_base
        values = (pose.x, pose.y, pose.theta)
        self._told_ns = event.stamp_ns
        if values != self._pose:
            self._pose, self._since_ns, self._moving_ns = values, event.stamp_ns, 0
        self._unset &= not event.has_heading
        if self._start is None:
            self._start = (pose.x, pose.y)
        if self._unset and hypot(pose.x - self._start[0], pose.y - self._start[1]) > _UNSET_WAY:
            raise UnusableOdometry("its orientations are never set (quaternions of zeros)")

    def _compare(self, scan: Scan) -> None:
        """Count the time for which the scans change and the odometry does not."""
        step = scan.stamp_ns - self._last_scan_ns
        self._last_scan_ns = scan.stamp_ns
        if self._old is None or len(self._old[1]) != len(scan.ranges):
            self._old = scan.stamp_ns, scan.ranges
            return
        if scan.stamp_ns - self._old[0] < _COMPARED_S * 1e9:
            if scan.stamp_ns < self._old[0]:
                self._old = None
            return
        with np.errstate(invalid="ignore"):
            both = np.isfinite(scan.ranges) & np.isfinite(self._old[1])
            apart = np.abs(scan.ranges[both] - self._old[1][both])
            changed = apart > np.maximum(_CHANGED_M, _CHANGED_PART * scan.ranges[both])
        seconds_ns = scan.stamp_ns - self._old[0]
        self._old = scan.stamp_ns, scan.ranges
        if both.sum() < _MIN_BEAMS or self._pose is None or step < 0:
            return
        if scan.stamp_ns - self._told_ns > _COMPARED_S * 1e9:  # odometry that is missing does not stand still
            self._moving_ns = 0
            return
        if float(changed.mean()) > _CHANGED_SHARE and scan.stamp_ns - self._since_ns >= seconds_ns:
            self._moving_ns += seconds_ns
        else:
            self._moving_ns = 0
        if self._moving_ns >= FROZEN_S * 1e9:
            seconds = (scan.stamp_ns - self._since_ns) / 1e9
            raise UnusableOdometry(f"it does not move for {seconds:.1f} s while the scans do")
