"""Events of a log, decoded when it is read: odometry or headings, scans and, where there is one, the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from math import cos, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.model.pose2 import IDENTITY, Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Interpolation(NamedTuple):
    """Of a pose that is interpolated: stamps of the messages around it (ns), and variances halfway (m^2, rad^2)."""

    before_ns: int
    after_ns: int
    way: float
    turn: float

    def variances(self, stamp_ns: int) -> NDArray[np.float64]:
        """Variances (3,) of x, y and theta at a stamp: none at the messages, as of a speed that changes evenly."""
        part = (stamp_ns - self.before_ns) / (self.after_ns - self.before_ns)
        return max(4.0 * part * (1.0 - part), 0.0) ** 2 * np.array((self.way, self.way, self.turn))


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Dead reckoning: the base's pose in the odometry frame.

    `covariance` is the 3 x 3 covariance of (x, y, theta) that the log states (m^2, rad^2), or None where it
    states none (all zero means unknown, not perfect). `has_heading` is False where the log states no orientation
    (a quaternion of zeros); the heading is then 0. `interpolation` is set where the pose is no measurement.
    """

    stamp_ns: int
    T_odom_base: Pose2
    covariance: NDArray[np.float64] | None = None
    has_heading: bool = True
    interpolation: Interpolation | None = None


@dataclass(frozen=True, slots=True)
class Heading:
    """The heading of the base (rad) from a start that is not known, where a log has no odometry; it may drift."""

    stamp_ns: int
    theta: float


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """A reference pose of the base that the log carries. It never reaches an estimator."""

    stamp_ns: int
    T_map_base: Pose2


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One turn of a 2D lidar.

    Beam i points along `angle_min + i * angle_increment` in the laser's frame and was measured at
    `stamp_ns + i * time_increment`. `ranges` (metres, shape (n,), float32 as in the log) keep their special
    values: +inf is no return within range, NaN and -inf are invalid. `T_base_laser` is the mounting; an
    upside-down laser is already turned (negated angles), so that the plane's geometry is all that is left.
    `T_base_beam` (n, 3), if the scan is deskewed, is where the base was when each beam was measured, seen from where
    it was at `stamp_ns`.
    """

    stamp_ns: int
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    time_increment: float = 0.0
    T_base_laser: Pose2 = IDENTITY
    frame_id: str = "laser"
    intensities: NDArray[np.float32] | None = field(default=None, repr=False)
    T_base_beam: NDArray[np.float64] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return f"<Scan: {self.frame_id!r} at {self.stamp_ns} ns, {self.hits().sum()} of {len(self.ranges)} beams hit>"

    def angles(self) -> NDArray[np.float64]:
        """Direction of each beam in the laser's frame, radians, shape (n,)."""
        return self.angle_min + self.angle_increment * np.arange(len(self.ranges), dtype=np.float64)

    def directions(self) -> NDArray[np.float64]:
        """Unit vectors along the beams in the laser's frame, shape (n, 2); not to be written to."""
        return _directions(len(self.ranges), self.angle_min, self.angle_increment)

    def hits(self) -> NDArray[np.bool_]:
        """Which beams hit something: finite and within [range_min, range_max] (both included)."""
        ranges = self.ranges
        with np.errstate(invalid="ignore"):
            return np.isfinite(ranges) & (ranges >= self.range_min) & (ranges <= self.range_max)

    def hit_ranges(self) -> NDArray[np.float64]:
        """The ranges of the hits, NaN for all other beams, metres, shape (n,)."""
        return np.where(self.hits(), self.ranges, np.nan).astype(np.float64)

    def beams_towards(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.intp]:
        """Numbers (m,) of the beams nearest to points in the laser's frame; n and more where none looks there."""
        along = (np.arctan2(y, x) - self.angle_min) * np.sign(self.angle_increment) % (2.0 * np.pi)
        return np.asarray(along / abs(self.angle_increment) + 0.5).astype(np.intp)

    def no_returns(self) -> NDArray[np.bool_]:
        """Which beams saw nothing within range (+inf): free space up to `range_max`."""
        return np.isposinf(self.ranges)

    def points_base(self) -> NDArray[np.float64]:
        """The hits as points in the base's frame, metres, shape (m, 2), in the order of the beams."""
        # Numba takes half a second to import, and not all who read a log need points.
        from hsloc.kernels.surfels import place_hits

        n, laser = len(self.ranges), self.T_base_laser
        found = np.empty((n, 2))
        count = place_hits(
            np.ascontiguousarray(self.ranges),
            (float(self.range_min), float(self.range_max)),
            self.directions(),
            (float(laser.x), float(laser.y), cos(laser.theta), sin(laser.theta)),
            found,
        )
        points: NDArray[np.float64] = found[:count]
        if self.T_base_beam is None:
            return points
        x, y, theta = self.T_base_beam[self.hits()].T
        c, s = np.cos(theta), np.sin(theta)
        return np.column_stack((x + c * points[:, 0] - s * points[:, 1], y + s * points[:, 0] + c * points[:, 1]))

    def noise(self) -> NDArray[np.float64]:
        """The standard deviation of the range of each point of `points_base` (m), shape (m,); 0 where not known."""
        from hsloc.kernels.fitness import range_noise

        found = np.empty(len(self.ranges))
        limits = float(self.range_min), float(self.range_max)
        range_noise(np.ascontiguousarray(self.ranges), *limits, float(self.angle_increment), found)
        known: NDArray[np.float64] = found[self.hits()]
        return known


@lru_cache(maxsize=16)
def _directions(beams: int, angle_min: float, increment: float) -> NDArray[np.float64]:
    """Unit vectors (n, 2) along the beams in the laser's frame: a lidar measures along the same ones in each scan."""
    angles = angle_min + increment * np.arange(beams, dtype=np.float64)
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    directions.flags.writeable = False
    return directions


@dataclass(frozen=True, slots=True, eq=False)
class PairedScan:
    """A scan, and the pose of the base at its stamp by odometry.

    Of several lasers, scans of about the same time are matched together: `companions` are those that this one carries,
    and a scan that another one will carry `is_held`: nothing is to be matched yet. `heading` is the last one before the
    scan (rad), where the log has headings and no odometry. `interpolation` is that of `T_odom_base`, if it is between
    messages that are far apart.
    """

    scan: Scan
    T_odom_base: Pose2
    companions: tuple[PairedScan, ...] = ()
    is_held: bool = False
    heading: float | None = None
    interpolation: Interpolation | None = None

    def points_base(self) -> NDArray[np.float64]:
        """The hits of the scan and its companions in the base's frame at the scan's stamp, metres, shape (m, 2)."""
        points = self.scan.points_base()
        if not self.companions:
            return points
        return np.concatenate((points, *(self.to(other) @ other.scan.points_base() for other in self.companions)))

    def to(self, other: PairedScan) -> Pose2:
        """How the base moved from this scan to another, by odometry."""
        return self.T_odom_base.between(other.T_odom_base)


HELD = "matched together with the next laser's scan"
"""Reason of the estimate of a scan that is held."""


Event = Odometry | Heading | Scan | Truth
