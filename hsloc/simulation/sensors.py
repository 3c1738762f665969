"""What the robot sees with: a 2D lidar, and the sensor of the course report that looks through walls."""

from __future__ import annotations

from dataclasses import dataclass
from math import tau
from typing import TYPE_CHECKING, Annotated, Protocol, TypeAlias

import numpy as np

from hsloc.kernels.raycasting import cast_rays
from hsloc.model import IDENTITY, Pose2, Scan
from hsloc.model.pose2 import compose_poses
from hsloc.parameters import NonNegative, Parameters, Positive, Range, Ratio

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.simulation.world import World

    Array = NDArray[np.float64]


RANGE_STEP = 2.0**-10
"""Metres: as fine as the millimetres of a real lidar. Short binary numbers take a fifth off a compressed log."""
Beams: TypeAlias = Annotated[int, Range(1, 100_000)]
Length: TypeAlias = Annotated[float, Range(1e-6, 1e6)]


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """One source of randomness for each kind of noise, so that changing one leaves the others as they were."""

    ranges: np.random.Generator
    dropouts: np.random.Generator


class Sensor(Protocol):
    """Something that yields scans."""

    @property
    def mounting(self) -> Pose2:
        """T_base_laser."""
        ...

    @property
    def upside_down(self) -> bool:
        """Whether it is mounted upside down: its beams then turn clockwise, seen from above."""
        ...

    @property
    def motion_distortion(self) -> bool:
        """Whether each beam is measured at its own time during the sweep."""
        ...

    @property
    def beams(self) -> int:
        """Readings a scan."""
        ...

    def measure(
        self, world: World, stamp_ns: int, period_s: float, poses: Array, circles: Array, noise: SensorNoise
    ) -> Scan:
        """One scan. `poses` (1, 3) or (beams, 3) are T_map_base; `circles` (k, 3) are people's legs."""
        ...


@dataclass(frozen=True, slots=True)
class Lidar(Parameters):
    """A scanning 2D lidar; lengths in metres, angles in radians.

    `field_of_view` is centred ahead of the laser's frame; a full turn does not measure its first direction twice.
    Readings have Gaussian noise `range_noise` and are rounded to `range_step`; beyond `range_max` they are +inf,
    nearer than `range_min` -inf (REP-117). A fraction `dropout` of the readings is lost: NaN, or +inf where
    `dropout_as_inf`, as many drivers do, which wrongly claims free space. With `motion_distortion` the beams are
    spread over the whole period of the scan (`time_increment`), else all are measured at its stamp.
    """

    beams: Beams = 360
    """Number of beams of a scan."""
    field_of_view: Annotated[float, Range(1e-3, tau)] = tau
    """Angle from the first beam to the last [rad]."""
    range_min: NonNegative = 0.1
    """Smallest range that is measured [m]."""
    range_max: Length = 15.0
    """Largest range that is measured [m]."""
    range_noise: NonNegative = 0.01
    """Standard deviation of a range [m]."""
    range_step: Positive = RANGE_STEP
    """Step to which ranges are rounded [m]."""
    dropout: Ratio = 0.0
    """Ratio of the readings that are lost."""
    dropout_as_inf: bool = False
    """Whether a lost reading is +inf instead of NaN."""
    mounting: Pose2 = IDENTITY
    """Pose of the laser in the base frame."""
    upside_down: bool = False
    """Whether the laser is mounted upside down."""
    motion_distortion: bool = False
    """Whether each beam is measured at its own time during the sweep."""
    frame_id: str = "laser"
    """Name of the laser's frame."""

    def measure(
        self, world: World, stamp_ns: int, period_s: float, poses: Array, circles: Array, noise: SensorNoise
    ) -> Scan:
        """See `Sensor`."""
        angle_min, increment = self._geometry()
        turn = -1.0 if self.upside_down else 1.0
        T_map_laser = compose_poses(poses, self.mounting.to_array())
        directions = T_map_laser[:, 2] + turn * (angle_min + increment * np.arange(self.beams))
        origins = np.broadcast_to(T_map_laser[:, :2], (self.beams, 2))
        reach = self.range_max + float(np.hypot(*np.ptp(poses[:, :2], axis=0)))
        distances = cast_rays(
            np.ascontiguousarray(origins),
            np.column_stack((np.cos(directions), np.sin(directions))),
            within_reach(world.segments, T_map_laser[0, :2], reach),
            circles,
        )
        return Scan(
            stamp_ns=stamp_ns,
            ranges=self._readings(distances, noise),
            angle_min=turn * angle_min,
            angle_increment=turn * increment,
            range_min=_single(self.range_min),
            range_max=_single(self.range_max),
            time_increment=_single(period_s / self.beams) if self.motion_distortion else 0.0,
            T_base_laser=self.mounting,
            frame_id=self.frame_id,
        )

    def _geometry(self) -> tuple[float, float]:
        """Angle of the first beam and the step to the next, as the message will hold them."""
        is_full_turn = self.field_of_view > tau - 1e-6
        gaps = self.beams if is_full_turn else max(self.beams - 1, 1)
        return _single(-self.field_of_view / 2.0), _single(self.field_of_view / gaps)

    def _readings(self, distances: Array, noise: SensorNoise) -> NDArray[np.float32]:
        readings = distances + self.range_noise * noise.ranges.standard_normal(self.beams)
        lost = noise.dropouts.random(self.beams) < self.dropout
        finite = np.isfinite(readings)
        readings[finite] = np.round(readings[finite] / self.range_step) * self.range_step
        readings[(distances > self.range_max) | (readings > self.range_max)] = np.inf
        readings[readings < self.range_min] = -np.inf
        readings[lost] = np.inf if self.dropout_as_inf else np.nan
        return readings.astype(np.float32)


@dataclass(frozen=True, slots=True)
class PointSensor(Parameters):
    """The course report's sensor [P V]: every point of the world within range, seen through walls, free of noise.

    A scan message has evenly spaced beams, the points have not: each is put into the nearest of `beams`
    directions, all others are +inf. With 14,400 beams that moves a point 50 m away by at most 1.1 cm sideways,
    0.6 cm rms. Of two points in one direction the nearer counts.
    """

    beams: Beams = 14_400
    """Number of directions of a scan."""
    range_max: Length = 50.0
    """Largest range that is measured [m]."""
    range_step: Positive = RANGE_STEP
    """Step to which ranges are rounded [m]."""
    mounting: Pose2 = IDENTITY
    """Pose of the sensor in the base frame."""
    frame_id: str = "laser"
    """Name of the sensor's frame."""

    upside_down = False
    motion_distortion = False

    def measure(
        self, world: World, stamp_ns: int, period_s: float, poses: Array, circles: Array, noise: SensorNoise
    ) -> Scan:
        """See `Sensor`; `circles` and `noise` leave it untouched."""
        angle_min, increment = _single(-tau / 2.0), _single(tau / self.beams)
        points = np.empty((0, 2)) if world.points is None else world.points
        T_laser_map = (Pose2.from_array(poses[0]) @ self.mounting).inverse()
        seen = T_laser_map @ points
        distances = np.hypot(seen[:, 0], seen[:, 1])
        near = distances <= self.range_max
        beams = np.round((np.arctan2(seen[near, 1], seen[near, 0]) - angle_min) / increment).astype(int) % self.beams
        ranges = np.full(self.beams, np.inf)
        np.minimum.at(ranges, beams, np.round(distances[near] / self.range_step) * self.range_step)
        return Scan(
            stamp_ns=stamp_ns,
            ranges=ranges.astype(np.float32),
            angle_min=angle_min,
            angle_increment=increment,
            range_min=0.0,
            range_max=_single(self.range_max),
            T_base_laser=self.mounting,
            frame_id=self.frame_id,
        )


def within_reach(segments: Array, origin: Array, reach: float) -> Array:
    """The segments whose bounding box comes within `reach` of `origin` in x and in y: no others can be hit."""
    low, high = origin - reach, origin + reach
    xs, ys = segments[:, (0, 2)], segments[:, (1, 3)]
    near = (xs.max(axis=1) >= low[0]) & (xs.min(axis=1) <= high[0])
    near &= (ys.max(axis=1) >= low[1]) & (ys.min(axis=1) <= high[1])
    return np.ascontiguousarray(segments[near])


def _single(value: float) -> float:
    """As the message's 32 bits hold it: the log is then exact."""
    return float(np.float32(value))
