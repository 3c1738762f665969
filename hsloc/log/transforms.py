"""Transforms between frames as logs carry them: in space, static or timed, in a tree.

Everything is projected to the plane in one place, at the end: `laser_mounting`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import acos, atan2, hypot, sqrt
from typing import TYPE_CHECKING

from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Sequence


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


_MAX_STATEMENTS = 8
"""Different values of one static transform that are kept for the warning."""
_FEW_PLACES = 4
"""Places of a frame up to which several publishers may have stated one each; a joint that moves has more."""
MOVED_METRES, MOVED_RADIANS = 1e-3, 2e-3
"""Change (m, rad) above which a mounting counts as moving. Internal: above the noise of a joint's encoder."""


class FrameTree:
    """Frames and their parents, as far as a log states them; what comes later overrides."""

    def __init__(self) -> None:
        self._links: dict[str, tuple[str, Transform3]] = {}
        self._changes: Counter[str] = Counter()
        self._statements: dict[str, list[tuple[str, Transform3]]] = {}
        self.unturned: dict[str, tuple[float, ...]] = {}
        """Frames whose last quaternion states no rotation, with it."""

    def add(self, parent: str, child: str, transform: Transform3) -> None:
        """State (or restate) a frame's pose in its parent's."""
        if states_rotation(transform.rotation):
            self.unturned.pop(child, None)
        else:
            self.unturned[child] = transform.rotation
        transform = transform.normalised()
        known = self._links.get(child)
        if known is not None and differ(known, (parent, transform)):
            self._changes[child] += 1
        self._links[child] = (parent, transform)
        statements = self._statements.setdefault(child, [])
        if len(statements) < _MAX_STATEMENTS and all(differ((parent, transform), each) for each in statements):
            statements.append((parent, transform))

    def statements(self, frame: str) -> list[tuple[str, Transform3]]:
        """Different (parent, transform) that were stated of a frame, in their order; of many the first few."""
        return self._statements.get(frame, [])

    def resolve(self, frame: str, beside: str = "") -> str | None:
        """The frame under the name that the tree has for it: itself, or with or without a prefix.

        Of several with one last name the one with the prefix of `beside` is meant; None where that is ambiguous.
        """
        if frame in self:
            return frame
        name = frame.rpartition("/")[2]
        found = [known for known in self.frames() if known.rpartition("/")[2] == name]
        alike = [known for known in found if known.rpartition("/")[0] == beside.rpartition("/")[0]]
        for candidates in (alike, found):
            if len(candidates) == 1:
                return candidates[0]
        return None

    def __contains__(self, frame: str) -> bool:
        return frame in self._links or any(parent == frame for parent, _ in self._links.values())

    def frames(self) -> list[str]:
        """All frames, sorted."""
        return sorted(self._links.keys() | {parent for parent, _ in self._links.values()})

    def children(self) -> set[str]:
        """All frames that have a parent."""
        return set(self._links)

    def is_moving(self, frame: str) -> bool:
        """Whether the frame's pose in its parent's changed."""
        return frame in self._changes

    def alternates(self, frame: str) -> bool:
        """Whether the frame's pose changes between a few places, each stated again and again by its own publisher."""
        return len(self.statements(frame)) <= _FEW_PLACES < self._changes[frame]

    def _ancestry(self, frame: str) -> list[str]:
        """The frame, its parent, and so on; ends at the root, or where a loop would close."""
        line = [frame]
        while (link := self._links.get(line[-1])) and link[0] not in line:
            line.append(link[0])
        return line

    def path(self, target: str, source: str) -> tuple[list[str], list[str]] | None:
        """Frames to climb from target and from source to their nearest common ancestor; None without one."""
        up_target, up_source = self._ancestry(target), self._ancestry(source)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            return None
        return up_target[: up_target.index(common)], up_source[: up_source.index(common)]

    def lookup(self, target: str, source: str) -> Transform3 | None:
        """T_target_source, or None where the frames are not connected.

        Where a frame was given several parents, the last one that connects the two counts.
        """
        path = self.path(target, source)
        if path is None:
            return self._lookup_by_earlier_parents(target, source)
        from_target, from_source = (self._climb(frames) for frames in path)
        return from_target.inverse() @ from_source

    def lookup_if(self, frame: str, statement: tuple[str, Transform3], target: str, source: str) -> Transform3 | None:
        """T_target_source if `statement` were the parent and the pose of a frame that has others, too."""
        last = self._links.get(frame)
        self._links[frame] = statement
        path = self.path(target, source)
        found = None if path is None else [self._climb(frames) for frames in path]
        if last is None:
            del self._links[frame]
        else:
            self._links[frame] = last
        return None if found is None else found[0].inverse() @ found[1]

    def _lookup_by_earlier_parents(self, target: str, source: str) -> Transform3 | None:
        for child, statements in self._statements.items():
            for statement in reversed(statements[:-1]):
                found = self.lookup_if(child, statement, target, source)
                if found is not None:
                    return found
        return None

    def _climb(self, frames: list[str]) -> Transform3:
        """The pose of the first frame in the parent of the last."""
        total = Transform3()
        for frame in frames:
            total = self._links[frame][1] @ total
        return total


_UNIT = 1e-3
"""Error of the length of a quaternion that was written with few digits."""
_ROUNDED = 0.05
"""Length of x, y and z beside which w is 1 if it was rounded to three digits."""


def states_rotation(quaternion: Sequence[float]) -> bool:
    """Whether a quaternion (x, y, z, w) states a rotation: not where it or its w was never filled.

    With w = 0 the robot would look straight back, which no robot does all the time; then the others are of unit length.
    With w = 1 it would look ahead, and they are 0: angles were written in their place where they are not.
    """
    x, y, z, w = quaternion
    if w not in (0.0, 1.0):
        return True
    length = sqrt(x * x + y * y + z * z)
    return abs(length - 1.0) <= _UNIT if w == 0.0 else length <= _ROUNDED


def differ(first: tuple[str, Transform3], second: tuple[str, Transform3]) -> bool:
    """Whether two statements of a frame's parent and normalised pose contradict each other."""
    return first[0] != second[0] or _moved(first[1], second[1])


def _moved(first: Transform3, second: Transform3) -> bool:
    change = first.inverse() @ second
    x, y, z, w = change.rotation
    angle = 2.0 * atan2(sqrt(x * x + y * y + z * z), abs(w))
    return hypot(*change.translation) > MOVED_METRES or angle > MOVED_RADIANS


@dataclass(frozen=True, slots=True)
class Mounting:
    """How a laser is mounted, as far as it matters in the plane.

    `flipped` lasers are upside-down: their angles count clockwise. `tilt` (radians) is the angle between the
    laser's plane and the base's.
    """

    T_base_laser: Pose2
    flipped: bool = False
    tilt: float = 0.0


def laser_mounting(T_base_laser: Transform3) -> Mounting:
    """Project a mounting to the plane.

    As AMCL does (it moves angle_min and angle_min + angle_increment to the base and takes the sign of what comes
    out): the laser's x axis gives the direction, the sign of its z axis says whether angles are negated.
    """
    ux, uy, _ = T_base_laser.rotate((1.0, 0.0, 0.0))
    *_, up = T_base_laser.rotate((0.0, 0.0, 1.0))
    x, y, _ = T_base_laser.translation
    return Mounting(Pose2(x, y, atan2(uy, ux)), up < 0.0, acos(min(abs(up), 1.0)))
