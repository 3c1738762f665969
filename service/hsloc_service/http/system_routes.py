"""Health, metrics, options, schemas: for operators and programs."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import APIRouter, Query
from fastapi.responses import Response
from prometheus_client import generate_latest
from pydantic import AwareDatetime, BaseModel, Field
from sqlalchemy import func, select, text

from hsloc.options import describe
from hsloc.version import __version__
from hsloc_service import audit
from hsloc_service import config_schema as job_options
from hsloc_service.db.database import clock
from hsloc_service.db.tables import DeliveryRow, JobRow
from hsloc_service.errors import ServiceError, not_found
from hsloc_service.http import metrics
from hsloc_service.http.context import Admin, Context, Ctx, Reader, problems
from hsloc_service.http.schemas import (
    Ident,
    LabelList,
    Problem,
    SecretView,
    known_moment,
)
from hsloc_service.http.validation import UUID_PATTERN
from hsloc_service.jobs.workers import alive_workers, workers
from hsloc_service.uploads.repository import used_bytes
from hsloc_service.webhooks import secret_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc_service.jobs.workers import WorkerState

router = APIRouter(tags=["system"])
MAX_COMPARED = 100


class Info(BaseModel):
    """About this server, for whoever asks."""

    version: str
    tenant: str
    scopes: list[str]
    slots: int
    busy: int
    queued: int
    max_upload_bytes: int
    free_bytes: int
    upload_bytes: int = Field(description="what your uploads take")
    result_bytes: int = Field(description="what the results of your jobs take")
    quota_bytes: int = Field(description="what both may take together")


class Options(BaseModel):
    """The options of a job, and the parameters that it may set in `config`."""

    run: list[dict[str, Any]] = Field(
        description="the options of a run: name, kind, group, help, choices, default, for a form"
    )
    config_schema: dict[str, Any] = Field(description="JSON Schema of `config`")
    presets: dict[str, Any] = Field(description="the effective configuration of each preset")


class Health(BaseModel):
    """Alive, or ready to work."""

    status: Literal["ok"]


class SeedTable(BaseModel):
    """Groups of jobs that differ in their seed alone; each row is the name of a figure, then a cell for each group."""

    names: list[str]
    rows: list[list[str]]


class WorkerView(BaseModel):
    """A server or worker."""

    id: str
    kind: Literal["server", "worker"]
    host: str
    pid: int
    version: str
    slots: int
    busy: int = Field(description="slots that run a job, of any tenant")
    jobs: list[Ident] = Field(description="your jobs that it runs")
    draining: bool = Field(description="it was asked to stop, and begins no more jobs")
    started: AwareDatetime
    heartbeat_age_s: float
    alive: bool = Field(description="its last heartbeat is younger than a lease; else its jobs go to others")


class WorkerList(BaseModel):
    """The servers and workers that share a database; empty where it is one server's own."""

    workers: list[WorkerView]


_TEXT = {"description": "the metrics", "content": {"text/plain": {"schema": {"type": "string"}}}}


def _worker_view(state: WorkerState, lease_s: float) -> WorkerView:
    """A server or worker."""
    row = state.row
    return WorkerView(
        id=row.id,
        kind="server" if row.kind == "server" else "worker",
        host=row.host,
        pid=row.pid,
        version=row.version,
        slots=row.slots,
        busy=state.busy,
        jobs=state.jobs,
        draining=row.draining,
        started=known_moment(row.started),
        heartbeat_age_s=round(state.age_s, 3),
        alive=state.age_s < lease_s,
    )


@router.get("/healthz")
def healthz() -> Health:
    """The process answers."""
    return Health(status="ok")


@router.get("/readyz", responses={503: {"model": Problem, "description": "not ready"}})
def readyz(ctx: Ctx) -> Health:
    """The database answers and the disk has room: jobs can be taken."""
    if ctx.stopping.is_set():
        raise ServiceError(503, "stopping", "the server is shutting down", {"Retry-After": "5"})
    with ctx.database.read() as session:
        session.execute(text("select 1"))
    if ctx.storage.free_bytes() < ctx.storage.min_free_bytes:
        raise ServiceError(503, "no_space", "the server's disk is full", {"Retry-After": "60"})
    return Health(status="ok")


@router.get("/metrics", response_class=Response, responses={200: _TEXT, **problems()})
def prometheus(ctx: Ctx, who: Admin) -> Response:
    """Metrics of all tenants in Prometheus' text format; needs the scope `admin`."""
    del who
    _measure(ctx)
    return Response(generate_latest(metrics.REGISTRY), media_type="text/plain; version=0.0.4; charset=utf-8")


@router.get("/v1/info", responses=problems())
def info(ctx: Ctx, who: Reader) -> Info:
    """This server, and who you are to it."""
    capacity = ctx.dispatcher.capacity()
    with ctx.database.read() as session:
        queued = session.scalar(
            select(func.count()).select_from(JobRow).where(JobRow.state == "queued", JobRow.tenant == who.tenant)
        )
        uploads, results = used_bytes(session, who)
    return Info(
        version=__version__,
        tenant=who.tenant,
        scopes=sorted(who.scopes),
        slots=capacity.slots,
        busy=capacity.busy,
        queued=queued or 0,
        max_upload_bytes=ctx.settings.max_upload_bytes,
        free_bytes=ctx.storage.free_bytes(),
        upload_bytes=uploads,
        result_bytes=results,
        quota_bytes=ctx.settings.tenant_bytes,
    )


@router.get("/v1/workers", responses=problems())
def list_workers(ctx: Ctx, who: Admin) -> WorkerList:
    """The servers and workers that share the database, with your jobs that they run. Needs the scope `admin`."""
    return WorkerList(workers=[_worker_view(each, ctx.settings.lease_s) for each in workers(ctx.database, who)])


class AuditEntry(BaseModel):
    """Something that cannot be undone, or that gave or took access."""

    id: int
    at: AwareDatetime
    actor: str = Field(description="id of the token; `operator`: the server's command line; `retention`: the server")
    action: str = Field(
        description="token.issue, token.revoke, share.issue, share.revoke, job.delete, sweep.delete, file.delete"
    )
    target: str = Field(description="id of the token, job, sweep or upload; of a link, JOB/LINK")


class AuditList(BaseModel):
    """Entries of your tenant, newest first; pass `next` as `before` for more."""

    entries: list[AuditEntry]
    next: int | None


@router.get("/v1/audit", responses=problems())
def audit_log(
    ctx: Ctx,
    who: Admin,
    before: Annotated[int | None, Query(ge=1, le=2**62, description="`next` of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> AuditList:
    """Tokens, links and deletions of your tenant, for a year. Needs the scope `admin`."""
    rows = audit.entries(ctx.database, who.tenant, before, limit)
    found = [
        AuditEntry(id=row.id, at=known_moment(row.at), actor=row.actor, action=row.action, target=row.target)
        for row in rows
    ]
    return AuditList(entries=found, next=rows[-1].id if len(rows) == limit else None)


@router.get("/v1/options", responses=problems())
def options(who: Reader) -> Options:
    """The options of a job, JSON Schema of its `config`, and the presets."""
    del who
    return Options(run=describe(), **job_options.options())


@router.get("/v1/labels", responses=problems())
def labels(ctx: Ctx, who: Reader) -> LabelList:
    """The labels of all your jobs."""
    return LabelList(labels=list(ctx.jobs.labels(who)))


@router.get("/v1/compare", responses=problems(404))
def compare(
    ctx: Ctx,
    who: Reader,
    job: Annotated[list[Annotated[str, Field(pattern=UUID_PATTERN)]], Query(max_length=MAX_COMPARED)],
) -> SeedTable:
    """Figures over jobs that differ in their seed alone: mean, standard deviation, 95 % interval of the mean."""
    from hsloc.report.html import ComparedRun, over_seeds  # with numpy, which the server does not load at its start

    runs = []
    for row in ctx.jobs.get_all(who, job):
        found = row.summary or {}
        summary = {"verdict": found.get("metrics", {}).get("verdict", row.state), "figures": found.get("figures", [])}
        runs.append(ComparedRun(row.title or row.log_name, {"run": found.get("run"), "summary": summary}))
    table = over_seeds(runs)
    return SeedTable(**table) if table is not None else SeedTable(names=[], rows=[])


@router.get("/v1/schemas", responses=problems())
def schemas(who: Reader) -> list[str]:
    """Names of the schemas."""
    del who
    return sorted(_SCHEMAS)


@router.get("/v1/schemas/{name}", responses=problems(404))
def schema(name: str, who: Reader) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a file of the results: `run-metrics` of metrics.json."""
    del who
    if name not in _SCHEMAS:
        raise not_found("schema", name)
    return _SCHEMAS[name]()


@router.get("/v1/webhook-secret", responses=problems())
def webhook_secret(ctx: Ctx, who: Admin) -> SecretView:
    """The key that signs your webhooks; made when first asked for. Needs the scope `admin`."""
    with ctx.database.write() as session:
        ctx.database.lock(session, f"secret {who.tenant}")
        return SecretView(secret=secret_of(session, who.tenant))


def _measure(ctx: Context) -> None:
    with ctx.database.read() as session:
        rows = session.execute(select(JobRow.state, func.count()).group_by(JobRow.state)).all()
        counts = {row[0]: row[1] for row in rows}
        oldest = session.scalar(select(func.min(JobRow.created)).where(JobRow.state == "queued"))
        pending = session.scalar(select(func.count()).select_from(DeliveryRow).where(DeliveryRow.state == "pending"))
        waits_s = 0.0 if oldest is None else clock(session) - oldest
        alive = alive_workers(session, ctx.database.now(session) - ctx.settings.lease_s)
    for state in ("queued", "running", "cancelling", "succeeded", "failed", "crashed", "cancelled"):
        metrics.JOBS.labels(state).set(counts.get(state, 0))
    for kind in ("server", "worker"):
        metrics.WORKERS.labels(kind).set(sum(row.kind == kind for row in alive))
    metrics.FLEET_SLOTS.set(sum(row.slots for row in alive))
    capacity = ctx.dispatcher.capacity()
    metrics.SLOTS.set(capacity.slots)
    metrics.BUSY.set(capacity.busy)
    metrics.FREE.set(ctx.storage.free_bytes())
    metrics.OLDEST.set(waits_s)
    metrics.DELIVERIES.set(pending or 0)


@functools.cache
def _run_metrics() -> dict[str, Any]:
    from hsloc.run_metrics import schema

    return schema()


_SCHEMAS: dict[str, Callable[[], dict[str, Any]]] = {"run-metrics": _run_metrics}
