"""The files of a recording: which there are, of which kind, by what they hold and never by their names."""

from __future__ import annotations

import re
import shutil
import tempfile
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hsloc.errors import LogError, LogFormatError
from hsloc.log.mcap.records import MAGIC
from hsloc.log.packing import GZIP, is_archive, is_packed, plain_name, unpack, unpacked_head

if TYPE_CHECKING:
    from collections.abc import Sequence

NO_LOG = "is not an MCAP, a ROS bag or a CARMEN log"
_BAG_MAGIC = b"#ROSBAG V"
_SQLITE_MAGIC = b"SQLite format 3\0"
_HEAD_BYTES = 4096
_ENDINGS = (".mcap", ".db3", ".bag")
_MAX_UNNAMED = 1000
"""Files of a folder that are looked into where none has the ending of a log."""


class LogFile(NamedTuple):
    """A file to read, its kind (`mcap`, `db3`, `bag` or `text`), and the name that people know it by."""

    path: Path
    kind: str
    shown: Path


class Scratch:
    """A temporary folder that is made when it is first needed, and removed with the last reference to it."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """The folder. Raises LogError where none can be made."""
        if self._folder is None:
            try:
                self._folder = Path(tempfile.mkdtemp(prefix="hsloc-log-"))
            except OSError as error:
                raise LogError(
                    f"no temporary folder to unpack the log in ({error.strerror or error}); set TMPDIR"
                ) from error
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        return self._folder


def expand(path: Path, scratch: Scratch, shown: Path | None = None) -> list[LogFile]:
    """The files of a recording: the path itself, unpacked if need be, or the parts in a folder or an archive.

    What metadata.yaml says of a bag's folder is not needed: the files say the same, and it may be wrong.
    Raises LogError (no such file) and LogFormatError (not a log).
    """
    shown = path if shown is None else shown
    try:
        if not path.exists():
            raise LogError(f"{shown}: no such file or folder")
        if path.name == "metadata.yaml":  # What a bag's folder is known by.
            path = path.parent
        if not path.is_dir():
            return _of_file(path, scratch, shown)
        inside = sorted((part for part in path.iterdir() if not part.name.startswith(".")), key=natural)
    except OSError as error:
        raise LogError(f"{shown}: cannot be read ({error.strerror or error})") from error
    for ending in _ENDINGS:
        found = [part for part in inside if Path(plain_name(part)).suffix.lower() == ending and part.is_file()]
        names = {part.name for part in found}
        # A file that lies there packed and unpacked is one part.
        found = [part for part in found if plain_name(part) == part.name or plain_name(part) not in names]
        if found:
            return [file for part in found for file in expand(part, scratch, _name_inside(part, path, shown))]
    return _by_content(inside, path, scratch, shown)


def natural(path: Path) -> list[tuple[int, str]]:
    """Order of names in which run_2 comes before run_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _name_inside(part: Path, folder: Path, shown: Path) -> Path:
    """The name of a part: its own in a folder of the user's, the archive's where it was unpacked from one."""
    return part if shown == folder or folder.name == "metadata.yaml" else shown


def _by_content(inside: Sequence[Path], path: Path, scratch: Scratch, shown: Path) -> list[LogFile]:
    """The bags among the files of a folder without a known ending."""
    files = [part for part in inside[:_MAX_UNNAMED] if part.is_file() and kind_of(_head(part)) not in ("", "text")]
    if not files:
        raise LogFormatError(f"{shown}: is a folder without .mcap, .db3 or .bag files; name a log file")
    return [file for part in files for file in expand(part, scratch, _name_inside(part, path, shown))]


def _of_file(path: Path, scratch: Scratch, shown: Path) -> list[LogFile]:
    if not path.is_file():
        raise LogFormatError(f"{shown}: is not a regular file")
    head = _head(path)
    if not head:
        raise LogFormatError(f"{shown}: is empty")
    if is_packed(head):
        inner = unpacked_head(path, head)
        # Text logs are read through gzip line by line; all else is unpacked.
        if head.startswith(GZIP) and not is_archive(inner) and kind_of(inner) in ("", "text"):
            return [LogFile(path, "text", shown)]
        found = unpack(path, head, scratch.folder)
        return expand(found, scratch, shown) if found.is_dir() else _of_file(found, scratch, shown)
    kind = kind_of(head)
    if not kind:
        raise LogFormatError(f"{shown}: {NO_LOG}")
    return [LogFile(path, kind, shown)]


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(_HEAD_BYTES)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error})") from error


def kind_of(head: bytes) -> str:
    """`mcap`, `db3`, `bag` or `text`, by the first bytes of a file; empty where it is none of them."""
    if head.startswith(MAGIC):
        return "mcap"
    if head.startswith(_BAG_MAGIC):
        return "bag"
    if head.startswith(_SQLITE_MAGIC):
        return "db3"
    return "text" if head and b"\0" not in head else ""
