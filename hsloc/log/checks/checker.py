"""The validator: what is wrong with a recording, before it is blamed on an algorithm.

The list is that of cartographer_rosbag_validate, with what users of 2D lidars ask for besides. One pass, in the order
of the log, with a memory that does not grow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.log.checks.findings import NANOSECONDS, Finding, Findings, Intervals, Place, Severity
from hsloc.log.checks.topics import OdometryCheck, ScanCheck, TopicCheck
from hsloc.log.messages.decode import OdometryMessage, ScanMessage
from hsloc.log.messages.definitions import POINT_CLOUD2
from hsloc.log.no_log import COPY_AGAIN
from hsloc.log.session.transform_topics import MAP_FRAME
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hsloc.log.messages.decode import LinkMessage
    from hsloc.log.reader import Log
    from hsloc.log.summary import LogSummary, Losses


@dataclass(frozen=True, slots=True)
class CheckReport:
    """All findings, the worst first; intervals between messages by topic; how many messages were looked at.

    `frames` are (frame, child frame) of scans and odometry by topic, `parents` the parent of each frame of transforms.
    """

    findings: tuple[Finding, ...]
    intervals: dict[str, Intervals]
    messages: int
    losses: Losses
    frames: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    parents: Mapping[str, str] = field(default_factory=dict)

    @property
    def has_errors(self) -> bool:
        """Whether results from this log are not to be trusted."""
        return any(finding.severity is Severity.ERROR for finding in self.findings)


def check_log(log: Log, progress: Callable[[int], None] | None = None) -> CheckReport:
    """Read all scans, odometry and transforms of a log once, and everything else for damage.

    `progress` is called with the log time (ns) every few thousand messages. Raises LogError where the log vanishes.
    """
    findings = Findings()
    topics: dict[tuple[str, type], TopicCheck] = {}
    transforms = TransformCheck(findings)
    count = 0
    for topic, log_time, message in log.observations():
        count += 1
        if isinstance(message, list):
            for link in message:
                transforms.add(topic, link, log_time)
        else:
            key = (topic, type(message))
            if key not in topics:
                topics[key] = _SCAN_OR_ODOMETRY[type(message)](topic, findings)
            topics[key].add(message, log_time)
        if progress is not None and count % 4096 == 0:
            progress(log_time)
    losses = log.losses.copy()
    for check in topics.values():
        check.finish()
        if check.steps:
            losses.clock_steps[check.topic] = check.steps
    if any(warning.code == WarningCode.CLOCK_SET for warning in log.summary.warnings):
        # Of the recorder: the order of the log is not that of writing, and its times are no measure of stamps.
        findings.drop(_BY_LOG_TIME)
        losses.clock_steps.clear()
    if losses.log_times_repaired:
        findings.add(
            Severity.WARNING, "log_time", "",
            "log times are impossible, or out of line with those around them: each was replaced by the one before",
            "none is needed: stamps are what counts; look at the recorder, whose clock these are of",
            losses.log_times_repaired,
        )  # fmt: skip
    for warning in losses.step_warnings(log.summary):
        findings.add(Severity.ERROR, warning.code, "", warning.text, warning.remedy)
    scans = [check for check in topics.values() if isinstance(check, ScanCheck)]
    odometry = [check for check in topics.values() if isinstance(check, OdometryCheck)]
    _check_frames(scans, findings)
    _check_coverage(scans, odometry, log.summary, findings)
    for check in odometry:
        if check.frame != MAP_FRAME:
            transforms.compare_odometry(check.topic, check.frame, check.child)
    _check_damage(log, losses, not topics and not _clouds(log.summary), findings)
    _check_summary(log.summary, bool(scans), losses, findings)
    intervals = {f"{check.topic} {check.what}": check.intervals for check in topics.values()}
    frames = {
        check.topic: (getattr(check, "frame", "") or "", getattr(check, "child", "") or "") for check in topics.values()
    }
    return CheckReport(tuple(findings.sorted()), intervals, count, losses, frames, transforms.parents)


_BY_LOG_TIME = ("latency", "latency_high", "other_clock", "stamp_backwards", "gap")
"""Findings that compare with the log's times, or go by their order."""
_SCAN_OR_ODOMETRY: dict[type, type[TopicCheck]] = {ScanMessage: ScanCheck, OdometryMessage: OdometryCheck}


def _check_frames(scans: list[ScanCheck], findings: Findings) -> None:
    by_frame: dict[str, list[str]] = {}
    for check in scans:
        by_frame.setdefault(check.frame or "", []).append(check.topic)
    for frame, topics in by_frame.items():
        if len(topics) > 1:
            findings.add(
                Severity.WARNING, "frame_shared", ", ".join(topics), f"scan topics share the frame {frame!r}",
                "give each laser its own frame; choose one with --scan-topic if they are the same laser",
            )  # fmt: skip


def _check_coverage(
    scans: list[ScanCheck], odometry: list[OdometryCheck], summary: LogSummary, findings: Findings
) -> None:
    """Scans before the first odometry or after the last have to do without."""
    chosen = next((check for check in odometry if check.topic == summary.odom_topic), None)
    if chosen is None or chosen.first_ns is None or chosen.last_ns is None:
        return
    for check in scans:
        if check.first_ns is None or check.last_ns is None:
            continue
        early, late = chosen.first_ns - check.first_ns, check.last_ns - chosen.last_ns
        if max(early, late) > NANOSECONDS // 2:
            findings.add(
                Severity.WARNING, "odometry_short", check.topic,
                f"scans begin {max(early, 0) / NANOSECONDS:.2f} s before {chosen.topic} and end "
                f"{max(late, 0) / NANOSECONDS:.2f} s after it",
                "cut the log with --start and --end to where it has both",
            )  # fmt: skip


_CHECKED_HERE = (WarningCode.TOPIC_MISSING, WarningCode.TOPIC_AMBIGUOUS, WarningCode.EXTRINSICS_ASSUMED)
"""Warnings of the opening that the checks have findings of their own for."""


def _clouds(summary: LogSummary) -> list[str]:
    """The topics of point clouds."""
    return [topic.topic for topic in summary.topics if topic.typename == POINT_CLOUD2 and topic.count]


def _check_summary(summary: LogSummary, has_scans: bool, losses: Losses, findings: Findings) -> None:
    """What was missing or had to be assumed when the log was opened.

    What is missing of a log that is cut off may have been in the part that is lost: then that is said first.
    """
    is_cut = bool(losses.truncated_files or losses.bytes_lost or losses.damaged_chunks)
    left = " in what is left of the log" if is_cut else ""
    first = f"{COPY_AGAIN}; else " if is_cut else ""
    clouds = _clouds(summary)
    if not has_scans and not (clouds and summary.scan_topic):
        findings.add(
            Severity.ERROR, "no_scan", "", f"no scans (sensor_msgs/msg/LaserScan){left}",
            f"read the point clouds on {clouds[0]} with --slice LOW,HIGH, the heights of walls above the base [m]"
            if clouds
            else f"{first}record again, with the laser's topic; `hsloc info` lists what there is",
        )  # fmt: skip
    elif summary.scan_topic is None:
        findings.add(
            Severity.WARNING, "scan_ambiguous", "", "several scan topics", "choose with --scan-topic, or name them all"
        )
    is_fixed = any(warning.code == WarningCode.ODOMETRY_UNUSABLE for warning in summary.warnings)
    has_any = has_scans or not is_cut
    if summary.odom_topic is None and summary.heading_topic is None and not is_fixed and has_any:
        findings.add(
            Severity.WARNING, "no_odometry", "",
            f"no odometry on a topic of its own or in /tf that would be chosen{left}",
            f"{first}choose with --odom-topic, or map without it: --no-odom",
        )  # fmt: skip
    for laser in summary.lasers:
        if laser.extrinsics == "identity":
            findings.add(
                Severity.WARNING, "no_extrinsic", laser.topic,
                f"no transform from {summary.base_frame or 'the base'} to {laser.frame or 'the laser'}",
                "record /tf_static, or give --laser-pose x,y,yaw",
            )  # fmt: skip
    for warning in summary.warnings:
        if warning.code == WarningCode.EXTRINSICS_ASSUMED and not summary.lasers:  # a text log
            findings.add(Severity.WARNING, "no_extrinsic", "", warning.text, warning.remedy)
        elif warning.code not in _CHECKED_HERE:
            severity = Severity.ERROR if warning.code == WarningCode.CLOCK_SET else Severity.WARNING
            findings.add(severity, warning.code, "", warning.text, warning.remedy or "see `hsloc info`")


def _check_damage(log: Log, losses: Losses, is_empty: bool, findings: Findings) -> None:
    """What could not be read: of the topics above, and, chunk by chunk, of everything."""
    everything = log.verify()
    for name in ("damaged_chunks", "unknown_compression", "bytes_lost", "truncated_files"):
        setattr(losses, name, getattr(everything, name))
    for reason in everything.reasons:
        losses.note(reason)
    if losses.data_lost:
        first = f" ({losses.reasons[0]})" if losses.reasons else ""
        used = "what is whole is used, and `hsloc convert` writes it into a sound file"
        if is_empty:
            used = f"{COPY_AGAIN}; else record again: no scan and no odometry of it is whole"
        elif losses.truncated_files or losses.bytes_lost or losses.damaged_chunks:
            used = f"{COPY_AGAIN}; else {used}"
        findings.add(Severity.DAMAGE, "damage", "", "; ".join(losses.lines()) + first, used)


MAX_FRAMES = 1000
"""Frames that are followed; a log with more is broken, and the others are left aside."""
_STATIC = "tf_static"


class TransformCheck:
    """Takes the transforms of a log one by one."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self.parents: dict[str, str] = {}
        self._stamps: dict[tuple[str, str], int] = {}
        self._number = 0

    def add(self, topic: str, link: LinkMessage, log_time_ns: int) -> None:
        """One transform of a message."""
        place = Place(topic, self._number, link.stamp_ns, log_time_ns)
        self._number += 1
        if link.child not in self.parents and len(self.parents) >= MAX_FRAMES:
            self._findings.add(
                Severity.WARNING, "frames", place, f"more than {MAX_FRAMES} frames", "look for a broken publisher"
            )
            return
        parent = self.parents.setdefault(link.child, link.parent)
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
        parent = self.parents.get(child)
        if not child or "odom" not in self.parents.values():
            return
        if parent is None or (parent != frame and frame):
            moved = sorted(name for name, above in self.parents.items() if above == "odom")
            self._findings.add(
                Severity.WARNING, "odometry_frames", topic,
                f"the topic speaks of {frame} -> {child}, /tf of odom -> {', '.join(moved[:5])}",
                "name --base-frame, or take odometry from /tf: --odom-topic tf",
            )  # fmt: skip
