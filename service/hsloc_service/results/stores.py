"""The stores of a server: the data folder, and the object store that the settings name.

An object store is whatever fsspec knows: `s3://bucket/prefix`, `gcs://…`, `file:///mnt/results`. Objects are written
one by one under `<url>/<folder>/<job>.<attempt>/`. The folder is the data folder's instance: two servers may share a
bucket, and one that starts on an empty folder does not take the results of another for leftovers. Where servers share a
database it is `results`, for all of them: the rows say what is whose.
"""

from __future__ import annotations

import os
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from sqlalchemy import select

from hsloc.sweep.remote import OBJECT_STORES, PACKAGES
from hsloc_service.db.tables import JobRow, RemovalRow
from hsloc_service.errors import StoreError
from hsloc_service.results.store import FolderStore, checked_asset, checked_result
from hsloc_service.settings import SettingsError
from hsloc_service.storage import sync_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from hsloc_service.db.database import Database
    from hsloc_service.results.store import Asset, AssetReader, ResultStore
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage


class ObjectStore:
    """A `ResultStore` over a file system of fsspec. Holds no connection of its own, and may be used from many threads.

    Raises SettingsError for a URL that cannot be used; whether the store answers is seen when it is needed.
    """

    def __init__(self, url: str, folder: str, setting: str = "HSLOC_RESULTS_URL") -> None:
        parts = urlsplit(url)
        if not parts.scheme or "::" in url:
            raise SettingsError(f"{setting} is {url!r}; it must be a URL such as s3://bucket/prefix")
        if parts.username is not None or parts.password is not None or parts.query:
            # The URL is in the database and in errors.
            raise SettingsError(
                f"{setting}: leave user, password and query out of the {parts.scheme} URL; "
                "credentials stand where the file system looks for them, such as AWS_ACCESS_KEY_ID"
            )
        try:
            import fsspec  # only servers with an object store need it

            # Listings must be those of the store, not of our memory: leftovers are found by them.
            self._fs, root = fsspec.url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
        except ImportError as error:
            package = PACKAGES.get(parts.scheme)
            hint = f": pip install {package}" if package else f": {error}"
            raise SettingsError(f"{setting} is {url!r}; its file system is not installed{hint}") from error
        except Exception as error:
            raise SettingsError(f"{setting} is {url!r}, which cannot be used: {error}") from error
        self._flat = parts.scheme in OBJECT_STORES
        """No folder is made before its files: s3fs would make a bucket of a name that was mistyped."""
        self._url = url if url.endswith("://") else url.rstrip("/")
        self._root = f"{str(root).rstrip('/')}/{folder}"
        self._there = False
        """Whether our folder was seen to be there."""

    @property
    def url(self) -> str:
        """What the job's row says."""
        return self._url

    def expect(self) -> None:
        """Refuse to make the root folder again: it has held results."""
        self._there = True

    def publish(self, output: Path, name: str, assets: list[Asset]) -> None:
        """Write every asset, and see that each is there with all its bytes."""
        folder = f"{self._root}/{checked_result(name)}"
        with _typed(f"writing {name}", missing=True):
            if not self._flat:
                if self._there:
                    self._need_root()
                self._fs.makedirs(folder, exist_ok=True)
                self._there = True
            for asset in assets:
                target = f"{folder}/{checked_asset(asset.name)}"
                self._fs.put_file(str(output / asset.name), target)
                size = self._fs.info(target)["size"]
                if size != asset.size:
                    raise StoreError(f"{asset.name}: {size} of {asset.size} bytes are there after writing")
            self._sync(folder, assets)

    def _sync(self, folder: str, assets: list[Asset]) -> None:
        """A mounted disk keeps written files in memory for a while; an object store answers when they are safe."""
        from fsspec.implementations.local import LocalFileSystem

        if not isinstance(self._fs, LocalFileSystem):
            return
        for asset in assets:
            descriptor = os.open(f"{folder}/{asset.name}", os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        for path in (folder, os.path.dirname(folder), os.path.dirname(os.path.dirname(folder))):
            sync_folder(path)

    def open(self, name: str, asset: str) -> AssetReader:
        """A reader of one object; each range is a call to the store."""
        return _ObjectReader(self, checked_result(name), checked_asset(asset))

    def read(self, name: str, asset: str, start: int, size: int) -> bytes:
        """One range of an object."""
        if size == 0:
            return b""
        place = f"{self._root}/{checked_result(name)}/{checked_asset(asset)}"
        with _typed(f"reading {asset}"):
            block: bytes = self._unless_away(lambda: self._fs.cat_file(place, start=start, end=start + size))
            if len(block) != size:
                raise StoreError(f"{asset}: {len(block)} of {size} bytes came")
            return block

    def remove(self, name: str) -> None:
        """Remove all objects of the results `name`."""
        place = f"{self._root}/{checked_result(name)}"
        with suppress(FileNotFoundError), _typed(f"removing {name}"):
            self._unless_away(lambda: self._fs.rm(place, recursive=True))

    def _unless_away(self, work: Callable[[], Any]) -> Any:
        """The result of `work`. What is not there because nothing is, is not gone: a disk that is not mounted."""
        try:
            return work()
        except FileNotFoundError:
            if not self._flat:
                self._need_root()
            raise

    def _need_root(self) -> None:
        """Raises StoreError if the folder that held results is away; written to, it would be made on another disk."""
        if not self._fs.exists(self._root):
            raise StoreError(f"{self._root} is away; is its disk mounted?")

    def names(self) -> list[str]:
        """What has the name of results."""
        found: list[Any] = []
        with suppress(FileNotFoundError), _typed("listing"):
            found = self._fs.ls(self._root, detail=False)
        names = [str(path).rstrip("/").rsplit("/", 1)[-1] for path in found]
        return [name for name in names if _is_result(name)]


@dataclass(frozen=True, slots=True)
class _ObjectReader:
    store: ObjectStore
    name: str
    asset: str

    def read(self, start: int, size: int) -> bytes:
        return self.store.read(self.name, self.asset, start, size)

    def close(self) -> None:
        """Nothing is open."""


def _is_result(name: str) -> bool:
    try:
        checked_result(name)
    except ValueError:
        return False
    return True


@contextmanager
def _typed(doing: str, missing: bool = False) -> Iterator[None]:
    """Whatever a file system raises, each its own, as StoreError; that something is not there, only if `missing`."""
    try:
        yield
    except StoreError:
        raise
    except Exception as error:
        if isinstance(error, FileNotFoundError) and not missing:
            raise
        raise StoreError(f"{doing}: {type(error).__name__}: {error}"[:300]) from error


class ResultStores:
    """The data folder, where results are by default, and the object store that the settings name."""

    def __init__(self, storage: Storage, settings: Settings) -> None:
        self.folder = FolderStore(storage.results)
        self.current: ResultStore = self.folder
        self.parts_store: ResultStore | None = None
        """Where the parts of uploads are; None: uploads are files of the data folder."""
        if settings.store_url:
            self.current = ObjectStore(settings.store_url, "results", "HSLOC_STORE_URL")
            self.parts_store = ObjectStore(settings.store_url, "uploads", "HSLOC_STORE_URL")
        elif settings.results_url:
            self.current = ObjectStore(settings.results_url, storage.instance)

    def expect(self, database: Database) -> None:
        """Take the folder of the current store for away, not for new, if the database names results in it."""
        url = self.current.url
        if url is None:
            return
        with database.read() as session:
            found = session.scalar(select(JobRow.id).where(JobRow.store == url).limit(1))
            found = found or session.scalar(select(RemovalRow.folder).where(RemovalRow.store == url).limit(1))
        if found is not None:
            self.current.expect()

    def of(self, url: str | None) -> ResultStore:
        """The store that a job's row names. Raises StoreError if the settings do not name it any more."""
        if url is None:
            return self.folder
        if url != self.current.url:
            raise StoreError(
                f"these results are in {url}, which this server is not set to (HSLOC_STORE_URL, HSLOC_RESULTS_URL)"
            )
        return self.current
