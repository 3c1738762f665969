"""Uploads in an object store: each block that is safe is an object, and the database knows what an upload is made of.

So any server may take the next block of an upload, no object is ever written to again, and what a broken request left
behind is not part of anything.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import uuid
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from sqlalchemy import delete, select
from sqlalchemy.exc import SQLAlchemyError

from hsloc_service.call_timeout import call_within
from hsloc_service.db.tables import FileRow, UploadPartRow
from hsloc_service.errors import ServiceError, StoreError, not_found
from hsloc_service.results.store import BLOCK, Asset, transfer_timeout_s

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from hsloc_service.db.database import Database
    from hsloc_service.results.store import ResultStore

ASSET = "part"


class Part(NamedTuple):
    """A block of an upload, and the name of its object."""

    name: str
    size: int


@dataclass(frozen=True, slots=True)
class UploadParts:
    """The parts of uploads. Methods raise StoreError for trouble of the store."""

    database: Database
    store: ResultStore
    timeout_s: float

    def add(self, file_id: str, start: int, staged: Path, size: int, *, last: bool) -> None:
        """Store the file `part` in the folder `staged` as the bytes from `start` on, and move the upload's offset.

        The last part does not move it: see `_Append`. Raises ServiceError 409 if another request has moved it.
        """
        number = secrets.randbelow(10**9)
        name = f"{file_id}.{number}"
        asset = Asset(ASSET, size, "", "application/octet-stream")
        call_within(self.timeout_of(size), lambda: self.store.publish(staged, name, [asset]))
        try:
            self._record(UploadPartRow(file_id=file_id, start=start, size=size, number=number), last)
        except (ServiceError, SQLAlchemyError):
            # After an error of the database the row may be there all the same; then the object must stay.
            if self._is_part(file_id, number):
                raise
            with suppress(StoreError):  # then `sweep` removes it, if the upload is completed
                self._remove(name)
            raise

    def _is_part(self, file_id: str, number: int) -> bool:
        """Whether the upload has this part; True where the database cannot be asked."""
        query = select(UploadPartRow.size).where(UploadPartRow.file_id == file_id, UploadPartRow.number == number)
        try:
            with self.database.read() as session:
                return session.scalar(query) is not None
        except SQLAlchemyError:
            return True

    def _record(self, part: UploadPartRow, last: bool) -> None:
        with self.database.write() as session:
            row = session.get(FileRow, part.file_id, with_for_update=True)
            if row is None:
                raise not_found("file", part.file_id)
            if row.state != "receiving" or row.received != part.start:
                raise ServiceError(409, "offset", f"the offset is {row.received}: another request wrote to this upload")
            after = (UploadPartRow.file_id == part.file_id, UploadPartRow.start >= part.start)
            session.execute(delete(UploadPartRow).where(*after))  # of a last block whose upload was not completed
            session.add(part)
            if not last:
                row.received = part.start + part.size

    def of(self, file_id: str) -> list[Part]:
        """The parts of an upload in their order."""
        query = select(UploadPartRow).where(UploadPartRow.file_id == file_id).order_by(UploadPartRow.start)
        with self.database.read() as session:
            return [Part(f"{file_id}.{row.number}", row.size) for row in session.scalars(query)]

    def blocks(self, file_id: str) -> Iterator[bytes]:
        """The bytes of an upload."""
        for part in self.of(file_id):
            with closing(self.store.open(part.name, ASSET)) as reader:
                for start in range(0, part.size, BLOCK):
                    yield reader.read(start, min(BLOCK, part.size - start))

    def hash(self, file_id: str) -> tuple[int, str]:
        """Size and SHA-256 of the bytes that are there."""
        digest, size = hashlib.sha256(), 0
        for block in self.blocks(file_id):
            digest.update(block)
            size += len(block)
        return size, digest.hexdigest()

    def remove(self, file_id: str) -> None:
        """Remove the parts of a deleted upload."""
        for part in self.of(file_id):
            self._remove(part.name)
        with self.database.write() as session:
            session.execute(delete(UploadPartRow).where(UploadPartRow.file_id == file_id))

    def sweep(self) -> int:
        """Remove the objects of complete uploads that these are not made of; how many.

        Objects of uploads that are still received, or that the database does not know (any more), stay.
        """
        names = call_within(self.timeout_s, self.store.names)  # before the rows: what a row names was stored earlier
        with self.database.read() as session:
            complete = set(session.scalars(select(FileRow.id).where(FileRow.state == "complete")))
            rows = session.execute(select(UploadPartRow.file_id, UploadPartRow.number)).all()
        known = {f"{row.file_id}.{row.number}" for row in rows}
        left = [name for name in names if name.rpartition(".")[0] in complete and name not in known]
        for name in left:
            self._remove(name)
        return len(left)

    def _remove(self, name: str) -> None:
        call_within(self.timeout_s, lambda: self.store.remove(name))

    def timeout_of(self, size: int) -> float:
        """Time limit for a transfer of this size [s]."""
        return transfer_timeout_s(self.store, [size], self.timeout_s)


class Staging:
    """A folder with the block that is being received; a server that starts removes those of one that died."""

    def __init__(self, work: Path) -> None:
        self.folder = work / f"upload-{uuid.uuid4().hex}"

    def open(self) -> int:
        """Make it, and open its file."""
        self.folder.mkdir(mode=0o700)
        return os.open(self.folder / ASSET, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    def remove(self) -> None:
        """Remove it."""
        shutil.rmtree(self.folder, ignore_errors=True)
