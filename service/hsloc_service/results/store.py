"""What a store of results must do, and the data folder as one.

Law of a store: `publish` puts files under a name that was never used, which the job's row names in the commit that ends
the job. Until then they cannot be requested: there is the whole result or none, whatever fails in between, and what an
abandoned attempt left behind is found by `names` and removed.
"""

from __future__ import annotations

import math
import os
import re
import stat
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from hsloc_service.call_timeout import MIN_BYTES_PER_S
from hsloc_service.storage import hash_file, remove_tree, sync_folder

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


MAX_ASSETS = 1000
BLOCK = 4 << 20
"""Bytes that are read from a store at once."""
MEDIA_TYPES = {
    ".tum": "text/plain; charset=utf-8",
    ".json": "application/json",
    ".yaml": "application/yaml",
    ".png": "image/png",
    ".pgm": "image/x-portable-graymap",
    ".svg": "image/svg+xml",
    ".html": "text/html; charset=utf-8",
    ".mcap": "application/octet-stream",
    ".ply": "application/octet-stream",
    ".csv": "text/csv; charset=utf-8",
}
"""What results may be; anything else is application/octet-stream."""
_ASSET_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}\Z")
_RESULT_NAME = re.compile(r"[0-9a-f-]{36}\.[0-9]{1,9}\Z")


@dataclass(frozen=True, slots=True)
class Asset:
    """A file of a result."""

    name: str
    size: int
    sha256: str
    media_type: str


class AssetReader(Protocol):
    """Reads ranges of one asset."""

    def read(self, start: int, size: int) -> bytes:
        """`size` bytes from `start` on. Raises as `ResultStore.read`."""
        ...

    def close(self) -> None:
        """Give the file back."""
        ...


class ResultStore(Protocol):
    """See the law above. Methods may block for as long as the store does: see `call_timeout`.

    All but `publish` raise StoreError for trouble that may pass, and FileNotFoundError for what is not there.
    """

    @property
    def url(self) -> str | None:
        """What the job's row says of where its results are; None for the data folder."""
        ...

    def expect(self) -> None:
        """The store has had results; where its folder is missing, its disk is not mounted."""
        ...

    def publish(self, output: Path, name: str, assets: list[Asset]) -> None:
        """Make the files of `output`, which `collect` has seen, the results `name`.

        Raises StoreError, or OSError for trouble of the local disk.
        """
        ...

    def open(self, name: str, asset: str) -> AssetReader:
        """A reader of one asset; where it is a file, it stays readable when the results are removed meanwhile."""
        ...

    def read(self, name: str, asset: str, start: int, size: int) -> bytes:
        """`size` bytes from `start` on, which the manifest says are there."""
        ...

    def remove(self, name: str) -> None:
        """Remove results; no error if they are gone."""
        ...

    def names(self) -> list[str]:
        """All results, also those that no job names."""
        ...


class FolderStore:
    """A folder of the data folder: results appear by one rename."""

    url = None

    def __init__(self, root: Path) -> None:
        self._root = root

    def expect(self) -> None:
        """The data folder is always there."""

    def publish(self, output: Path, name: str, assets: list[Asset]) -> None:
        """Rename the output to `<root>/<name>`; its files were synced when they were hashed."""
        del assets
        sync_folder(output)
        output.rename(self._root / checked_result(name))
        sync_folder(self._root)

    def open(self, name: str, asset: str) -> AssetReader:
        """A reader of the file of an asset. Raises FileNotFoundError."""
        return _FileReader(self._root / checked_result(name) / checked_asset(asset))

    def read(self, name: str, asset: str, start: int, size: int) -> bytes:
        """Bytes of an asset. Raises OSError if they are not there: that does not pass."""
        with closing(self.open(name, asset)) as reader:
            return reader.read(start, size)

    def remove(self, name: str) -> None:
        """Remove the results `name`."""
        remove_tree(self._root / checked_result(name))

    def names(self) -> list[str]:
        """The folders with the names of results; anything else is left alone."""
        return [entry.name for entry in os.scandir(self._root) if _RESULT_NAME.match(entry.name)]


class _FileReader:
    """An open file. Does not follow a link."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)

    def read(self, start: int, size: int) -> bytes:
        block = os.pread(self._descriptor, size, start)
        while 0 < len(block) < size and (more := os.pread(self._descriptor, size - len(block), start + len(block))):
            block += more
        if len(block) != size:
            raise OSError(f"{self._path}: shorter than its manifest says")
        return block

    def close(self) -> None:
        os.close(self._descriptor)


def transfer_timeout_s(store: ResultStore, sizes: Sequence[int], call_timeout_s: float) -> float:
    """Time limit for a transfer of files of these sizes [B]; infinite for the data folder, a local disk."""
    if store.url is None:
        return math.inf
    return call_timeout_s * (1 + len(sizes)) + sum(sizes) / MIN_BYTES_PER_S


def collect(output: Path) -> list[Asset]:
    """The manifest of a job's output: each file hashed, and on the disk.

    Only regular files with plain names and no second one are taken; what else a job leaves behind is removed.
    """
    assets: list[Asset] = []
    for path in sorted(output.iterdir()):
        if not is_plain_file(path) or _ASSET_NAME.match(path.name) is None or len(assets) >= MAX_ASSETS:
            remove_tree(path)
            continue
        size, digest = hash_file(path, sync=True)
        media = MEDIA_TYPES.get(path.suffix.lower(), "application/octet-stream")
        assets.append(Asset(path.name, size, digest, media))
    return assets


def is_plain_file(path: Path) -> bool:
    """Whether it is a regular file with no second name, which could be one of the server's own, such as its database.

    Raises OSError where nothing is there.
    """
    found = path.lstat()
    return stat.S_ISREG(found.st_mode) and found.st_nlink == 1


def checked_asset(name: str) -> str:
    """The name of an asset; raises ValueError for anything that could lead elsewhere."""
    if not _ASSET_NAME.match(name):
        raise ValueError(f"{name!r} is not the name of an asset")
    return name


def checked_result(name: str) -> str:
    """The name of results, `<job>.<attempt>`; raises ValueError for anything that could lead elsewhere."""
    if not _RESULT_NAME.match(name):
        raise ValueError(f"{name!r} is not the name of results")
    return name
