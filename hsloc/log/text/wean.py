"""The format of the Wean Hall logs (Carnegie Mellon's course on particle filters): O and L lines.

::

    O x y theta t
    L x y theta laser_x laser_y laser_theta r1 .. r180 t

Centimetres and radians in the odometry's frame, seconds from the log's start; beams one degree apart from -90. Both
lines carry odometry, those of L that of the scan; O lines run about 0.15 s ahead of it and are not read where there are
L lines. The second pose of L is the laser's, which gives its mounting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.log.text.carmen import beam_angles, numbers
from hsloc.log.text.line_format import Line, pose, rounded, stamp_ns
from hsloc.model import Odometry, Scan

if TYPE_CHECKING:
    from collections.abc import Sequence

METRES = 0.01
"""Unit of the format (m)."""
BEAMS = 180
"""Beams of each scan of the format."""


class Wean:
    """The format."""

    name = "Wean"
    keywords = frozenset(("O", "L"))
    states_mounting = frozenset(("L",))
    laser_odometry = True

    def parse(self, words: Sequence[str]) -> Line:
        """As `LineFormat.parse`."""
        expected = 5 if words[0] == "O" else 8 + BEAMS
        if len(words) != expected:
            raise ValueError(f"{len(words)} words, not {expected}")
        stamp = stamp_ns(words[-1])
        T_odom_base = pose(words[1:4], METRES)
        odometry = Odometry(stamp, T_odom_base)
        if words[0] == "O":
            return Line(odometry=odometry)
        mounting = T_odom_base.between(pose(words[4:7], METRES))
        ranges = numbers(words[7:-1]) * np.float32(METRES)
        angle_min, increment = beam_angles(BEAMS)
        scan = Scan(stamp, ranges, angle_min, increment, 0.0, 0.0, T_base_laser=rounded(mounting), frame_id="laser")
        return Line(odometry=odometry, scan=scan)
