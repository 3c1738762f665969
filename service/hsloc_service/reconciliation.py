"""The data folder compared with its database when the server starts.

What the database knows to be deleted or abandoned is removed. What it does not know is moved to `quarantine/` and
logged, because the database may be the wrong one: restored from a backup, or lost. When the right one is back, what it
names is moved out of the quarantine again.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import TYPE_CHECKING

from sqlalchemy import select, update

from hsloc_service.db.tables import FileRow, JobRow, UploadDeletionRow
from hsloc_service.logs import log
from hsloc_service.storage import remove_tree

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc_service.db.database import Database
    from hsloc_service.results.deletion_queue import DeletionQueue
    from hsloc_service.storage import Storage


def reconcile(database: Database, storage: Storage, deletions: DeletionQueue) -> int:
    """Compare uploads, attempts and results of the data folder with the database; how many entries were quarantined.

    For the start only, when no job runs and nobody uploads.
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
