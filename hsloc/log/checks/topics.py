"""Checks of the messages of one topic: scans or odometry."""

from __future__ import annotations

from math import hypot, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.log.checks.findings import NANOSECONDS, Findings, Intervals, Place, Severity
from hsloc.log.session.ordering import StepDetector

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.log.messages.decode import ScanMessage

LATE_WARNING_NS, LATE_ERROR_NS = NANOSECONDS // 10, NANOSECONDS // 2
"""Delay of a message that is a warning, and an error. Internal, like all limits here: checks of two logs compare."""
OTHER_CLOCK_NS = 3600 * NANOSECONDS
"""Difference between stamps and log time above which they are of different clocks."""
GAP_NS = NANOSECONDS // 10
"""Minimum duration of a gap, as lidars turn at 5 to 15 Hz."""
GAP_FACTOR = 2.5
"""Minimum duration of a gap in usual intervals."""
LONGEST_SWEEP_S = 2.0
"""Maximum duration of a sweep (s); no lidar turns more slowly."""
MAX_SPEED = 15.0
"""Maximum speed (m/s) of a robot; odometry that moves faster has jumped."""
LEAST_JUMP, LONGEST_JUMP_S = 0.5, 1.0
"""Minimum length (m) and maximum duration (s) of a jump of the odometry."""
_BEAMS_TOLERATED = 0.1
"""Ratio by which the number of beams may vary from scan to scan."""


class TopicCheck:
    """Stamps and their order, on one topic."""

    what = ""

    def __init__(self, topic: str, findings: Findings) -> None:
        self.topic = topic
        self.intervals = Intervals()
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._findings = findings
        self._count = 0
        self._last_log_ns = 0
        self._same_log_time = 0
        self._steps = StepDetector()
        self.steps: list[tuple[int, int]] = []

    def add(self, message: Any, log_time_ns: int) -> None:
        """One message."""
        place = Place(self.topic, self._count, message.stamp_ns, log_time_ns)
        self._count += 1
        if message.stamp_ns == 0 < log_time_ns:
            self._findings.add(
                Severity.WARNING, "stamp_zero", place, "messages have no stamp; the log's time is used instead",
                "have the driver stamp its messages, or wait for /clock before recording",
            )  # fmt: skip
            return
        if (step := self._steps.take(message.stamp_ns, log_time_ns)) is not None:
            self.steps.append(step)
        self._same_log_time += log_time_ns == self._last_log_ns and place.stamp_ns != self.last_ns
        self._last_log_ns = log_time_ns
        self._check_latency(place)
        self._check_order(place)
        self.last_ns = place.stamp_ns
        self.first_ns = place.stamp_ns if self.first_ns is None else self.first_ns

    def finish(self) -> None:
        """At the end of the log: short topics have waited for what is usual."""
        for interval, place in self.intervals.settle():
            self._check_gap(interval, place)
        if self._same_log_time > self._count // 2:
            # Whatever their latency is, the log does not say.
            self._findings.drop(("latency", "latency_high"), self.topic)
            self._findings.add(
                Severity.WARNING, "log_time_repeated", self.topic,
                f"most log times of the {self.what} are that of the message before: they were written in batches, and "
                "the log does not say when each was received",
                "none is needed: stamps are what counts; --stamps log cannot be used",
            )  # fmt: skip

    def _check_latency(self, place: Place) -> None:
        late = abs(place.log_time_ns - place.stamp_ns)
        if late > OTHER_CLOCK_NS:
            self._findings.add(
                Severity.INFO, "other_clock", place, "stamps and the log's times are of different clocks",
                "none is needed: stamps are what counts; a simulation looks like this",
            )  # fmt: skip
        elif late > LATE_WARNING_NS:
            bad = late > LATE_ERROR_NS
            self._findings.add(
                Severity.ERROR if bad else Severity.WARNING,
                "latency_high" if bad else "latency",
                place,
                f"stamps are more than {0.5 if bad else 0.1} s away from when the message was recorded",
                "synchronise the clocks of sensor and recorder (chrony, PTP), or look for a driver that stamps late",
            )

    def _check_order(self, place: Place) -> None:
        if self.last_ns is None:
            return
        interval = place.stamp_ns - self.last_ns
        if interval < 0:
            self._findings.add(
                Severity.ERROR, "stamp_backwards", place, f"stamps of the {self.what} run backwards",
                "look for two publishers on the topic, or a clock that was set while recording",
            )  # fmt: skip
        elif interval == 0:
            self._findings.add(
                Severity.WARNING, "stamp_repeated", place, f"{self.what} with the stamp of the one before",
                "look for two publishers on the topic, or for messages recorded twice",
            )  # fmt: skip
        else:
            for known, where in self.intervals.add(interval, place):
                self._check_gap(known, where)

    def _check_gap(self, interval_ns: int, place: Place) -> None:
        usual = self.intervals.usual_ns
        if usual is not None and interval_ns > max(GAP_NS, GAP_FACTOR * usual):
            self._findings.add(
                Severity.WARNING, "gap", place,
                f"gaps in the {self.what}: the first lasts {interval_ns / NANOSECONDS:.3f} s, usual are "
                f"{usual / NANOSECONDS:.3f} s",
                "messages were dropped: record less, or to a faster disk; use reliable QoS",
            )  # fmt: skip


class ScanCheck(TopicCheck):
    """Scans: their stamps, geometry and ranges."""

    what = "scans"

    def __init__(self, topic: str, findings: Findings) -> None:
        super().__init__(topic, findings)
        self.frame: str | None = None
        self._previous: NDArray[np.float32] | None = None
        self._previous_ns = 0
        self._previous_end_ns: int | None = None
        self._beams: int | None = None

    def add(self, message: Any, log_time_ns: int) -> None:
        """One message."""
        place = Place(self.topic, self._count, message.stamp_ns, log_time_ns)
        super().add(message, log_time_ns)
        self._check_geometry(message, place)
        self._check_ranges(message, place)
        if self.frame is not None and message.frame_id != self.frame:
            self._findings.add(
                Severity.WARNING, "frame_changes", place, f"scans of several frames ({self.frame}, {message.frame_id})",
                "two lasers share the topic; give each its own",
            )  # fmt: skip
        self.frame = message.frame_id
        # Drivers round: a twentieth of a turn is no trouble.
        sweep_s = 0.95 * max(len(message.ranges) - 1, 0) * message.time_increment
        if not 0.0 <= sweep_s < LONGEST_SWEEP_S:
            self._findings.add(
                Severity.WARNING, "time_increment", place,
                f"time_increment is {message.time_increment:g} s, a turn would take {sweep_s / 0.95:g} s",
                "repair the driver; --deskew leaves such scans as they are",
            )  # fmt: skip
            sweep_s = 0.0
        end = message.stamp_ns + round(sweep_s * 1e9)
        if self._previous_end_ns is not None and self._previous_ns <= message.stamp_ns < self._previous_end_ns:
            self._findings.add(
                Severity.WARNING, "scans_overlap", place, "scans begin before the last beam of the one before",
                "time_increment or stamp is wrong in the driver; do not use --deskew",
            )  # fmt: skip
        self._previous_ns, self._previous_end_ns = message.stamp_ns, end

    def _check_geometry(self, message: ScanMessage, place: Place) -> None:
        usable = isfinite(message.angle_min) and isfinite(message.angle_increment) and message.angle_increment != 0.0
        if not usable or not message.range_max > 0.0 or len(message.ranges) == 0:
            self._findings.add(
                Severity.ERROR, "scan_unusable", place,
                f"scans without geometry (angle_min {message.angle_min:g}, angle_increment "
                f"{message.angle_increment:g}, range_max {message.range_max:g}, {len(message.ranges)} beams)",
                "repair the driver, or override a field with --scan-fix: no point can be made of them",
            )  # fmt: skip
        if self._beams is not None and len(message.ranges) != self._beams:
            far = abs(len(message.ranges) - self._beams) > _BEAMS_TOLERATED * self._beams
            self._findings.add(
                Severity.WARNING if far else Severity.INFO, "beams_change" if far else "beams_vary", place,
                f"the number of beams changes ({self._beams} to {len(message.ranges)})",
                "none is needed: each scan is read by its own length"
                + ("; by over a tenth it may be parts of scans" if far else ""),
            )  # fmt: skip
        self._beams = len(message.ranges)

    def _check_ranges(self, message: ScanMessage, place: Place) -> None:
        ranges = message.ranges
        if len(ranges) == 0:
            return
        with np.errstate(invalid="ignore"):
            hits = np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max)
        if not hits.any():
            self._findings.add(
                Severity.WARNING, "no_hits", place, "scans without a single valid range",
                "look for a covered or blinded laser, or for wrong range_min and range_max",
            )  # fmt: skip
        elif self._previous is not None and np.array_equal(ranges, self._previous, equal_nan=True):
            self._findings.add(
                Severity.WARNING, "scans_identical", place, "scans identical to the one before",
                "the driver repeats scans, or they were recorded twice",
            )  # fmt: skip
        self._previous = ranges


class OdometryCheck(TopicCheck):
    """Odometry: its stamps, orientations and speed."""

    what = "odometry"

    def __init__(self, topic: str, findings: Findings) -> None:
        super().__init__(topic, findings)
        self.frame = self.child = ""
        self._position: tuple[int, float, float] | None = None

    def add(self, message: Any, log_time_ns: int) -> None:
        """One message."""
        place = Place(self.topic, self._count, message.stamp_ns, log_time_ns)
        super().add(message, log_time_ns)
        self.frame, self.child = message.frame_id, message.child_frame_id
        norm = sum(value * value for value in message.quaternion) ** 0.5
        if not abs(norm - 1.0) < 1e-2:
            self._findings.add(
                Severity.ERROR, "quaternion", place, f"orientations are no unit quaternions (the first has {norm:g})",
                "repair the odometry's publisher",
            )  # fmt: skip
        pose = message.pose
        if not pose.is_finite():
            self._findings.add(
                Severity.ERROR, "not_finite", place, "odometry holds NaN or infinity", "repair the odometry's publisher"
            )
            return
        if self._position is not None:
            stamp, x, y = self._position
            seconds = (message.stamp_ns - stamp) / NANOSECONDS
            way = hypot(pose.x - x, pose.y - y)
            if 0.0 < seconds < LONGEST_JUMP_S and way > max(MAX_SPEED * seconds, LEAST_JUMP):
                self._findings.add(
                    Severity.WARNING, "odometry_jumps", place,
                    f"odometry jumps (the first by {way:.2f} m in {seconds:.3f} s)",
                    "odometry was reset or two publishers share the topic; the pose may be lost there",
                )  # fmt: skip
        self._position = (message.stamp_ns, pose.x, pose.y)
