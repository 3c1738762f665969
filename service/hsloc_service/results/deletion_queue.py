"""Uploads and results that were deleted: recorded in the transaction that deleted them, removed now or later."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import delete, select

from hsloc_service.call_timeout import call_within
from hsloc_service.db.tables import JobRow, RemovalRow, UploadDeletionRow
from hsloc_service.errors import StoreError
from hsloc_service.logs import log

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from hsloc_service.db.database import Database
    from hsloc_service.db.tables import FileRow
    from hsloc_service.results.store import ResultStore
    from hsloc_service.results.stores import ResultStores
    from hsloc_service.results.upload_parts import UploadParts
    from hsloc_service.storage import Storage

BATCH = 200
"""Deletions that are confirmed in one transaction."""


@dataclass(frozen=True, slots=True)
class DeletionQueue:
    """Removes what `delete_upload` and `delete_job` recorded, and what abandoned attempts left behind."""

    database: Database
    storage: Storage
    stores: ResultStores
    timeout_s: float
    parts: UploadParts | None = None

    def clear_uploads(self) -> int:
        """Remove the bytes of deleted uploads that can be reached; how many. Blocks as `clear` does."""
        count = 0
        while True:
            with self.database.read() as session:
                found = list(session.scalars(select(UploadDeletionRow.id).limit(BATCH)))
            if not found:
                return count
            try:
                for file_id in found:
                    self.storage.upload_path(file_id).unlink(missing_ok=True)
                    if self.parts is not None:
                        self.parts.remove(file_id)
            except StoreError as error:
                log("store.error", what="remove upload", name=file_id, error=str(error))
                return count  # the others would fail as well; they are tried in the next round
            with self.database.write() as session:
                session.execute(delete(UploadDeletionRow).where(UploadDeletionRow.id.in_(found)))
            count += len(found)

    def clear_folder(self) -> None:
        """Remove deleted results from the data folder: at once, so that the space is free again."""
        for row in self._rows():
            if row.store is None:
                self.stores.folder.remove(row.folder)
                self._confirm([row.folder])

    def clear(self) -> int:
        """Remove all deleted results that can be reached; how many. Blocks for as long as a slow store takes."""
        done: list[str] = []
        for row in self._rows():
            if row.store not in (None, self.stores.current.url):
                continue  # until the settings name that store again
            try:
                self._remove(self.stores.of(row.store), row.folder)
            except StoreError as error:
                log("store.error", what="remove", name=row.folder, error=str(error))
                break  # the others would fail as well; they are tried in the next round
            done.append(row.folder)
            if len(done) % BATCH == 0:
                self._confirm(done[-BATCH:])
        self._confirm(done[len(done) // BATCH * BATCH :])
        return len(done)

    def sweep_folder(self) -> list[str]:
        """`sweep` of the data folder."""
        return self.sweep(self.stores.folder)

    def sweep(self, store: ResultStore) -> list[str]:
        """Remove results of attempts that the database knows and that were abandoned before their commit.

        The names of results of jobs that the database does not know, which stay. May run at any time: what an attempt
        is storing just now belongs to a job that runs. Raises StoreError.
        """
        names = self._names(store)  # before the rows are read: what a row names then was stored earlier
        with self.database.read() as session:
            jobs = session.execute(select(JobRow.id, JobRow.attempt, JobRow.state, JobRow.folder, JobRow.store)).all()
        by_id = {row.id: row for row in jobs}
        unknown = []
        for name in names:
            job_id, _, attempt = name.rpartition(".")
            row = by_id.get(job_id)
            if row is None or int(attempt) > row.attempt:
                unknown.append(name)
            elif row.folder == name and row.store == store.url:
                continue
            elif int(attempt) < row.attempt or row.state not in ("running", "cancelling"):
                # A waiting job's attempt is one that died; the next has another number.
                log("sweep", kind="result", name=name)
                self._remove(store, name)
        return unknown

    def _names(self, store: ResultStore) -> list[str]:
        return store.names() if store.url is None else call_within(self.timeout_s, store.names)

    def _remove(self, store: ResultStore, name: str) -> None:
        if store.url is None:
            store.remove(name)
        else:
            call_within(self.timeout_s, lambda: store.remove(name))

    def _rows(self) -> list[RemovalRow]:
        with self.database.read() as session:
            return list(session.scalars(select(RemovalRow).order_by(RemovalRow.created)))

    def _confirm(self, folders: list[str]) -> None:
        """Forget deletions that are done."""
        if folders:
            with self.database.write() as session:
                session.execute(delete(RemovalRow).where(RemovalRow.folder.in_(folders)))


def removal_of(job: JobRow) -> RemovalRow:
    """The record that the results of a job were deleted."""
    return RemovalRow(folder=job.folder, store=job.store, created=time.time())


def delete_upload(session: Session, row: FileRow) -> None:
    """Delete the row of an upload, and record that its bytes are to be removed."""
    if session.get(UploadDeletionRow, row.id) is None:
        session.add(UploadDeletionRow(id=row.id, created=time.time()))
    session.delete(row)
