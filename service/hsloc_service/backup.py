"""A data folder copied: all of it while a server runs, as a backup; or to PostgreSQL and an object store.

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
from typing import TYPE_CHECKING, Any, NamedTuple

from sqlalchemy import delete, func, insert, select

from hsloc_service.db.database import SQLITE, Database
from hsloc_service.db.tables import AssetRow, Base, CounterRow, FileRow, JobRow, UploadPartRow
from hsloc_service.errors import StoreError
from hsloc_service.jobs.repository import delete_job
from hsloc_service.results.store import Asset
from hsloc_service.results.stores import ResultStores
from hsloc_service.results.upload_parts import ASSET as PART
from hsloc_service.results.upload_parts import Staging
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage, hash_file, sync_folder
from hsloc_service.uploads.upload_stream import SAFE_EVERY

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sqlalchemy import Table
    from sqlalchemy.orm import Session

    from hsloc_service.results.store import ResultStore
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
    copied: int
    """Bytes that were copied to the store; what an earlier attempt had copied is not counted."""


def move(settings: Settings, url: str) -> MoveReport:
    """Copy the database of the data folder to an empty one at `url`; where a store is set, uploads and results to it.

    The data folder is left as it is. The files come first, then all rows in one transaction, or none; called again, it
    copies what is not in the store yet. Raises SettingsError while a server runs on the folder, for a folder without a
    database, for a database that holds something already, for a file that is not what its row says, and for a store
    that does not take the files.
    """
    if settings.database_url:
        raise SettingsError("HSLOC_DATABASE_URL is set; leave it out to move the database of the data folder")
    if not url.startswith("postgresql"):
        raise SettingsError(f"{url.partition(':')[0]}: a move is to PostgreSQL; give postgresql://user@host/database")
    path = _database_in(settings.data)
    with (
        closing(Storage(settings.data, settings.min_free_bytes)) as storage,  # raises where a server runs
        closing(Database(path)) as source,
        closing(Database(url)) as target,
    ):
        with target.read() as session:
            _need_empty(session, target.name)
        stores = ResultStores(storage, settings)
        copied = FileCopy(source, storage, stores) if stores.parts_store is not None else None
        if copied is not None:
            copied.copy()
        return _copy_tables(source, target, copied)


class FileCopy:
    """Uploads and results of a data folder on their way to the store of the settings."""

    def __init__(self, source: Database, storage: Storage, stores: ResultStores) -> None:
        assert stores.parts_store is not None
        self._source, self._storage, self._results, self._uploads = source, storage, stores.current, stores.parts_store
        self.parts: list[dict[str, Any]] = []
        """Rows of the parts of the uploads."""
        self.bytes = 0
        """Bytes that were written."""

    def copy(self) -> None:
        """Copy what is not there. Raises SettingsError."""
        with self._source.read() as session:
            files = session.scalars(select(FileRow).order_by(FileRow.id)).all()
            jobs = session.scalars(select(JobRow).where(JobRow.folder.is_not(None), JobRow.store.is_(None))).all()
            rows = session.scalars(select(AssetRow).where(AssetRow.job_id.in_(select(JobRow.id)))).all()
        assets: dict[str, list[Asset]] = {}
        for row in rows:
            assets.setdefault(row.job_id, []).append(Asset(row.name, row.size, row.sha256, row.media_type))
        try:
            for file in files:
                self._copy_upload(file)
            for job in jobs:
                self._copy_result(job.folder or "", assets.get(job.id, []))
        except (StoreError, OSError) as error:
            raise SettingsError(f"{error}; when it is mended, run the same again: it goes on from there") from error

    def adapt(self, row: dict[str, Any]) -> dict[str, Any]:
        """The row of a job, with the place where its results are now."""
        moved = row["folder"] is not None and row["store"] is None
        return row | {"store": self._results.url} if moved else row

    def _copy_upload(self, row: FileRow) -> None:
        """In parts of SAFE_EVERY bytes, numbered from 0, so that those of a broken attempt have the same names."""
        path, size, digest = self._storage.upload_path(row.id), row.received, hashlib.sha256()
        staging = Staging(self._storage.work)
        if size == 0:
            return
        with path.open("rb") as file:
            for number, start in enumerate(range(0, size, SAFE_EVERY)):
                block = file.read(min(SAFE_EVERY, size - start))
                digest.update(block)
                part = Asset(PART, len(block), "", "application/octet-stream")
                name = f"{row.id}.{number}"
                if not _is_there(self._uploads, name, part):
                    descriptor = staging.open()
                    try:
                        with os.fdopen(descriptor, "wb") as staged:
                            staged.write(block)
                        self._uploads.publish(staging.folder, name, [part])
                    finally:
                        staging.remove()
                    self.bytes += len(block)
                self.parts.append({"file_id": row.id, "start": start, "size": len(block), "number": number})
            if file.tell() != size or (row.sha256 is not None and digest.hexdigest() != row.sha256):
                raise SettingsError(f"{path}: damaged: it is not what the database says; delete that upload first")

    def _copy_result(self, folder: str, assets: list[Asset]) -> None:
        output = self._storage.results / folder
        for asset in assets:
            if hash_file(output / asset.name) != (asset.size, asset.sha256):
                raise SettingsError(f"{output / asset.name}: damaged: it is not what the database says; delete its job")
        if not all(_is_there(self._results, folder, asset) for asset in assets):
            self._results.publish(output, folder, assets)
            self.bytes += sum(asset.size for asset in assets)


def _is_there(store: ResultStore, name: str, asset: Asset) -> bool:
    """Whether an earlier attempt has copied the file to its last byte."""
    with suppress(StoreError, FileNotFoundError):
        return len(store.read(name, asset.name, max(asset.size - 1, 0), min(asset.size, 1))) == min(asset.size, 1)
    return False


def _need_empty(session: Session, name: str) -> None:
    """Raises SettingsError."""
    for table in Base.metadata.sorted_tables:
        if table.name != CounterRow.__tablename__ and session.scalar(select(func.count()).select_from(table)):
            raise SettingsError(f"{name}: its table {table.name} has rows; give an empty database")


def _copy_tables(source: Database, target: Database, copied: FileCopy | None) -> MoveReport:
    """All rows in one transaction, or none."""
    tables = Base.metadata.sorted_tables
    counts: dict[str, int] = {}
    with source.read() as old, target.write() as new:
        target.lock(new, "migration")
        _need_empty(new, target.name)
        new.execute(delete(CounterRow))  # the marks of its own migration, which the old one has, too
        for table in tables:
            adapt = copied.adapt if copied is not None and table.name == JobRow.__tablename__ else dict
            counts[table.name] = _copy_table(old, new, table, adapt)
            _continue_numbers(new, table)
        if copied is not None and copied.parts:
            new.execute(insert(UploadPartRow), copied.parts)
    size = 0 if copied is None else copied.bytes
    return MoveReport(counts[JobRow.__tablename__], counts[FileRow.__tablename__], sum(counts.values()), size)


def _continue_numbers(session: Session, table: Table) -> None:
    """Let the rows that the database numbers go on after the highest number."""
    column = table.autoincrement_column
    if column is not None:
        highest = session.scalar(select(func.max(column))) or 0
        sequence = func.pg_get_serial_sequence(table.name, column.name)
        session.execute(select(func.setval(sequence, highest + 1, False)))


def _copy_table(old: Session, new: Session, table: Table, adapt: Callable[[dict[str, Any]], dict[str, Any]]) -> int:
    count = 0
    found = old.execute(select(table).execution_options(yield_per=BATCH))
    for batch in found.mappings().partitions():
        new.execute(insert(table), [adapt(dict(row)) for row in batch])
        count += len(batch)
    return count
