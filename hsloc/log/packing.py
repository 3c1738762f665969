"""Logs that were packed after they were recorded: gzip, zstd, zip and tar, found by their first bytes.

Packed logs are unpacked into a temporary folder (`$TMPDIR`), because containers are read at random places. What a
packed file may unpack to is bounded, so that a small file cannot fill the disk.
"""

from __future__ import annotations

import gzip
import lzma
import shutil
import tarfile
import tempfile
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, BinaryIO, cast

from hsloc.errors import LogError, LogFormatError

if TYPE_CHECKING:
    from collections.abc import Iterator

GZIP, ZSTD, ZIP = b"\x1f\x8b", b"\x28\xb5\x2f\xfd", b"PK\x03\x04"
_TAR_AT, _TAR = 257, b"ustar"
MAX_TOTAL_RATIO = 100
FREE_UNPACKED_BYTES = 4 << 30
"""Bytes that a packed log may unpack to: 100 times its size, and in any case 4 GiB."""
_MAX_MEMBERS = 1000
_BLOCK = 1 << 20
_HEAD_BYTES = 4096
_PACKED_ENDINGS = (".gz", ".zst", ".zstd", ".zip", ".tar", ".tgz")
_BROKEN = (EOFError, gzip.BadGzipFile, zlib.error, lzma.LZMAError, zipfile.BadZipFile, tarfile.TarError, ValueError)


def is_packed(head: bytes) -> bool:
    """Whether a file that begins with `head` (the first 512 bytes or more) is packed."""
    return head.startswith((GZIP, ZSTD, ZIP)) or _is_tar(head)


def unpacked_head(path: Path, head: bytes) -> bytes:
    """The first bytes of what a gzip or zstd file holds; empty where that cannot be read, and for archives."""
    if not head.startswith((GZIP, ZSTD)):
        return b""
    try:
        with _opened(path, head) as stream:
            return stream.read(_HEAD_BYTES)
    except (*_BROKEN, LogFormatError):
        return b""


def is_archive(head: bytes) -> bool:
    """Whether bytes are the beginning of a zip or tar archive, which holds files."""
    return head.startswith(ZIP) or _is_tar(head)


def unpack(path: Path, head: bytes, folder: Path) -> Path:
    """Unpack a file into `folder`: the file that was packed, or a folder with the files of the archive.

    Raises LogFormatError for what is damaged or unpacks to too much, and LogError where there is no space for it.
    """
    allowed = max(FREE_UNPACKED_BYTES, MAX_TOTAL_RATIO * path.stat().st_size)
    target = Path(tempfile.mkdtemp(dir=folder)) / plain_name(path)
    try:
        if head.startswith(ZIP):
            return _unpack_zip(path, target, allowed)
        with _opened(path, head) as stream, target.open("wb") as out:
            _copy(stream, out, path, allowed)
        with target.open("rb") as file:
            inner = file.read(_HEAD_BYTES)
        if not _is_tar(inner):
            return target
        archive = target.rename(target.with_name(target.name + ".packed"))
        found = _unpack_tar(archive, target.with_suffix(""), path, allowed)
        archive.unlink()
        return found
    except _BROKEN as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise LogFormatError(f"{path}: its compression is damaged or ends too early ({reason})") from error
    except OSError as error:
        raise LogError(
            f"{path}: cannot be unpacked into {folder} ({error.strerror or error}); set TMPDIR to a folder with space"
        ) from error


def plain_name(path: Path) -> str:
    """The name of a file without the ending of its packing."""
    return path.stem if path.suffix.lower() in _PACKED_ENDINGS and path.stem else path.name


def _is_tar(head: bytes) -> bool:
    return head[_TAR_AT : _TAR_AT + len(_TAR)] == _TAR


@contextmanager
def _opened(path: Path, head: bytes) -> Iterator[BinaryIO]:
    """What a packed file holds, as a stream; a tar file as it is."""
    if head.startswith(GZIP):
        with gzip.open(path, "rb") as stream:
            yield cast("BinaryIO", stream)
    elif head.startswith(ZSTD):
        import zstandard

        try:
            with path.open("rb") as file, zstandard.ZstdDecompressor(max_window_size=1 << 31).stream_reader(file) as s:
                yield cast("BinaryIO", s)
        except zstandard.ZstdError as error:
            raise LogFormatError(f"{path}: its compression is damaged or ends too early ({error})") from error
    else:
        with path.open("rb") as plain:
            yield plain


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
