"""The files of a recording: which there are, of which kind, by what they hold and never by their names.

Packed logs (gzip, bzip2, xz, lz4, zstd, zip, tar) are unpacked into a temporary folder (`$TMPDIR`), because containers
are read at random places. What a packed file may unpack to is bounded, so that a small file cannot fill the disk.
"""

from __future__ import annotations

import gzip
import lzma
import re
import shutil
import tarfile
import tempfile
import weakref
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, BinaryIO, NamedTuple, cast

from hsloc.errors import LogError, LogFormatError, no_such, not_read
from hsloc.log.mcap.records import MAGIC
from hsloc.log.no_log import EMPTY, no_logs_inside, why_no_log
from hsloc.log.packing import GZIP, STREAMS, ZSTD, opened

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_BAG_MAGIC = b"#ROSBAG V"
_SQLITE_MAGIC = b"SQLite format 3\0"
_HEAD_BYTES = 4096
_ENDINGS = (".mcap", ".db3", ".bag")
_MAX_UNNAMED = 1000
"""Files of a folder that are looked into where none has the ending of a log."""


class LogFile(NamedTuple):
    """A file to read, its kind (`mcap`, `db3`, `bag` or `text`), and the name that people know it by.

    With `is_cut` its packing was damaged or ended too early, and the file holds what came before.
    """

    path: Path
    kind: str
    shown: Path
    is_cut: bool = False


class Scratch:
    """A temporary folder that is made when it is first needed, and removed with the last reference to it."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    @property
    def is_used(self) -> bool:
        """Whether the folder was needed."""
        return self._folder is not None

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
            raise LogError(no_such(shown, "file or folder"))
        if path.name == "metadata.yaml":  # What a bag's folder is known by.
            path = path.parent
        if not path.is_dir():
            return _of_file(path, scratch, shown)
        inside = sorted((part for part in path.iterdir() if not part.name.startswith(".")), key=natural)
    except OSError as error:
        raise LogError(not_read(shown, error)) from error
    for ending in _ENDINGS:
        found = [part for part in inside if Path(plain_name(part)).suffix.lower() == ending and part.is_file()]
        names = {part.name for part in found}
        # A file that lies there packed and unpacked is one part.
        found = [part for part in found if plain_name(part) == part.name or plain_name(part) not in names]
        if found:
            return [file for part in found for file in expand(part, scratch, _name_inside(part, path, shown))]
    return _by_content(inside, path, scratch, shown)


def _has_ending(name: str) -> bool:
    """Whether a file is a log by its name, packed or not."""
    return Path(plain_name(Path(name))).suffix.lower() in _ENDINGS and not name.startswith(".")


def natural(path: Path) -> list[tuple[int, str]]:
    """Order of names in which run_2 comes before run_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _name_inside(part: Path, folder: Path, shown: Path) -> Path:
    """The name of a part: its own in a folder of the user's, the archive's where it was unpacked from one."""
    return part if shown == folder or folder.name == "metadata.yaml" else shown


def _by_content(inside: Sequence[Path], path: Path, scratch: Scratch, shown: Path) -> list[LogFile]:
    """The bags among the files of a folder without a known ending."""
    files = [part for part in inside[:_MAX_UNNAMED] if part.is_file() and _is_bag(part)]
    if not files:
        if any(part.name.endswith(".db3-wal") for part in inside):
            raise LogFormatError(f"{shown}: holds the write-ahead log of a .db3 file without that; copy both")
        if shown == path or shown.is_dir():
            raise LogFormatError(f"{shown}: {no_logs_inside(path, _has_ending)}")
        raise LogFormatError(f"{shown}: is an archive without .mcap, .db3 or .bag files; name a log file")
    return [file for part in files for file in expand(part, scratch, _name_inside(part, path, shown))]


def _is_bag(path: Path) -> bool:
    """Whether a file is a bag, by what it holds, packed or not."""
    head = _head(path)
    return kind_of(head if not is_packed(head) else unpacked_head(path, head)) not in ("", "text")


def _of_file(path: Path, scratch: Scratch, shown: Path, layers: int = 0) -> list[LogFile]:
    if not path.is_file():
        raise LogFormatError(f"{shown}: is not a regular file; copy what it holds into one")
    head = _head(path)
    if not head:
        has_log = path.with_name(f"{path.name}-wal").is_file()
        of_log = "is empty; its write-ahead log beside it cannot be read without the database: copy both again"
        raise LogFormatError(f"{shown}: {of_log if has_log else EMPTY}")
    if is_packed(head):
        inner = unpacked_head(path, head)
        # Text logs are read through gzip line by line; all else is unpacked.
        if head.startswith(GZIP) and not is_packed(inner) and kind_of(inner) in ("", "text"):
            return [LogFile(path, "text", shown)]
        if layers == _MAX_LAYERS:
            raise LogFormatError(f"{shown}: is packed more than {_MAX_LAYERS} times; unpack it first")
        found, is_cut = unpack(path, head, scratch.folder)
        if found.is_dir():
            return expand(found, scratch, shown)
        inside = _of_file(found, scratch, shown, layers + 1)
        return [file._replace(is_cut=file.is_cut or is_cut) for file in inside]
    kind = kind_of(head)
    if not kind:
        raise LogFormatError(f"{shown}: {why_no_log(path, head)}")
    return [LogFile(path, kind, shown)]


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(_HEAD_BYTES)
    except OSError as error:
        raise LogError(not_read(path, error)) from error


def why_no_text_log(path: Path) -> str:
    """What a file of kind `text` is that no format of text logs can read, and what to do: the end of a message."""
    head = _head(path)
    if is_packed(head):
        head = unpacked_head(path, head)
        if not head:
            return "nothing of it can be unpacked; copy it again, or record again"
    return why_no_log(path, head)


def kind_of(head: bytes) -> str:
    """`mcap`, `db3`, `bag` or `text`, by the first bytes of a file; empty where it is none of them."""
    if head.startswith(MAGIC):
        return "mcap"
    if head.startswith(_BAG_MAGIC):
        return "bag"
    if head.startswith(_SQLITE_MAGIC):
        return "db3"
    return "text" if head and b"\0" not in head else ""


_ZIP = b"PK\x03\x04"
_SKIPPED = b"\x2a\x4d\x18"
"""How a frame goes on that decompressors of zstd and lz4 skip; its first byte is 0x50 to 0x5f."""
_MAX_LAYERS = 3
"""How many times a file may be packed. Internal: some packed files unpack to themselves."""
_TAR_AT, _TAR = 257, b"ustar"
MAX_TOTAL_RATIO = 100
FREE_UNPACKED_BYTES = 4 << 30
"""Bytes that a packed log may unpack to: 100 times its size, and in any case 4 GiB."""
_MAX_MEMBERS = 1000
_BLOCK, _SMALL_BLOCK = 1 << 20, 1 << 12
"""Bytes that are unpacked at a time, and where the packing is damaged: what is read with the damage is lost."""
_PACKED_ENDINGS = (".gz", ".zst", ".zstd", ".bz2", ".xz", ".lz4", ".zip", ".tar", ".tgz")
_BROKEN = (EOFError, gzip.BadGzipFile, zlib.error, lzma.LZMAError, zipfile.BadZipFile, tarfile.TarError, ValueError)


def is_packed(head: bytes) -> bool:
    """Whether a file that begins with `head` (the first 512 bytes or more) is packed."""
    return head.startswith((*STREAMS, _ZIP)) or _is_tar(head) or _begins_with_zstd(head)


def _begins_with_zstd(head: bytes) -> bool:
    """Whether a file is packed by zstd; pzstd begins with a frame that decompressors skip."""
    at = 0
    while head[at + 1 : at + 4] == _SKIPPED and head[at] & 0xF0 == 0x50:
        at += 8 + int.from_bytes(head[at + 4 : at + 8], "little")
    return head[at : at + 4] == ZSTD


def unpacked_head(path: Path, head: bytes) -> bytes:
    """The first bytes of what a packed file holds; empty where that cannot be read, and for archives."""
    if not (head.startswith(STREAMS) or _begins_with_zstd(head)):
        return b""
    try:
        with _opened(path, head) as stream:
            return stream.read(_HEAD_BYTES)
    except (*_BROKEN, OSError, LogFormatError):
        return b""


class _DamagedPacking(LogFormatError):
    """What is packed is damaged or ends too early."""


def unpack(path: Path, head: bytes, folder: Path) -> tuple[Path, bool]:
    """Unpack a file into `folder`: the file that was packed, or a folder with the files of the archive.

    Also whether a log was cut off where its packing is damaged. Raises LogFormatError for what is damaged otherwise or
    unpacks to too much, and LogError where there is no space for it.
    """
    allowed = max(FREE_UNPACKED_BYTES, MAX_TOTAL_RATIO * path.stat().st_size)
    target = Path(tempfile.mkdtemp(dir=folder)) / plain_name(path)
    try:
        if head.startswith(_ZIP):
            return _unpack_zip(path, target, allowed), False
        try:
            with _opened(path, head) as stream, target.open("wb") as out:
                copied = _copy(stream, out, path, allowed)
                is_cut = copied < _stated_size(head)  # zstd raises nothing where the end is missing.
            if is_cut and not copied:
                raise _damaged(path, "nothing of it is whole")
        except (*_BROKEN, _DamagedPacking):
            if not _is_salvaged(path, head, target):
                raise
            return target, True
        with target.open("rb") as file:
            inner = file.read(_HEAD_BYTES)
        if not _is_tar(inner):
            return target, is_cut
        archive = target.rename(target.with_name(target.name + ".packed"))
        found = _unpack_tar(archive, target.with_suffix(""), path, allowed)
        archive.unlink()
        return found, False
    except _BROKEN as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise _damaged(path, reason) from error
    except OSError as error:
        raise LogError(
            f"{path}: cannot be unpacked into {folder} ({error.strerror or error}); set TMPDIR to a folder with space"
        ) from error


def plain_name(path: Path) -> str:
    """The name of a file without the ending of its packing."""
    return path.stem if path.suffix.lower() in _PACKED_ENDINGS and path.stem else path.name


def _is_tar(head: bytes) -> bool:
    return head[_TAR_AT : _TAR_AT + len(_TAR)] == _TAR


def _damaged(path: Path, reason: object) -> LogFormatError:
    return _DamagedPacking(f"{path}: its compression is damaged or ends too early ({reason})")


@contextmanager
def _opened(path: Path, head: bytes) -> Iterator[BinaryIO]:
    """What a packed file holds, as a stream; a tar file as it is."""
    if _begins_with_zstd(head):
        import zstandard

        try:
            with (
                path.open("rb") as file,
                zstandard.ZstdDecompressor(max_window_size=1 << 31).stream_reader(file, read_across_frames=True) as s,
            ):
                yield cast("BinaryIO", s)
        except zstandard.ZstdError as error:
            raise _damaged(path, error) from error
    elif head.startswith(STREAMS):
        try:
            with opened(path, head) as stream:
                yield cast("BinaryIO", stream)
        except RuntimeError as error:  # of lz4
            raise _damaged(path, error) from error
        except OSError as error:
            if error.errno is not None:  # gzip and bz2 raise one without a number for data that are damaged
                raise
            raise _damaged(path, error) from error
    else:
        with path.open("rb") as plain:
            yield plain


def _stated_size(head: bytes) -> int:
    """How many bytes a file that is packed by zstd says that it holds; 0 where it does not say."""
    if not head.startswith(ZSTD):
        return 0
    import zstandard

    return int(max(zstandard.frame_content_size(head), 0))


def _is_salvaged(path: Path, head: bytes, target: Path) -> bool:
    """Whether what can be unpacked before the damage looks like a log; it is then in `target`."""
    try:
        with _opened(path, head) as stream, target.open("wb") as out:
            while block := stream.read(_SMALL_BLOCK):
                out.write(block)
    except (*_BROKEN, _DamagedPacking):
        pass
    return target.stat().st_size >= _HEAD_BYTES and kind_of(_head(target)) != ""


def _copy(stream: IO[bytes], out: BinaryIO, path: Path, allowed: int) -> int:
    copied = 0
    while block := stream.read(_BLOCK):
        copied += len(block)
        if copied > allowed:
            raise LogFormatError(f"{path}: unpacks to more than {MAX_TOTAL_RATIO} times its size")
        out.write(block)
    return copied


def _unpack_zip(path: Path, target: Path, allowed: int) -> Path:
    """The files of a zip archive in one folder, under their own last names."""
    with zipfile.ZipFile(path) as archive:
        names = [info for info in archive.infolist() if not info.is_dir()]
        if len(names) > _MAX_MEMBERS:
            raise LogFormatError(f"{path}: holds {len(names)} files, at most {_MAX_MEMBERS} are read")
        folder = _folder(target)
        for info in names:
            name = Path(info.filename).name
            if not name or (folder / name).exists():
                continue
            try:
                with archive.open(info) as stream, (folder / name).open("wb") as out:
                    allowed -= _copy(stream, out, path, allowed)
            except (RuntimeError, NotImplementedError) as error:  # encrypted, or a compression that Python lacks
                raise LogFormatError(f"{path}: {info.filename} cannot be unpacked ({error})") from error
    return folder


def _unpack_tar(archive: Path, target: Path, path: Path, allowed: int) -> Path:
    with tarfile.open(archive, "r:") as tar:
        folder = _folder(target)
        for number, member in enumerate(tar):
            if number > _MAX_MEMBERS:
                raise LogFormatError(f"{path}: holds more than {_MAX_MEMBERS} files")
            name = Path(member.name).name
            stream = tar.extractfile(member) if member.isreg() else None
            if stream is None or not name or (folder / name).exists():
                continue
            with stream, (folder / name).open("wb") as out:
                allowed -= _copy(stream, out, path, allowed)
    return folder


def _folder(target: Path) -> Path:
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    return target
