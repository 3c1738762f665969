"""What a calibration says of a robot: how its odometry is to be corrected, and where and when its lidars measure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.events import Odometry
from hsloc.model.pose2 import IDENTITY, Pose2, relative_poses

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from hsloc.model.events import Event

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OdometryCorrection:
    """Linear correction of a planar odometry; with wheels that are too large, unequal, or a wrong track it is exact.

    A step of the odometry that drives ds (m) and turns dtheta (rad) truly drives `scale` ds and turns
    `rotation_scale` dtheta + `turn_per_metre` ds. For a differential drive whose radii are assumed alike, `scale` is
    the mean radius over the assumed one, `scale / rotation_scale` the track over the assumed one, and
    `turn_per_metre` (rad/m) the difference of the radii over track and assumed radius. Source: Censi, Franchi,
    Marchionni, Oriolo, T-RO 2013, whose matrix J this is, seen from the integrated odometry.
    """

    scale: float = 1.0
    rotation_scale: float = 1.0
    turn_per_metre: float = 0.0

    def __call__(self, poses: F64) -> F64:
        """The corrected poses of odometry poses, both (n, 3); the first one stays. The last heading is unwrapped."""
        along, aside, turned = self.steps(relative_poses(poses[:-1], poses[1:])).T
        theta = poses[0, 2] + np.concatenate(([0.0], np.cumsum(turned)))
        c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
        x = poses[0, 0] + np.concatenate(([0.0], np.cumsum(c * along - s * aside)))
        y = poses[0, 1] + np.concatenate(([0.0], np.cumsum(s * along + c * aside)))
        return np.column_stack((x, y, theta))

    def step(self, step: Pose2) -> Pose2:
        """A corrected step between two messages."""
        return Pose2.from_array(self.steps(step.to_array()[None])[0])

    def steps(self, steps: F64) -> F64:
        """Corrected steps of steps, both (n, 3). Turns are as long as they are: they are not wrapped."""
        turned = self.rotation_scale * steps[:, 2] + self.turn_per_metre * _driven(steps)
        # A chord points along the middle of its turn.
        bend = 0.5 * (turned - steps[:, 2])
        c, s = self.scale * np.cos(bend), self.scale * np.sin(bend)
        return np.column_stack((c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1], turned))

    def inverse(self) -> OdometryCorrection:
        """The correction that undoes this one."""
        return OdometryCorrection(
            1.0 / self.scale, 1.0 / self.rotation_scale, -self.turn_per_metre / (self.rotation_scale * self.scale)
        )

    @property
    def track_factor(self) -> float:
        """True track of a differential drive over the one that its odometry assumes."""
        return self.scale / self.rotation_scale


NO_CORRECTION = OdometryCorrection()


def step_derivatives(steps: F64) -> F64:
    """Derivatives (3, n, 3) of corrected steps by the three values of a correction, at no correction; steps (n, 3)."""
    found = np.zeros((3, len(steps), 3))
    found[0, :, :2] = steps[:, :2]
    found[1, :, 2] = steps[:, 2]
    found[2, :, 2] = _driven(steps)
    for of_turn in found[1:]:
        of_turn[:, 0] = -0.5 * of_turn[:, 2] * steps[:, 1]
        of_turn[:, 1] = 0.5 * of_turn[:, 2] * steps[:, 0]
    return found


def _driven(steps: F64) -> F64:
    """What steps (n, 3) drive forwards (m), shape (n,): negative where the robot drives backwards."""
    half = 0.5 * steps[:, 2]
    return np.asarray(np.cos(half) * steps[:, 0] + np.sin(half) * steps[:, 1], dtype=np.float64)


def corrected_odometry(events: Iterable[Event], correction: OdometryCorrection) -> Iterator[Event]:
    """Events whose odometry is corrected step by step; the first pose stays."""
    before: Pose2 | None = None
    pose = IDENTITY
    for event in events:
        if not isinstance(event, Odometry):
            yield event
            continue
        here = event.T_odom_base
        pose = here if before is None else pose @ correction.step(before.between(here))
        before = here
        yield replace(event, T_odom_base=pose)


@dataclass(frozen=True, slots=True)
class LidarCalibration:
    """A lidar: where it is mounted on the base, and what is added to its stamps (s) to get the odometry's time."""

    T_base_laser: Pose2 | None = None
    time_offset_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """Corrections of the odometry and of each lidar, by the topic of its scans."""

    odometry: OdometryCorrection = NO_CORRECTION
    lidars: tuple[tuple[str, LidarCalibration], ...] = ()

    def lidar(self, topic: str) -> LidarCalibration | None:
        """That of a topic, its leading slash left out or not."""
        return next((lidar for name, lidar in self.lidars if name.lstrip("/") == topic.lstrip("/")), None)
