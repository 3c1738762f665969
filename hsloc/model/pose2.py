"""A pose in the plane: SE(2), metres and radians."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, isfinite, pi, sin
from typing import TYPE_CHECKING, overload

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

TWO_PI = 2.0 * pi


def wrap_angle(angle: float) -> float:
    """Bring an angle in radians into (-pi, pi]."""
    wrapped = angle - TWO_PI * float(np.floor((angle + pi) / TWO_PI)) if not -pi < angle <= pi else angle
    return pi if wrapped <= -pi else wrapped


def wrap_angles(angles: Array) -> Array:
    """Bring angles in radians, of any shape, into (-pi, pi]."""
    return pi - np.mod(pi - angles, TWO_PI)


@dataclass(frozen=True, slots=True)
class Pose2:
    """A frame's pose in another: x and y in metres, theta in radians, counter-clockwise.

    Poses compose with `@`, and names contain the frames: `T_map_base @ T_base_laser` is
    `T_map_laser`; `T_map_laser @ points_laser` are the points, shape (n, 2), seen from the map.
    """

    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0

    @overload
    def __matmul__(self, other: Pose2) -> Pose2: ...
    @overload
    def __matmul__(self, other: Array) -> Array: ...
    def __matmul__(self, other: Pose2 | Array) -> Pose2 | Array:
        """Compose with a pose, or move points of shape (..., 2)."""
        c, s = cos(self.theta), sin(self.theta)
        if isinstance(other, Pose2):
            return Pose2(
                self.x + c * other.x - s * other.y,
                self.y + s * other.x + c * other.y,
                wrap_angle(self.theta + other.theta),
            )
        px, py = other[..., 0], other[..., 1]
        moved = np.empty((*px.shape, 2))
        moved[..., 0] = self.x + c * px - s * py
        moved[..., 1] = self.y + s * px + c * py
        return moved

    def inverse(self) -> Pose2:
        """The other frame's pose in this one."""
        c, s = cos(self.theta), sin(self.theta)
        return Pose2(-c * self.x - s * self.y, s * self.x - c * self.y, wrap_angle(-self.theta))

    def between(self, other: Pose2) -> Pose2:
        """`self.inverse() @ other`: the other pose seen from this one."""
        c, s = cos(self.theta), sin(self.theta)
        dx, dy = other.x - self.x, other.y - self.y
        return Pose2(c * dx + s * dy, -s * dx + c * dy, wrap_angle(other.theta - self.theta))

    def interpolate(self, other: Pose2, fraction: float) -> Pose2:
        """The pose at `fraction` of the way to `other`: straight in x and y, the short way round in theta."""
        return Pose2(
            self.x + fraction * (other.x - self.x),
            self.y + fraction * (other.y - self.y),
            wrap_angle(self.theta + fraction * wrap_angle(other.theta - self.theta)),
        )

    def distance(self, other: Pose2) -> float:
        """Distance in metres between the two origins."""
        return float(np.hypot(other.x - self.x, other.y - self.y))

    def is_finite(self) -> bool:
        """Whether no coordinate is NaN or infinite."""
        return isfinite(self.x) and isfinite(self.y) and isfinite(self.theta)

    def to_array(self) -> Array:
        """(x, y, theta) as a float64 array of shape (3,)."""
        return np.array((self.x, self.y, self.theta))

    @staticmethod
    def from_array(values: Array) -> Pose2:
        """From an array (x, y, theta) of shape (3,); theta is wrapped."""
        return Pose2(float(values[0]), float(values[1]), wrap_angle(float(values[2])))

    @staticmethod
    def from_quaternion(x: float, y: float, qx: float, qy: float, qz: float, qw: float) -> Pose2:
        """From a position and a quaternion as in ROS (x y z w); roll and pitch are dropped."""
        return Pose2(x, y, atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz))

    def to_quaternion(self) -> tuple[float, float, float, float]:
        """The rotation as a quaternion (x, y, z, w)."""
        return (0.0, 0.0, sin(self.theta / 2.0), cos(self.theta / 2.0))


IDENTITY = Pose2()


def rotated(covariance: Array, angle: float) -> Array:
    """A covariance or information (3, 3) of (x, y, theta), seen from a frame in which its own is turned by `angle`."""
    c, s = cos(angle), sin(angle)
    turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    result: Array = turn @ covariance @ turn.T
    return result


def relative_poses(first: Array, second: Array) -> Array:
    """`first^-1 @ second` row by row, for arrays of poses of shape (n, 3); theta is wrapped."""
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    dx, dy = second[:, 0] - first[:, 0], second[:, 1] - first[:, 1]
    return np.column_stack((c * dx + s * dy, -s * dx + c * dy, wrap_angles(second[:, 2] - first[:, 2])))


def pose_differences(poses: Array, others: Array) -> Array:
    """`poses` less `others`, number by number, for arrays of shape (n, 3) in one frame; theta is wrapped."""
    apart = poses - others
    apart[:, 2] = wrap_angles(apart[:, 2])
    return apart


def mahalanobis_distances(differences: Array, covariances: Array) -> Array:
    """Lengths (n,) of differences of poses (n, 3) in standard deviations, by their covariances (n, 3, 3)."""
    weighed = np.linalg.solve(covariances, differences[:, :, None])[:, :, 0]
    return np.asarray(np.sqrt(np.maximum((differences * weighed).sum(axis=1), 0.0)), dtype=np.float64)


def compose_poses(first: Array, second: Array) -> Array:
    """`first @ second` row by row, for arrays of poses of shape (n, 3), either may be (3,); theta is wrapped."""
    first, second = np.atleast_2d(first), np.atleast_2d(second)
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    x = first[:, 0] + c * second[:, 0] - s * second[:, 1]
    y = first[:, 1] + s * second[:, 0] + c * second[:, 1]
    return np.column_stack((x, y, wrap_angles(first[:, 2] + second[:, 2])))
