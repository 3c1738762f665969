"""How wrong a pose is that is interpolated between two odometry messages, by what the odometry itself shows.

Between two messages a pose goes straight on at an even speed, and the robot does not: it brakes, or begins to turn. By
how much it differs is measured on the odometry before: a pose in the middle of a span is left out, interpolated, and
compared. Where speeds change at random the variance grows with the cube of the time between the messages, which brings
one span to another.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.model.events import Interpolation
from hsloc.model.pose2 import pose_differences, wrap_angles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model.events import Odometry

    F64 = NDArray[np.float64]

_LEAST_NS = 100_000_000
"""Messages that are no farther apart are as good as their poses: an ordinary robot is off by 3 mm and 0.4 deg."""
_REMEMBERED = 3000
"""Messages from which is learned: a minute at 50 Hz."""
_RENEWED = 16
"""Messages after which it is learned again, at most: from a minute of messages that takes a millisecond."""
_USUAL, _USUAL_TURN = 1.0, 2.0
"""Accelerations (m/s^2, rad/s^2) before anything is known; halfway a constant one makes an eighth of its square of the
time. Ordinary robots reach 2.5 and 5 (`odometry_stalls`), and rarely."""
_ASSUMED = 3.0
"""Poses left out that this assumption counts as."""
_HARDEST, _HARDEST_TURN = 10.0, 30.0
"""Accelerations (m/s^2, rad/s^2) beyond which the odometry jumped, as in `odometry_stalls`."""
_MOST, _MOST_TURN = 0.5, 0.35
"""Standard deviations (m, rad) at most: the localiser's wide window. After a gap of a minute nothing is known, and
poses there are doubted with less."""
_METRES_PER_RADIAN = 0.5
"""Metres that a radian counts for as motion: about the track width of an indoor robot."""


class _Errors(NamedTuple):
    """Of a number of `poses` that were left out: mean squared errors (2,; m^2, rad^2) in the middle of a span of 1 s.

    And the mean squared motion (2,) in 1 s.
    """

    poses: int
    squared: F64
    motion: F64


class Interpolations:
    """State: the last odometry messages that are not interpolated themselves."""

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=_REMEMBERED)
        self._poses: deque[tuple[float, float, float]] = deque(maxlen=_REMEMBERED)
        self._messages = 0
        self._known: dict[int, tuple[int, _Errors]] = {}

    def follow(self, odometry: Odometry) -> None:
        """The next message."""
        if odometry.interpolation is None:
            pose = odometry.T_odom_base
            self._stamps.append(odometry.stamp_ns)
            self._poses.append((pose.x, pose.y, pose.theta))
            self._messages += 1

    def between(self, before: Odometry, after: Odometry) -> Interpolation | None:
        """What a pose between two messages is like; None where it is as good as theirs."""
        whole_ns = after.stamp_ns - before.stamp_ns
        if whole_ns <= _LEAST_NS:
            return None
        seconds = whole_ns * 1e-9
        motion = before.T_odom_base.between(after.T_odom_base)
        way, turn = float(np.hypot(motion.x, motion.y)), abs(motion.theta)
        found = self._left_out(seconds)
        prior = (np.array((_USUAL, _USUAL_TURN)) * seconds**2 / 8.0) ** 2
        mean = (found.poses * found.squared * seconds**3 + _ASSUMED * prior) / (found.poses + _ASSUMED)
        # A robot that goes farther may be farther off: half of the variance is shared out by the squares of the motion.
        size = np.array((way + _METRES_PER_RADIAN * turn, turn)) ** 2
        usual = found.motion * seconds**2 if found.poses else size
        variances = 0.5 * mean * (1.0 + size / np.maximum(usual, 1e-12))
        variances = np.minimum(variances, np.array((_MOST, _MOST_TURN)) ** 2)
        return Interpolation(before.stamp_ns, after.stamp_ns, float(variances[0]), float(variances[1]))

    def _left_out(self, seconds: float) -> _Errors:
        """Of poses in the middle of spans of about this time."""
        n = len(self._stamps)
        interval = (self._stamps[-1] - self._stamps[0]) * 1e-9 / (n - 1) if n > 1 else 0.0
        half = max(round(0.5 * seconds / interval), 1) if interval > 0.0 else n
        learned_at, known = self._known.get(half, (0, _NOTHING))
        if self._messages - learned_at >= min(_RENEWED, 1 + learned_at // 4) and n > 2 * half:
            known = self._learn(half, interval)
            self._known[half] = self._messages, known
        return known

    def _learn(self, half: int, interval: float) -> _Errors:
        stamps, poses = np.array(self._stamps, dtype=np.int64) * 1e-9, np.array(self._poses)
        first, middle, last = (slice(k, len(stamps) - 2 * half + k) for k in (0, half, 2 * half))
        span = stamps[last] - stamps[first]
        part = (stamps[middle] - stamps[first]) / np.maximum(span, 1e-9)
        # Near its middle, and not over a gap.
        like = (np.abs(part - 0.5) < 0.25) & (span > half * interval) & (span < 4.0 * half * interval)
        span, part = span[like, None], part[like, None]
        whole = pose_differences(poses[last][like], poses[first][like])
        off = pose_differences(poses[middle][like], poses[first][like]) - part * whole
        off[:, 2] = wrap_angles(off[:, 2])
        errors = np.column_stack((np.hypot(off[:, 0], off[:, 1]) / np.sqrt(2.0), off[:, 2]))
        errors /= 4.0 * part * (1.0 - part)
        possible = (np.abs(errors) < np.array((_HARDEST, _HARDEST_TURN)) * span**2 / 8.0).all(axis=1)
        count = int(possible.sum())
        if count == 0:
            return _NOTHING
        turn = np.abs(whole[:, 2])
        speeds = np.column_stack((np.hypot(whole[:, 0], whole[:, 1]) + _METRES_PER_RADIAN * turn, turn)) / span
        # Spans of another length say as much, by the cube of the times.
        squared, motion = (errors**2 / span**3)[possible], (speeds**2)[possible]
        return _Errors(count, squared.mean(axis=0), motion.mean(axis=0))


_NOTHING = _Errors(0, np.zeros(2), np.zeros(2))
