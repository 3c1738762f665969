"""One attempt at one job: its folder, its process, its results."""

from __future__ import annotations

import json
import math
import random
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hsloc_service.call_timeout import call_within
from hsloc_service.errors import StoreError
from hsloc_service.execution.heartbeat import Heartbeat
from hsloc_service.execution.job_process import JobProcess
from hsloc_service.execution.outcome import Outcome, interrupted
from hsloc_service.execution.processes import linked_files
from hsloc_service.execution.retry import Interrupted, Retry
from hsloc_service.logs import log
from hsloc_service.results.store import BLOCK, collect, transfer_timeout_s
from hsloc_service.storage import safe_name, write_hashed
from hsloc_service.stored_request import MAP_STATE, MAPS, UPLOADS, logs_of

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from hsloc_service.execution.input_cache import InputCache
    from hsloc_service.execution.sandbox import Sandbox
    from hsloc_service.jobs.leases import Claim, Leases, Source
    from hsloc_service.results.store import ResultStore
    from hsloc_service.results.stores import ResultStores
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage


@dataclass(frozen=True, slots=True)
class Supervisor:
    """Runs claimed jobs, one call of `run` for each, in the thread of a slot."""

    leases: Leases
    storage: Storage
    settings: Settings
    stores: ResultStores
    sandbox: Sandbox
    inputs: InputCache
    store_failed: Callable[[], None]

    def run(self, claim: Claim, *, stop: threading.Event, cancel: threading.Event) -> str:
        """The state that was written: a final one, `queued`, or `lost` if another attempt holds the job."""
        settings, folder = self.settings, self.storage.work_path(claim.job_id, claim.attempt)
        heartbeat = Heartbeat(claim, self.leases, settings.heartbeat_s, stop=stop, cancel=cancel)
        retry = Retry(heartbeat.cancel_reason, claim.job_id, self.store_failed)
        publisher = ResultPublisher(claim, self.leases, self.stores.current, heartbeat, retry, settings.store_timeout_s)
        try:
            return publisher.finish(self._attempt(claim, folder, heartbeat, retry), folder / "output")
        finally:
            self.storage.remove_work(folder)

    def _attempt(self, claim: Claim, folder: Path, heartbeat: Heartbeat, retry: Retry) -> Outcome:
        mark = f"{self.storage.instance}:{claim.job_id}.{claim.attempt}"
        try:
            if self.inputs.is_remote or claim.source is not None:
                heartbeat.enter("fetch")
            with self.inputs.files(claim, retry) as files:
                prepare(folder, claim, files, self.storage, self.settings, self.sandbox)
                self._fetch_map(claim, folder, heartbeat, retry)
                log("job.start", job=claim.job_id, tenant=claim.tenant, attempt=claim.attempt)
                if random.random() < self.settings.fault_fail_jobs:
                    return Outcome("failed", "fault_injection", "this server fails jobs on purpose (fault_fail_jobs)")
                return JobProcess(folder, mark, heartbeat, self.storage, self.settings, self.sandbox).run()
        except Interrupted as end:
            return interrupted(end.reason)
        except StoreError as error:
            log("store.error", job=claim.job_id, what="fetch", error=str(error))
            message = "the map to extend is in a store that this server is not set to; ask its operator"
            return Outcome("failed", "store", message)
        except OSError as error:
            return Outcome("again", "start", f"the job could not be started: {error.strerror or error}")

    def _fetch_map(self, claim: Claim, folder: Path, heartbeat: Heartbeat, retry: Retry) -> None:
        """Get the map that the job extends from the store that has it."""
        if claim.source is None:
            return
        source, store = claim.source, self.stores.of(claim.source.store)
        timeout_s = transfer_timeout_s(store, [source.size], self.settings.store_timeout_s)
        retry.retry("fetch", lambda: download(store, source, folder), timeout_s)


def prepare(
    folder: Path, claim: Claim, files: Mapping[str, Path], storage: Storage, settings: Settings, sandbox: Sandbox
) -> None:
    """`job.json`, the input under its own names (read-only), and an empty folder for temporary files.

    The logs are in `input`, `input-2`, and so on, because two parts of a run may have the same name. The saved map of a
    job that is extended belongs beside `job.json`: see `download`. `files` are the uploads by their ids.
    """
    storage.remove_work(folder)
    (folder / "tmp").mkdir(parents=True, mode=0o700)
    request = claim.request

    def link(place: str, file_id: str, default: str) -> str:
        name = safe_name(claim.names.get(file_id, ""), default)
        (folder / place).mkdir(exist_ok=True, mode=0o700)
        (folder / place / name).symlink_to(files[file_id].absolute())
        return name

    places = [("input" if k == 0 else f"input-{k + 1}", ident) for k, ident in enumerate(logs_of(request))]
    logs = [f"{place}/{link(place, ident, 'log')}" for place, ident in places]
    job: dict[str, Any] = {
        "request": request,
        "log": logs[0].partition("/")[2],
        "logs": logs,
        "limits": {
            "memory_bytes": settings.job_memory_bytes,
            "cpu_s": settings.job_cpu_s,
            "output_bytes": settings.job_output_bytes,
            "open_files": settings.job_open_files,
        },
    }
    for name in MAPS:
        if (chart := request.get(name)) is not None:
            job[name] = link(name, chart["yaml"], "map.yaml")
            # A name that no YAML can ask for; the worker links the name that this YAML does ask for.
            (folder / name / ".image").symlink_to(files[chart["image"]].absolute())
            job[f"{name}_image"] = ".image"
    job |= {name: link(name, request[name], name) for name in UPLOADS if request.get(name) is not None}
    if claim.source is not None:
        job["resume"] = MAP_STATE
    job["limits"]["landlock"] = sandbox.landlock(folder.absolute(), linked_files(folder))
    (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")


def download(store: ResultStore, source: Source, folder: Path) -> None:
    """Copy the saved map of an earlier job into the folder. Raises OSError if it is not what its manifest says."""
    starts = range(0, source.size, BLOCK)
    blocks = (store.read(source.folder, MAP_STATE, start, min(BLOCK, source.size - start)) for start in starts)
    if write_hashed(folder / MAP_STATE, blocks) != source.sha256:
        raise OSError(f"{MAP_STATE} of {source.folder} is not what was stored")


class ResultPublisher:
    """Writes how an attempt ended. Used in the thread of one slot."""

    def __init__(
        self,
        claim: Claim,
        leases: Leases,
        store: ResultStore,
        heartbeat: Heartbeat,
        retry: Retry,
        call_timeout_s: float,
    ) -> None:
        self._claim, self._leases, self._store = claim, leases, store
        self._heartbeat, self._retry, self._call_timeout_s = heartbeat, retry, call_timeout_s

    def finish(self, outcome: Outcome, output: Path) -> str:
        """The state that was written: a final one, `queued`, or `lost`. `output` is the folder of the results."""
        state = self._write(outcome, output)
        log("job.end", job=self._claim.job_id, attempt=self._claim.attempt, state=state, reason=outcome.reason)
        return state

    def _write(self, outcome: Outcome, output: Path) -> str:
        claim = self._claim
        if outcome.kind == "done":
            return self._publish(outcome, output)
        if outcome.kind == "again":
            self._leases.release(claim, outcome.message, counts=outcome.reason != "shutdown")
            return "queued"
        if outcome.kind == "lost":
            return "lost"
        message = self._without_paths(outcome.message, output.parent)
        return self._leases.fail(claim, outcome.kind, outcome.reason, message) or "lost"

    @staticmethod
    def _without_paths(message: str, folder: Path) -> str:
        """A message without the folders of the server, which are not the tenant's business."""
        return message.replace(f"{folder.absolute()}/", "").replace(f"{folder.absolute().parent.parent}/", "")

    def _publish(self, outcome: Outcome, output: Path) -> str:
        """Store the output, then commit. A crash between the two leaves results that the sweep removes."""
        claim, store = self._claim, self._store
        name = f"{claim.job_id}.{claim.attempt}"
        self._heartbeat.enter("store")
        try:
            assets = self._retry.retry("collect", lambda: collect(output), math.inf)
            timeout_s = transfer_timeout_s(store, [asset.size for asset in assets], self._call_timeout_s)
            self._retry.retry("publish", lambda: store.publish(output, name, assets), timeout_s)
        except Interrupted as end:
            return self._write(interrupted(end.reason), output)
        except OSError as error:
            message = f"the results could not be stored: {error.strerror}"
            return self._leases.fail(claim, "failed", "disk_full", message) or "lost"
        if self._leases.succeed(claim, name, assets, outcome.summary or {}, store.url):
            return "succeeded"
        with suppress(StoreError):  # then the sweep removes them
            call_within(self._call_timeout_s, lambda: store.remove(name))
        self._leases.fail(claim, "failed", "cancelled", "cancelled")
        return "lost"
