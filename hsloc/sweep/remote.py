"""Logs and results of a sweep at URLs, as fsspec knows them: `s3://bucket/logs/*.mcap`, `gs://...`, `file:///mnt/logs`.

A log is fetched by the process that runs it, which keeps the newest one for its next run; of an MCAP file with an index
the topics that hsloc cannot read, such as images, are left out (`hsloc.log.copy_needed`). An object of an object store
appears whole, and a file of a file system by a rename, so that nothing that is read is half written.
"""

from __future__ import annotations

import fnmatch
import shutil
import tempfile
import uuid
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.util import Finalize
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hsloc.errors import HslocError, LogError, OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

OBJECT_STORES = ("s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl")
"""They have no folders, and what is written appears by one call."""
_FLAT = (*OBJECT_STORES, "memory")
_VERSIONS = ("ETag", "etag", "md5Hash", "LastModified", "last_modified", "mtime")
"""What changes with the content of a file; each file system has its own."""
PACKAGES = {
    "s3": "s3fs",
    "s3a": "s3fs",
    "gs": "gcsfs",
    "gcs": "gcsfs",
    "abfs": "adlfs",
    "abfss": "adlfs",
    "az": "adlfs",
}
"""Packages of the file systems that fsspec does not have itself."""


@dataclass(frozen=True, slots=True)
class RemoteFile:
    """A file at a URL: its path below the log's name, its size [B], and what its content is known by."""

    url: str
    path: str
    size: int
    version: str


@dataclass(frozen=True, slots=True)
class RemoteLog:
    """A log at a URL: a file, or a folder of files."""

    url: str
    files: tuple[RemoteFile, ...]

    @property
    def name(self) -> str:
        """Last part of the URL."""
        return _last_part(self.url)

    def fetch(self) -> Path:
        """A copy on the local disk, which is kept until this process fetches another log. Raises LogError."""
        if _kept.log != self:
            _kept.replace(self)
        return _kept.folder / self.name

    def _copy(self, folder: Path) -> None:
        for file in self.files:
            target = folder / self.name / file.path if file.path else folder / self.name
            target.parent.mkdir(parents=True, exist_ok=True)
            with _as_error(LogError, file.url, "read"):
                fs, path = _file_system(file.url)
                if _copy_ranges(fs, path, file.size, target):
                    # What came of two versions would fit together by chance only.
                    changed = file.version != (_version(fs.info(path)) or file.version)
                else:
                    fs.get_file(path, str(target))
                    changed = target.stat().st_size != file.size
            if changed:
                raise LogError(f"{file.url}: it changed while it was read; run the sweep again")


def _copy_ranges(fs: Any, path: str, size: int, target: Path) -> bool:
    """Whether a file is one of which a part is enough, and that was fetched."""
    from hsloc.log import copy_needed

    def fetch(ranges: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        found: list[bytes] = fs.cat_ranges(
            [path] * len(ranges), *map(list, zip(*ranges, strict=True)), on_error="raise"
        )
        return found

    with target.open("w+b") as file:
        return copy_needed(fetch, size, file) is not None


class _Kept:
    """The log that this process fetched last; its copy is removed when the process ends."""

    def __init__(self) -> None:
        self.log: RemoteLog | None = None
        self.folder = Path()
        self._end: Any = None

    def replace(self, log: RemoteLog) -> None:
        self.clear()
        self.folder = Path(tempfile.mkdtemp(prefix="hsloc-log-"))
        # Unlike `atexit`, it is called in the processes of a pool, too.
        self._end = Finalize(None, shutil.rmtree, (self.folder, True), exitpriority=0)
        log._copy(self.folder)
        self.log = log

    def clear(self) -> None:
        self.log = None
        if self._end is not None:
            self._end()
            self._end = None


_kept = _Kept()


def remote_logs(url: str) -> list[RemoteLog]:
    """The logs that a URL, or a pattern such as `s3://bucket/*.mcap`, names, by their names. Raises LogError."""
    with _as_error(LogError, url, "read"):
        fs, path = _file_system(url)
        found = fs.glob(path, detail=True) if any(sign in path for sign in "*?[") else {path: {}}
        logs = [
            RemoteLog(fs.unstrip_protocol(each), tuple(_files(fs, str(each), found[each]))) for each in sorted(found)
        ]
    if not logs or not all(log.files for log in logs):
        raise LogError(f"{url}: no log is there")
    return logs


def _files(fs: Any, path: str, listed: dict[str, Any]) -> Iterator[RemoteFile]:
    """`listed` is what a listing says of the path: an object store is not asked for each file again."""
    if listed.get("type") == "file" or not fs.isdir(path):
        yield _file(fs, path, "", listed)
        return
    for each, info in sorted(fs.find(path, detail=True).items()):
        yield _file(fs, str(each), str(each).removeprefix(path).lstrip("/"), info)


def _file(fs: Any, path: str, below: str, listed: dict[str, Any]) -> RemoteFile:
    info = listed if listed.get("type") == "file" else fs.info(path)  # a link is listed as what it is, not as its file
    # Where nothing changes with the content, none is taken for known.
    return RemoteFile(fs.unstrip_protocol(path), below, int(info["size"]), _version(info) or uuid.uuid4().hex)


def _version(info: dict[str, Any]) -> str | None:
    """What a file's content is known by; None where the file system has nothing of the kind."""
    return next((str(info[name]) for name in _VERSIONS if info.get(name) is not None), None)


@dataclass(frozen=True, slots=True)
class UrlFolder:
    """A folder at a URL, with what a sweep needs of `Path`. Raises OutputError where it cannot be written."""

    url: str

    def __truediv__(self, name: str) -> UrlFolder:
        return UrlFolder(f"{self.url.rstrip('/')}/{name}")

    def __str__(self) -> str:
        return self.url

    @property
    def name(self) -> str:
        """Last part of the URL."""
        return _last_part(self.url)

    def mkdir(self, *, parents: bool, exist_ok: bool) -> None:
        """Make it; a bucket of an object store must be there. Raises OutputError."""
        with _as_error(OutputError, self.url, "written"):
            fs, path = _file_system(self.url)
            scheme, bucket = urlsplit(self.url).scheme, path.split("/")[0]
            if scheme not in _FLAT:
                fs.makedirs(path, exist_ok=exist_ok)
            elif scheme != "memory" and not fs.exists(bucket):
                raise OutputError(f"{self.url}: there is no bucket {bucket}, or it is not yours to see")

    def glob(self, pattern: str) -> list[UrlFolder]:
        """What is in the folder and has such a name."""
        with _as_error(HslocError, self.url, "read"):
            names = _names(*_file_system(self.url))
        return [self / name for name in sorted(fnmatch.filter(names, pattern))]

    def read_text(self, encoding: str = "utf-8") -> str:
        """Content of a file. Raises FileNotFoundError, or HslocError."""
        with _as_error(HslocError, self.url, "read"):
            fs, path = _file_system(self.url)
            content: bytes = fs.cat_file(path)
        return content.decode(encoding)

    def write_text(self, text: str, encoding: str = "utf-8") -> None:
        """Write a file, whole or not at all."""
        self.write_bytes(text.encode(encoding))

    def write_bytes(self, content: bytes) -> None:
        """Write a file, whole or not at all."""
        with _as_error(OutputError, self.url, "written"):
            fs, path = _file_system(self.url)
            if urlsplit(self.url).scheme in _FLAT:
                fs.pipe_file(path, content)
                return
            folder, _, name = path.rpartition("/")
            beside = f"{folder}/.{name}.{uuid.uuid4().hex}.tmp"
            fs.makedirs(folder, exist_ok=True)
            fs.pipe_file(beside, content)
            fs.mv(beside, path)

    def replace(self, local: Path, mark: str) -> None:
        """Make this the folder `local`: what is there is removed, the file `mark` is removed first and written last.

        So a folder with the mark is whole. Raises OutputError for a folder that holds something else than results.
        """
        with _as_error(OutputError, self.url, "written"):
            fs, path = _file_system(self.url)
            before = _names(fs, path)
            if before and "metrics.json" not in before:
                raise OutputError(f"{self.url}: is in use for something else; choose another folder")
            if mark in before:
                fs.rm_file(f"{path}/{mark}")
            if before:
                fs.rm(path, recursive=True)
        names = sorted(
            (each.name for each in local.iterdir()), key=lambda name: (name == mark, name != "metrics.json", name)
        )
        for name in names:
            (self / name).write_bytes((local / name).read_bytes())


def _last_part(path: str) -> str:
    return path.rstrip("/").rsplit("/", 1)[-1]


def _names(fs: Any, path: str) -> set[str]:
    """What is in a folder; nothing where there is none."""
    return {_last_part(str(each)) for each in fs.ls(path, detail=False)} if fs.exists(path) else set()


def _file_system(url: str) -> tuple[Any, str]:
    """File system of a URL, and the path there. Raises HslocError where a package is missing."""
    scheme = urlsplit(url).scheme
    try:
        import fsspec

        # Listings must be those of the store, not of our memory.
        fs, path = fsspec.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        package = "fsspec" if error.name == "fsspec" else PACKAGES.get(scheme, str(error.name or error))
        raise HslocError(f"{url}: the package {package} is missing; pip install fsspec {package}") from error
    except ValueError as error:
        raise HslocError(f"{url}: {error}") from error
    return fs, str(path)


@contextmanager
def _as_error(kind: type[HslocError], url: str, done: str) -> Iterator[None]:
    """Whatever a file system raises, each its own, as an error of ours."""
    try:
        yield
    except HslocError:
        raise
    except FileNotFoundError as error:
        if kind is HslocError:
            raise
        raise kind(f"{url}: not found") from error
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise kind(
            f"{url}: cannot be {done}: {type(error).__name__}: {reason}; check the URL and the credentials"
        ) from error
