"""What is in an upload, before it is run: read in a process of its own, as a job is, because it may be hostile."""

from __future__ import annotations

import json
import threading
import uuid
from base64 import b64encode
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from hsloc_service.errors import ServiceError, busy
from hsloc_service.execution.job_process import JobProcess
from hsloc_service.execution.retry import Interrupted, Retry
from hsloc_service.execution.supervisor import prepare
from hsloc_service.jobs.leases import Claim
from hsloc_service.results.store import is_plain_file

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from hsloc_service.auth import Principal
    from hsloc_service.execution.input_cache import InputCache
    from hsloc_service.execution.sandbox import Sandbox
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage

WALL_S = 120.0
"""Longest time of an inspection [s]."""
WAIT_S = 20.0
"""A request waits so long for the inspection of another one, then it is asked to come later [s]."""
MAX_VIEW_BYTES, MAX_PICTURE_BYTES = 1 << 20, 8 << 20
"""What is taken of the process's files [B]."""


class _Monitor:
    """Of a process that holds no job: there is no lease, and it is not cancelled."""

    def begin(self) -> None: ...

    def report(self, phase: str, done: float, total: float, scans: int) -> None: ...

    def log(self, lines: list[str]) -> None: ...

    def flush(self) -> None: ...

    def cancel_reason(self) -> str | None:
        return None


@dataclass(frozen=True, slots=True)
class Inspector:
    """Inspects one request at a time."""

    storage: Storage
    settings: Settings
    sandbox: Sandbox
    inputs: InputCache
    store_failed: Callable[[], None]
    _one: threading.Lock = field(default_factory=threading.Lock)

    def inspect(self, who: Principal, request: Mapping[str, Any], names: dict[str, str]) -> dict[str, Any]:
        """What the process found: see `hsloc_service.execution.worker.inspect`; with `map_image`, a picture as text.

        `request` is a validated `JobRequest` as plain data, `names` the labels of its files. Raises ServiceError: 422
        for a log or map that cannot be read, 429 where others are inspected, 503 where the process did not end well.
        """
        if not self._one.acquire(timeout=WAIT_S):
            raise busy("other logs are being inspected", 5.0)
        try:
            return self._inspect(who, request, names)
        finally:
            self._one.release()

    def _inspect(self, who: Principal, request: Mapping[str, Any], names: dict[str, str]) -> dict[str, Any]:
        ident, monitor = str(uuid.uuid4()), _Monitor()
        claim = Claim(ident, who.tenant, "", 0, "", {**request, "inspect": True}, names)
        folder, settings = self.storage.work_path(ident, 0), replace(self.settings, job_wall_s=WALL_S)
        retry = Retry(monitor.cancel_reason, ident, self.store_failed)
        mark = f"{self.storage.instance}:{ident}.0"
        try:
            with self.inputs.files(claim, retry) as files:
                prepare(folder, claim, files, self.storage, settings, self.sandbox)
                outcome = JobProcess(folder, mark, monitor, self.storage, settings, self.sandbox).run()
            if outcome.kind != "done":
                status = 422 if outcome.kind == "failed" else 503
                raise ServiceError(
                    status, outcome.reason or "inspection", outcome.message or "the log was not inspected"
                )
            return {**(outcome.summary or {}), **_view_in(folder / "output")}
        except (OSError, Interrupted) as error:
            raise ServiceError(503, "inspection", "the log could not be inspected; try again") from error
        finally:
            self.storage.remove_work(folder)


def _view_in(folder: Path) -> dict[str, Any]:
    """The map as the page draws it, where the process has written one."""
    found: dict[str, Any] = {}
    with suppress(OSError, ValueError, RecursionError):
        found["view"] = json.loads(_read(folder / "viewer.json", MAX_VIEW_BYTES))
        picture = _read(folder / "viewer-map.png", MAX_PICTURE_BYTES)
        found["map_image"] = f"data:image/png;base64,{b64encode(picture).decode('ascii')}"
    return found if "map_image" in found else {}


def _read(path: Path, most: int) -> bytes:
    """Raises OSError for what is no file of its own, and ValueError for what is too large."""
    if not is_plain_file(path):
        raise OSError(f"{path.name} is no plain file")
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"{path.name} is too large")
    return content
