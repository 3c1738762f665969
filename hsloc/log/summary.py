"""What a log holds, what is read from it and how, and what was lost on the way."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import dataclass, field
from math import nan
from typing import TYPE_CHECKING

from hsloc.errors import ConfigError
from hsloc.model import IDENTITY, Pose2
from hsloc.options import AUTO, STAMPS
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from hsloc.log.transforms import Transform3
    from hsloc.model.calibration import Calibration

NANOSECONDS = 1_000_000_000
LONGEST_OFFSET_S = 1e6
"""Clocks that are farther apart (s) are of different epochs: the log's time is the way out."""


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a log. None means: find out.

    `scan_topic` may name several topics, separated by commas: their scans are merged into one run. `truth_topic` may
    be `"tf"`: the truth is then map -> odom -> base of /tf. `base_frame` names the frame of the robot's base,
    `laser_pose` overrides the mounting T_base_laser that the log states. `start_s` and `end_s` cut a half-open window,
    in seconds from the first event of the chosen topics. Without `require_scan` or
    `require_odometry` a missing or ambiguous topic is a warning, not an error. `deskew` asks for scans whose points
    are moved to where the robot was when each beam was measured.

    `scan_fix` overrides fields of scans (see `hsloc.log.session.scan_geometry.ScanFixes`). `slice` are two heights
    above the base [m], `LOW,HIGH`: point clouds are read as scans, the nearest point of each direction between them.
    `time_offset` (`TOPIC=SECONDS`, several with commas, or `auto`) is added to the stamps of a topic. With `stamps`
    "log" the log's times are used in place of the header stamps. `wheels` are radius and track [m], `RADIUS,TRACK`:
    odometry is then made of joint states. `calibration` corrects the odometry, and mounting and stamps of the lidars
    that it names; a `laser_pose` is used instead of its mounting, a `time_offset` in addition. `mountings` are those of
    laser frames that the log states several times, by frame: T_base_laser of each as it is to be used.
    """

    scan_topic: str | None = None
    odom_topic: str | None = None
    truth_topic: str | None = None
    base_frame: str | None = None
    laser_pose: Pose2 | None = None
    start_s: float | None = None
    end_s: float | None = None
    require_scan: bool = True
    require_odometry: bool = True
    deskew: bool = False
    scan_fix: str | None = None
    slice: str | None = None
    time_offset: str | None = None
    stamps: str = "header"
    wheels: str | None = None
    calibration: Calibration | None = None
    mountings: tuple[tuple[str, Transform3], ...] = ()

    def __post_init__(self) -> None:
        if self.stamps not in STAMPS:
            raise ConfigError(f"stamps is {self.stamps!r}; it must be one of {', '.join(STAMPS)}")
        self.heights()
        self.offsets_s()
        self.wheel_size()

    def wheel_size(self) -> tuple[float, float] | None:
        """Radius and track of `wheels` [m]. Raises ConfigError."""
        if self.wheels is None:
            return None
        radius, track = _pair(self.wheels)
        if not (0.0 < radius < 100.0 and 0.0 < track < 100.0):
            raise ConfigError(f"--wheels {self.wheels}: must be RADIUS,TRACK, both above 0 metres")
        return radius, track

    def heights(self) -> tuple[float, float] | None:
        """The two heights of `slice` [m]. Raises ConfigError."""
        if self.slice is None:
            return None
        low, high = _pair(self.slice)
        if not low < high:
            raise ConfigError(f"--slice {self.slice}: must be LOW,HIGH, two heights above the base in metres")
        return low, high

    def offsets_s(self) -> dict[str, float]:
        """Seconds to add by topic, its name without the leading slash. Raises ConfigError."""
        found: dict[str, float] = {}
        if self.calibration is not None:
            found = {topic.lstrip("/"): lidar.time_offset_s for topic, lidar in self.calibration.lidars}
        if self.time_offset is None or self.time_offset == AUTO:
            return found
        for item in self.time_offset.split(","):
            topic, _, seconds = item.rpartition("=")
            try:
                value = float(seconds)
            except ValueError:
                value = float("nan")
            if not topic or not abs(value) <= LONGEST_OFFSET_S:
                raise ConfigError(
                    f"--time-offset {item}: must be auto, or TOPIC=SECONDS with at most {LONGEST_OFFSET_S:g} seconds; "
                    "--stamps log is the way out for clocks that are farther apart"
                )
            name = topic.strip().lstrip("/")
            found[name] = found.get(name, 0.0) + value
        return found


def _pair(text: str) -> tuple[float, float]:
    """Two numbers with a comma between them; NaN where the text is anything else."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        return nan, nan
    return first, second


@dataclass(slots=True)
class TopicStatistics:
    """Counts and times of one topic, filled message by message or from an index."""

    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    largest_gap_ns: int = 0

    def add(self, first_ns: int, last_ns: int, count: int, inner_gap_ns: int) -> None:
        """Add `count` messages between two log times, with their largest gap between neighbours."""
        if self.last_ns is not None:
            self.largest_gap_ns = max(self.largest_gap_ns, first_ns - self.last_ns)
        self.largest_gap_ns = max(self.largest_gap_ns, inner_gap_ns)
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = last_ns if self.last_ns is None else max(self.last_ns, last_ns)
        self.count += count


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """A topic: its message type as in ROS 2, how it is encoded, how many messages, how often (by log time)."""

    topic: str
    typename: str
    encoding: str
    count: int
    first_ns: int | None
    last_ns: int | None
    largest_gap_s: float

    @property
    def rate_hz(self) -> float:
        """Mean rate; 0 where it is unknown."""
        if self.count < 2 or self.first_ns is None or self.last_ns is None or self.last_ns <= self.first_ns:
            return 0.0
        return (self.count - 1) * NANOSECONDS / (self.last_ns - self.first_ns)


@dataclass(frozen=True, slots=True)
class LaserSummary:
    """A laser: its scan topic, its frame, how it is mounted, and where that is stated (as in `LogSummary`).

    `alternatives` are the different T_base_laser that the log states, in their order, where it states several.
    """

    topic: str
    frame: str
    T_base_laser: Pose2
    flipped: bool
    extrinsics: str
    alternatives: tuple[Transform3, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """The same for JSON: x, y in metres, yaw in radians."""
        return {
            "topic": self.topic,
            "frame": self.frame,
            "x": self.T_base_laser.x,
            "y": self.T_base_laser.y,
            "yaw": self.T_base_laser.theta,
            "upside_down": self.flipped,
            "extrinsics": self.extrinsics,
        }


@dataclass(frozen=True, slots=True)
class PartSummary:
    """One of several files that are one run, with the log times of its first and last scan or odometry."""

    path: Path
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class LogSummary:
    """What a log holds and what hsloc takes from it.

    `start_ns` and `end_ns` are log times of the first and last message of any topic (0 and 0 in an empty log);
    `origin_ns` is the stamp of the first event, from which `ReadOptions.start_s` counts. `extrinsics` says where
    T_base_laser comes from: `/tf_static`, `/tf`, `option`, `file format` or `identity`. `order` is `stamp` (events
    in the order of their header stamps) or `log` (in the order of the log, where that is the true one). Where several
    lasers are merged, `scan_topic` names them all, `lasers` describes each, and the other fields the first.
    `parts` are the files that hold scans or odometry that are read, in the order of time. `segments` is how many
    messages make a turn of the lidar, where these were joined. `clocks_apart_s` is by how much the stamps of scans and
    odometry differ beyond what their log times differ: a hint, since messages may be late. `heading_topic` is that of
    headings without positions, which predict rotations where there is no odometry.
    """

    paths: tuple[Path, ...]
    format: str
    profile: str = ""
    start_ns: int = 0
    end_ns: int = 0
    origin_ns: int = 0
    topics: tuple[TopicSummary, ...] = ()
    scan_topic: str | None = None
    odom_topic: str | None = None
    heading_topic: str | None = None
    truth_topic: str | None = None
    reference_candidates: tuple[str, ...] = ()
    odom_frame: str | None = None
    base_frame: str | None = None
    laser_frame: str | None = None
    T_base_laser: Pose2 = IDENTITY
    laser_flipped: bool = False
    extrinsics: str = "identity"
    lasers: tuple[LaserSummary, ...] = ()
    parts: tuple[PartSummary, ...] = ()
    order: str = "stamp"
    segments: int = 1
    clocks_apart_s: float = 0.0
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    warnings: tuple[RunWarning, ...] = ()

    @property
    def duration_s(self) -> float:
        """From the first to the last message, seconds of log time."""
        return (self.end_ns - self.start_ns) / NANOSECONDS


REASONS_KEPT = 50


@dataclass(slots=True)
class Losses:
    """What could not be read, counted while reading, and oddities of time that were put in order.

    `clock_steps` are, by topic, the steps of the clock of its stamps (ns), with the log times (ns) after them.
    `reasons` are lines for people, at most 50 of them.
    """

    damaged_chunks: int = 0
    unknown_compression: Counter[str] = field(default_factory=Counter)
    bytes_lost: int = 0
    truncated_files: int = 0
    undecodable_messages: Counter[str] = field(default_factory=Counter)
    invalid_messages: Counter[str] = field(default_factory=Counter)
    stamps_backwards: Counter[str] = field(default_factory=Counter)
    stamp_jumps: Counter[str] = field(default_factory=Counter)
    clock_steps: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    stamps_zero: Counter[str] = field(default_factory=Counter)
    stamps_zero_dropped: Counter[str] = field(default_factory=Counter)
    orientations_unset: Counter[str] = field(default_factory=Counter)
    late_messages: int = 0
    log_times_repaired: int = 0
    reasons: list[str] = field(default_factory=list)

    @property
    def data_lost(self) -> bool:
        """Whether part of the input is missing from what was read (the command line then ends with 3)."""
        return bool(
            self.damaged_chunks
            or self.unknown_compression
            or self.bytes_lost
            or self.truncated_files
            or self.undecodable_messages
        )

    def note(self, reason: str) -> None:
        """Keep a line for people, once."""
        if len(self.reasons) < REASONS_KEPT and reason not in self.reasons:
            self.reasons.append(reason)

    def add(self, other: Losses) -> None:
        """Add what another part of the log lost."""
        self.damaged_chunks += other.damaged_chunks
        self.bytes_lost += other.bytes_lost
        self.truncated_files += other.truncated_files
        self.late_messages += other.late_messages
        self.log_times_repaired += other.log_times_repaired
        self.unknown_compression.update(other.unknown_compression)
        self.undecodable_messages.update(other.undecodable_messages)
        self.invalid_messages.update(other.invalid_messages)
        self.stamps_backwards.update(other.stamps_backwards)
        self.stamp_jumps.update(other.stamp_jumps)
        for topic, steps in other.clock_steps.items():
            self.clock_steps.setdefault(topic, []).extend(steps)
        self.stamps_zero.update(other.stamps_zero)
        self.orientations_unset.update(other.orientations_unset)
        self.stamps_zero_dropped.update(other.stamps_zero_dropped)
        for reason in other.reasons:
            self.note(reason)

    def step_warnings(self, summary: LogSummary) -> tuple[RunWarning, ...]:
        """A warning for each step of a clock in the log of a summary, with all topics that it shows on."""
        alike: dict[tuple[float, int], list[str]] = {}
        for topic, steps in sorted(self.clock_steps.items()):
            alike.setdefault((round(steps[0][0] / NANOSECONDS, 1), len(steps)), []).append(topic)
        found = []
        for (step_s, count), topics in alike.items():
            at_s = (min(self.clock_steps[topic][0][1] for topic in topics) - summary.start_ns) / NANOSECONDS
            direction = "forward" if step_s > 0.0 else "back"
            text = (
                f"the stamps of {', '.join(topics)} step {direction} by {abs(step_s):.1f} s at {at_s:.1f} s of the log"
                f"{f', the first of {count} steps' if count > 1 else ''}: a clock was set while it was recorded"
            )
            remedy = (
                "cut the log there with --start or --end"
                if all(topic.encoding == "text" for topic in summary.topics)
                else "--stamps log takes the times at which messages were recorded"
            )
            found.append(RunWarning(WarningCode.CLOCK_SET, text, remedy))
        return tuple(found)

    def copy(self) -> Losses:
        """An independent copy."""
        return deepcopy(self)

    def as_cause(self) -> str:
        """What could not be read, as the end of a message; empty where all could."""
        lost = [*self.lines(), *self.reasons]
        return f": {'; '.join(lost)}" if lost else ""

    def lines(self) -> list[str]:
        """Everything counted, in words; empty where nothing happened."""
        named = (
            ("message{s} could not be decoded", self.undecodable_messages),
            ("message{s} hold{es} no usable values and {were} skipped", self.invalid_messages),
            ("stamp{s} run{es} backwards; the order of the log was kept", self.stamps_backwards),
            ("stamp{s} jump{es} out of line and {were} not trusted for the order", self.stamp_jumps),
            ("message{s} without stamp; the log's time was taken", self.stamps_zero),
            ("message{s} without stamp {were} dropped", self.stamps_zero_dropped),
            (
                "orientation{s} {are} no rotation{s} (zeros, NaN, no w, angles beside w = 1): left out between others",
                self.orientations_unset,
            ),
        )
        plain = (
            (self.damaged_chunks, "damaged chunk{s} {were} skipped"),
            (self.bytes_lost, "byte{s} {were} lost"),
            (self.truncated_files, "file{s} end{es} too early (cut off, or never closed)"),
            (self.late_messages, "message{s} came later than the window of reordering"),
            (self.log_times_repaired, "message{s} with an impossible log time; the time of the one before was taken"),
        )

        def counted(count: int, text: str) -> str:
            forms = ("", "s", "is", "was") if count == 1 else ("s", "", "are", "were")
            return f"{count} " + text.format_map(dict(zip(("s", "es", "are", "were"), forms, strict=True)))

        found = [counted(count, text) for count, text in plain if count]
        found += [f"{n} chunks in unknown compression {name!r}" for name, n in self.unknown_compression.items()]
        found += [f"{counted(n, text)}: {topic}" for text, counter in named for topic, n in sorted(counter.items())]
        return found
