"""Uploads: their rows, whose offset counts only bytes that are on the disk; and a log to try the service with."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import uuid
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import case, delete, func, select, tuple_

from hsloc.version import __version__
from hsloc_service.audit import note
from hsloc_service.db.database import clock
from hsloc_service.db.tables import ACTIVE, FileRow, JobRow, UploadPartRow
from hsloc_service.errors import ServiceError, busy, conflict, empty_file, no_space, not_found
from hsloc_service.results.deletion_queue import delete_upload
from hsloc_service.stored_request import files_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from sqlalchemy.orm import Session

    from hsloc_service.auth import Principal
    from hsloc_service.db.database import Database
    from hsloc_service.results.upload_parts import UploadParts
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage

SECONDS = 60
"""Length of the log [s]."""
TIMEOUT_S = 120.0
WAIT_S = 10.0
_making = threading.Lock()


@dataclass(frozen=True, slots=True)
class Files:
    """The uploads of all tenants; every method sees those of the principal only."""

    database: Database
    storage: Storage
    settings: Settings
    parts: UploadParts | None = None
    """Where uploads are that are in an object store; None: they are files of the data folder."""

    def create(self, who: Principal, name: str, size: int | None, file_id: str | None = None) -> FileRow:
        """A row for an upload of `size` bytes (None: not known yet), which are reserved.

        Raises ServiceError 400 for an empty file, 413 for too much, 507 where disk or quota do not suffice, 409 for an
        id that is taken.
        """
        if size is not None:
            self.need_size(size)
        with self.database.write() as session:
            now = clock(session)
            self.database.lock_tenant(session, who.tenant)
            self._need_room(session, who, size or 0)
            taken = None if file_id is None else session.get(FileRow, file_id)
            if taken is not None:
                raise conflict("exists", "taken") if taken.tenant == who.tenant else not_found("file", taken.id)
            row = FileRow(
                id=file_id or str(uuid.uuid4()),
                tenant=who.tenant,
                name=name.replace("\0", "")[:255] or "log",
                state="receiving",
                size=size,
                received=0,
                created=now,
                expires=now + self.settings.upload_ttl_s,
            )
            session.add(row)
        return row

    def need_size(self, size: int) -> None:
        """Raises ServiceError 400 for an empty file, 413 for one larger than any that is taken."""
        if size == 0:
            raise empty_file()
        if size > self.settings.max_upload_bytes:
            raise ServiceError(
                413, "too_large", f"it has {size} bytes; at most {self.settings.max_upload_bytes} are taken"
            )

    def need_room(self, who: Principal) -> None:
        """Raises ServiceError 507 where disk or quota are used up; asked now and then while bytes come in."""
        with self.database.read() as session:
            self._need_room(session, who, 0)

    def _need_room(self, session: Session, who: Principal, size: int) -> None:
        need_quota(session, who, self.settings.tenant_bytes, size)
        if self.parts is not None:
            self.storage.need_space()
            return
        # What others announced and have not sent yet is theirs already.
        pending = session.scalar(
            select(func.coalesce(func.sum(FileRow.size - FileRow.received), 0)).where(
                FileRow.state == "receiving", FileRow.size.is_not(None)
            )
        )
        self.storage.need_space((pending or 0) + size)

    def get(self, who: Principal, file_id: str) -> FileRow:
        """One upload."""
        with self.database.read() as session:
            return _file(session, who, file_id)

    def list(self, who: Principal, limit: int = 200, before: str | None = None) -> Sequence[FileRow]:
        """Uploads, newest first; `before` is the id of the last one seen. Raises ServiceError 404 if that is gone."""
        query = select(FileRow).where(FileRow.tenant == who.tenant).limit(limit)
        with self.database.read() as session:
            if before is not None:
                last = _file(session, who, before)
                query = query.where(tuple_(FileRow.created, FileRow.id) < tuple_(last.created, last.id))
            return session.scalars(query.order_by(FileRow.created.desc(), FileRow.id.desc())).all()

    def advance(self, file_id: str, received: int | None = None) -> float | None:
        """Write the number of bytes that are on the disk, if it has changed, and put off the upload's expiry.

        When it expires now; None if it was deleted meanwhile.
        """
        with self.database.write() as session:
            row = session.get(FileRow, file_id, with_for_update=True)
            if row is None:
                return None
            row.received = row.received if received is None else received
            row.expires = clock(session) + self.settings.upload_ttl_s
            return row.expires

    def complete(self, file_id: str, size: int, sha256: str) -> FileRow:
        """The file is whole. Raises ServiceError 404 if it was deleted meanwhile."""
        with self.database.write() as session:
            row = session.get(FileRow, file_id, with_for_update=True)
            if row is None:
                raise not_found("file", file_id)
            row.state, row.size, row.received, row.sha256, row.expires = "complete", size, size, sha256, None
            return row

    def restart(self, who: Principal, file_id: str, size: int | None) -> None:
        """Start an unfinished upload again, of `size` bytes; the same checks as for a new one."""
        if size is not None:
            self.need_size(size)
        with self.database.write() as session:
            self.database.lock_tenant(session, who.tenant)
            row = _file(session, who, file_id)
            if row.state == "complete":
                raise conflict("complete", "this upload is finished and cannot be changed")
            session.execute(delete(UploadPartRow).where(UploadPartRow.file_id == file_id))
            row.received, row.size = 0, None  # what was reserved for it is free again
            session.flush()
            self._need_room(session, who, size or 0)
            row.size = size

    def delete(self, who: Principal, file_id: str) -> None:
        """Remove an upload. Raises ServiceError 409 while an active job needs it."""
        with self.database.write() as session:
            self.database.lock_tenant(session, who.tenant)
            row = _file(session, who, file_id)
            if file_id in needed_files(session):
                raise conflict("in_use", "an active job needs this file; cancel it first")
            delete_upload(session, row)
            note(session, who.tenant, who.token, "file.delete", file_id)
        self.storage.upload_path(file_id).unlink(missing_ok=True)


def used_bytes(session: Session, who: Principal) -> tuple[int, int]:
    """What uploads, as received or announced, and results of a tenant take.

    Results count wherever they are stored, by their manifest.
    """
    size_or_none = func.coalesce(FileRow.size, 0)
    announced = case((FileRow.received > size_or_none, FileRow.received), else_=size_or_none)
    uploads = session.scalar(select(func.coalesce(func.sum(announced), 0)).where(FileRow.tenant == who.tenant)) or 0
    results = session.scalar(select(func.coalesce(func.sum(JobRow.bytes), 0)).where(JobRow.tenant == who.tenant)) or 0
    return int(uploads), int(results)


def need_quota(session: Session, who: Principal, most: int, size: int = 0) -> None:
    """Raises ServiceError 507 where uploads and results of a tenant take too much."""
    uploads, results = used_bytes(session, who)
    if uploads + results + size > most:
        raise no_space(f"your uploads take {uploads} and your results {results} of {most} bytes; delete some")


def needed_files(session: Session) -> set[str]:
    """Ids of the files that jobs read which have not ended."""
    active = session.scalars(select(JobRow.request).where(JobRow.state.in_(ACTIVE)))
    return {file_id for request in active for file_id in files_of(request)}


def _file(session: Session, who: Principal, file_id: str) -> FileRow:
    row = session.scalar(select(FileRow).where(FileRow.id == file_id, FileRow.tenant == who.tenant))
    if row is None:
        raise not_found("file", file_id)
    return row


def sample_log(storage: Storage) -> Path:
    """The log, made by `hsloc record` in a process of its own by whoever asks first.

    Raises ServiceError 503 where that fails, 429 where another still makes it after WAIT_S.
    """
    path = storage.cache / f"sample-{__version__}.mcap"
    if path.exists():
        return path
    if not _making.acquire(timeout=WAIT_S):  # who waits holds a thread that other requests need
        raise busy("the sample is being made", 5.0)
    try:
        if not path.exists():
            storage.need_space(4 << 20)
            made = storage.work / f"sample-{uuid.uuid4().hex}.mcap"
            command = [sys.executable, "-P", "-m", "hsloc.cli.main", "record", str(made), "--world", "office", "-q"]
            try:
                subprocess.run([*command, "--duration", str(SECONDS)], check=True, timeout=TIMEOUT_S)
            except (OSError, subprocess.SubprocessError) as error:
                made.unlink(missing_ok=True)
                raise ServiceError(503, "sample", "the sample could not be made; upload a log of your own") from error
            os.replace(made, path)
    finally:
        _making.release()
    return path
