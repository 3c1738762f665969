"""Where the laser is, of lines that state the laser's pose or, depending on the log, that of a mapper's correction."""

from __future__ import annotations

from hsloc.model.pose2 import IDENTITY, Pose2, wrap_angle

_FEWEST_LINES = 20
_LEAST_TURNED = 1.0
"""Rotation (rad) without which a correction, too, may be the same all the time."""
_SAME_M = 0.005
"""Distance (m) between mountings that are one: poses are written with three to six decimals."""
_SAME_RAD = 0.005
_SAME_PART = 0.99
"""Part of the lines that state one mounting: a correction changes with the drift."""


class StatedMounting:
    """State: the poses of the laser in the base frame, as lines state them, and how far the robot turned."""

    def __init__(self) -> None:
        self._first: Pose2 | None = None
        self._lines = self._same = 0
        self._turned = 0.0
        self._heading: float | None = None

    def learn(self, T_base_laser: Pose2, heading: float) -> None:
        """Take a line, with the heading (rad) of the odometry in it."""
        first = self._first = T_base_laser if self._first is None else self._first
        turned = abs(wrap_angle(T_base_laser.theta - first.theta))
        self._lines += 1
        self._same += T_base_laser.distance(first) <= _SAME_M and turned <= _SAME_RAD
        self._turned += 0.0 if self._heading is None else abs(wrap_angle(heading - self._heading))
        self._heading = heading

    def mounting(self) -> Pose2 | None:
        """The laser's pose in the base frame; None where the lines do not state one, or that of the base."""
        first = self._first
        if first is None or (first.distance(IDENTITY) <= _SAME_M and abs(first.theta) <= _SAME_RAD):
            return None
        is_one = self._lines >= _FEWEST_LINES and self._same >= _SAME_PART * self._lines
        return first if is_one and self._turned >= _LEAST_TURNED else None
