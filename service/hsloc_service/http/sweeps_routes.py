"""Sweeps: logs x configurations x seeds as jobs, and one table."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from pydantic import AwareDatetime, BaseModel, BeforeValidator, Field

from hsloc.sweep.table import as_csv, as_markdown
from hsloc_service import config_schema
from hsloc_service.config_schema import whole
from hsloc_service.errors import ServiceError
from hsloc_service.http.context import Ctx, Reader, Writer, problems
from hsloc_service.http.jobs_routes import Key
from hsloc_service.http.schemas import (
    UNIQUE,
    Config,
    Ident,
    JobRequest,
    Label,
    Model,
    Strict,
    checked,
    known_moment,
)
from hsloc_service.http.validation import RUN_PATTERN, UUID_PATTERN
from hsloc_service.jobs.sweeps import SweepJob, SweepState
from hsloc_service.stored_request import plain

router = APIRouter(prefix="/v1/sweeps", tags=["sweeps"])
SweepId = Annotated[str, Path(pattern=UUID_PATTERN, description="id of a sweep")]
MAX_EACH = 1000
CLOSED: dict[str, Any] = {"additionalProperties": False}
Name = Annotated[str, Field(pattern=RUN_PATTERN)]
Seed = Annotated[int, Field(ge=0, le=2**53 - 1), BeforeValidator(whole)]


_OF_EACH = ("log", "logs", "seed", "resume")
"""What a sweep does not give to all its runs."""
_Options = Model(
    "SweepRunOptions",
    __base__=Strict,
    **{name: (each.annotation, each) for name, each in JobRequest.model_fields.items() if name not in _OF_EACH},
)


class SweepOptions(_Options):  # type: ignore[misc, valid-type]
    """The options of several runs of a sweep, as those of a job."""


Configs = Annotated[dict[Name, SweepOptions], Field(min_length=1, max_length=MAX_EACH, json_schema_extra=CLOSED)]


class SweepRequest(Strict):
    """A job for each log, configuration and seed."""

    name: Label = ""
    logs: Annotated[list[Ident], Field(min_length=1, max_length=MAX_EACH, json_schema_extra=UNIQUE)] = Field(
        description="ids of uploaded logs; each is a run of its own"
    )
    seeds: Annotated[list[Seed], Field(min_length=1, max_length=MAX_EACH, json_schema_extra=UNIQUE)] = Field(
        default=[0], description="seeds"
    )
    configs: Configs | None = Field(
        default=None,
        description="by a label of the table what some runs have besides `run`: `config`, `preset`, `matcher`",
        examples=[{"few": {"config": {"hide": {"budget": 100}}}, "icp": {"matcher": "icp"}}],
    )
    run: SweepOptions | None = Field(default=None, description="options of all runs")


class SweepView(BaseModel):
    """A sweep."""

    id: Ident
    name: str
    created: AwareDatetime
    jobs: int
    states: dict[str, int] = Field(description="number of jobs by their state; `deleted` for those that are gone")
    ended: bool = Field(description="no job waits or runs")


class SweepList(BaseModel):
    """Sweeps, newest first."""

    sweeps: list[SweepView]


class SweepTable(BaseModel):
    """A row for each run, with the columns of `hsloc sweep`, in the order logs, configurations, seeds."""

    jobs: list[Ident]
    rows: list[dict[str, Any]]


@router.post("", status_code=201, responses={200: {"model": SweepView}, **problems(404, 409, 413, 507)})
def submit(ctx: Ctx, who: Writer, response: Response, request: SweepRequest, idempotency_key: Key = None) -> SweepView:
    """Queue the jobs of a sweep, all or none; 200 if they were there already (Idempotency-Key)."""
    state, made = ctx.sweeps.submit(who, request.name, _runs(request, ctx.settings.max_queued), idempotency_key)
    response.headers["Location"] = f"/v1/sweeps/{state.row.id}"
    for job_id in made:
        ctx.dispatcher.enqueue(job_id)
    if not made:
        response.status_code = 200
    return _view(state)


@router.get("", responses=problems())
def list_sweeps(
    ctx: Ctx,
    who: Reader,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    offset: Annotated[int, Query(ge=0, le=2**31)] = 0,
) -> SweepList:
    """Your sweeps, newest first."""
    return SweepList(sweeps=[_view(each) for each in ctx.sweeps.newest(who, limit, offset)])


@router.get("/{sweep_id}", responses=problems(404))
def get(ctx: Ctx, who: Reader, sweep_id: SweepId) -> SweepView:
    """One sweep."""
    return _view(ctx.sweeps.get(who, sweep_id))


@router.get("/{sweep_id}/table", responses=problems(404))
def table(ctx: Ctx, who: Reader, sweep_id: SweepId) -> SweepTable:
    """The table, also while jobs run."""
    jobs, rows = ctx.sweeps.table(who, sweep_id)
    return SweepTable(jobs=jobs, rows=rows)


class SweepMatrixView(BaseModel):
    """The table by logs and configurations, as `sweep.html` shows it."""

    name: str
    ended: bool
    logs: list[str]
    configs: list[str]
    cells: list[list[dict[str, Any]]] = Field(
        description="by log and configuration: `runs` with job, seed, state and verdict, and `texts`"
    )
    overall: list[list[str]] = Field(description="texts of each configuration over all logs")


@router.get("/{sweep_id}/matrix", responses=problems(404))
def matrix(ctx: Ctx, who: Reader, sweep_id: SweepId) -> SweepMatrixView:
    """The table as a matrix, with errors over seeds: mean, standard deviation, 95 % interval of the mean."""
    from hsloc.report.sweep_page import sweep_matrix  # with numpy, which the server does not load at its start

    state, (jobs, rows) = ctx.sweeps.get(who, sweep_id), ctx.sweeps.table(who, sweep_id)
    found = sweep_matrix(rows)
    shown = ("seed", "state", "verdict")
    runs = [{"job": job} | {name: row[name] for name in shown} for job, row in zip(jobs, rows, strict=True)]
    cells = [
        [{"runs": [runs[k] for k in cell.rows], "texts": list(cell.texts)} for cell in line] for line in found.cells
    ]
    return SweepMatrixView(
        name=state.row.name,
        ended=state.has_ended,
        logs=list(found.logs),
        configs=list(found.configs),
        cells=cells,
        overall=[list(texts) for texts in found.overall],
    )


def _text(kind: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"description": "the table", "content": {kind: {"schema": {"type": "string"}}}}, **problems(404)}


@router.get("/{sweep_id}/table.csv", response_class=Response, responses=_text("text/csv"))
def table_csv(ctx: Ctx, who: Reader, sweep_id: SweepId) -> Response:
    """The table as CSV."""
    return Response(as_csv(ctx.sweeps.table(who, sweep_id)[1]), media_type="text/csv; charset=utf-8")


@router.get("/{sweep_id}/table.md", response_class=Response, responses=_text("text/markdown"))
def table_markdown(ctx: Ctx, who: Reader, sweep_id: SweepId) -> Response:
    """The table as Markdown, with the columns that people look at."""
    return Response(as_markdown(ctx.sweeps.table(who, sweep_id)[1]), media_type="text/markdown; charset=utf-8")


@router.post("/{sweep_id}/cancel", status_code=202, responses=problems(404))
def cancel(ctx: Ctx, who: Writer, sweep_id: SweepId) -> SweepView:
    """End all jobs of a sweep that have not ended."""
    return _view(ctx.sweeps.cancel(who, sweep_id, ctx.dispatcher.cancel))


@router.delete("/{sweep_id}", status_code=204, responses=problems(404, 409))
def delete(ctx: Ctx, who: Writer, sweep_id: SweepId) -> None:
    """Remove a sweep that has ended, its jobs and their results. The uploads stay."""
    ctx.storage.with_room(lambda: ctx.sweeps.delete(who, sweep_id))
    ctx.deletions.clear_folder()


def _runs(request: SweepRequest, most: int) -> list[SweepJob]:
    """The jobs in the order of the table. Raises ServiceError 422."""
    configs = request.configs or {"default": SweepOptions()}
    count = len(request.logs) * len(configs) * len(request.seeds)
    if count > most:
        raise ServiceError(413, "runs", f"the sweep has {count} runs; at most {most} jobs may wait")
    for name, values in (("logs", request.logs), ("seeds", request.seeds)):
        if len(set(values)) < len(values):
            raise ServiceError(422, "invalid", f"{name}: one is named twice")
    common = {} if request.run is None else request.run.model_dump(exclude_unset=True)
    found = []
    for log in request.logs:
        for label, options in configs.items():
            merged = _merged(common, options.model_dump(exclude_unset=True))
            if merged.get("config") is not None:
                merged["config"] = config_schema.check(merged["config"])
            for seed in request.seeds:
                job = checked(JobRequest, {**merged, "log": log, "seed": seed})
                found.append(SweepJob(plain(job.model_dump()), label, seed))
    return found


def _merged(common: Config, changes: Config) -> Config:
    both = {key: common[key] for key in common.keys() & changes.keys() if isinstance(common[key], dict)}
    tables = {key: _merged(table, changes[key]) for key, table in both.items() if isinstance(changes[key], dict)}
    return {**common, **changes, **tables}


def _view(state: SweepState) -> SweepView:
    row = state.row
    return SweepView(
        id=row.id,
        name=row.name,
        created=known_moment(row.created),
        jobs=len(row.runs),
        states=state.states,
        ended=state.has_ended,
    )
