"""Writes the body of an upload to the disk: bounded memory, one writer for each upload, only synced bytes count."""

from __future__ import annotations

import errno
import hashlib
import os
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from anyio import to_thread
from starlette.requests import ClientDisconnect

from hsloc_service.errors import ServiceError, conflict, empty_file, no_space
from hsloc_service.logs import log
from hsloc_service.results.upload_parts import Staging
from hsloc_service.storage import hash_file, sync_folder

if TYPE_CHECKING:
    from collections.abc import AsyncIterable, Iterator

    from hsloc_service.auth import Principal
    from hsloc_service.db.tables import FileRow
    from hsloc_service.settings import Settings
    from hsloc_service.uploads.repository import Files

BLOCK = 1 << 20
"""Bytes gathered before a thread writes them."""
SAFE_EVERY = 32 << 20
"""Bytes after which the file is synced and the offset committed."""
_MAX_HASHES = 1024


class UploadReceiver:
    """Takes the bodies of uploads. Lives on the event loop; files and database are touched in threads."""

    def __init__(self, files: Files, settings: Settings) -> None:
        self._files, self._settings = files, settings
        self._busy: set[str] = set()
        self._hashes: dict[str, tuple[Any, int]] = {}
        self._to_drop = 0.5

    @contextmanager
    def writer(self, file_id: str) -> Iterator[None]:
        """Be the only writer of an upload. Raises ServiceError 423 at once if another is."""
        if file_id in self._busy:
            raise ServiceError(423, "locked", "another request is writing to this upload", {"Retry-After": "1"})
        self._busy.add(file_id)
        try:
            yield
        finally:
            self._busy.discard(file_id)

    async def append(
        self,
        who: Principal,
        file_id: str,
        offset: int,
        body: AsyncIterable[bytes],
        checksum: tuple[str, bytes] | None = None,
    ) -> FileRow:
        """Append a body at `offset`, which must be the upload's; completes the upload when its last byte is there.

        With a checksum (algorithm, digest) the body is taken whole or not at all (460). A broken connection keeps what
        arrived, and raises ClientDisconnect; an upload whose last byte came that way is complete all the same.
        """
        row = await to_thread.run_sync(self._files.get, who, file_id)
        if row.state != "receiving":
            raise conflict("complete", "this upload is finished and cannot be changed")
        if offset != row.received:
            raise ServiceError(409, "offset", f"the offset is {row.received}, not {offset}")
        limit = self._settings.max_upload_bytes if row.size is None else row.size
        append = _Append(self._files, who, row, limit, self._hash(file_id, offset), checksum)
        try:
            await append.run(body, drop=self._drops())
        except ClientDisconnect:
            if append.safe != row.size:
                raise
        finally:
            self._hashes[file_id] = (append.digest, append.safe)
        row.received = append.safe
        if append.safe == row.size:
            return await self.finish(file_id)
        return row

    async def finish(self, file_id: str) -> FileRow:
        """All bytes are there: note size and sha256, computed on the way or (after a restart) from the file.

        Raises ServiceError 400 where there are none, of an upload that did not state its size.
        """
        path, parts = self._files.storage.upload_path(file_id), self._files.parts
        digest, counted = self._hashes.pop(file_id, (None, -1))

        def size_of() -> int:
            return path.stat().st_size if parts is None else sum(part.size for part in parts.of(file_id))

        size = await to_thread.run_sync(size_of)
        if size == 0:
            raise empty_file()
        if digest is not None and counted == size:
            sha256 = digest.hexdigest()
        elif parts is None:
            sha256 = (await to_thread.run_sync(hash_file, path))[1]
        else:
            sha256 = (await to_thread.run_sync(parts.hash, file_id))[1]

        def done() -> FileRow:
            if parts is not None:
                return self._files.complete(file_id, size, sha256)
            sync_folder(path.parent)
            row = self._files.complete(file_id, size, sha256)
            path.chmod(0o400)  # not before: a server that died in between could not go on with the upload
            return row

        row = await to_thread.run_sync(done)
        log("upload.complete", file=file_id, tenant=row.tenant, size=size)
        return row

    def _drops(self) -> bool:
        """Whether to cut this request off on purpose: a share of them, evenly, as chance may cut ten in a row."""
        self._to_drop += self._settings.fault_drop_uploads
        if self._to_drop < 1.0:
            return False
        self._to_drop -= 1.0
        return True

    def forget(self, file_id: str) -> None:
        """Forget the running hash: the upload was deleted or starts again."""
        self._hashes.pop(file_id, None)

    def _hash(self, file_id: str, offset: int) -> Any:
        """The running hash up to the offset; None if it is not known (then the whole file is read at the end)."""
        if offset == 0:
            while len(self._hashes) >= _MAX_HASHES:
                self._hashes.pop(next(iter(self._hashes)))
            return hashlib.sha256()
        digest, counted = self._hashes.get(file_id, (None, -1))
        return digest if counted == offset else None


class _Append:
    """One body being appended. `safe` is the offset that is on the disk and in the database.

    The offset of the last byte comes into the database by `Files.complete` alone: an upload that says that it has all
    bytes, and is not complete, would look finished to its client, and to no job.
    """

    def __init__(
        self, files: Files, who: Principal, row: FileRow, limit: int, digest: Any, checksum: tuple[str, bytes] | None
    ) -> None:
        self._files, self._who, self._row, self._limit = files, who, row, limit
        self._path, self._parts = files.storage.upload_path(row.id), files.parts
        self._staging = Staging(files.storage.work)
        self.safe = self._at = row.received
        self.digest = digest
        self._running = None if digest is None else digest.copy()
        self._alive_s = files.settings.upload_ttl_s / 4.0
        """While bytes come, the expiry is put off this often: it is for uploads that were given up."""
        self._alive_until = time.monotonic()
        self._check = None if checksum is None else hashlib.new(checksum[0])
        self._wanted = None if checksum is None else checksum[1]

    async def run(self, body: AsyncIterable[bytes], drop: bool) -> None:
        """Write the body, and move `safe` on."""
        descriptor = await to_thread.run_sync(self._open)
        try:
            buffer = bytearray()
            try:
                async for block in body:
                    buffer += block
                    if time.monotonic() > self._alive_until:
                        self._row.expires = await to_thread.run_sync(self._files.advance, self._row.id)
                        self._alive_until = time.monotonic() + self._alive_s
                    if self._at + len(buffer) > self._limit:
                        raise ServiceError(413, "too_large", f"more than the {self._limit} bytes that are expected")
                    if len(buffer) >= BLOCK:
                        await to_thread.run_sync(self._write, descriptor, bytes(buffer))
                        buffer.clear()
                        if drop:
                            raise ServiceError(503, "fault_injection", "this server drops uploads on purpose")
            except ClientDisconnect:
                # Keep what arrived, unless it was to be checked as a whole.
                if self._check is None:
                    await to_thread.run_sync(self._commit, descriptor, bytes(buffer))
                raise
            await to_thread.run_sync(self._commit, descriptor, bytes(buffer))
        finally:
            await to_thread.run_sync(self._close, descriptor, abandon_on_cancel=False)

    def _open(self) -> int:
        """Open at the offset; bytes beyond it were never acknowledged and go."""
        if self._parts is not None:
            return self._staging.open()
        flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(self._path, flags, 0o600)
        size = os.fstat(descriptor).st_size
        if size < self.safe:
            os.close(descriptor)
            self._files.advance(self._row.id, size)
            raise ServiceError(409, "offset", f"the offset is {size}: the disk lost what came after it")
        os.ftruncate(descriptor, self.safe)
        os.lseek(descriptor, self.safe, os.SEEK_SET)
        return descriptor

    def _write(self, descriptor: int, block: bytes) -> None:
        view = memoryview(block)
        try:
            while view:
                view = view[os.write(descriptor, view) :]
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise no_space("the server's disk is full") from error
            raise
        self._at += len(block)
        for digest in (self._running, self._check):
            if digest is not None:
                digest.update(block)
        if self._check is None and self._at - self.safe >= SAFE_EVERY:
            self._make_safe(descriptor)
            self._files.need_room(self._who)

    def _commit(self, descriptor: int, rest: bytes) -> None:
        self._write(descriptor, rest)
        if self._check is not None and self._check.digest() != self._wanted:
            raise ServiceError(460, "checksum", "the checksum does not match; the bytes were not taken")
        self._make_safe(descriptor)
        if self._row.size is None:
            self._files.need_room(self._who)  # nothing was reserved for it

    def _make_safe(self, descriptor: int) -> None:
        if self._at == self.safe:
            return
        if self._parts is not None:
            size, last = self._at - self.safe, self._at == self._row.size
            self._parts.add(self._row.id, self.safe, self._staging.folder, size, last=last)
            os.ftruncate(descriptor, 0)
            os.lseek(descriptor, 0, os.SEEK_SET)
            self._set_safe()
            return
        os.fdatasync(descriptor)
        if self._at != self._row.size:
            self._row.expires = self._files.advance(self._row.id, self._at)
        self._set_safe()

    def _set_safe(self) -> None:
        self.safe = self._at
        self.digest = None if self._running is None else self._running.copy()

    def _close(self, descriptor: int) -> None:
        """Cut off what is not acknowledged: gives the room back when the disk is full."""
        try:
            if self._parts is None:
                os.ftruncate(descriptor, self.safe)
        finally:
            os.close(descriptor)
            self._staging.remove()
