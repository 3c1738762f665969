"""The data folder: uploads, running jobs, results. Names come from here, never from a client."""

from __future__ import annotations

import fcntl
import hashlib
import math
import os
import re
import uuid
from contextlib import suppress
from typing import TYPE_CHECKING

from sqlalchemy.exc import OperationalError

from hsloc_service.errors import is_disk_full, no_space
from hsloc_service.settings import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

BALLAST = "ballast"
"""A file that is deleted when the disk is full, so that the database has room to delete."""
BALLAST_BYTES = 4 << 20
MAX_DEPTH = 64
"""Folders in folders that a job may make."""


def make_data_folder(root: Path, *folders: Path) -> None:
    """Make the data folder and those in it, for this user alone. Raises SettingsError."""
    try:
        for folder in (root, *folders):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise _unusable(root, error) from error


def _unusable(root: Path, error: OSError) -> SettingsError:
    return SettingsError(f"{root}: cannot be used as data folder ({error.strerror}); give another --data")


class Storage:
    """The local data folder, held by one server at a time. Results are the business of `results`."""

    def __init__(self, root: Path, min_free_bytes: int = 0) -> None:
        self.root = root
        self.min_free_bytes = min_free_bytes
        self.uploads, self.work, self.results = root / "uploads", root / "work", root / "results"
        self.cache, self.quarantine = root / "cache", root / "quarantine"
        make_data_folder(root, self.uploads, self.work, self.results, self.cache)
        try:
            self._lock = os.open(root / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise _unusable(root, error) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise SettingsError(f"{root}: another hsloc service is using this folder; give another --data") from error
        self.instance = self._instance()
        self.restore_ballast()

    def close(self) -> None:
        """Release the lock of the folder."""
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
        """Free bytes of the disk."""
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
        remove_tree(path)


def hash_file(path: Path, sync: bool = False) -> tuple[int, str]:
    """Size and SHA-256 of a file; with `sync` it is on the disk afterwards, and its owner's. Does not follow a link."""
    digest, size = hashlib.sha256(), 0
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
            size += len(block)
        if sync:
            os.fchmod(file.fileno(), 0o600)
            os.fsync(file.fileno())
    return size, digest.hexdigest()


def write_hashed(path: Path, blocks: Iterable[bytes]) -> str:
    """Write a file; the SHA-256 of what was written."""
    digest = hashlib.sha256()
    with path.open("wb") as file:
        for block in blocks:
            digest.update(block)
            file.write(block)
    return digest.hexdigest()


def sync_folder(path: Path | str) -> None:
    """Make renames and new names in a folder last."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def folder_bytes(path: Path) -> float:
    """What a folder takes on the disk, infinity if it is nested more than MAX_DEPTH deep.

    Files that vanish meanwhile count nothing.
    """
    total, folders = 0, [(str(path), 0)]
    while folders:
        base, depth = folders.pop()
        if depth > MAX_DEPTH:
            return math.inf
        with suppress(OSError), os.scandir(base) as entries:
            for entry in entries:
                with suppress(OSError):
                    total += entry.stat(follow_symlinks=False).st_blocks * 512
                    if entry.is_dir(follow_symlinks=False):
                        folders.append((entry.path, depth + 1))
    return total


def remove_tree(path: Path | str) -> None:
    """Remove a file, or a folder with all that is in it, however deep it is nested; no error if it is gone.

    Folders of folders are moved up first: a path of 20,000 names is too long for the kernel, and for recursion.
    """
    root = str(path)
    with suppress(OSError):
        if os.path.islink(root) or not os.path.isdir(root):
            os.unlink(root)
            return
    with suppress(OSError):
        while folders := _folders_of(root):
            for folder in folders:
                for inner in _folders_of(folder):
                    os.rename(inner, os.path.join(root, uuid.uuid4().hex))
                os.rmdir(folder)
        os.rmdir(root)


def _folders_of(path: str) -> list[str]:
    """The folders in a folder, whose other entries are removed."""
    if os.stat(path).st_mode & 0o700 != 0o700:
        os.chmod(path, 0o700)
    folders = []
    with os.scandir(path) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                if entry.stat().st_mode & 0o700 != 0o700:  # without, it cannot be moved
                    os.chmod(entry.path, 0o700)
                folders.append(entry.path)
            else:
                os.unlink(entry.path)
    return folders


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
