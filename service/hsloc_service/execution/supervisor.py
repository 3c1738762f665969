"""One attempt at one job: its folder, its process, its results."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hsloc_service.errors import StoreError
from hsloc_service.execution.heartbeat import Heartbeat
from hsloc_service.execution.job_folder import download, prepare
from hsloc_service.execution.job_process import JobProcess
from hsloc_service.execution.outcome import Outcome, interrupted
from hsloc_service.execution.result_publisher import ResultPublisher
from hsloc_service.execution.retry import Interrupted, Retry, transfer_timeout_s
from hsloc_service.logs import log

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable
    from pathlib import Path

    from hsloc_service.execution.input_cache import InputCache
    from hsloc_service.execution.sandbox import Sandbox
    from hsloc_service.jobs.leases import Claim, Leases
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
