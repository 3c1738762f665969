"""Who runs jobs: the servers and workers that share a database, and when each was last there."""

from __future__ import annotations

import os
import socket
import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from sqlalchemy import delete, select
from sqlalchemy.exc import DBAPIError

from hsloc.version import __version__
from hsloc_service.db.tables import JobRow, WorkerRow
from hsloc_service.logs import log

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sqlalchemy.orm import Session

    from hsloc_service.auth import Principal
    from hsloc_service.db.database import Database

FORGET_S = 86400.0
"""Age of the last heartbeat at which the row of a worker that was killed is removed [s]."""


class WorkerState(NamedTuple):
    """A server or worker, and what it does."""

    row: WorkerRow
    age_s: float
    """Age of its last heartbeat [s]."""
    busy: int
    """Slots that run a job, of any tenant."""
    jobs: list[str]
    """Ids of those jobs that are the asking tenant's."""


def workers(database: Database, who: Principal) -> list[WorkerState]:
    """All that share the database, those that were there first at the beginning."""
    with database.read() as session:
        now = database.now(session)
        rows = session.scalars(select(WorkerRow).order_by(WorkerRow.started, WorkerRow.id)).all()
        query = select(JobRow.owner, JobRow.id, JobRow.tenant).where(JobRow.state.in_(("running", "cancelling")))
        running = session.execute(query.order_by(JobRow.seq)).all()
    found = []
    for row in rows:
        jobs = [job for job in running if job.owner == row.id]
        mine = [job.id for job in jobs if job.tenant == who.tenant]
        found.append(WorkerState(row, max(now - row.heartbeat, 0.0), len(jobs), mine))
    return found


def alive_workers(session: Session, since: float) -> Sequence[WorkerRow]:
    """Those whose last heartbeat was after a time of the database's clock."""
    return session.scalars(select(WorkerRow).where(WorkerRow.heartbeat > since)).all()


def forget_workers(database: Database) -> None:
    """Remove the rows of those that were not there for a day."""
    with database.write() as session:
        session.execute(delete(WorkerRow).where(WorkerRow.heartbeat < database.now(session) - FORGET_S))


@dataclass(slots=True)
class Presence:
    """A thread that writes the row of this server or worker as often as its jobs' heartbeats."""

    database: Database
    owner: str
    kind: str
    slots: int
    interval_s: float
    draining: Callable[[], bool] = lambda: False
    lease_s: float = 30.0
    servers: int = 1
    """How many servers were alive at the last heartbeat, this one among them."""
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Write the row, and keep on."""
        self.beat()
        self._thread = threading.Thread(target=self._run, name="presence", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Remove the row: who stops in good order is not missing."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        try:
            with self.database.write() as session:
                session.execute(delete(WorkerRow).where(WorkerRow.id == self.owner))
        except DBAPIError as error:
            log("presence.error", error=str(error.orig))

    def beat(self) -> None:
        """Write the row once; a database that is away is logged."""
        try:
            self._write()
        except DBAPIError as error:
            log("presence.error", error=str(error.orig))

    def _write(self) -> None:
        with self.database.write() as session:
            now = self.database.now(session)
            row = session.get(WorkerRow, self.owner)
            if row is None:
                row = WorkerRow(id=self.owner, kind=self.kind, host=socket.gethostname(), pid=os.getpid())
                row.version, row.slots, row.started = __version__, self.slots, now
                session.add(row)
            row.heartbeat, row.draining = now, self.draining()
            session.flush()
            self.servers = max(sum(each.kind == "server" for each in alive_workers(session, now - self.lease_s)), 1)

    def _run(self) -> None:
        while not self._stop.wait(self.interval_s):
            self.beat()
