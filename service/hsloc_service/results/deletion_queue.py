"""Results that no job has any more: removed now or later, but never forgotten."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import or_, select

from hsloc_service.call_timeout import wait
from hsloc_service.db.tables import JobRow, RemovalRow
from hsloc_service.errors import StoreError
from hsloc_service.logs import log

if TYPE_CHECKING:
    from hsloc_service.db.database import Database
    from hsloc_service.results.store import ResultStore
    from hsloc_service.results.stores import ResultStores


@dataclass(frozen=True, slots=True)
class Removals:
    """Works off what `erase` noted down in the transaction that removed the job."""

    database: Database
    stores: ResultStores
    timeout_s: float

    def clear_folder(self) -> None:
        """Remove what is in the data folder: at once, so that its room is there again."""
        for row in self._rows():
            if row.store is None:
                self.stores.folder.remove(row.folder)
                self._done(row)

    def clear(self) -> int:
        """Remove all that can be reached; how many results went. Blocks for as long as a slow store is waited for."""
        count = 0
        for row in self._rows():
            if row.store not in (None, self.stores.current.url):
                continue  # until the operator names that store again
            try:
                self._remove(self.stores.of(row.store), row.folder)
            except StoreError as error:
                log("store.error", what="remove", name=row.folder, error=str(error))
                break  # the others would fail as well; they are tried in the next round
            self._done(row)
            count += 1
        return count

    def sweep(self, store: ResultStore) -> int:
        """Remove results that no job names: of attempts that died, or were fenced off, between storing and commit.

        May run at any time: what an attempt is storing just now belongs to a job that runs. Raises StoreError.
        """
        names = self._names(store)  # before the rows are read: what is named by a row now was stored earlier
        with self.database.read() as session:
            query = select(JobRow.folder).where(JobRow.folder.is_not(None))
            here = JobRow.store.is_(None) if store.url is None else JobRow.store == store.url
            kept = set(session.scalars(query.where(here)))
            # A waiting job's attempt is one that died; the next has another number.
            running = (JobRow.state == "running", JobRow.state == "cancelling")
            active = session.execute(select(JobRow.id, JobRow.attempt).where(or_(*running))).all()
        kept |= {f"{row.id}.{row.attempt}" for row in active}
        doomed = [name for name in names if name not in kept]
        for name in doomed:
            log("sweep", kind="result", name=name)
            self._remove(store, name)
        return len(doomed)

    def _names(self, store: ResultStore) -> list[str]:
        return store.names() if store.url is None else wait(store.names, self.timeout_s)

    def _remove(self, store: ResultStore, name: str) -> None:
        if store.url is None:
            store.remove(name)
        else:
            wait(lambda: store.remove(name), self.timeout_s)

    def _rows(self) -> list[RemovalRow]:
        with self.database.read() as session:
            return list(session.scalars(select(RemovalRow).order_by(RemovalRow.created)))

    def _done(self, row: RemovalRow) -> None:
        with self.database.write() as session:
            found = session.get(RemovalRow, row.folder)
            if found is not None:
                session.delete(found)


def removal_of(job: JobRow) -> RemovalRow:
    """The note that the results of a job are to go."""
    return RemovalRow(folder=job.folder, store=job.store, created=time.time())
