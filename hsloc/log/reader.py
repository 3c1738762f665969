"""The one door: `open_log` takes whatever holds a recording and gives events of the model."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.errors import LogError, LogFormatError
from hsloc.log.mcap.records import MAGIC
from hsloc.log.summary import NANOSECONDS, LogSummary, Losses, ReadOptions

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from hsloc.log.container import Container
    from hsloc.log.source import Observation, Source
    from hsloc.model import Event, OccupancyGrid, Pose2

_BAG_MAGIC = b"#ROSBAG V"
_SQLITE_MAGIC = b"SQLite format 3\0"
_GZIP_MAGIC = b"\x1f\x8b"
_COMPRESSED = re.compile(rb"^\s*compression_mode:\s*[\"']?(file|message)", re.IGNORECASE | re.MULTILINE)
_METADATA_BYTES = 1 << 20
_NO_LOG = "is not an MCAP, a ROS bag or a CARMEN log"


class Log:
    """A recording, opened. Events are decoded while they are asked for; memory does not grow with the log.

    `summary` says what is in it and what is read; `losses` what could not be read, up to date while `events` is
    under way and complete at its end.
    """

    def __init__(self, source: Source, options: ReadOptions, files: Sequence[Path]) -> None:
        self._source = source
        self._options = options
        self._files = tuple(files)
        self.losses = source.losses_at_opening.copy()

    @property
    def summary(self) -> LogSummary:
        """What the log holds and what is taken from it."""
        return self._source.summary

    def events(self) -> Iterator[Event]:
        """All events in a total, repeatable order (see `hsloc.log.session.ordering`), with their own header stamps.

        Only those whose effective stamp lies in [start_s, end_s) of the options, counted from `origin_ns`. Each
        call reads the log anew, and counts its losses anew. Raises LogError where a file vanishes under way.
        """
        self.losses = losses = self._source.losses_at_opening.copy()
        events = self._source.events(losses)
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

        Counts its losses anew, as `events` does; `start_s` and `end_s` have no say.
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
                raise LogError(f"{path}: cannot be read ({error.strerror or error})") from error
        return digest.hexdigest()


def open_log(paths: Path | str | Sequence[Path | str], options: ReadOptions | None = None) -> Log:
    """Open a recording: MCAP, a ROS 1 or ROS 2 bag (file or folder), CARMEN or Wean text (also gzipped).

    Several paths, or a folder with several files, are one recording in parts. Raises LogError (no such file),
    LogFormatError (not a log, or damaged beyond use) and TopicError (topics missing or ambiguous).
    """
    options = ReadOptions() if options is None else options
    given = [Path(paths)] if isinstance(paths, (str, Path)) else [Path(path) for path in paths]
    if not given:
        raise LogError("no log was named")
    files = [file for path in given for file in _expand(path)]
    kinds = [_kind(path) for path in files]
    if "text" in kinds:
        if len(files) > 1:
            raise LogFormatError(f"{files[0]}: text logs are read one at a time; convert them first")
        return Log(_text_source(files[0], options), options, files)
    from hsloc.log.session.message_source import RosSource

    containers = [_container(path, kind) for path, kind in zip(files, kinds, strict=True)]
    return Log(RosSource(containers, options), options, [part for file in files for part in _parts(file)])


def is_log(path: Path) -> bool:
    """Whether a file or folder is a log of a known format, by what it holds; raises LogError as `open_log`."""
    from hsloc.log.text.source import find_format

    (first, *_) = _expand(path)
    return _kind(first) != "text" or find_format(first) is not None


def _text_source(path: Path, options: ReadOptions) -> Source:
    from hsloc.log.text.source import TextSource, find_format

    line_format = find_format(path)
    if line_format is None:
        raise LogFormatError(f"{path}: {_NO_LOG}")
    return TextSource(path, line_format, options)


def _container(path: Path, kind: str) -> Container:
    if kind == "mcap":
        from hsloc.log.mcap.container import McapContainer

        return McapContainer(path)
    from hsloc.log.bags import BagContainer

    return BagContainer(path)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Order of names in which run_2 comes before run_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _expand(path: Path) -> list[Path]:
    """The files of a recording: the path itself, or the parts in a folder.

    Only a compressed SQLite bag stays a folder. Of all others metadata.yaml tells nothing that the files do not, and
    where it is wrong (a type's hash, say) rosbags would give no messages and no error.
    """
    try:
        if not path.exists():
            raise LogError(f"{path}: no such file or folder")
        if path.name == "metadata.yaml":  # What a bag's folder is known by.
            path = path.parent
        if not path.is_dir():
            return [path]
        inside = sorted(path.iterdir(), key=_natural)
        metadata = path / "metadata.yaml"
        if metadata.is_file() and _COMPRESSED.search(metadata.read_bytes()[:_METADATA_BYTES]):
            return [path]
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error})") from error
    for suffix in (".mcap", ".db3", ".bag"):
        found = [part for part in inside if part.suffix == suffix and not part.name.startswith(".")]
        if found:
            return found
    raise LogFormatError(f"{path}: is a folder without .mcap, .db3 or .bag files; name a log file")


def _parts(path: Path) -> list[Path]:
    return sorted((part for part in path.iterdir() if part.is_file()), key=_natural) if path.is_dir() else [path]


def _kind(path: Path) -> str:
    """`mcap`, `bag` or `text`, by the first bytes and not by the name."""
    if path.is_dir():
        return "bag"
    try:
        if not path.is_file():
            raise LogFormatError(f"{path}: is not a regular file")
        with path.open("rb") as stream:
            head = stream.read(4096)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error})") from error
    if not head:
        raise LogFormatError(f"{path}: is empty")
    if head.startswith(MAGIC):
        return "mcap"
    if head.startswith((_BAG_MAGIC, _SQLITE_MAGIC)):
        return "bag"
    if head.startswith(_GZIP_MAGIC) or b"\0" not in head:
        return "text"
    raise LogFormatError(f"{path}: {_NO_LOG}")
