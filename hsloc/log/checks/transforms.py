"""Checks of /tf: one parent for each frame, stamps in order, rotations that are rotations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.log.checks.findings import Findings, Place, Severity
from hsloc.log.session.transform_topics import MAP_FRAME

if TYPE_CHECKING:
    from hsloc.log.messages.decode import LinkMessage

MAX_FRAMES = 1000
"""Frames that are followed; a log with more is broken, and the others are left aside."""
_STATIC = "tf_static"


class TransformCheck:
    """Takes the transforms of a log one by one."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._parents: dict[str, str] = {}
        self._stamps: dict[tuple[str, str], int] = {}
        self._number = 0

    def add(self, topic: str, link: LinkMessage, log_time_ns: int) -> None:
        """One transform of a message."""
        place = Place(topic, self._number, link.stamp_ns, log_time_ns)
        self._number += 1
        if link.child not in self._parents and len(self._parents) >= MAX_FRAMES:
            self._findings.add(
                Severity.WARNING, "frames", place, f"more than {MAX_FRAMES} frames", "look for a broken publisher"
            )
            return
        parent = self._parents.setdefault(link.child, link.parent)
        if parent != link.parent:
            self._findings.add(
                Severity.ERROR, "two_parents", place, f"{link.child} has two parents: {parent} and {link.parent}",
                "two nodes publish the frame (a localiser beside odometry, say); stop one, or name --odom-topic",
            )  # fmt: skip
        if (link.parent, link.child) == (MAP_FRAME, "odom"):
            self._findings.add(
                Severity.INFO, "map_to_odom", topic, "somebody localised while recording: map -> odom is in /tf",
                "it is never used as input; compare with it by --truth-topic tf",
            )  # fmt: skip
        norm = sum(value * value for value in link.transform.rotation) ** 0.5
        if not abs(norm - 1.0) < 1e-2:
            self._findings.add(
                Severity.ERROR, "quaternion", place, f"rotations of {link.child} are no unit quaternions",
                "repair its publisher",
            )  # fmt: skip
        if _STATIC not in topic:
            self._check_order(link, place)

    def _check_order(self, link: LinkMessage, place: Place) -> None:
        key = (link.parent, link.child)
        last = self._stamps.get(key)
        if last is not None and link.stamp_ns < last:
            self._findings.add(
                Severity.WARNING, "stamp_backwards", place, f"stamps of {link.parent} -> {link.child} run backwards",
                "look for two publishers of the transform",
            )  # fmt: skip
        self._stamps[key] = link.stamp_ns

    def compare_odometry(self, topic: str, frame: str, child: str) -> None:
        """Whether an odometry topic and /tf speak of the same frames."""
        parent = self._parents.get(child)
        if not child or "odom" not in self._parents.values():
            return
        if parent is None or (parent != frame and frame):
            moved = sorted(name for name, above in self._parents.items() if above == "odom")
            self._findings.add(
                Severity.WARNING, "odometry_frames", topic,
                f"the topic speaks of {frame} -> {child}, /tf of odom -> {', '.join(moved[:5])}",
                "name --base-frame, or take odometry from /tf: --odom-topic tf",
            )  # fmt: skip
