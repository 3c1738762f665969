"""What jobs read: uploads of the data folder, or copies of those in the object store, known by their SHA-256."""

from __future__ import annotations

import os
import threading
import uuid
from collections import Counter
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING

from sqlalchemy import select

from hsloc_service.db.tables import FileRow
from hsloc_service.storage import write_hashed
from hsloc_service.stored_request import files_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from hsloc_service.execution.retry import Retry
    from hsloc_service.jobs.leases import Claim
    from hsloc_service.results.upload_parts import UploadParts
    from hsloc_service.storage import Storage


class InputCache:
    """Paths of the uploads that a job reads. Used by all slots of a server or worker."""

    def __init__(self, storage: Storage, parts: UploadParts | None, max_bytes: int) -> None:
        self._storage, self._parts, self._max_bytes = storage, parts, max_bytes
        self._folder = storage.cache / "inputs"
        self._lock = threading.Lock()
        self._used: Counter[str] = Counter()

    @property
    def is_remote(self) -> bool:
        """Whether uploads have to be fetched."""
        return self._parts is not None

    @contextmanager
    def files(self, claim: Claim, retry: Retry) -> Iterator[Mapping[str, Path]]:
        """Paths by the id of the upload, which stay there until the block ends.

        Raises Interrupted where the job has to stop meanwhile, and OSError for trouble of the local disk.
        """
        ids = files_of(claim.request)
        if self._parts is None:
            yield {ident: self._storage.upload_path(ident) for ident in ids}
            return
        parts = self._parts
        with parts.database.read() as session:
            rows = session.scalars(select(FileRow).where(FileRow.id.in_(ids), FileRow.tenant == claim.tenant)).all()
        digests = {row.id: row.sha256 or "" for row in rows}
        with self._lock:
            self._used.update(digests.values())
        try:
            for row in rows:
                fetch = partial(self._fetch, row.id, self._folder / digests[row.id])
                retry.retry("fetch", fetch, parts.timeout_of(row.size or 0))
            yield {ident: self._folder / digest for ident, digest in digests.items()}
        finally:
            with self._lock:
                self._used.subtract(digests.values())
                self._used += Counter()  # drops those that are not in use
                self._evict()

    def _fetch(self, file_id: str, path: Path) -> None:
        """Copy an upload to `path`, whose name is its SHA-256. Raises StoreError, or OSError."""
        assert self._parts is not None
        if path.exists():
            os.utime(path)
            return
        self._folder.mkdir(mode=0o700, exist_ok=True)
        # Where a worker that starts removes what one that was killed has left.
        copy = self._storage.work / f"input-{uuid.uuid4().hex}"
        try:
            if write_hashed(copy, self._parts.blocks(file_id)) != path.name:
                raise OSError(f"upload {file_id} is not what was stored")
            copy.chmod(0o400)
            copy.rename(path)
        finally:
            copy.unlink(missing_ok=True)

    def _evict(self) -> None:
        """Remove what was used longest ago, until the rest fits. Needs the lock."""
        found = []
        with suppress(OSError), os.scandir(self._folder) as entries:
            found = sorted((entry.stat().st_mtime, entry.stat().st_size, entry.name) for entry in entries)
        total = sum(size for _, size, _ in found)
        for _, size, name in found:
            if total <= self._max_bytes:
                return
            if name not in self._used:
                with suppress(OSError):
                    (self._folder / name).unlink()
                    total -= size
