"""Formats of text logs: CARMEN, and the Wean Hall logs."""

from __future__ import annotations

from math import isfinite, pi
from typing import TYPE_CHECKING

import numpy as np

from hsloc.log.text.line_format import Line, pose, rounded, stamp_ns
from hsloc.model import IDENTITY, Odometry, Scan, Truth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.model import Pose2

MAX_BEAMS = 20_000
"""Maximum number of beams of a scan. Internal: guards the memory against a damaged file."""

_WEAN_UNIT = 0.01
"""Unit of the Wean format [m]."""
_WEAN_BEAMS = 180
"""Beams of each scan of the Wean format."""


def beam_angles(count: int) -> tuple[float, float]:
    """(angle_min, angle_increment) of n beams over 180 degrees.

    With and without the beam at +90 degrees: 180 and 181 beams are one degree apart, 360 and 361 half a degree.
    """
    return -pi / 2.0, pi / max(count - count % 2, 1)


def numbers(words: Sequence[str]) -> NDArray[np.float32]:
    """Words as numbers; what single precision does not hold is infinite. Raises ValueError."""
    with np.errstate(over="ignore"):
        # Python reads them in two thirds of the time that numpy takes, to the same numbers.
        return np.array(list(map(float, words)), dtype=np.float32)


def readings(words: Sequence[str]) -> tuple[NDArray[np.float32], int]:
    """A count and that number of values at the head of `words`; returns them and the number of words read."""
    count = int(words[0])
    if not 0 <= count <= MAX_BEAMS or len(words) < 1 + count:
        raise ValueError(f"{words[0]} readings in {len(words)} words")
    return numbers(words[1 : 1 + count]), 1 + count


class Carmen:
    """The format of CARMEN: ODOM, FLASER, ROBOTLASER1 and TRUEPOS lines.

    Fields as in CARMEN's own loggers::

        ODOM x y theta tv rv accel ipc_timestamp ipc_hostname logger_timestamp
        FLASER n r1 .. rn x y theta odom_x odom_y odom_theta ipc_timestamp ipc_hostname logger_timestamp
        ROBOTLASER1 type start_angle field_of_view resolution maximum_range accuracy remission_mode n r1 .. rn
            m i1 .. im laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward side turn
            ipc_timestamp ipc_hostname logger_timestamp
        TRUEPOS x y theta odom_x odom_y odom_theta ipc_timestamp ipc_hostname logger_timestamp

    The stamp is the ipc_timestamp, third from the end. The odometry of laser lines is used only in logs without ODOM
    lines (it repeats them); the x, y, theta of FLASER are, depending on the log, the laser's pose or that of a mapper's
    correction: the mounting of the scan counts where it is the same in all lines. Where a line has no room for its
    stamp, IndexError says so.
    """

    name = "CARMEN"
    keywords = frozenset(("ODOM", "FLASER", "ROBOTLASER1", "TRUEPOS"))
    states_mounting = frozenset(("ROBOTLASER1",))
    may_state_mounting = frozenset(("FLASER",))
    laser_odometry = False

    def parse(self, words: Sequence[str]) -> Line:
        """As `LineFormat.parse`."""
        if words[0] == "ODOM":
            if len(words) < 10:
                raise ValueError("too short")
            return Line(odometry=Odometry(stamp_ns(words[-3]), pose(words[1:4])))
        if words[0] == "FLASER":
            return _front_laser(words)
        if words[0] == "ROBOTLASER1":
            return _robot_laser(words)
        if len(words) < 10:
            raise ValueError("too short")
        return Line(truth=Truth(stamp_ns(words[-3]), pose(words[1:4])))


def _front_laser(words: Sequence[str]) -> Line:
    ranges, used = readings(words[1:])
    rest = words[1 + used :]
    if len(rest) < 9:
        raise ValueError("too short")
    stamp = stamp_ns(words[-3])
    angle_min, increment = beam_angles(len(ranges))
    T_odom_base = pose(rest[3:6])
    mounting = IDENTITY if rest[:3] == rest[3:6] else _stated(rest[:3], T_odom_base)
    scan = Scan(stamp, ranges, angle_min, increment, 0.0, 0.0, T_base_laser=mounting, frame_id="laser")
    return Line(odometry=Odometry(stamp, T_odom_base), scan=scan)


def _stated(words: Sequence[str], T_odom_base: Pose2) -> Pose2:
    """The laser in the base frame, if the words are its pose; what is no pose states nothing, and loses no scan."""
    try:
        return rounded(T_odom_base.between(pose(words)))
    except ValueError:
        return IDENTITY


def _robot_laser(words: Sequence[str]) -> Line:
    start, resolution, range_max = float(words[2]), float(words[4]), float(words[5])
    if not (isfinite(start) and isfinite(resolution) and isfinite(range_max) and range_max > 0.0):
        raise ValueError("the laser's configuration is not finite")
    ranges, used = readings(words[8:])
    remissions, more = readings(words[8 + used :])
    rest = words[8 + used + more :]
    if len(rest) < 14:
        raise ValueError("too short")
    stamp = stamp_ns(words[-3])
    T_world_laser, T_world_base = pose(rest[0:3]), pose(rest[3:6])
    scan = Scan(
        stamp,
        # The line states its own limit: at and beyond it nothing was measured.
        np.where(ranges >= np.float32(range_max), np.float32(np.inf), ranges),
        start,
        resolution,
        0.0,
        range_max,
        T_base_laser=rounded(T_world_base.between(T_world_laser)),
        frame_id="laser",
        intensities=remissions if len(remissions) else None,
    )
    return Line(odometry=Odometry(stamp, T_world_base), scan=scan)


class Wean:
    """The format of the Wean Hall logs (Carnegie Mellon's course on particle filters): O and L lines.

    ::

        O x y theta t
        L x y theta laser_x laser_y laser_theta r1 .. r180 t

    Centimetres and radians in the odometry's frame, seconds from the log's start; beams one degree apart from -90. Both
    lines carry odometry, those of L that of the scan; O lines run about 0.15 s ahead of it and are not read where there
    are L lines. The second pose of L is the laser's, which gives its mounting.
    """

    name = "Wean"
    keywords = frozenset(("O", "L"))
    states_mounting = frozenset(("L",))
    may_state_mounting = frozenset[str]()
    laser_odometry = True

    def parse(self, words: Sequence[str]) -> Line:
        """As `LineFormat.parse`."""
        expected = 5 if words[0] == "O" else 8 + _WEAN_BEAMS
        if len(words) != expected:
            raise ValueError(f"{len(words)} words, not {expected}")
        stamp = stamp_ns(words[-1])
        T_odom_base = pose(words[1:4], _WEAN_UNIT)
        odometry = Odometry(stamp, T_odom_base)
        if words[0] == "O":
            return Line(odometry=odometry)
        mounting = T_odom_base.between(pose(words[4:7], _WEAN_UNIT))
        ranges = numbers(words[7:-1]) * np.float32(_WEAN_UNIT)
        angle_min, increment = beam_angles(_WEAN_BEAMS)
        scan = Scan(stamp, ranges, angle_min, increment, 0.0, 0.0, T_base_laser=rounded(mounting), frame_id="laser")
        return Line(odometry=odometry, scan=scan)
