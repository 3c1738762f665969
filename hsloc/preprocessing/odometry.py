"""Odometry as logs have it: resets that are mended, and odometry that is none.

It begins again from zero in the middle of a log where a driver was restarted, or a frame was reset. The robot did not
move by it, so the new odometry goes on where the old one ended, for whoever estimates with it and in the results.
Odometry that jumps all the time has another fault, and is passed on as it is.

Other odometry stands still, or never states a heading, while the scans say that the robot moves: a fixed transform that
was published to satisfy another node, a dead encoder, a pose or a heading that is never filled in. Estimating with it
is worse than estimating without. The watch looks at odometry and scans as they pass, and raises `UnusableOdometry` as
soon as it is sure.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from math import hypot, inf
from typing import TYPE_CHECKING

import numpy as np

from hsloc.log import LEAST_JUMP, LONGEST_JUMP_S, MAX_SPEED
from hsloc.model.events import Odometry, Scan
from hsloc.model.pose2 import Pose2, wrap_angle
from hsloc.preprocessing.odometry_stalls import UnstalledOdometry
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.model.events import Event

_LEAST_TURN, _MAX_TURN = 0.8, 10.0
"""A step is a jump as `hsloc check` has it, or if it turns by more than this (rad), and faster than this (rad/s)."""
_MOST = 20
"""Number of jumps that are mended; after more of them the odometry is taken for broken."""

_FROZEN_S = 3.0
"""Odometry that is at rest for this long (s) while the scans change is frozen. A robot at 0.1 m/s
has gone 0.3 m by then, more than scans can hide; wheel encoders tick many times."""
_COMPARED_S = 1.0
"""Scans are compared with one that is at least this old (s)."""
_CHANGED_M = 0.1
"""A beam has changed if its range differs by more than this (m), several times the noise of common lidars ..."""
_CHANGED_PART = 0.05
"""... and by more than this part of it."""
_CHANGED_SHARE = 0.6
"""The robot moves if more than this part of the beams changed: crowds around a robot at rest change fewer, since most
beams meet walls, and never for seconds."""
_MIN_BEAMS = 20
_STILL_M, _STILL_RAD = 0.01, 0.01
"""Changes (m, rad) below which odometry is at rest: the noise of a sensor that measures no motion. Scans that change
have moved ten times as far."""
_TURNED, _TURNS = 1.5, 15
"""Rotation of the scans (rad) in this number of comparisons after which a heading that never changed never will.
Of 1,114 comparisons on Intel's log in which the robot drove straight 13 show a rotation, each alone."""
_CLEAR, _WIDEST = 0.2, 1.2
"""Smallest and largest rotation (rad) between two scans that is looked for."""
_COMPARED_BEAMS = 360
_UNSET_WAY = 0.3
"""Metres of driving without a heading after which it will not come any more."""


class ContinuousOdometry:
    """Events whose odometry goes on where it jumped. To be gone through once; then `warnings` gives what was found."""

    def __init__(self, events: Iterable[Event], topic: str | None = None) -> None:
        self._stalls = UnstalledOdometry(events, topic)
        self._topic = topic
        self._start_ns = 0
        self._first = (0.0, 0.0)
        self._jumps = 0

    def __iter__(self) -> Iterator[Event]:
        before: Odometry | None = None
        T_joined_odom: Pose2 | None = None
        for event in self._stalls:
            if not isinstance(event, Odometry):
                yield event
                continue
            if before is None:
                self._start_ns = event.stamp_ns
            elif self._has_jumped(before, event) and self._jumps <= _MOST:
                place = before.T_odom_base if T_joined_odom is None else T_joined_odom @ before.T_odom_base
                T_joined_odom = place @ event.T_odom_base.inverse()
            before = event
            yield event if T_joined_odom is None else replace(event, T_odom_base=T_joined_odom @ event.T_odom_base)

    def _has_jumped(self, before: Odometry, after: Odometry) -> bool:
        a, b = before.T_odom_base, after.T_odom_base
        way, turn = hypot(b.x - a.x, b.y - a.y), abs(b.theta - a.theta)
        if way <= LEAST_JUMP and turn <= _LEAST_TURN:
            return False
        seconds, turn = (after.stamp_ns - before.stamp_ns) / 1e9, abs(wrap_angle(turn))
        fast = way > max(MAX_SPEED * seconds, LEAST_JUMP) or turn > max(_MAX_TURN * seconds, _LEAST_TURN)
        if not (fast and 0.0 < seconds < LONGEST_JUMP_S):
            return False
        self._jumps += 1
        if self._jumps == 1:
            self._first = (way, (after.stamp_ns - self._start_ns) / 1e9)
        return True

    def warnings(self) -> tuple[RunWarning, ...]:
        """A warning if there were stalls, and one if there were jumps."""
        if self._jumps == 0:
            return self._stalls.warnings()
        way, at = self._first
        corrected = self._jumps <= _MOST
        what = (
            "it is continued from the pose before each jump"
            if corrected
            else "too often to be corrected: poses may be wrong"
        )
        return (
            *self._stalls.warnings(),
            RunWarning(
                WarningCode.ODOMETRY_RESET if corrected else WarningCode.ODOMETRY_JUMPS,
                f"odometry ({self._topic}) jumps ({self._jumps} times, first by {way:.2f} m at {at:.3f} s); {what}",
                "check whether it was reset, or whether two publishers share the topic",
            ),
        )


class UnusableOdometry(Exception):
    """The odometry cannot be used; the text says why. Internal: whoever replays goes on without it."""


class OdometryWatch:
    """Passes events on until the odometry proves unusable. To be gone through once."""

    def __init__(self, events: Iterable[Event]) -> None:
        self._events = events
        self._pose: Pose2 | None = None
        self._latest_ns = 0
        self._since_ns = 0
        self._old: tuple[int, NDArray[np.float32]] | None = None
        self._moving_ns = 0
        self._last_scan_ns = 0
        self._had_heading = False
        self._turns = False
        self._heading = 0.0
        self._turned: deque[float] = deque(maxlen=_TURNS)
        self._start: tuple[float, float] | None = None

    def __iter__(self) -> Iterator[Event]:
        for event in self._events:
            if isinstance(event, Odometry):
                self._follow(event)
            elif isinstance(event, Scan):
                self._compare(event)
            yield event

    def _follow(self, event: Odometry) -> None:
        pose, last = event.T_odom_base, self._pose
        self._latest_ns = event.stamp_ns
        if (
            last is None
            or hypot(pose.x - last.x, pose.y - last.y) > _STILL_M
            or abs(wrap_angle(pose.theta - last.theta)) > _STILL_RAD
        ):
            self._pose, self._since_ns, self._moving_ns = pose, event.stamp_ns, 0
        self._turns |= last is not None and pose.theta != self._heading
        self._heading = pose.theta
        self._had_heading |= event.has_heading
        if self._start is None:
            self._start = (pose.x, pose.y)
        if event.has_heading:
            return
        # Between others a few are left out when the log is read; those that come have none around them.
        if self._had_heading or hypot(pose.x - self._start[0], pose.y - self._start[1]) > _UNSET_WAY:
            raise UnusableOdometry("its orientations are not set (zeros, NaN, no w, or angles beside w = 1)")

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
        before, self._old = self._old[1], (scan.stamp_ns, scan.ranges)
        if both.sum() < _MIN_BEAMS or self._pose is None or step < 0:
            return
        if scan.stamp_ns - self._latest_ns > _COMPARED_S * 1e9:  # odometry that is missing does not stand still
            self._moving_ns = 0
            return
        if not self._turns:
            self._turned.append(_rotation(before, scan))
            if sum(self._turned) > _TURNED:
                raise UnusableOdometry(f"its heading never changes while the scans turn by {sum(self._turned):.1f} rad")
        if float(changed.mean()) > _CHANGED_SHARE and scan.stamp_ns - self._since_ns >= seconds_ns:
            self._moving_ns += seconds_ns
        else:
            self._moving_ns = 0
        if self._moving_ns >= _FROZEN_S * 1e9:
            seconds = (scan.stamp_ns - self._since_ns) / 1e9
            raise UnusableOdometry(f"it does not move for {seconds:.1f} s while the scans do")


def _rotation(before: NDArray[np.float32], scan: Scan) -> float:
    """How far a scan (n,) turned since the one before (n,), without its sign (rad); 0 where that is not clear.

    It turned where the ranges, moved by some beams, agree at least twice as well as they do as they are.
    """
    count = len(before)
    increment = abs(scan.angle_increment)
    if increment == 0.0:
        return 0.0
    stride = max(1, count // _COMPARED_BEAMS)
    costs = {0: inf}
    for shift in range(0, min(int(_WIDEST / increment), count // 2), max(1, int(_STILL_RAD / increment))):
        for k in (shift, -shift):
            with np.errstate(invalid="ignore"):
                apart = np.abs(
                    scan.ranges[max(-k, 0) : count - max(k, 0) : stride]
                    - before[max(k, 0) : count + min(k, 0) : stride]
                )
            known = apart[np.isfinite(apart)]
            costs[k] = float(np.median(known)) if len(known) >= _MIN_BEAMS else inf
    best = min(costs, key=costs.__getitem__)
    turned = abs(best) * increment
    return turned if turned > _CLEAR and costs[best] < 0.5 * costs[0] else 0.0
