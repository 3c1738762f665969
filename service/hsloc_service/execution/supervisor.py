"""One attempt at one job: a process of its own, watched until it is dead, its results published whole or not at all."""

from __future__ import annotations

import math
import os
import random
import selectors
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from hsloc_service.call_timeout import wait
from hsloc_service.errors import StoreError
from hsloc_service.execution.job_folder import fetch, prepare
from hsloc_service.execution.processes import end_job, start_job
from hsloc_service.execution.progress_pipe import plain_line
from hsloc_service.execution.retry import BYTES_PER_S, Interrupted, Retry
from hsloc_service.logs import log
from hsloc_service.results.store import collect
from hsloc_service.storage import folder_bytes

if TYPE_CHECKING:
    import subprocess
    import threading
    from collections.abc import Callable

    from hsloc_service.jobs.leases import Claim, Leases
    from hsloc_service.results.store import ResultStore
    from hsloc_service.results.stores import ResultStores
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage

T = TypeVar("T")
_LINE_BYTES = 1 << 18
"""The longest line of the pipe; more is a job gone mad."""
TICK_S = 0.1
POLL_S = 0.5
"""Time between two looks at the size of the folder, and between two notes of progress."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an attempt ended: `done`, `failed`, `crashed`, `again` (to be tried again) or `lost` (fenced off)."""

    kind: str
    reason: str = ""
    message: str = ""
    summary: dict[str, Any] | None = None


class Attempt:
    """Runs a claimed job to its end. Made and used in the thread of one slot."""

    def __init__(
        self,
        claim: Claim,
        leases: Leases,
        storage: Storage,
        settings: Settings,
        stores: ResultStores,
        *,
        stop: threading.Event,
        cancel: threading.Event,
        store_failed: Callable[[], None] = lambda: None,
    ) -> None:
        self._claim, self._leases, self._storage, self._settings = claim, leases, storage, settings
        self._stop, self._cancel, self._store_failed = stop, cancel, store_failed
        self._stores = stores
        self._folder = storage.work_path(claim.job_id, claim.attempt)
        self._mark = f"{storage.instance}:{claim.job_id}.{claim.attempt}"
        self._buffer = b""
        self._final: dict[str, Any] | None = None
        self._progress: dict[str, Any] | None = None
        self._told: dict[str, Any] | None = None
        self._beaten = self._looked = 0.0
        self._begin = time.monotonic()

    def run(self) -> str:
        """The final state that was written, or `queued` or `lost`."""
        try:
            outcome = self._attempt()
            return self._finish(outcome)
        finally:
            self._storage.remove_work(self._folder)

    def _attempt(self) -> Outcome:
        """Prepare the folder, start the process, watch it."""
        try:
            self._prepare()
            log("job.start", job=self._claim.job_id, tenant=self._claim.tenant, attempt=self._claim.attempt)
            if random.random() < self._settings.fault_fail_jobs:
                return Outcome("failed", "fault_injection", "this server fails jobs on purpose (fault_fail_jobs)")
            process, pipe = self._start()
        except Interrupted as end:
            return _interrupted(end)
        except StoreError as error:
            return Outcome("failed", "store", str(error))
        except OSError as error:
            return Outcome("again", "start", f"the job could not be started: {error.strerror or error}")
        try:
            outcome = self._watch(process, pipe)
        finally:
            # Whatever happened: the slot is free only when every process of the job is dead.
            end_job(process, self._mark, 0.0)
            os.close(pipe)
        return outcome

    def _prepare(self) -> None:
        """The folder with the input; also the map of an earlier job, wherever that is."""
        claim = self._claim
        prepare(self._folder, claim, self._storage, self._settings)
        if claim.source is not None:
            source, store = claim.source, self._stores.of(claim.source.store)
            self._phase("fetch")
            timeout = self._timeout(store, [source.size])
            self._insist("fetch", lambda: fetch(store, source, self._folder), timeout)

    def _start(self) -> tuple[subprocess.Popen[bytes], int]:
        """The job's process, and the reading end of its pipe."""
        settings = self._settings
        return start_job(
            settings.worker_command, self._folder, self._mark, settings.job_threads, self._storage.cache.absolute()
        )

    def _watch(self, process: subprocess.Popen[bytes], pipe: int) -> Outcome:
        """Read the pipe, prolong the lease, keep the limits; until the process has ended or must."""
        settings = self._settings
        begin = self._begin = time.monotonic()
        beat_at = size_at = begin
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while process.poll() is None:
                if selector.select(TICK_S) and not self._read(pipe):
                    if len(self._buffer) > _LINE_BYTES:
                        return Outcome("crashed", "protocol", "the job's process wrote nonsense")
                    time.sleep(TICK_S / 2)  # the pipe is closed, the process lives on
                now = time.monotonic()
                if self._stop.is_set():
                    return Outcome("again", "shutdown", "the server was stopped")
                if now - begin > settings.job_wall_s:
                    return Outcome("failed", "wall_limit", f"the job took longer than {settings.job_wall_s:.0f} s")
                if now >= size_at:
                    size_at = now + POLL_S
                    if folder_bytes(self._folder) > settings.job_output_bytes:
                        return Outcome("failed", "output_limit", "the job wrote more than it is allowed")
                    if self._storage.free_bytes() < self._storage.min_free_bytes // 2:
                        return Outcome("failed", "disk_full", "the server's disk became full while the job ran")
                if now >= beat_at or self._cancel.is_set():
                    beat_at = now + min(POLL_S, settings.heartbeat_s)
                    held = self._beat(now, begin)
                    if held == "lost":
                        return Outcome("lost")
                    if held == "cancel":
                        end_job(process, self._mark, settings.grace_s)
                        return Outcome("failed", "cancelled", "cancelled")
        while self._read(pipe):
            pass
        return self._judge(process.returncode)

    def _beat(self, now: float, begin: float) -> str:
        """Tell the database, if there is something new or it is time; `lost`, `cancel` or `go`."""
        progress = None
        if self._progress is not None and self._progress is not self._told:
            self._told = self._progress
            done = self._progress["done"]
            progress = {**self._progress, "speed": round(done / max(now - begin, 1e-3), 3)}
        elif now - self._beaten < self._settings.heartbeat_s and not self._cancel.is_set():
            return "go"
        self._beaten = now
        beat = self._leases.beat(self._claim, progress)
        return "lost" if not beat.mine else "cancel" if beat.cancel else "go"

    def _read(self, pipe: int) -> bool:
        """Take what the pipe has; False when it is at its end (or the process writes nonsense)."""
        try:
            block = os.read(pipe, 1 << 16)
        except BlockingIOError:
            return False
        *lines, self._buffer = (self._buffer + block).split(b"\n")
        for line in lines:
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                self._take(plain_line(line))
        return bool(block) and len(self._buffer) <= _LINE_BYTES

    def _take(self, line: dict[str, Any]) -> None:
        if "done" in line or "failed" in line:
            self._final = line
        else:
            self._progress = {
                "phase": str(line["phase"])[:40],
                "done": float(line["part"]),
                "total": float(line["total"]),
                "scans": int(line["scans"]),
            }

    def _judge(self, code: int) -> Outcome:
        """What the exit of the process means. Its own words count, but not its claim of success over its exit code."""
        final = self._final or {}
        output = self._folder / "output"
        # A link would have us publish, and tidy up, a folder elsewhere.
        if code == 0 and isinstance(final.get("done"), dict) and output.is_dir() and not output.is_symlink():
            return Outcome("done", summary=final["done"])
        if "failed" in final:
            reason = str(final["failed"])[:40]
            state = "crashed" if reason == "internal_error" else "failed"
            return Outcome(state, reason, str(final.get("message", ""))[:2000])
        if code == -signal.SIGXCPU:
            return Outcome(
                "failed", "cpu_limit", f"the job used more than {self._settings.job_cpu_s:.0f} s of processor"
            )
        if code == -signal.SIGKILL:
            # The kernel (no memory) or an operator: not the job's own doing, so it is tried again, but not for ever.
            return Outcome("again", "killed", "the job's process was killed")
        if code < 0:
            name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
            return Outcome("crashed", "signal", f"the job's process was ended by {name}")
        return Outcome("crashed", "exit", f"the job's process ended with code {code}{self._last_words()}")

    def _last_words(self) -> str:
        with suppress(OSError):
            text = (self._folder / "log.txt").read_bytes()[-2000:].decode("utf-8", "replace").strip()
            if text:
                return f": {text.splitlines()[-1][:300]}"
        return ""

    def _finish(self, outcome: Outcome) -> str:
        """Write the outcome, and log it; the state that was written."""
        state = self._write(outcome)
        log("job.end", job=self._claim.job_id, attempt=self._claim.attempt, state=state, reason=outcome.reason)
        return state

    def _write(self, outcome: Outcome) -> str:
        """Write the outcome, under the fence."""
        claim, state = self._claim, outcome.kind
        if outcome.kind == "done":
            state = self._publish(outcome.summary or {})
        elif outcome.kind == "again":
            self._leases.release(claim, outcome.message, counts=outcome.reason != "shutdown")
            state = "queued"
        elif outcome.kind != "lost":
            self._leases.fail(claim, outcome.kind, outcome.reason, outcome.message)
        return state

    def _publish(self, summary: dict[str, Any]) -> str:
        """Put the output into the store, then commit; a crash between the two leaves results that are swept later."""
        claim, store, output = self._claim, self._stores.current, self._folder / "output"
        name = f"{claim.job_id}.{claim.attempt}"
        self._phase("store")
        try:
            assets = self._insist("collect", lambda: collect(output), math.inf)
            timeout = self._timeout(store, [asset.size for asset in assets])
            self._insist("publish", lambda: store.publish(output, name, assets), timeout)
        except Interrupted as end:
            return self._write(_interrupted(end))
        except OSError as error:
            self._leases.fail(claim, "failed", "disk_full", f"the results could not be kept: {error.strerror}")
            return "failed"
        if self._leases.succeed(claim, name, assets, summary, store.url):
            return "succeeded"
        with suppress(StoreError):  # then the sweep finds them
            wait(lambda: store.remove(name), self._settings.store_timeout_s)
        self._leases.fail(claim, "failed", "cancelled", "cancelled")
        return "lost"

    def _insist(self, what: str, work: Callable[[], T], timeout_s: float) -> T:
        patience = Retry(self._look, self._claim.job_id, self._store_failed)
        return patience.retry(what, work, timeout_s)

    def _look(self) -> str:
        """Keep the lease while the store is waited for."""
        if self._stop.is_set():
            return "stop"
        now = time.monotonic()
        if now < self._looked + POLL_S and not self._cancel.is_set():
            return "go"
        self._looked = now
        return self._beat(now, self._begin)

    def _phase(self, name: str) -> None:
        """Say what is done beside the job's process."""
        scans = self._progress["scans"] if self._progress is not None else 0
        self._progress = {"phase": name, "done": 0.0, "total": 1.0, "scans": scans}

    def _timeout(self, store: ResultStore, sizes: list[int]) -> float:
        """How long a call to the store may take; a local disk takes as long as it takes."""
        if store.url is None:
            return math.inf
        return self._settings.store_timeout_s * (1 + len(sizes)) + sum(sizes) / BYTES_PER_S


def _interrupted(end: Interrupted) -> Outcome:
    """What becomes of a job that was stopped while it waited for the store."""
    return {
        "stop": Outcome("again", "shutdown", "the server was stopped"),
        "cancel": Outcome("failed", "cancelled", "cancelled"),
        "lost": Outcome("lost"),
    }[end.why]
