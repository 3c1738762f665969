"""Who starts the jobs. The job's row with its lease decides; a dispatcher only chooses when it is read.

`LocalDispatcher` runs jobs in N slots of this machine, whether the database is its own or shared with others: a slot
that is free looks for a job once a second, and at once when this server took one, or PostgreSQL notifies that another
did.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from sqlalchemy.exc import OperationalError

from hsloc_service.execution.processes import kill_marked
from hsloc_service.housekeeping import reconcile
from hsloc_service.jobs.leases import new_owner
from hsloc_service.logs import log

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc_service.execution.supervisor import Supervisor
    from hsloc_service.results.deletion_queue import DeletionQueue

IDLE_S = 1.0
"""Time between two looks of a free slot for a job [s]."""
LISTEN_S = 0.5
LISTEN_AGAIN_S = 5.0
"""Wait before listening again to a database that was away [s]."""


@dataclass(frozen=True, slots=True)
class Capacity:
    """Slots, and how many of them run a job."""

    slots: int
    busy: int


class Dispatcher(Protocol):
    """After `enqueue` a free slot claims the job within a second; after `cancel` a running job ends within its grace
    time, or at the next heartbeat where it runs elsewhere."""

    def enqueue(self, job_id: str) -> None:
        """A job was queued and committed."""
        ...

    def cancel(self, job_id: str) -> None:
        """A job was cancelled, and its row says so."""
        ...

    @property
    def owner(self) -> str:
        """Name of this server in the leases."""
        ...

    @property
    def sandbox_kind(self) -> str:
        """What keeps jobs from the server's files: see `Sandbox`."""
        ...

    def capacity(self) -> Capacity:
        """Slots of this machine."""
        ...

    def start(self) -> None:
        """Begin."""
        ...

    def stop(self) -> None:
        """Put the running jobs back into the queue, kill their processes, return when they are dead."""
        ...


class LocalDispatcher:
    """N slots on this machine, a thread each. The kernel's death signal for a job's process is bound to the thread that
    started it, so a thread lives at least as long as its job."""

    def __init__(
        self, supervisor: Supervisor, deletions: DeletionQueue, ended: Callable[[str, float, float], None]
    ) -> None:
        self._supervisor, self._deletions, self._ended = supervisor, deletions, ended
        self._leases, self._storage, self._settings = supervisor.leases, supervisor.storage, supervisor.settings
        self._owner = new_owner(self._storage.instance)
        self._stop, self._draining = threading.Event(), threading.Event()
        self._work = threading.Condition()
        self._claiming = threading.Lock()
        """A job is claimed and entered into `_running` in one step; else another slot would take it for abandoned."""
        self._running: dict[str, threading.Event] = {}
        self._threads: list[threading.Thread] = []

    @property
    def sandbox_kind(self) -> str:
        """What keeps the jobs apart."""
        return self._supervisor.sandbox.kind

    @property
    def owner(self) -> str:
        """Name of this server in the leases."""
        return self._owner

    def start(self) -> None:
        """Clean up after a server that was killed, then start the slots."""
        if killed := kill_marked(f"{self._storage.instance}:"):
            log("orphans.killed", count=killed)
        for job_id in self._leases.recover(self._owner):
            log("job.requeued", job=job_id)
        reconcile(self._leases.database, self._storage, self._deletions)
        for k in range(self._settings.slots):
            thread = threading.Thread(target=self._slot, name=f"slot-{k}", daemon=True)
            thread.start()
            self._threads.append(thread)
        if self._leases.database.shared:
            thread = threading.Thread(target=self._listen, name="listen", daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """End the slots."""
        self._stop.set()
        with self._work:
            self._work.notify_all()
        for thread in self._threads:
            thread.join()

    @property
    def is_draining(self) -> bool:
        """Whether no job is begun any more."""
        return self._draining.is_set()

    def drain(self) -> None:
        """Begin no more jobs; those that run go on. `capacity` says when they have ended."""
        self._draining.set()
        with self._work:
            self._work.notify_all()

    def enqueue(self, job_id: str) -> None:
        """Wake a slot."""
        del job_id
        with self._work:
            self._work.notify()

    def cancel(self, job_id: str) -> None:
        """Wake the slot that runs the job, if it runs here."""
        event = self._running.get(job_id)
        if event is not None:
            event.set()

    def capacity(self) -> Capacity:
        """Slots of this server."""
        return Capacity(self._settings.slots, len(self._running))

    def _slot(self) -> None:
        while not self._stop.is_set() and not self._draining.is_set():
            try:
                if not self._run_next():
                    with self._work:
                        self._work.wait(IDLE_S)
            except OperationalError as error:
                # A full disk, a locked database or one that is away passes; the slot must survive it.
                log("slot.database", error=str(error.orig))
                if not self._leases.database.shared:
                    self._storage.drop_ballast()
                self._stop.wait(IDLE_S)
            except Exception as error:
                log("slot.error", error=f"{type(error).__name__}: {error}")
                self._stop.wait(IDLE_S)

    def _listen(self) -> None:
        """Wake slots for jobs that other servers have queued, and end those that were cancelled there.

        Where the database is away, or does not deliver notifications, slots find jobs by looking every IDLE_S.
        """
        while not self._stop.is_set():
            try:
                with self._leases.database.listening() as messages:
                    while not self._stop.is_set():
                        for message in messages(LISTEN_S):
                            self._hear(message)
            except Exception as error:
                log("listen.error", error=f"{type(error).__name__}: {error}"[:300])
                self._stop.wait(LISTEN_AGAIN_S)

    def _hear(self, message: str) -> None:
        kind, _, job_id = message.partition(" ")
        if kind == "cancelling":
            self.cancel(job_id)
            return
        with self._work:
            self._work.notify_all()

    def _run_next(self) -> bool:
        """Run the next job; False if there is none, or the disk is so full that it would end as `disk_full`."""
        if self._storage.free_bytes() < self._storage.min_free_bytes:
            return False
        with self._claiming:
            claim = self._leases.claim(self._owner)
            if claim is None:
                for job_id in self._leases.recover(held=self._running):
                    log("job.requeued", job=job_id)
                return False
            cancel = self._running[claim.job_id] = threading.Event()
        try:
            begin = time.monotonic()
            state = self._supervisor.run(claim, stop=self._stop, cancel=cancel)
            self._ended(state, time.monotonic() - begin, claim.waited_s)
        finally:
            self._running.pop(claim.job_id, None)
        return state != "queued"  # a job that could not be started is not tried again before IDLE_S
