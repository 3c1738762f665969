"""Sweeps: jobs that are submitted, watched, cancelled and deleted together, with one table."""

from __future__ import annotations

import uuid
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from sqlalchemy import func, select

from hsloc.sweep import log_labels
from hsloc.sweep.table import COLUMNS
from hsloc_service.audit import note
from hsloc_service.db.database import clock
from hsloc_service.db.tables import ACTIVE, JobRow, SweepRow
from hsloc_service.errors import conflict, not_found
from hsloc_service.jobs.repository import (
    base_job,
    cancel_job,
    delete_job,
    made_before,
    remember_key,
    request_digest,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sqlalchemy.orm import Session

    from hsloc_service.auth import Principal
    from hsloc_service.jobs.repository import Jobs


class SweepJob(NamedTuple):
    """A run of a sweep that is submitted: its request as plain data, and what its row of the table says."""

    request: dict[str, Any]
    config: str
    seed: int


class SweepState(NamedTuple):
    """A sweep, and how many of its jobs are in which state; those that are not there any more are `deleted`."""

    row: SweepRow
    states: dict[str, int]

    @property
    def has_ended(self) -> bool:
        """Whether no job waits or runs."""
        return not any(self.states.get(state) for state in ACTIVE)


@dataclass(frozen=True, slots=True)
class Sweeps:
    """The sweeps of all tenants; every method sees those of the principal only."""

    jobs: Jobs

    def submit(
        self, who: Principal, name: str, runs: Sequence[SweepJob], key: str | None = None
    ) -> tuple[SweepState, list[str]]:
        """Queue all jobs of a sweep, or none; the sweep, and the ids of the jobs that this request made.

        Raises ServiceError as `Jobs.submit` does.
        """
        digest = request_digest([name, [run._asdict() for run in runs]])
        with self.jobs.database.write() as session:
            self.jobs.database.lock_tenant(session, who.tenant)
            if (known := made_before(session, who, key, digest)) is not None:
                return _state(session, _sweep(session, who, known)), []
            self.jobs.need_room(session, who, len(runs))
            row = SweepRow(id=str(uuid.uuid4()), tenant=who.tenant, name=name, created=clock(session), runs={})
            made = [(run, self.jobs.insert(session, who, run.request, sweep=row.id)) for run in runs]
            row.runs = _named(made)
            session.add(row)
            remember_key(session, who, key, digest, row.id)
            session.flush()
            return _state(session, row), list(row.runs)

    def newest(self, who: Principal, limit: int, offset: int) -> list[SweepState]:
        """Sweeps, newest first."""
        query = select(SweepRow).where(SweepRow.tenant == who.tenant).order_by(SweepRow.created.desc(), SweepRow.id)
        with self.jobs.database.read() as session:
            return _states(session, session.scalars(query.limit(limit).offset(offset)).all())

    def get(self, who: Principal, sweep_id: str) -> SweepState:
        """One sweep."""
        with self.jobs.database.read() as session:
            return _state(session, _sweep(session, who, sweep_id))

    def table(self, who: Principal, sweep_id: str) -> tuple[list[str], list[dict[str, Any]]]:
        """Ids of the jobs, and a row of `hsloc.sweep.table.COLUMNS` for each, in the order of the request."""
        with self.jobs.database.read() as session:
            row = _sweep(session, who, sweep_id)
            query = select(JobRow).where(JobRow.sweep == sweep_id, JobRow.tenant == who.tenant)
            jobs = {job.id: job for job in session.scalars(query)}
        ids = sorted(row.runs, key=lambda each: int(row.runs[each]["number"]))
        return ids, [_table_row(row.runs[ident], jobs.get(ident)) for ident in ids]

    def cancel(self, who: Principal, sweep_id: str, cancelled: Callable[[str], None]) -> SweepState:
        """Ask for the end of all jobs that have not ended; `cancelled` is called with the id of each."""
        with self.jobs.database.write() as session:
            _sweep(session, who, sweep_id)
            query = select(JobRow).where(JobRow.sweep == sweep_id, JobRow.state.in_(ACTIVE)).order_by(JobRow.seq)
            active = session.scalars(query.with_for_update()).all()
            for job in active:
                cancel_job(session, job)
        for job in active:
            cancelled(job.id)
        return self.get(who, sweep_id)

    def delete(self, who: Principal, sweep_id: str) -> None:
        """Remove a sweep that has ended, with its jobs and their results. Raises ServiceError 409 as `Jobs.delete`."""
        with self.jobs.database.write() as session:
            self.jobs.database.lock_tenant(session, who.tenant)
            state = _state(session, _sweep(session, who, sweep_id))
            if not state.has_ended:
                raise conflict("active", "jobs of the sweep wait or run; cancel it first")
            jobs = session.scalars(select(JobRow).where(JobRow.sweep == sweep_id).with_for_update()).all()
            if base_job(session, *(job.id for job in jobs)):
                raise conflict("in_use", "an active job extends the map of a job of this sweep; cancel that first")
            delete_job(session, *jobs)
            note(session, who.tenant, who.token, "job.delete", *(job.id for job in jobs))
            note(session, who.tenant, who.token, "sweep.delete", sweep_id)
            session.delete(state.row)


def _named(made: Sequence[tuple[SweepJob, JobRow]]) -> dict[str, Any]:
    """What the table says of each job, by its id; names as `hsloc sweep` gives them."""
    logs = list(dict.fromkeys(job.file_id for _, job in made))
    names = {job.file_id: job.log_name for _, job in made}
    labels = dict(zip(logs, log_labels([names[each] for each in logs]), strict=True))
    found = {}
    for number, (run, job) in enumerate(made):
        name = f"{labels[job.file_id]}-{run.config}-seed{run.seed}"
        row = {"number": number, "run": name, "log": labels[job.file_id], "config": run.config, "seed": run.seed}
        found[job.id] = row
    return found


def _sweep(session: Session, who: Principal, sweep_id: str) -> SweepRow:
    row = session.scalar(select(SweepRow).where(SweepRow.id == sweep_id, SweepRow.tenant == who.tenant))
    if row is None:
        raise not_found("sweep", sweep_id)
    return row


def _state(session: Session, row: SweepRow) -> SweepState:
    return _states(session, [row])[0]


def _states(session: Session, rows: Sequence[SweepRow]) -> list[SweepState]:
    """Sweeps with the states of their jobs, by one query."""
    found: dict[str | None, Counter[str]] = {row.id: Counter() for row in rows}
    query = select(JobRow.sweep, JobRow.state, func.count()).where(JobRow.sweep.in_(found))
    for sweep_id, state, jobs in session.execute(query.group_by(JobRow.sweep, JobRow.state)):
        found[sweep_id][state] = jobs
    for row in rows:
        found[row.id]["deleted"] = len(row.runs) - found[row.id].total()
    return [SweepState(row, {state: jobs for state, jobs in sorted(found[row.id].items()) if jobs}) for row in rows]


def _table_row(run: dict[str, Any], job: JobRow | None) -> dict[str, Any]:
    values: dict[str, Any] = dict.fromkeys(COLUMNS)
    values |= {"run": run["run"], "log": run["log"], "config": run["config"], "seed": run["seed"]}
    if job is None:
        return {**values, "state": "deleted", "data_lost": False, "limits": "", "error": ""}
    summary = job.summary or {}
    figures = summary.get("row") or {}
    values |= {name: figures[name] for name in COLUMNS if figures.get(name) is not None}
    return values | {
        "state": job.state,
        "data_lost": bool(summary.get("data_lost")),
        "limits": "; ".join(summary.get("limits", ())),
        "error": "" if job.state == "succeeded" else job.message or "",
    }
