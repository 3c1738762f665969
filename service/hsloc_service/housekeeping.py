"""What is removed with time, and what is put right when the server starts.

With time: unfinished uploads, old jobs, old keys, expired links. At the start the data folder is compared with its
database. What the database knows to be deleted or abandoned is removed. What it does not know is moved to
`quarantine/` and logged, because the database may be the wrong one: restored from a backup, or lost. When the right one
is back, what it names is moved out of the quarantine again.
"""

from __future__ import annotations

import logging
import math
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from sqlalchemy import delete, exists, select, tuple_, update

from hsloc_service.audit import RETENTION, forget, note
from hsloc_service.db.database import clock
from hsloc_service.db.tables import ENDED, FileRow, IdempotencyRow, JobRow, ShareRow, SweepRow, UploadDeletionRow
from hsloc_service.errors import StoreError
from hsloc_service.jobs.repository import base_job, delete_job
from hsloc_service.jobs.workers import forget_workers
from hsloc_service.logs import log
from hsloc_service.results.deletion_queue import delete_upload
from hsloc_service.storage import remove_tree
from hsloc_service.uploads.repository import needed_files

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc_service.db.database import Database
    from hsloc_service.results.deletion_queue import DeletionQueue
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage


SWEEP_S = 3600.0
BATCH = 25
"""Rows that are deleted in one transaction."""
KEY_S = 7 * 86400.0
"""An Idempotency-Key is remembered for a week."""


class Housekeeping:
    """A thread that tidies up."""

    def __init__(self, database: Database, storage: Storage, settings: Settings, deletions: DeletionQueue) -> None:
        self._database, self._storage, self._settings, self._deletions = database, storage, settings, deletions
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
            pause = self._settings.housekeeping_s
            try:
                with self._database.read() as session:
                    now = clock(session)
                self.tidy(now)
            except Exception as error:
                log("housekeeping.error", error=f"{type(error).__name__}: {error}")

    def tidy(self, now: float) -> None:
        """One round; of the servers that share a database one at a time does what concerns them all."""
        self._storage.restore_ballast()
        with self._database.elected("housekeeping") as mine:
            if mine:
                self._tidy_database(now)

    def _tidy_database(self, now: float) -> None:
        self._expire_uploads(now)
        forget_workers(self._database)
        if self._settings.retention_s is not None:
            self._delete_old(now - self._settings.retention_s)
        with self._database.write() as session:
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.created < now - KEY_S))
            session.execute(delete(ShareRow).where(ShareRow.expires <= now))
            forget(session, now)
        uploads, results = self._deletions.clear_uploads(), self._deletions.clear()
        if uploads or results:
            log("tidy", uploads=uploads, results=results)
        self._sweep(now)

    def _sweep(self, now: float) -> None:
        """Remove abandoned results from the object store: in the first round and then every SWEEP_S.

        Those of the data folder are removed at the start, by `reconcile`.
        """
        store = self._deletions.stores.current
        if store.url is None or now - self._swept < SWEEP_S:
            return
        try:
            if self._deletions.parts is not None:
                self._deletions.parts.sweep()
            unknown = self._deletions.sweep(store)
        except StoreError as error:
            log("store.error", what="sweep", error=str(error))
        else:
            self._swept = now
            if unknown:
                log("result.unknown", logging.WARNING, store=store.url, count=len(unknown), first=unknown[0])

    def _expire_uploads(self, now: float) -> None:
        with self._database.write() as session:
            self._database.lock(session, "tenants")
            rows = session.scalars(select(FileRow).where(FileRow.state == "receiving", FileRow.expires < now)).all()
            for row in rows:
                delete_upload(session, row)

    def _delete_old(self, before: float) -> None:
        """Delete jobs that ended before `before` and uploads of that age, but none that an active job needs.

        In batches of BATCH, a transaction each, so that other writes wait for one batch at most.
        """
        last: tuple[float, int] | None = (0.0, 0)
        while last is not None and not self._stop.is_set():
            last = self._delete_jobs(before, last)
        with self._database.write() as session:
            empty = ~exists().where(JobRow.sweep == SweepRow.id)
            session.execute(delete(SweepRow).where(SweepRow.created < before, empty))
        ident: str | None = ""
        while ident is not None and not self._stop.is_set():
            ident = self._delete_uploads(before, ident)

    def _delete_jobs(self, before: float, after: tuple[float, int]) -> tuple[float, int] | None:
        """Delete a batch of jobs that ended after others; end and `seq` of the last one, None if there are no more."""
        behind = tuple_(JobRow.ended, JobRow.seq) > tuple_(*after)
        query = select(JobRow).where(JobRow.ended < before, behind)
        with self._database.write() as session:
            self._database.lock(session, "tenants")
            jobs = session.scalars(query.order_by(JobRow.ended, JobRow.seq).limit(BATCH)).all()
            extended = base_job(session, *(job.id for job in jobs))
            # Not a part of the query: SQLite would go by the state, through all jobs.
            old = [job for job in jobs if job.state in ENDED and job.id not in extended]
            delete_job(session, *old)
            for job in old:
                note(session, job.tenant, RETENTION, "job.delete", job.id)
            return (jobs[-1].ended or 0.0, jobs[-1].seq) if jobs else None

    def _delete_uploads(self, before: float, after: str) -> str | None:
        """Delete a batch of uploads; the id of the last one, None if there are no more."""
        query = select(FileRow).where(FileRow.state == "complete", FileRow.created < before, FileRow.id > after)
        with self._database.write() as session:
            self._database.lock(session, "tenants")
            files, needed = session.scalars(query.order_by(FileRow.id).limit(BATCH)).all(), needed_files(session)
            for row in files:
                if row.id not in needed:
                    delete_upload(session, row)
                    note(session, row.tenant, RETENTION, "file.delete", row.id)
            return files[-1].id if files else None


def reconcile(database: Database, storage: Storage, deletions: DeletionQueue) -> int:
    """Compare uploads, attempts and results of the data folder with the database; how many entries were quarantined.

    For the start only, when no job runs and no upload is received.
    """
    if not database.shared:  # else other servers may receive them just now; and none of those was that old
        for file_id in reopen_uploads(database):
            with suppress(OSError):
                storage.upload_path(file_id).chmod(0o600)
    _restore(database, storage)
    deletions.clear_uploads()
    for path in storage.work.iterdir():
        log("sweep", kind="work", name=path.name)
        with suppress(OSError):
            remove_tree(path)
    unknown = [*_unknown_uploads(database, storage), *(storage.results / each for each in deletions.sweep_folder())]
    for path in unknown:
        target = storage.quarantine / path.parent.name / path.name
        log("quarantine", logging.WARNING, name=f"{path.parent.name}/{path.name}")
        with suppress(OSError):
            target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            path.rename(target)
    if unknown:
        remedy = "if the database was lost or is an old one, restore it and start again; else delete the quarantine"
        log("quarantined", logging.WARNING, count=len(unknown), folder=str(storage.quarantine), remedy=remedy)
    return len(unknown)


def reopen_uploads(database: Database) -> list[str]:
    """Ask for the last byte again of uploads that have all their bytes, but are not complete; their ids.

    An older server that was killed at that moment leaves such a row; its client takes it for finished, a job does not.
    """
    whole = (FileRow.state == "receiving", FileRow.size == FileRow.received, FileRow.received > 0)
    with database.read() as session:
        found = list(session.scalars(select(FileRow.id).where(*whole)))
    if found:  # else nothing is written: a server must start on a full disk, too
        with database.write() as session:
            session.execute(update(FileRow).where(*whole).values(received=FileRow.received - 1))
    return found


def _restore(database: Database, storage: Storage) -> None:
    """Move back from the quarantine what the database names and the data folder lacks."""
    if not storage.quarantine.is_dir():
        return
    with database.read() as session:
        files = session.scalars(select(FileRow.id)).all()
        results = session.scalars(select(JobRow.folder).where(JobRow.folder.is_not(None), JobRow.store.is_(None))).all()
    named = [storage.upload_path(each) for each in files] + [storage.results / (each or "") for each in results]
    for path in named:
        kept = storage.quarantine / path.parent.name / path.name
        if kept.exists() and not path.exists():
            log("quarantine.restored", name=f"{path.parent.name}/{path.name}")
            kept.rename(path)


def _unknown_uploads(database: Database, storage: Storage) -> list[Path]:
    """Files among the uploads that are neither a row's nor recorded as deleted."""
    with database.read() as session:
        known = {*session.scalars(select(FileRow.id)), *session.scalars(select(UploadDeletionRow.id))}
    return sorted(path for path in storage.uploads.iterdir() if path.name not in known)
