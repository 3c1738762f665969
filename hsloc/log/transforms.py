"""Transforms between frames as logs carry them: in space, static or timed, in a tree.

Everything is projected to the plane in one place, at the end: `laser_mounting`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from hsloc.model import Pose2


@dataclass(frozen=True, slots=True)
class Transform3:
    """A frame's pose in its parent's: translation in metres, rotation as a unit quaternion (x, y, z, w).

    Composes with `@`, like `Pose2`.
    """

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    @staticmethod
    def from_pose2(pose: Pose2) -> Transform3:
        """A pose of the plane, lifted into space at z = 0."""
        return Transform3((pose.x, pose.y, 0.0), pose.to_quaternion())

    def to_pose2(self) -> Pose2:
        """The plane's part: z, roll and pitch are dropped."""
        x, y, _ = self.translation
        return Pose2.from_quaternion(x, y, *self.rotation)

    def normalised(self) -> Transform3:
        """With a rotation of unit length; an all-zero quaternion (unset in the log) becomes the identity."""
        x, y, z, w = self.rotation
        norm = sqrt(x * x + y * y + z * z + w * w)
        if norm < 1e-9:
            return Transform3(self.translation)
        return Transform3(self.translation, (x / norm, y / norm, z / norm, w / norm))

    def rotate(self, vector: tuple[float, float, float]) -> tuple[float, float, float]:
        """A direction of the child's frame, seen from the parent's."""
        x, y, z, w = self.rotation
        vx, vy, vz = vector
        # v + 2 w (q x v) + 2 q x (q x v), the quaternion product written out
        tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
        return (
            vx + w * tx + y * tz - z * ty,
            vy + w * ty + z * tx - x * tz,
            vz + w * tz + x * ty - y * tx,
        )

    def __matmul__(self, other: Transform3) -> Transform3:
        """Compose: `T_a_b @ T_b_c` is `T_a_c`."""
        moved = self.rotate(other.translation)
        ax, ay, az, aw = self.rotation
        bx, by, bz, bw = other.rotation
        return Transform3(
            (
                self.translation[0] + moved[0],
                self.translation[1] + moved[1],
                self.translation[2] + moved[2],
            ),
            (
                aw * bx + ax * bw + ay * bz - az * by,
                aw * by - ax * bz + ay * bw + az * bx,
                aw * bz + ax * by - ay * bx + az * bw,
                aw * bw - ax * bx - ay * by - az * bz,
            ),
        )

    def inverse(self) -> Transform3:
        """The parent's pose in the child's frame."""
        x, y, z, w = self.rotation
        turned = Transform3((0.0, 0.0, 0.0), (-x, -y, -z, w))
        tx, ty, tz = turned.rotate(self.translation)
        return Transform3((-tx, -ty, -tz), turned.rotation)
