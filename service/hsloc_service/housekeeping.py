"""What goes with time: unfinished uploads, old jobs, old keys."""

from __future__ import annotations

import math
import threading
import time
from typing import TYPE_CHECKING

from sqlalchemy import delete, select

from hsloc_service.db.tables import ENDED, FileRow, IdempotencyRow, JobRow
from hsloc_service.errors import StoreError
from hsloc_service.jobs.repository import base_job, delete_job
from hsloc_service.logs import log
from hsloc_service.results.deletion_queue import Removals
from hsloc_service.uploads.repository import needed

if TYPE_CHECKING:
    from hsloc_service.db.database import Database
    from hsloc_service.results.stores import ResultStores
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage

EVERY_S = 60.0
SWEEP_S = 3600.0
KEY_S = 7 * 86400.0
"""An Idempotency-Key is remembered for a week."""


class Housekeeping:
    """A thread that tidies up."""

    def __init__(self, database: Database, storage: Storage, settings: Settings, stores: ResultStores) -> None:
        self._database, self._storage, self._settings, self._stores = database, storage, settings, stores
        self._removals = Removals(database, stores, settings.store_timeout_s)
        self._swept = -math.inf
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="housekeeping", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End."""
        self._stop.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        pause = 0.0
        while not self._stop.wait(pause):
            pause = EVERY_S
            try:
                self.tidy(time.time())
            except Exception as error:
                log("housekeeping.error", error=f"{type(error).__name__}: {error}")

    def tidy(self, now: float) -> None:
        """One round."""
        self._storage.restore_ballast()
        paths = self._expired_uploads(now)
        if self._settings.retention_s is not None:
            paths += self._old(now - self._settings.retention_s)
        with self._database.write() as session:
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.created < now - KEY_S))
        for file_id in paths:
            self._storage.upload_path(file_id).unlink(missing_ok=True)
        results = self._removals.clear()
        if paths or results:
            log("tidy", uploads=len(paths), results=results)
        self._sweep(now)

    def _sweep(self, now: float) -> None:
        """Leftovers in the object store: at the first round and then now and then. (The folder's go at start-up.)"""
        store = self._stores.current
        if store.url is None or now - self._swept < SWEEP_S:
            return
        try:
            self._removals.sweep(store)
        except StoreError as error:
            log("store.error", what="sweep", error=str(error))
        else:
            self._swept = now

    def _expired_uploads(self, now: float) -> list[str]:
        with self._database.write() as session:
            rows = session.scalars(select(FileRow).where(FileRow.state == "receiving", FileRow.expires < now)).all()
            for row in rows:
                session.delete(row)
            return [row.id for row in rows]

    def _old(self, before: float) -> list[str]:
        """Erase jobs that ended before and uploads of that age, but none that an active job needs; the uploads' ids."""
        with self._database.write() as session:
            jobs = session.scalars(select(JobRow).where(JobRow.state.in_(ENDED), JobRow.ended < before)).all()
            for job in jobs:
                if not base_job(session, job.id):
                    delete_job(session, job)
            query = select(FileRow).where(FileRow.state == "complete", FileRow.created < before)
            files = [row for row in session.scalars(query) if not needed(session, row.id)]
            for row in files:
                session.delete(row)
            return [row.id for row in files]
