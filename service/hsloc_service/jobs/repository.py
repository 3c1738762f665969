"""Jobs as their owners see them: submit, look, cancel, run again, delete."""

from __future__ import annotations

import hashlib
import json
import uuid
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from sqlalchemy import ColumnElement, delete, func, or_, select

from hsloc_service.audit import note
from hsloc_service.db.database import clock
from hsloc_service.db.tables import (
    ACTIVE,
    AssetRow,
    CounterRow,
    DeliveryRow,
    EventRow,
    FileRow,
    IdempotencyRow,
    JobRow,
    ShareRow,
)
from hsloc_service.errors import ServiceError, busy, conflict, not_found
from hsloc_service.jobs.events import record
from hsloc_service.results.deletion_queue import removal_of
from hsloc_service.stored_request import MAP_STATE, MAPS, UPLOADS, logs_of
from hsloc_service.uploads.repository import need_quota
from hsloc_service.webhooks import queue_webhook

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from sqlalchemy.orm import Session

    from hsloc_service.auth import Principal
    from hsloc_service.db.database import Database
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage


class Submitted(NamedTuple):
    """A job, and whether this request made it (else an earlier one with the same Idempotency-Key)."""

    job: JobRow
    created: bool


JobOrder = Literal["newest", "oldest", "name", "longest"]
ORDERS: dict[JobOrder, tuple[ColumnElement[Any], ...]] = {
    "newest": (JobRow.seq.desc(),),
    "oldest": (JobRow.seq.asc(),),
    "name": (func.lower(JobRow.log_name), JobRow.seq.desc()),
    "longest": (func.coalesce(JobRow.ended - JobRow.started, 0.0).desc(), JobRow.seq.desc()),
}
"""By name, what jobs are ordered by; longest is the time from start to end."""


@dataclass(frozen=True, slots=True)
class JobFilter:
    """Which jobs are listed, and in what order; what is None does not matter."""

    state: str | None = None
    verdict: str | None = None
    """Verdict of the result: good, check or failed."""
    search: str | None = None
    """Part of the log's name, the title, the labels or the notes in any case, or the beginning of the job's id."""
    label: str | None = None
    """A label that the job has."""
    order: JobOrder = "newest"
    sweep: str | None = None
    """The sweep that they are runs of."""

    def conditions(self, who: Principal) -> list[ColumnElement[bool]]:
        """For a query; never without the tenant."""
        found: list[ColumnElement[bool]] = [JobRow.tenant == who.tenant]
        if self.state is not None:
            found.append(JobRow.state == self.state)
        if self.verdict is not None:
            found.append(JobRow.summary["metrics"]["verdict"].as_string() == self.verdict)
        if self.sweep is not None:
            found.append(JobRow.sweep == self.sweep)
        if self.search:
            texts = (JobRow.log_name, JobRow.title, JobRow.labels, JobRow.notes)
            by_text = [text.icontains(self.search, autoescape=True) for text in texts]
            found.append(or_(*by_text, JobRow.id.startswith(self.search, autoescape=True)))
        if self.label is not None:
            found.append(JobRow.labels.contains(f",{self.label},", autoescape=True))
        return found


@dataclass(frozen=True, slots=True)
class Jobs:
    """The jobs of all tenants; every method sees those of the principal only."""

    database: Database
    storage: Storage
    settings: Settings

    def submit(self, who: Principal, request: dict[str, Any], key: str | None = None) -> Submitted:
        """Queue a job; when this returns, the job is on the disk.

        `request` is a validated `JobRequest` as plain data. Raises ServiceError: 404 for files and jobs that are not
        there, 409 for a key that was used for another request, 422 for a job without a map to extend, 429 when too
        many wait, 507 when the disk or the quota is full.
        """
        digest = request_digest(request)
        with self.database.write() as session:
            self.database.lock_tenant(session, who.tenant)
            if (known := made_before(session, who, key, digest)) is not None:
                return Submitted(job_of(session, who, known), created=False)
            self.need_room(session, who)
            job = self.insert(session, who, request)
            remember_key(session, who, key, digest, job.id)
            return Submitted(job, created=True)

    def rerun(self, who: Principal, job_id: str, request: dict[str, Any]) -> JobRow:
        """The job again, with what the caller made of its request."""
        with self.database.write() as session:
            self.database.lock_tenant(session, who.tenant)
            old = job_of(session, who, job_id)
            self.need_room(session, who)
            job = self.insert(session, who, request, rerun_of=old.id)
            job.title, job.labels = old.title, old.labels
            return job

    def get(self, who: Principal, job_id: str) -> JobRow:
        """One job."""
        with self.database.read() as session:
            return job_of(session, who, job_id)

    def get_all(self, who: Principal, job_ids: Sequence[str]) -> Sequence[JobRow]:
        """Several jobs, each once, in this order. Raises ServiceError 404 if one is not there."""
        query = select(JobRow).where(JobRow.tenant == who.tenant, JobRow.id.in_(job_ids))
        with self.database.read() as session:
            found = {job.id: job for job in session.scalars(query)}
        if missing := [each for each in job_ids if each not in found]:
            raise not_found("job", missing[0])
        return [found[each] for each in dict.fromkeys(job_ids)]

    def list(
        self, who: Principal, wanted: JobFilter, *, before: int | None = None, offset: int = 0, limit: int = 50
    ) -> Sequence[JobRow]:
        """Jobs in the order that is asked for; `before` is the `seq` of the last one seen, `offset` how many were."""
        query = (
            select(JobRow).where(*wanted.conditions(who)).order_by(*ORDERS[wanted.order]).offset(offset).limit(limit)
        )
        if before is not None:
            query = query.where(JobRow.seq < before)
        with self.database.read() as session:
            return session.scalars(query).all()

    def count(self, who: Principal, wanted: JobFilter) -> int:
        """How many jobs there are to list."""
        with self.database.read() as session:
            return session.scalar(select(func.count()).select_from(JobRow).where(*wanted.conditions(who))) or 0

    def assets(self, who: Principal, job_id: str) -> tuple[JobRow, Sequence[AssetRow]]:
        """A job and the manifest of its results."""
        with self.database.read() as session:
            job = job_of(session, who, job_id)
            rows = session.scalars(select(AssetRow).where(AssetRow.job_id == job_id).order_by(AssetRow.name)).all()
            return job, rows

    def events(self, who: Principal, job_id: str, after: int, limit: int = 200) -> tuple[JobRow, Sequence[EventRow]]:
        """A job and what happened to it after the cursor."""
        query = (
            select(EventRow).where(EventRow.job_id == job_id, EventRow.id > after).order_by(EventRow.id).limit(limit)
        )
        with self.database.read() as session:
            job = job_of(session, who, job_id)
            return job, session.scalars(query).all()

    def deliveries(self, who: Principal, job_id: str) -> Sequence[DeliveryRow]:
        """The webhooks of a job."""
        with self.database.read() as session:
            job_of(session, who, job_id)
            return session.scalars(select(DeliveryRow).where(DeliveryRow.job_id == job_id)).all()

    def cancel(self, who: Principal, job_id: str) -> JobRow:
        """Ask for the end of a job. A waiting job is cancelled at once; a running one when its processes are dead."""
        with self.database.write() as session:
            job = job_of(session, who, job_id, lock=True)
            cancel_job(session, job)
            return job

    def describe(self, who: Principal, job_id: str, changes: Mapping[str, Any]) -> JobRow:
        """Set title, labels or notes of a job; what `changes` does not name stays."""
        with self.database.write() as session:
            job = job_of(session, who, job_id, lock=True)
            for name, value in changes.items():
                setattr(job, name, joined_labels(value or ()) if name == "labels" else value or None)
            return job

    def labels(self, who: Principal) -> Sequence[str]:
        """The labels of all jobs, in the order of the alphabet."""
        with self.database.read() as session:
            texts = session.scalars(select(JobRow.labels).where(JobRow.tenant == who.tenant).distinct()).all()
        return sorted({label for text in texts for label in split_labels(text)}, key=str.casefold)

    def delete(self, who: Principal, job_id: str) -> None:
        """Remove a job that has ended; its results are noted down for `DeletionQueue`.

        Raises ServiceError 409 while it is active, or while an active job extends its map.
        """
        with self.database.write() as session:
            self.database.lock_tenant(session, who.tenant)
            job = job_of(session, who, job_id, lock=True)
            if job.state in ACTIVE:
                raise conflict("active", f"the job is {job.state}; cancel it first")
            if base_job(session, job_id):
                raise conflict("in_use", "an active job extends the map of this one; cancel that first")
            delete_job(session, job)
            note(session, who.tenant, who.token, "job.delete", job.id)

    def need_room(self, session: Session, who: Principal, count: int = 1) -> None:
        """Raises ServiceError 429 if `count` more jobs would be too many, 507 for a full disk or quota."""
        self.storage.need_space()
        need_quota(session, who, self.settings.tenant_bytes)
        waiting = session.scalar(
            select(func.count()).select_from(JobRow).where(JobRow.tenant == who.tenant, JobRow.state == "queued")
        )
        if (waiting or 0) + count > self.settings.max_queued:
            raise busy(f"{waiting} jobs are waiting already; the limit is {self.settings.max_queued}", 10.0)

    def insert(
        self,
        session: Session,
        who: Principal,
        request: dict[str, Any],
        *,
        rerun_of: str | None = None,
        sweep: str | None = None,
    ) -> JobRow:
        """Queue a job in the caller's transaction, which holds the tenant's lock. Raises ServiceError."""
        logs = [_complete_file(session, who, ident, "log") for ident in logs_of(request)]
        for name in MAPS:
            for part, ident in (request.get(name) or {}).items():
                _complete_file(session, who, ident, f"{name}.{part}")
        for name in UPLOADS:
            if request.get(name) is not None:
                _complete_file(session, who, request[name], name)
        if request.get("resume") is not None:
            _need_map(session, job_of(session, who, request["resume"]))
        self.database.lock(session, SEQ)
        job = JobRow(
            seq=_next_seq(session),
            id=str(uuid.uuid4()),
            tenant=who.tenant,
            file_id=logs[0].id,
            log_name=", ".join(log.name for log in logs)[:1000],
            request=request,
            rerun_of=rerun_of,
            resume_of=request.get("resume"),
            state="queued",
            created=clock(session),
            attempt=0,
            cancel=False,
            webhook=request.get("webhook"),
            tag=request.get("tag"),
            priority=request.get("priority") or 0,
            sweep=sweep,
        )
        session.add(job)
        session.flush()
        record(session, job, "state", {"state": "queued"})
        return job


def request_digest(request: Any) -> str:
    """What is kept of a request, to know it again."""
    return hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()


def made_before(session: Session, who: Principal, key: str | None, digest: str) -> str | None:
    """Id of what an earlier request with this Idempotency-Key made. Raises ServiceError 409 if it was another one."""
    known = None if key is None else session.get(IdempotencyRow, (who.tenant, key))
    if known is None:
        return None
    if known.sha256 != digest:
        raise conflict("idempotency", "this Idempotency-Key was used for a different request")
    return known.job_id


def remember_key(session: Session, who: Principal, key: str | None, digest: str, made: str) -> None:
    """Record what a request with an Idempotency-Key made."""
    if key is not None:
        row = IdempotencyRow(tenant=who.tenant, key=key, sha256=digest, job_id=made, created=clock(session))
        session.add(row)


def joined_labels(labels: Iterable[str]) -> str:
    """The column of these labels, each once, in their order."""
    return "".join(f",{label}" for label in dict.fromkeys(labels)) + ","


def split_labels(text: str) -> list[str]:
    """The labels of a column."""
    return [label for label in text.split(",") if label]


SEQ = "job.seq"


def _next_seq(session: Session) -> int:
    """A number that no job had, also none that was deleted: it is a cursor of clients. Needs the lock `SEQ`."""
    counter = session.get(CounterRow, SEQ)
    if counter is None:
        counter = CounterRow(name=SEQ, value=0)
        session.add(counter)
    counter.value = max(counter.value, session.scalar(select(func.max(JobRow.seq))) or 0) + 1
    return counter.value


def finish_job(session: Session, job: JobRow, state: str, reason: str | None, message: str | None) -> None:
    """Put a job into a final state, and its webhook into the outbox, in one transaction."""
    job.state, job.reason, job.message = state, reason, message
    job.ended = clock(session)
    job.owner = job.lease_until = None
    record(session, job, "state", {"state": state, "reason": reason, "message": message})
    queue_webhook(session, job, "job.ended")


def cancel_job(session: Session, job: JobRow) -> None:
    """Cancel a waiting job, and ask for the end of a running one; the row is locked."""
    if job.state == "queued":
        finish_job(session, job, "cancelled", "cancelled", "cancelled before it started")
    elif job.state == "running":
        job.cancel, job.state = True, "cancelling"
        record(session, job, "state", {"state": "cancelling"})


def delete_job(session: Session, *jobs: JobRow) -> None:
    """Delete jobs with all their rows, and record that their results are to be removed."""
    session.add_all([removal_of(job) for job in jobs if job.folder is not None])
    ids = [job.id for job in jobs]
    for table in (AssetRow, EventRow, DeliveryRow, IdempotencyRow, ShareRow):
        session.execute(delete(table).where(table.job_id.in_(ids)))
    session.execute(delete(JobRow).where(JobRow.id.in_(ids)))


def base_job(session: Session, *job_ids: str) -> set[str]:
    """Those of the jobs whose map is extended by a job that has not ended."""
    query = select(JobRow.resume_of).where(JobRow.resume_of.in_(job_ids), JobRow.state.in_(ACTIVE))
    return {each for each in session.scalars(query) if each is not None}


def _need_map(session: Session, job: JobRow) -> None:
    """Raises ServiceError 422 unless the job left a map that can be extended."""
    if job.state != "succeeded":
        raise ServiceError(422, "resume", f"resume: job {job.id} is {job.state}; only a succeeded one has left a map")
    if session.get(AssetRow, (job.id, MAP_STATE)) is None:
        raise ServiceError(
            422, "resume", f"resume: job {job.id} drew no map with the graph mapper, so there is none to extend"
        )


def job_of(session: Session, who: Principal, job_id: str, lock: bool = False) -> JobRow:
    """A job of the principal; with `lock` no other transaction changes it before this one ends."""
    query = select(JobRow).where(JobRow.id == job_id, JobRow.tenant == who.tenant)
    job = session.scalar(query.with_for_update() if lock else query)
    if job is None:
        raise not_found("job", job_id)
    return job


def _complete_file(session: Session, who: Principal, file_id: str, what: str) -> FileRow:
    row = session.scalar(select(FileRow).where(FileRow.id == file_id, FileRow.tenant == who.tenant))
    if row is None:
        raise ServiceError(404, "not_found", f"{what}: there is no file {file_id[:64]!r}; upload it first")
    if row.state != "complete":
        raise conflict("incomplete", f"{what}: the upload of file {file_id} is not finished")
    return row
