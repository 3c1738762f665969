"""Who runs a job: leases with a fence.

A worker owns a job by (owner, attempt) until its lease ends. Each of its writes names both; when another has taken the
job meanwhile, the write finds no row and the worker must throw its work away. So a job may be started twice (a server
was killed), but it ends once. Leases are measured by the clock of the database, and a worker never takes a job from
itself, so that a clock that is set forward ends no lease of a job that runs.
"""

from __future__ import annotations

import time
import uuid
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from sqlalchemy import and_, func, or_, select
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import aliased

from hsloc_service.db.database import is_unreachable
from hsloc_service.db.tables import AssetRow, FileRow, JobRow
from hsloc_service.jobs.events import record
from hsloc_service.jobs.repository import finish_job
from hsloc_service.settings import UNLIMITED
from hsloc_service.stored_request import MAP_STATE, files_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from sqlalchemy import ColumnElement
    from sqlalchemy.orm import Session

    from hsloc_service.db.database import Database
    from hsloc_service.results.store import Asset


T = TypeVar("T")
RETRY_S = 1.0
"""Wait between two attempts to reach the database [s]."""


class Source(NamedTuple):
    """The saved map that a job extends."""

    store: str | None
    folder: str
    size: int
    sha256: str


class Claim(NamedTuple):
    """A job that a worker holds."""

    job_id: str
    tenant: str
    owner: str
    attempt: int
    log_name: str
    request: dict[str, Any]
    names: dict[str, str]
    """Labels of the files of the request."""
    source: Source | None = None
    waited_s: float = 0.0
    """Time since the job was submitted [s]."""


class HeartbeatReply(NamedTuple):
    """The answer to a heartbeat: whether the job is still the worker's, and whether it was cancelled."""

    mine: bool
    cancel: bool


MAX_RETRY_WAIT_S = 3600.0


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How often a job is begun."""

    max_attempts: int = 3
    """Where its process or its server was killed."""
    by_reason: Mapping[str, int] = field(default_factory=dict)
    """Number of attempts where it ended for a reason; once for all others."""
    wait_s: float = 10.0
    """Wait before the second attempt by reason [s]; doubled for each further one."""

    def retried_after_s(self, reason: str, attempt: int) -> float | None:
        """Wait before the attempt after this one; None if there is none."""
        if attempt >= self.by_reason.get(reason, 1):
            return None
        return min(self.wait_s * 2.0 ** (attempt - 1), MAX_RETRY_WAIT_S)


@dataclass(frozen=True, slots=True)
class Leases:
    """The queue as the workers see it."""

    database: Database
    lease_s: float
    retries: RetryPolicy = RetryPolicy()
    tags: tuple[str, ...] = ()
    """Tags of jobs that are taken, besides those without one."""
    max_running: int = UNLIMITED
    """Number of running jobs of a tenant at which no more of its jobs are taken."""

    def claim(self, owner: str) -> Claim | None:
        """Take the first waiting job of the tenant whose turn it is; None if none waits."""
        with self.database.write() as session:
            now = self.database.now(session)
            job = self._next(session, now)
            if job is None:
                return None
            job.state, job.owner, job.attempt = "running", owner, job.attempt + 1
            job.lease_until, job.heartbeat = now + self.lease_s, now
            job.started, job.not_before = job.started or now, None
            job.phase = job.done = job.total = job.scans = job.speed = job.progressed = None
            record(session, job, "state", {"state": "running", "attempt": job.attempt})
            names, source = _names(session, job.request), _source(session, job)
            waited_s = max(now - job.created, 0.0)
            return Claim(job.id, job.tenant, owner, job.attempt, job.log_name, job.request, names, source, waited_s)

    def beat(self, claim: Claim, progress: dict[str, Any] | None, lines: Sequence[str] = ()) -> HeartbeatReply:
        """Renew the lease, and write the progress and the lines of the job's log."""
        with self.database.write() as session:
            job = _held(session, claim)
            if job is None:
                return HeartbeatReply(mine=False, cancel=False)
            now = self.database.now(session)
            job.lease_until, job.heartbeat = now + self.lease_s, now
            if progress is not None:
                job.phase, job.done, job.total = progress["phase"], progress["done"], progress["total"]
                job.scans, job.speed, job.progressed = progress["scans"], progress["speed"], now
                record(session, job, "progress", progress)
            if lines:
                record(session, job, "log", {"lines": list(lines)})
            return HeartbeatReply(mine=True, cancel=job.cancel)

    def succeed(
        self, claim: Claim, folder: str, assets: list[Asset], summary: dict[str, Any], store: str | None = None
    ) -> bool:
        """End a job as succeeded; False if another attempt holds it or it was cancelled: its results must be removed.

        The results, which the store has already, become visible by this commit.
        """
        return self._patiently(lambda: self._succeed(claim, folder, assets, summary, store))

    def _succeed(
        self, claim: Claim, folder: str, assets: list[Asset], summary: dict[str, Any], store: str | None
    ) -> bool:
        with self.database.write() as session:
            job = _held(session, claim)
            if job is None or job.cancel:
                # A commit whose answer was lost may be tried again.
                done = (JobRow.id == claim.job_id, JobRow.state == "succeeded", JobRow.folder == folder)
                return session.scalar(select(JobRow.seq).where(*done)) is not None
            job.folder, job.store, job.summary = folder, store, summary
            job.bytes = sum(asset.size for asset in assets)
            for asset in assets:
                session.add(
                    AssetRow(
                        job_id=job.id,
                        name=asset.name,
                        size=asset.size,
                        sha256=asset.sha256,
                        media_type=asset.media_type,
                    )
                )
            finish_job(session, job, "succeeded", None, None)
            return True

    def fail(self, claim: Claim, state: str, reason: str, message: str) -> str | None:
        """End a job otherwise: failed, crashed or cancelled; or put it back, as the policy says.

        The state that was written; None if another attempt holds it.
        """

        def fail() -> str | None:
            with self.database.write() as session:
                job = _held(session, claim)
                if job is None:
                    return None
                wait_s = self.retries.retried_after_s(reason, job.attempt)
                if wait_s is not None and not job.cancel:
                    job.not_before = self.database.now(session) + wait_s
                    _requeue(session, job, f"{reason}: {message}")
                    return job.state
                ended = ("cancelled", "cancelled") if job.cancel else (state, reason)
                finish_job(session, job, *ended, message)
                return job.state

        return self._patiently(fail)

    def _next(self, session: Session, now: float) -> JobRow | None:
        """The next job that may run here, locked; tenants in turn.

        Who has least running comes first, then who was served longest ago. A row that another claim has locked is
        skipped, so that a claim may find nothing while jobs wait, and is tried again.
        """
        waiting = (
            JobRow.state == "queued",
            or_(JobRow.tag.is_(None), JobRow.tag.in_(self.tags)),
            or_(JobRow.not_before.is_(None), JobRow.not_before <= now),
        )
        query = select(JobRow).where(*waiting).order_by(JobRow.priority.desc(), JobRow.seq).limit(1)
        for running, _, _, tenant in _turns(session, waiting):
            if running >= self.max_running:
                break  # those that come have as many, or more
            of_tenant = query.where(JobRow.tenant == tenant).with_for_update(skip_locked=True)
            if self.max_running >= UNLIMITED:
                job = session.scalar(of_tenant)
            else:
                # Rolled back, the savepoint gives up the tenant's lock: a claim that kept it while it waited for that
                # of the next tenant, and one that took them in another order, would wait for each other.
                savepoint = session.begin_nested()
                job = session.scalar(of_tenant) if self._may_run(session, tenant) else None
                if job is None:
                    savepoint.rollback()
            if job is not None:
                return job
        return None

    def _may_run(self, session: Session, tenant: str) -> bool:
        """Whether one more job of the tenant may run; no other server begins one until the transaction ends."""
        self.database.lock(session, f"running {tenant}")
        count = select(func.count()).where(JobRow.tenant == tenant, JobRow.state.in_(("running", "cancelling")))
        return (session.scalar(count) or 0) < self.max_running

    def _patiently(self, work: Callable[[], T]) -> T:
        """The result of `work`, tried again while a shared database is away, for as long as a lease lasts."""
        until = time.monotonic() + self.lease_s
        while True:
            try:
                return work()
            except DBAPIError as error:
                if not (self.database.shared and is_unreachable(error) and time.monotonic() < until):
                    raise
            time.sleep(RETRY_S)

    def release(self, claim: Claim, reason: str, counts: bool = True) -> None:
        """Put a job back into the queue: its process or its server was ended from outside."""

        def release() -> None:
            with self.database.write() as session:
                job = _held(session, claim)
                if job is not None:
                    self._again(session, job, reason, counts)

        self._patiently(release)

    def recover(self, owner: str | None = None, held: Collection[str] = ()) -> list[str]:
        """Requeue the jobs whose lease has ended, except those in `held`, which the caller runs itself; their ids.

        With `owner` also those of every other owner of the same data folder: at the start, when the lock of the folder
        proves that they are dead. On a shared database others may live.
        """
        with self.database.write() as session:
            ended = or_(JobRow.lease_until.is_(None), JobRow.lease_until <= self.database.now(session))
            if owner is not None:
                gone = JobRow.owner != owner
                if self.database.shared:
                    gone = gone & JobRow.owner.startswith(f"{instance_of(owner)}:", autoescape=True)
                ended = or_(ended, gone)
            query = select(JobRow).where(JobRow.state.in_(("running", "cancelling")), ended)
            found = []
            for job in session.scalars(query.with_for_update(skip_locked=True)).all():
                if job.id not in held:
                    self._again(session, job, "the server was gone", counts=True)
                    found.append(job.id)
            return found

    def _again(self, session: Session, job: JobRow, reason: str, counts: bool) -> None:
        if job.cancel:
            finish_job(session, job, "cancelled", "cancelled", "cancelled")
        elif counts and job.attempt >= self.retries.max_attempts:
            finish_job(session, job, "crashed", "attempts", f"given up after {job.attempt} attempts: {reason}")
        else:
            _requeue(session, job, reason)


def _requeue(session: Session, job: JobRow, reason: str) -> None:
    job.state = "queued"
    job.owner = job.lease_until = None
    record(session, job, "state", {"state": "queued", "reason": "requeued", "message": reason})


def new_owner(instance: str) -> str:
    """A name for the leases of a server or worker that starts now on the data folder `instance`."""
    return f"{instance}:{uuid.uuid4().hex}"


def instance_of(owner: str) -> str:
    """The data folder of an owner of leases."""
    return owner.partition(":")[0]


def _turns(session: Session, waiting: Iterable[ColumnElement[bool]]) -> list[tuple[int, float, int | None, str]]:
    """The tenants with jobs that wait: how many run, when one was begun last, first `seq` and name, in their order."""
    tenants = select(JobRow.tenant).where(*waiting).distinct().subquery()
    other = aliased(JobRow)
    running = select(func.count()).where(other.tenant == tenants.c.tenant, other.state.in_(("running", "cancelling")))
    served = select(func.max(other.started)).where(other.tenant == tenants.c.tenant)
    # Of the plain column SQLite would look for the minimum from the oldest row on, through all that have ended.
    first = select(func.min(other.seq + 0)).where(other.tenant == tenants.c.tenant, other.state == "queued")
    turns = session.execute(
        select(
            running.correlate(tenants).scalar_subquery(),
            func.coalesce(served.correlate(tenants).scalar_subquery(), 0.0),
            first.correlate(tenants).scalar_subquery(),
            tenants.c.tenant,
        )
    ).all()
    return sorted(((*turn,) for turn in turns), key=lambda turn: (turn[0], turn[1], turn[2] or 0))


class Place(NamedTuple):
    """Where a waiting job is in the queue of its tenant."""

    ahead: int
    """Jobs of the tenant that are begun before."""
    wait_s: float | None
    """Time until it begins [s], about; None where no job of the tenant has run."""


_LAST_RUNS = 20
"""Jobs whose run times stand for those that wait."""


def place_in_queue(database: Database, job: JobRow) -> Place:
    """Of a waiting job: how many go before, and for how long, if as many of the tenant run at once as now.

    The jobs that run now are taken to be half done.
    """
    of_tenant = JobRow.tenant == job.tenant
    before = or_(JobRow.priority > job.priority, and_(JobRow.priority == job.priority, JobRow.seq < job.seq))
    run_s = (
        select((JobRow.ended - JobRow.started).label("run_s"))
        .where(of_tenant, JobRow.state == "succeeded")
        .order_by(JobRow.seq.desc())
        .limit(_LAST_RUNS)
        .subquery()
    )
    with database.read() as session:
        counted = select(func.count()).select_from(JobRow)
        ahead = session.scalar(counted.where(of_tenant, JobRow.state == "queued", before)) or 0
        running = session.scalar(counted.where(of_tenant, JobRow.state.in_(("running", "cancelling")))) or 0
        mean_s = session.scalar(select(func.avg(run_s.c.run_s)))
    wait_s = None if mean_s is None else float(mean_s) * (ahead / max(running, 1) + (0.5 if running else 0.0))
    return Place(ahead, wait_s)


def _held(session: Session, claim: Claim) -> JobRow | None:
    """The job, if the claim still holds; no other transaction changes it before this one ends."""
    return session.scalar(
        select(JobRow)
        .where(
            JobRow.id == claim.job_id,
            JobRow.owner == claim.owner,
            JobRow.attempt == claim.attempt,
            JobRow.state.in_(("running", "cancelling")),
        )
        .with_for_update()
    )


def _names(session: Session, request: dict[str, Any]) -> dict[str, str]:
    rows = session.execute(select(FileRow.id, FileRow.name).where(FileRow.id.in_(files_of(request)))).all()
    return {row.id: row.name for row in rows}


def _source(session: Session, job: JobRow) -> Source | None:
    """The map that is extended; it cannot be gone, for the job that drew it is kept while this one is active."""
    if job.resume_of is None:
        return None
    found = session.execute(
        select(JobRow.store, JobRow.folder, AssetRow.size, AssetRow.sha256)
        .join(AssetRow, AssetRow.job_id == JobRow.id)
        .where(JobRow.id == job.resume_of, JobRow.tenant == job.tenant, AssetRow.name == MAP_STATE)
    ).one()
    return Source(found.store, found.folder or "", found.size, found.sha256)
