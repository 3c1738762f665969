"""`open_log` takes whatever holds a recording and gives events of the model."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from itertools import tee
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.errors import LogError, LogFormatError, not_read
from hsloc.log.files import LogFile, Scratch, why_no_text_log
from hsloc.log.files import expand as _expand
from hsloc.log.summary import NANOSECONDS, LogSummary, Losses, ReadOptions
from hsloc.model.calibration import NO_CORRECTION, corrected_odometry
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from hsloc.log.container import Container
    from hsloc.log.source import Observation, Source
    from hsloc.log.text.source import TextSource
    from hsloc.model import Event, OccupancyGrid, Pose2
    from hsloc.model.calibration import Calibration, OdometryCorrection


class Log:
    """A recording, opened. Events are decoded while they are asked for; memory does not grow with the log.

    `summary` says what is in it and what is read; `losses` what could not be read, up to date while `events` is
    under way and complete at its end.
    """

    def __init__(
        self, source: Source, options: ReadOptions, files: Sequence[Path], scratch: Scratch | None = None
    ) -> None:
        """`scratch` holds what had to be unpacked; it goes with the log."""
        self._source = source
        self._scratch = scratch
        self._options = options
        self._files = tuple(files)
        self.losses = source.losses_at_opening.copy()
        found = source.summary
        self._summary = replace(found, warnings=(*found.warnings, *_unused(options.calibration, found.scan_topic)))

    @property
    def summary(self) -> LogSummary:
        """What the log holds and what is taken from it."""
        return self._summary

    @property
    def is_unpacked(self) -> bool:
        """Whether it takes disk space for files that were unpacked, as long as it lives."""
        return self._scratch is not None and self._scratch.is_used

    def events(self) -> Iterator[Event]:
        """All events in a total, repeatable order (see `hsloc.log.session.ordering`), with their own header stamps.

        Only those whose effective stamp lies in [start_s, end_s) of the options, counted from `origin_ns`. Each
        call reads the log and counts its losses again. Raises LogError where a file vanishes under way.
        """
        self.losses = losses = self._source.losses_at_opening.copy()
        events = self._source.events(losses)
        calibration = self._options.calibration
        if calibration is not None and calibration.odometry != NO_CORRECTION:
            events = _corrected(events, calibration.odometry)
        start, end = (
            None if seconds is None else self.summary.origin_ns + round(seconds * NANOSECONDS)
            for seconds in (self._options.start_s, self._options.end_s)
        )
        for effective, event in events:
            if end is not None and effective >= end:
                return
            if start is None or effective >= start:
                yield event

    def observations(self) -> Iterator[Observation]:
        """All scans, odometry and transforms of all topics as the log has them, in its order; for checks.

        Counts its losses again, as `events` does; `start_s` and `end_s` are ignored.
        """
        self.losses = self._source.losses_at_opening.copy()
        return self._source.observations(self.losses)

    def map(self) -> OccupancyGrid | None:
        """The map that the log carries on /map, or None."""
        return self._source.map()

    def initial_pose(self) -> tuple[int, Pose2] | None:
        """(stamp in ns, T_map_base) that the log states as the start, or None."""
        return self._source.initial_pose()

    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """Metadata records of MCAP files by name; of several with one name, the last."""
        return self.summary.metadata

    def verify(self) -> Losses:
        """Read every byte, also of topics that no event is made of, and count what is damaged."""
        return self._source.verify()

    def sha256(self) -> str:
        """Checksum of the log's files, one after the other, in hexadecimal."""
        digest = hashlib.sha256()
        for path in self._files:
            try:
                with path.open("rb") as stream:
                    while block := stream.read(1 << 20):
                        digest.update(block)
            except OSError as error:
                raise LogError(not_read(path, error)) from error
        return digest.hexdigest()


def _unused(calibration: Calibration | None, scan_topic: str | None) -> Iterator[RunWarning]:
    """A warning for each lidar of a calibration whose scans are not read."""
    read = {name.strip().lstrip("/") for part in (scan_topic or "").split(",") for name in part.split(" + ")}
    for topic, _ in calibration.lidars if calibration is not None else ():
        if read.isdisjoint({topic.lstrip("/")}):
            yield RunWarning(
                WarningCode.CALIBRATION_UNUSED,
                f"the calibration of {topic} is not used: no scans of it are read",
                "calibrate this log's lidar, or name its topic in the file",
            )


def _corrected(events: Iterator[tuple[int, Event]], correction: OdometryCorrection) -> Iterator[tuple[int, Event]]:
    """The same with the odometry corrected."""
    stamps, plain = tee(events)
    return zip(
        (stamp for stamp, _ in stamps), corrected_odometry((event for _, event in plain), correction), strict=True
    )


def open_log(paths: Path | str | Sequence[Path | str], options: ReadOptions | None = None) -> Log:
    """Open a recording: MCAP, a ROS 1 or ROS 2 bag (file or folder), CARMEN or Wean text (also gzipped).

    Several paths, or a folder with several files, are one recording in parts. Raises LogError (no such file),
    LogFormatError (not a log, or damaged beyond use) and TopicError (topics missing or ambiguous).
    """
    options = ReadOptions() if options is None else options
    given = [Path(paths)] if isinstance(paths, (str, Path)) else [Path(path) for path in paths]
    if not given:
        raise LogError("no log was named")
    scratch = Scratch()
    files = [file for path in given for file in _expand(path, scratch)]
    kinds = [file.kind for file in files]
    originals = [*dict.fromkeys(file.shown for file in files)]
    if "text" in kinds:
        if len(files) > 1:
            raise LogFormatError(f"{files[0].shown}: text logs are read one at a time; convert them first")
        text = _text_source(files[0], options)
        return Log(_noted(text, files), options, originals, None if text.is_in_memory else scratch)
    from hsloc.log.session.message_source import RosSource

    source = RosSource([_container(file) for file in files], options)
    return Log(_noted(source, files), options, originals, scratch)


def _noted(source: Source, files: Sequence[LogFile]) -> Source:
    """The source, with what its packing lost among its losses."""
    losses = source.losses_at_opening
    for file in files:
        if file.is_cut:
            losses.note(f"{file.shown}: its compression is damaged or ends too early: it was read as far as it goes")
            losses.truncated_files = max(losses.truncated_files, 1)
    return source


def is_log(path: Path) -> bool:
    """Whether a file or folder is a log of a known format, by what it holds; raises LogError as `open_log`."""
    from hsloc.log.text.source import find_format

    (first, *_) = _expand(path, Scratch())
    return first.kind != "text" or find_format(first.path) is not None


def _text_source(file: LogFile, options: ReadOptions) -> TextSource:
    from hsloc.log.text.source import TextSource, find_format

    line_format = find_format(file.path)
    if line_format is None:
        raise LogFormatError(f"{file.shown}: {why_no_text_log(file.path)}")
    return TextSource(file.path, line_format, options, file.shown)


def _container(file: LogFile) -> Container:
    if file.kind == "mcap":
        from hsloc.log.mcap.container import McapContainer

        return McapContainer(file.path, file.shown)
    if file.kind == "db3":
        from hsloc.log.ros_bags import Db3Container

        return Db3Container(file.path, file.shown)
    from hsloc.log.ros_bags import BagContainer

    return BagContainer(file.path, file.shown)
