"""Logs that are lines of text: CARMEN and Wean, plain or gzipped.

They are surveyed, read, and read once more for the report. What the lines of a small log say is kept from the first
reading; a large one is read each time, so that memory does not grow with it.
"""

from __future__ import annotations

import gzip
import zlib
from collections import defaultdict, deque
from dataclasses import replace
from heapq import heappop, heappush
from io import BufferedReader
from typing import TYPE_CHECKING, BinaryIO, cast

from hsloc.errors import LogFormatError, TopicError, not_read
from hsloc.log.container import AGREEING, STEP_NS
from hsloc.log.messages.decode import OdometryMessage, ScanMessage
from hsloc.log.packing import GZIP
from hsloc.log.range_codes import NO_RETURN_CM, RANGE_MIN, NoReturnCode, RangeRule
from hsloc.log.source import Observation
from hsloc.log.summary import LogSummary, Losses, ReadOptions, TopicStatistics, TopicSummary
from hsloc.log.text.formats import Carmen, Wean
from hsloc.log.text.stated_mounting import StatedMounting
from hsloc.model import IDENTITY, Odometry, Scan
from hsloc.model.calibration import LidarCalibration
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from io import RawIOBase
    from pathlib import Path

    from hsloc.log.text.line_format import Line, LineFormat
    from hsloc.model import Event, OccupancyGrid, Pose2

MAX_LINE_BYTES = 1 << 20
MAX_TOTAL_RATIO = 100
FREE_UNPACKED_BYTES = 64 << 20
"""Bytes that a gzipped log may unpack to: 100 times its size, and in any case 64 MiB. Lines of numbers shrink 4 to 20
times; a small file that unpacks to gigabytes would keep a reader busy for hours."""
MAX_KEPT_BYTES = 64 << 20
"""Memory for parsed lines; a log that takes more is read from the file each time."""
_BYTES_OF_A_LINE = 1000
"""Memory of a parsed line beside its numbers, at most: of a scan with its pose, each value an object."""
_BYTES_OF_A_WORD = 4
_BYTES_TO_KNOW = 1 << 20
_LINES_TO_KNOW = 200


def _open(path: Path) -> BinaryIO:
    stream = path.open("rb")
    if stream.read(2) == GZIP:
        stream.close()
        # Lines of the compressed stream itself are cut in Python.
        return cast("BinaryIO", BufferedReader(cast("RawIOBase", gzip.open(path, "rb"))))
    stream.seek(0)
    return stream


def _lines(path: Path, losses: Losses, limit: int | None = None) -> Iterator[list[str]]:
    """Words of each line that is neither empty nor a comment, of the first `limit` bytes."""
    try:
        allowed = max(FREE_UNPACKED_BYTES, MAX_TOTAL_RATIO * path.stat().st_size) if limit is None else limit
        with _open(path) as stream:
            while line := stream.readline(MAX_LINE_BYTES):
                allowed -= len(line)
                if allowed < 0:
                    if limit is None:
                        raise LogFormatError(f"{path}: unpacks to more than {MAX_TOTAL_RATIO} times its size")
                    return
                words = line.decode("ascii", errors="replace").split()
                if words and not words[0].startswith("#"):
                    yield words
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        losses.truncated_files += 1
        losses.note(f"{path}: its compression is damaged or ends too early ({error})")
    except OSError as error:
        raise LogFormatError(not_read(path, error)) from error


def find_format(path: Path) -> LineFormat | None:
    """The format of a text log, by the first line that one of them can read; None for anything else."""
    candidates: tuple[LineFormat, ...] = (Carmen(), Wean())
    for number, words in enumerate(_lines(path, Losses(), _BYTES_TO_KNOW)):
        for candidate in candidates:
            if words[0] in candidate.keywords:
                try:
                    candidate.parse(words)
                except (ValueError, IndexError):
                    continue
                return candidate
        if number > _LINES_TO_KNOW:
            break
    return None


class TextSource:
    """A text log as events in the order of its lines: there the order is right even where the stamps are not."""

    def __init__(self, path: Path, line_format: LineFormat, options: ReadOptions, shown: Path | None = None) -> None:
        """`shown` is the name for messages to people, where the file is a copy of another."""
        self._path = path
        self._shown = shown or path
        self._format = line_format
        self._options = options
        self._rule = RangeRule()
        self._code = NoReturnCode()
        self._laser_lines_count = False
        self._stated_mounting: Pose2 | None = None
        self._scan_offset_ns = self._odometry_offset_ns = 0
        self._kept: list[tuple[str, Line]] = []
        self._kept_events: list[tuple[str, tuple[Event, ...]]] | None = None
        self._kept_losses: Losses | None = None
        self.losses_at_opening = Losses()
        self.summary = self._survey()

    @property
    def is_in_memory(self) -> bool:
        """Whether all lines are kept, and the file is not needed any more."""
        return self._kept_losses is not None

    def _parsed(self, losses: Losses) -> Iterator[tuple[str, tuple[Event, ...]]]:
        """Keyword and events of each line; of lines that are kept the events are kept in their place."""
        if self._kept_losses is None:
            return ((keyword, tuple(self._events_of(keyword, line))) for keyword, line in self._parsed_file(losses))
        losses.add(self._kept_losses)
        if self._kept_events is None:
            self._kept_events = [(keyword, tuple(self._events_of(keyword, line))) for keyword, line in self._kept]
            self._kept = []
        return iter(self._kept_events)

    def _kept_lines(self) -> Iterator[tuple[str, Line]]:
        """The lines of the file, which are kept if there is room for all of them."""
        losses, room = Losses(), MAX_KEPT_BYTES
        for keyword, line in self._parsed_file(losses):
            if room > 0:
                numbers = 0 if line.scan is None else len(line.scan.ranges)
                numbers += 0 if line.scan is None or line.scan.intensities is None else len(line.scan.intensities)
                room -= _BYTES_OF_A_LINE + _BYTES_OF_A_WORD * numbers
                self._kept.append((keyword, line))
                if room <= 0:
                    self._kept = []
            yield keyword, line
        if room > 0:
            self._kept_losses = losses

    def _parsed_file(self, losses: Losses) -> Iterator[tuple[str, Line]]:
        keywords, parse = self._format.keywords, self._format.parse
        for words in _lines(self._path, losses):
            if words[0] not in keywords:
                continue
            try:
                line = parse(words)
            except (ValueError, IndexError, OverflowError) as error:
                losses.undecodable_messages[words[0]] += 1
                losses.note(f"{self._shown}: a line {words[0]} cannot be read ({str(error)[:80]})")
                continue
            yield words[0], line

    def _mounting(self, keyword: str, scan: Scan) -> Pose2:
        """The laser in the base frame, by the user, by this line or by all lines."""
        of_lines = self._stated_mounting or IDENTITY if keyword in self._format.may_state_mounting else None
        return self._given_mounting or of_lines or scan.T_base_laser

    def _events_of(self, keyword: str, line: Line) -> Iterator[Event]:
        if line.odometry is not None and (line.scan is not None) == self._laser_lines_count:
            offset_ns = self._odometry_offset_ns
            odometry = line.odometry
            yield replace(odometry, stamp_ns=odometry.stamp_ns + offset_ns) if offset_ns else odometry
        if line.scan is not None:
            scan = line.scan
            yield Scan(  # All fields by name: a copy by `replace` takes as long as the line.
                stamp_ns=scan.stamp_ns + self._scan_offset_ns,
                ranges=self._code.apply(self._rule.apply(scan.ranges)),
                angle_min=scan.angle_min,
                angle_increment=scan.angle_increment,
                range_min=RANGE_MIN,
                range_max=scan.range_max or self._rule.range_max,
                time_increment=scan.time_increment,
                T_base_laser=self._mounting(keyword, scan),
                frame_id=scan.frame_id,
                intensities=scan.intensities,
            )
        if line.truth is not None:
            yield line.truth

    def observations(self, losses: Losses) -> Iterator[Observation]:
        """As `Source.observations`; a text log has no clock beside its stamps."""
        for keyword, events in self._parsed(losses):
            for event in events:
                if isinstance(event, Scan):
                    limits = event.range_min, event.range_max
                    values = event.angle_min, event.angle_increment, event.time_increment, *limits, event.ranges
                    message = ScanMessage(event.stamp_ns, event.frame_id, *values, None)
                    yield Observation(keyword, event.stamp_ns, message)
                elif isinstance(event, Odometry):
                    pose = OdometryMessage(event.stamp_ns, "", "", event.T_odom_base, None)
                    yield Observation(keyword, event.stamp_ns, pose)

    def _survey(self) -> LogSummary:
        """First reading: counts, times, and what the end of the scale means."""
        topics: dict[str, TopicStatistics] = {}
        kinds: dict[str, dict[str, None]] = {"odometry": {}, "scan": {}, "truth": {}}
        first_ns: int | None = None
        latest = 0
        first_scan: Scan | None = None
        scan_keyword = ""
        stated = StatedMounting()
        for keyword, line in self._kept_lines():
            for event in line:
                if event is not None:
                    first_ns = event.stamp_ns if first_ns is None else first_ns
                    latest = max(latest, event.stamp_ns)
            for kind, event in zip(kinds, line, strict=True):
                if event is not None:
                    kinds[kind][keyword] = None
            if line.scan is not None:
                self._rule.learn(line.scan.ranges)
                largest = line.scan.range_max or (NO_RETURN_CM - 0.5) / 100.0
                self._code.learn(line.scan.ranges, line.scan.angle_increment, (RANGE_MIN, largest))
                if first_scan is None:
                    first_scan, scan_keyword = line.scan, keyword
                if keyword in self._format.may_state_mounting and line.odometry is not None:
                    stated.learn(line.scan.T_base_laser, line.odometry.T_odom_base.theta)
            topics.setdefault(keyword, TopicStatistics()).add(latest, latest, 1, 0)
        self._check(bool(kinds["scan"]), bool(kinds["odometry"]))
        self._stated_mounting = stated.mounting()
        # One of the two kinds of lines is used: both give the same path with different delays.
        of_lasers = [keyword for keyword in kinds["odometry"] if keyword in kinds["scan"]]
        others = [keyword for keyword in kinds["odometry"] if keyword not in kinds["scan"]]
        self._laser_lines_count = bool(of_lasers) and (self._format.laser_odometry or not others)
        kinds["odometry"] = dict.fromkeys(of_lasers if self._laser_lines_count else others)
        self._calibrate(kinds["scan"], kinds["odometry"])
        return self._summary(topics, kinds, first_ns or 0, latest, first_scan, scan_keyword)

    def _calibrate(self, scans: Collection[str], odometry: Collection[str]) -> None:
        """Mounting and offset of the laser: its lines, which may have several keywords, are of one laser and clock.

        Raises TopicError where an offset is given for what is not in the log.
        """
        calibration, offsets = self._options.calibration, replace(self._options, calibration=None).offsets_s()
        lidars = () if calibration is None else calibration.lidars
        lidar = next((each for topic, each in lidars if topic.lstrip("/") in scans), LidarCalibration())
        self._given_mounting = self._options.laser_pose or lidar.T_base_laser
        unknown = [name for name in offsets if name not in scans and name not in odometry]
        if unknown:
            names = ", ".join((*scans, *(name for name in odometry if name not in scans)))
            raise TopicError(f"{self._shown}: no lines {unknown[0]} that --time-offset could move; it has {names}")
        # A keyword of both is the laser's: its stamps are those that come late.
        of_scans = sum(value for name, value in offsets.items() if name in scans)
        self._scan_offset_ns = round(1e9 * (lidar.time_offset_s + of_scans))
        self._odometry_offset_ns = round(1e9 * sum(value for name, value in offsets.items() if name not in scans))

    def _summary(
        self,
        topics: dict[str, TopicStatistics],
        kinds: dict[str, dict[str, None]],
        first_ns: int,
        last_ns: int,
        scan: Scan | None,
        scan_keyword: str,
    ) -> LogSummary:
        extrinsics, warnings = "identity", list[RunWarning]()
        if self._given_mounting is not None:
            extrinsics = "calibration" if self._options.laser_pose is None else "option"
        elif scan_keyword in self._format.states_mounting or self._stated_mounting is not None:
            extrinsics = "file format"
        elif scan is not None:
            warnings.append(
                RunWarning(
                    WarningCode.EXTRINSICS_ASSUMED,
                    f"{scan_keyword} lines do not state where the laser is mounted: it is assumed to be at the origin "
                    "of the base",
                    "give --laser-pose x,y,yaw",
                )
            )
        clip = self._rule.clip
        if self._code.is_known and not (clip is not None and self._code.low <= clip <= self._code.high):
            warnings.append(RunWarning(WarningCode.SCAN_NO_RETURN_CODE, f"{scan_keyword}: {self._code}"))
        mounting = self._mounting(scan_keyword, scan) if scan else self._given_mounting or IDENTITY
        return LogSummary(
            paths=(self._shown,),
            format=self._format.name,
            start_ns=first_ns,
            end_ns=last_ns,
            origin_ns=first_ns,
            topics=tuple(
                TopicSummary(name, "", "text", s.count, s.first_ns, s.last_ns, s.largest_gap_ns / 1e9)
                for name, s in sorted(topics.items())
            ),
            scan_topic=" + ".join(kinds["scan"]) or None,
            odom_topic=" + ".join(kinds["odometry"]) or None,
            truth_topic=" + ".join(kinds["truth"]) or None,
            odom_frame="odom",
            base_frame="base_link",
            laser_frame=scan.frame_id if scan else None,
            T_base_laser=mounting,
            extrinsics=extrinsics,
            order="log",
            warnings=tuple(warnings),
        )

    def _check(self, has_scans: bool, has_odometry: bool) -> None:
        options = self._options
        named = (
            ("topics", "scan-topic", options.scan_topic),
            ("topics", "odom-topic", options.odom_topic),
            ("topics", "truth-topic", options.truth_topic),
            ("frames", "base-frame", options.base_frame),
            ("fields to override", "scan-fix", options.scan_fix),
            ("joint states", "wheels", options.wheels),
        )
        for what, flag, value in named:
            if value is not None:
                raise TopicError(f"{self._shown}: a text log has no {what}; leave out --{flag} {value}")
        if self._options.require_scan and not has_scans:
            raise TopicError(f"{self._shown}: no laser lines in this {self._format.name} log")
        if self._options.require_odometry and not has_odometry:
            raise TopicError(f"{self._shown}: no odometry lines in this {self._format.name} log")

    def events(self, losses: Losses) -> Iterator[tuple[int, Event]]:
        """As `Source.events`: in the order of the lines; effective stamps are the running maximum.

        Events with an offset take the place among the other lines that their corrected stamps have.
        """
        latest: int | None = None
        last: dict[tuple[str, type], int] = {}
        recent = defaultdict[tuple[str, type], deque[int]](lambda: deque(maxlen=2 * AGREEING))
        number = 0
        offsets = {Scan: self._scan_offset_ns, Odometry: self._odometry_offset_ns}
        earliest = min(*offsets.values(), 0)
        waiting: list[tuple[int, int, Event]] = []
        for keyword, events in self._parsed(losses):
            for event in events:
                key = (keyword, type(event))
                if event.stamp_ns < last.get(key, event.stamp_ns):
                    losses.stamps_backwards[keyword] += 1
                last[key] = event.stamp_ns
                around = recent[key]
                around.append(event.stamp_ns)
                if len(around) == 2 * AGREEING and (step := _step_back(around)) is not None:
                    losses.clock_steps.setdefault(keyword, []).append((step, around[AGREEING - 1]))
                offset_ns = offsets.get(type(event), 0)
                as_written = event.stamp_ns - offset_ns
                latest = as_written if latest is None else max(latest, as_written)
                number += 1
                heappush(waiting, (latest + offset_ns, number, event))
                # No line to come is earlier than that.
                while waiting and waiting[0][0] <= latest + earliest:
                    effective, _, first = heappop(waiting)
                    yield effective, first
        while waiting:
            effective, _, first = heappop(waiting)
            yield effective, first

    def map(self) -> OccupancyGrid | None:
        """Text logs carry no map."""
        return None

    def initial_pose(self) -> tuple[int, Pose2] | None:
        """Text logs state no start."""
        return None

    def verify(self) -> Losses:
        """Read every line."""
        losses = Losses()
        for _ in self._parsed(losses):
            pass
        return losses


def _step_back(around: Sequence[int]) -> int | None:
    """Step (ns, negative) of the clock in the middle of stamps, where all after it are earlier than all before."""
    if around[AGREEING] > around[AGREEING - 1] - STEP_NS:
        return None
    stamps = list(around)
    is_step = max(stamps[AGREEING:]) < min(stamps[:AGREEING])
    return stamps[AGREEING] - stamps[AGREEING - 1] if is_step else None
