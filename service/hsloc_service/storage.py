"""The data folder: uploads, running jobs, results. Names come from here, never from a client."""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import uuid
from contextlib import suppress
from typing import TYPE_CHECKING

from sqlalchemy.exc import OperationalError

from hsloc_service.errors import is_disk_full, no_space
from hsloc_service.settings import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

BALLAST = "ballast"
"""A file that is given up when the disk is full, so that the database can delete."""
BALLAST_BYTES = 4 << 20


class Storage:
    """The local data folder, held by one server at a time. Results are the business of `results`."""

    def __init__(self, root: Path, min_free_bytes: int = 0) -> None:
        self.root = root
        self.min_free_bytes = min_free_bytes
        self.uploads, self.work, self.results = root / "uploads", root / "work", root / "results"
        self.cache = root / "cache"
        try:
            for folder in (self.uploads, self.work, self.results, self.cache):
                folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._lock = os.open(root / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise SettingsError(f"{root}: cannot be used as data folder: {error.strerror}") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise SettingsError(f"{root}: another hsloc service is using this folder; give another --data") from error
        self.instance = self._instance()
        self.restore_ballast()

    def close(self) -> None:
        """Let another server have the folder."""
        os.close(self._lock)

    def _instance(self) -> str:
        """An identity of the folder, by which leftover processes of it are known."""
        path = self.root / "instance"
        with suppress(OSError):
            text = path.read_text(encoding="ascii").strip()
            if text:
                return text
        text = uuid.uuid4().hex
        path.write_text(text, encoding="ascii")
        return text

    def free_bytes(self) -> int:
        """What the disk has left for us."""
        found = os.statvfs(self.root)
        return found.f_bavail * found.f_frsize

    def need_space(self, size: int = 0) -> None:
        """Raises ServiceError 507 if `size` more bytes would leave less than the floor."""
        free = self.free_bytes()
        if free - size < self.min_free_bytes:
            raise no_space(f"the server's disk is full: {free >> 20} MiB free, {size >> 20} MiB asked for")

    def drop_ballast(self) -> None:
        """Give the database room to delete with, when the disk is full to the last byte."""
        (self.root / BALLAST).unlink(missing_ok=True)

    def restore_ballast(self) -> None:
        """Put the reserve back, if there is room."""
        path = self.root / BALLAST
        if path.exists() or self.free_bytes() < self.min_free_bytes + 2 * BALLAST_BYTES:
            return
        with suppress(OSError), path.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, BALLAST_BYTES)

    def with_room(self, work: Callable[[], None]) -> None:
        """Do what frees room, even if the disk is full to the last byte: the database needs a little to delete."""
        try:
            work()
        except OperationalError as error:
            if not is_disk_full(error):
                raise
            self.drop_ballast()
            work()

    def upload_path(self, file_id: str) -> Path:
        """Where the bytes of an upload are."""
        return self.uploads / _checked(file_id)

    def work_path(self, job_id: str, attempt: int) -> Path:
        """The folder of one attempt at a job."""
        return self.work / f"{_checked(job_id)}.{attempt}"

    def remove_work(self, path: Path) -> None:
        """Remove the folder of an attempt."""
        shutil.rmtree(path, ignore_errors=True)

    def leftovers(self) -> Iterator[tuple[str, Path]]:
        """Every upload and attempt on the disk, with its kind."""
        for kind, folder in (("upload", self.uploads), ("work", self.work)):
            for path in folder.iterdir():
                yield kind, path


def hash_file(path: Path, sync: bool = False) -> tuple[int, str]:
    """Size and SHA-256 of a file; with `sync` it is on the disk afterwards. Does not follow a link."""
    digest, size = hashlib.sha256(), 0
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
            size += len(block)
        if sync:
            os.fsync(file.fileno())
    return size, digest.hexdigest()


def sync_folder(path: Path | str) -> None:
    """Make renames and new names in a folder last."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def folder_bytes(path: Path) -> int:
    """What a folder takes on the disk; files that vanish meanwhile count nothing."""
    total = 0
    for base, _, names in os.walk(path):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(base, name)).st_blocks * 512
    return total


def safe_name(label: str, default: str) -> str:
    """A file name made of a client's label: its last part, letters, digits, dot, dash and underscore only.

    A plain name such as `office.mcap` stays what it is, so that results name their input as the command line does.
    """
    last = re.split(r"[/\\]", label)[-1]
    kept = re.sub(r"[^A-Za-z0-9._-]+", "_", last).lstrip(".-")[:100]
    return kept or default


def _checked(ident: str) -> str:
    """Identifiers are UUIDs; anything else must not become part of a path."""
    return str(uuid.UUID(ident))
