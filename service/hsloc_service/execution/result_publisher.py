"""The end of an attempt: its results published whole or not at all, its outcome written under the fence."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

from hsloc_service.call_timeout import call_within
from hsloc_service.errors import StoreError
from hsloc_service.execution.outcome import interrupted
from hsloc_service.execution.retry import Interrupted, transfer_timeout_s
from hsloc_service.logs import log
from hsloc_service.results.store import collect

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc_service.execution.heartbeat import Heartbeat
    from hsloc_service.execution.outcome import Outcome
    from hsloc_service.execution.retry import Retry
    from hsloc_service.jobs.leases import Claim, Leases
    from hsloc_service.results.store import ResultStore


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
        if outcome.kind != "lost":
            self._leases.fail(claim, outcome.kind, outcome.reason, self._without_paths(outcome.message, output.parent))
        return outcome.kind

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
            self._leases.fail(claim, "failed", "disk_full", f"the results could not be stored: {error.strerror}")
            return "failed"
        if self._leases.succeed(claim, name, assets, outcome.summary or {}, store.url):
            return "succeeded"
        with suppress(StoreError):  # then the sweep removes them
            call_within(self._call_timeout_s, lambda: store.remove(name))
        self._leases.fail(claim, "failed", "cancelled", "cancelled")
        return "lost"
