"""A data folder copied: all of it while a server runs, as a backup; or its database to PostgreSQL.

A backup has a copy of the database, and of every upload and result that it names. A plain copy of the folder is none
while a server runs: what is in the database's write-ahead log is missing in a copy of `hsloc.db`. The backup is a data
folder itself: to restore it, copy it to where `--data` points. To move a database the server must be stopped.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from contextlib import closing, suppress
from typing import TYPE_CHECKING, NamedTuple

from sqlalchemy import delete, func, insert, select

from hsloc_service.db.database import SQLITE, Database
from hsloc_service.db.tables import AssetRow, Base, CounterRow, FileRow, JobRow
from hsloc_service.jobs.repository import delete_job
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage, sync_folder

if TYPE_CHECKING:
    from pathlib import Path

    from sqlalchemy import Table
    from sqlalchemy.orm import Session

    from hsloc_service.settings import Settings

BLOCK = 1 << 20
BATCH = 1000
"""Rows that are copied at once."""


class BackupReport(NamedTuple):
    """What a backup holds."""

    uploads: int
    jobs: int
    results: int
    """Jobs whose results were copied; those in an object store stay there."""
    bytes: int
    deleted: int
    """Uploads and jobs that were deleted while the backup was made, and that are not in it."""


def back_up(data: Path, target: Path) -> BackupReport:
    """Copy the data folder `data` to the new folder `target`, while a server may run on it; each file is verified.

    Raises SettingsError where `data` is no data folder, `target` is there already, the copy fails, or a file does not
    have the SHA-256 that the database names.
    """
    database = _database_in(data)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise SettingsError(f"{target}: exists already; name a new folder for the backup")
    partial = target.with_name(f".{target.name}.partial")
    try:
        if partial.exists():
            shutil.rmtree(partial)
        for name in ("uploads", "results"):
            (partial / name).mkdir(parents=True, mode=0o700)
        partial.chmod(0o700)
        _copy_database(database, partial / SQLITE)
        with suppress(FileNotFoundError):
            shutil.copyfile(data / "instance", partial / "instance")
        report = _copy_files(data, partial)
        for base, _, _ in os.walk(partial):
            sync_folder(base)
        if target.exists():
            target.rmdir()
        partial.rename(target)
        sync_folder(target.absolute().parent)
    except (OSError, sqlite3.Error) as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise SettingsError(f"{target}: the backup failed: {error}") from error
    except SettingsError:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return report


def _copy_database(source: Path, target: Path) -> None:
    """SQLite's own online backup: one consistent state, with what is in the write-ahead log."""
    with (
        closing(sqlite3.connect(f"file:{source}?mode=ro", uri=True, timeout=15.0)) as reading,
        closing(sqlite3.connect(target)) as writing,
    ):
        reading.backup(writing, pages=4096)
        problem = writing.execute("PRAGMA integrity_check(1)").fetchone()[0]
    if problem != "ok":
        raise SettingsError(f"{source}: the database is damaged: {problem}; restore an earlier backup")
    target.chmod(0o600)


def _copy_files(data: Path, target: Path) -> BackupReport:
    """Copy what the copied database names; what was deleted meanwhile is deleted from it, too."""
    database = Database(target / SQLITE)
    size = deleted = 0
    try:
        with database.write() as session:
            files = session.scalars(select(FileRow)).all()
            for row in files:
                source = data / "uploads" / row.id
                if not source.exists() and row.received > 0:
                    session.delete(row)
                    deleted += 1
                elif source.exists():
                    size += _copy(source, target / "uploads" / row.id, row.sha256)
                    (target / "uploads" / row.id).chmod(0o400 if row.state == "complete" else 0o600)
            jobs = session.scalars(select(JobRow)).all()
            stored = [job for job in jobs if job.folder is not None and job.store is None]
            for job in stored:
                copied = _copy_result(session, job, data, target)
                size += copied or 0
                deleted += copied is None
            return BackupReport(len(files), len(jobs), len(stored), size, deleted)
    finally:
        database.close()


def _copy_result(session: Session, job: JobRow, data: Path, target: Path) -> int | None:
    """Bytes that were copied; None if the job was deleted meanwhile."""
    source, place = data / "results" / (job.folder or ""), target / "results" / (job.folder or "")
    size = 0
    place.mkdir(mode=0o700)
    try:
        for row in session.scalars(select(AssetRow).where(AssetRow.job_id == job.id)):
            size += _copy(source / row.name, place / row.name, row.sha256)
    except FileNotFoundError:
        shutil.rmtree(place)
        job.folder = None
        delete_job(session, job)
        return None
    return size


def _copy(source: Path, target: Path, sha256: str | None) -> int:
    """Copy a file onto the disk; its size. Raises SettingsError if it is not what the database says."""
    digest, size = hashlib.sha256(), 0
    with source.open("rb") as reading, target.open("xb") as writing:
        while block := reading.read(BLOCK):
            digest.update(block)
            writing.write(block)
            size += len(block)
        writing.flush()
        os.fsync(writing.fileno())
    if sha256 is not None and digest.hexdigest() != sha256:
        raise SettingsError(f"{source}: damaged: its SHA-256 is not the one in the database; delete it first")
    return size


def _database_in(data: Path) -> Path:
    """The database of a data folder. Raises SettingsError where there is none."""
    path = data / SQLITE
    if not path.is_file():
        raise SettingsError(f"{data}: no data folder of hsloc; name it with --data")
    return path


class MoveReport(NamedTuple):
    """What was moved."""

    jobs: int
    uploads: int
    rows: int


def move(settings: Settings, url: str) -> MoveReport:
    """Copy the database of the data folder to an empty one at `url`; uploads and results stay where they are.

    The folder's own database is left as it is. Raises SettingsError while a server runs on the folder, for a folder
    without a database, and for a database that holds something already.
    """
    if settings.database_url:
        raise SettingsError("HSLOC_DATABASE_URL is set; leave it out to move the database of the data folder")
    if not url.startswith("postgresql"):
        raise SettingsError(f"{url.partition(':')[0]}: a move is to PostgreSQL; give postgresql://user@host/database")
    path = _database_in(settings.data)
    with (
        closing(Storage(settings.data, settings.min_free_bytes)),  # raises where a server runs
        closing(Database(path)) as source,
        closing(Database(url)) as target,
    ):
        return _copy_tables(source, target)


def _copy_tables(source: Database, target: Database) -> MoveReport:
    """All rows in one transaction, or none."""
    tables = Base.metadata.sorted_tables
    counts: dict[str, int] = {}
    with source.read() as old, target.write() as new:
        target.lock(new, "migration")
        for table in tables:
            if table.name != CounterRow.__tablename__ and new.scalar(select(func.count()).select_from(table)):
                raise SettingsError(f"{target.name}: its table {table.name} has rows; give an empty database")
        new.execute(delete(CounterRow))  # the marks of its own migration, which the old one has, too
        for table in tables:
            counts[table.name] = _copy_table(old, new, table)
            _continue_numbers(new, table)
    return MoveReport(counts[JobRow.__tablename__], counts[FileRow.__tablename__], sum(counts.values()))


def _continue_numbers(session: Session, table: Table) -> None:
    """Let the rows that the database numbers go on after the highest number."""
    column = table.autoincrement_column
    if column is not None:
        highest = session.scalar(select(func.max(column))) or 0
        sequence = func.pg_get_serial_sequence(table.name, column.name)
        session.execute(select(func.setval(sequence, highest + 1, False)))


def _copy_table(old: Session, new: Session, table: Table) -> int:
    count = 0
    found = old.execute(select(table).execution_options(yield_per=BATCH))
    for batch in found.mappings().partitions():
        new.execute(insert(table), [dict(row) for row in batch])
        count += len(batch)
    return count
