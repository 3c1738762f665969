"""Who wakes the workers. The truth is the job's row with its lease; a dispatcher only says when to look.

`LocalDispatcher` runs the jobs of this machine in N slots. A dispatcher over PostgreSQL and Procrastinate would satisfy
the same protocol: `enqueue` defers a task that carries nothing but the job's id, in the transaction that inserts the
row; its workers call the same `Attempt`; a task delivered twice finds the row taken and ends.
"""

from __future__ import annotations

import os
import shutil
import threading
import uuid
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from sqlalchemy import select, update
from sqlalchemy.exc import OperationalError

from hsloc_service.db.tables import FileRow
from hsloc_service.execution.processes import kill_marked
from hsloc_service.execution.supervisor import Attempt
from hsloc_service.logs import log
from hsloc_service.results.deletion_queue import Removals

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc_service.db.database import Database
    from hsloc_service.jobs.leases import Leases
    from hsloc_service.results.stores import ResultStores
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage

IDLE_S = 1.0


@dataclass(frozen=True, slots=True)
class Capacity:
    """Slots, and how many of them work."""

    slots: int
    busy: int


class Dispatcher(Protocol):
    """Law: after `enqueue` the job is looked at soon; after `cancel` a running job ends within its grace, or at the
    next heartbeat where it runs elsewhere."""

    def enqueue(self, job_id: str) -> None:
        """A job was queued and committed."""
        ...

    def cancel(self, job_id: str) -> None:
        """The job's row says that it is to end."""
        ...

    def capacity(self) -> Capacity:
        """Slots of this machine."""
        ...

    def start(self) -> None:
        """Begin."""
        ...

    def stop(self) -> None:
        """Put the running jobs back into the queue, kill their processes, return when they are dead."""
        ...


class LocalDispatcher:
    """N slots on this machine, a thread each; a thread lives as long as its job, because the kernel's death signal
    for the job's process is bound to the thread that started it."""

    def __init__(
        self,
        leases: Leases,
        storage: Storage,
        settings: Settings,
        stores: ResultStores,
        ended: Callable[[str], None] = lambda state: None,
        store_failed: Callable[[], None] = lambda: None,
    ) -> None:
        self._leases, self._storage, self._settings, self._stores = leases, storage, settings, stores
        self._ended, self._store_failed = ended, store_failed
        self._owner = uuid.uuid4().hex
        self._stop = threading.Event()
        self._work = threading.Condition()
        self._running: dict[str, threading.Event] = {}
        self._threads: list[threading.Thread] = []

    @property
    def owner(self) -> str:
        """Name of this server in the leases."""
        return self._owner

    def start(self) -> None:
        """Clean up after a server that died, then start the slots."""
        if killed := kill_marked(f"{self._storage.instance}:"):
            log("orphans.killed", count=killed)
        for job_id in self._leases.recover(self._owner):
            log("job.requeued", job=job_id)
        sweep(self._leases.database, self._storage)
        Removals(self._leases.database, self._stores, self._settings.store_timeout_s).sweep(self._stores.folder)
        for k in range(self._settings.slots):
            thread = threading.Thread(target=self._slot, name=f"slot-{k}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """End the slots."""
        self._stop.set()
        with self._work:
            self._work.notify_all()
        for thread in self._threads:
            thread.join()

    def enqueue(self, job_id: str) -> None:
        """Wake a slot."""
        del job_id
        with self._work:
            self._work.notify()

    def cancel(self, job_id: str) -> None:
        """Tell the slot that runs the job, if it runs here."""
        event = self._running.get(job_id)
        if event is not None:
            event.set()

    def capacity(self) -> Capacity:
        """Slots of this server."""
        return Capacity(self._settings.slots, len(self._running))

    def _slot(self) -> None:
        while not self._stop.is_set():
            try:
                if not self._one():
                    with self._work:
                        self._work.wait(IDLE_S)
            except OperationalError as error:
                # A full disk or a locked database passes; the slot must not.
                log("slot.database", error=str(error.orig))
                self._storage.drop_ballast()
                self._stop.wait(IDLE_S)
            except Exception as error:
                log("slot.error", error=f"{type(error).__name__}: {error}")
                self._stop.wait(IDLE_S)

    def _one(self) -> bool:
        """Run the next job; False if there is none, or none may start: without room each would end as `disk_full`."""
        if self._storage.free_bytes() < self._storage.min_free_bytes:
            return False
        claim = self._leases.claim(self._owner)
        if claim is None:
            self._leases.recover()
            return False
        cancel = threading.Event()
        self._running[claim.job_id] = cancel
        try:
            attempt = Attempt(
                claim,
                self._leases,
                self._storage,
                self._settings,
                self._stores,
                stop=self._stop,
                cancel=cancel,
                store_failed=self._store_failed,
            )
            self._ended(state := attempt.run())
        finally:
            self._running.pop(claim.job_id, None)
        return state != "queued"  # what could not be started now will not a millisecond later: it has a breath


def sweep(database: Database, storage: Storage) -> None:
    """Remove what a killed server left: folders of attempts, bytes that no upload names.

    Only at start-up, when nothing runs.
    """
    for file_id in reopen(database):
        with suppress(OSError):
            storage.upload_path(file_id).chmod(0o600)
    with database.read() as session:
        files = set(session.scalars(select(FileRow.id)))
    for kind, path in storage.leftovers():
        if kind == "work" or path.name not in files:
            log("sweep", kind=kind, name=path.name)
            with suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else os.unlink(path)


def reopen(database: Database) -> list[str]:
    """Ask for the last byte again of uploads that have all their bytes, but are not complete; their ids.

    A server of an older hsloc that died at that moment left such; to a client they look finished, to a job they do not.
    """
    whole = (FileRow.state == "receiving", FileRow.size == FileRow.received, FileRow.received > 0)
    with database.read() as session:
        found = list(session.scalars(select(FileRow.id).where(*whole)))
    if found:  # else nothing is written: a server must start on a full disk, too
        with database.write() as session:
            session.execute(update(FileRow).where(*whole).values(received=FileRow.received - 1))
    return found
