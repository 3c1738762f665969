"""The stores of a server: the data folder, and the object store that the settings name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import select

from hsloc_service.db.tables import JobRow, RemovalRow
from hsloc_service.errors import StoreError
from hsloc_service.results.store import FolderStore

if TYPE_CHECKING:
    from hsloc_service.db.database import Database
    from hsloc_service.results.store import ResultStore
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage


class ResultStores:
    """The data folder, where results are by default, and the object store that the settings name."""

    def __init__(self, storage: Storage, settings: Settings) -> None:
        self.folder = FolderStore(storage.results)
        self.current: ResultStore = self.folder
        self.parts_store: ResultStore | None = None
        """Where the parts of uploads are; None: uploads are files of the data folder."""
        if settings.store_url:
            from hsloc_service.results.object_store import ObjectStore

            self.current = ObjectStore(settings.store_url, "results", "HSLOC_STORE_URL")
            self.parts_store = ObjectStore(settings.store_url, "uploads", "HSLOC_STORE_URL")
        elif settings.results_url:
            # fsspec is imported where it is needed alone.
            from hsloc_service.results.object_store import ObjectStore

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
