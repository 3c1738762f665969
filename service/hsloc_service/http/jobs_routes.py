"""Jobs, and what happens to one as server-sent events with a cursor."""

from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Body, Header, Path, Query, Response
from fastapi.responses import StreamingResponse

from hsloc.options import OPTIONS
from hsloc_service import config_schema as options
from hsloc_service.db.tables import ENDED
from hsloc_service.errors import busy
from hsloc_service.http.context import Context, Ctx, Reader, Writer, problems
from hsloc_service.http.schemas import (
    DeliveryList,
    JobDescription,
    JobList,
    JobRequest,
    JobView,
    QueueView,
    RerunRequest,
    State,
    Verdict,
    checked,
)
from hsloc_service.http.validation import KEY_PATTERN, NUMBER_PATTERN, UUID_PATTERN
from hsloc_service.http.views import brief_view, delivery_view, job_view
from hsloc_service.jobs.leases import place_in_queue
from hsloc_service.jobs.repository import JobFilter, JobOrder
from hsloc_service.stored_request import plain

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from starlette.types import Receive, Scope, Send

    from hsloc_service.auth import Principal

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])
JobId = Annotated[str, Path(pattern=UUID_PATTERN, description="id of a job")]
Key = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=200,
        pattern=KEY_PATTERN,
        description="a text that you choose: the same request sent again with it makes no second job",
    ),
]

POLL_S = 0.4
HEARTBEAT_S = 10.0
"""A comment is sent so often, so that both sides notice a dead connection."""


@router.post("", status_code=201, responses={200: {"model": JobView}, **problems(404, 409, 413, 507)})
def submit(ctx: Ctx, who: Writer, response: Response, request: JobRequest, idempotency_key: Key = None) -> JobView:
    """Queue a job. The answer comes when the job is safe on the disk; 200 if it was there already (Idempotency-Key)."""
    if request.config is not None:
        request.config = options.check(request.config)
    job, created = ctx.jobs.submit(who, plain(request.model_dump()), idempotency_key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    if created:
        ctx.dispatcher.enqueue(job.id)
    else:
        response.status_code = 200
    return job_view(job)


@router.get("", responses=problems())
def list_jobs(
    ctx: Ctx,
    who: Reader,
    *,
    state: Annotated[State | None, Query()] = None,
    before: Annotated[int | None, Query(ge=1, le=2**62, description="`next` of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    offset: Annotated[int, Query(ge=0, le=2**31, description="how many to leave out; instead of `before`")] = 0,
    order: JobOrder = "newest",
    verdict: Annotated[Verdict | None, Query(description="verdict of the result")] = None,
    search: Annotated[
        str | None,
        Query(
            max_length=200, description="part of log's name, title, labels or notes, or the beginning of the job's id"
        ),
    ] = None,
    label: Annotated[str | None, Query(max_length=40, description="a label that the job has")] = None,
    sweep: Annotated[str | None, Query(pattern=UUID_PATTERN, description="the sweep that they are runs of")] = None,
    brief: Annotated[
        bool, Query(description="of each summary the key figures alone, and how many jobs there are")
    ] = False,
) -> JobList:
    """Your jobs, newest first. Page with `next` and `before`; in another order with `offset`."""
    wanted = JobFilter(state=state, verdict=verdict, search=search, label=label, order=order, sweep=sweep)
    rows = ctx.jobs.list(who, wanted, before=before, offset=offset, limit=limit)
    views = [brief_view(row) if brief else job_view(row) for row in rows]
    more = len(rows) == limit and order == "newest"
    total = ctx.jobs.count(who, wanted) if brief else None
    return JobList(jobs=views, next=rows[-1].seq if more else None, total=total)


@router.get("/{job_id}", responses=problems(404))
def get(ctx: Ctx, who: Reader, job_id: JobId) -> JobView:
    """One job; of one that waits, where it is in the queue."""
    row = ctx.jobs.get(who, job_id)
    view = job_view(row)
    if row.state != "queued":
        return view
    ahead, wait_s = place_in_queue(ctx.database, row)
    return view.model_copy(update={"queue": QueueView(ahead=ahead, wait_s=wait_s)})


@router.patch("/{job_id}", responses=problems(404))
def describe(ctx: Ctx, who: Writer, job_id: JobId, description: JobDescription) -> JobView:
    """Set title, labels or notes of a job."""
    return job_view(ctx.jobs.describe(who, job_id, description.model_dump(exclude_unset=True)))


@router.post("/{job_id}/cancel", status_code=202, responses=problems(404))
def cancel(ctx: Ctx, who: Writer, job_id: JobId) -> JobView:
    """End a job: `cancelling` until its processes are dead, then `cancelled`. One that has ended stays as it is."""
    job = ctx.jobs.cancel(who, job_id)
    ctx.dispatcher.cancel(job.id)
    return job_view(job)


@router.post("/{job_id}/rerun", status_code=201, responses=problems(404, 409, 413, 507))
def rerun(
    ctx: Ctx,
    who: Writer,
    response: Response,
    job_id: JobId,
    changes: Annotated[RerunRequest | None, Body()] = None,
) -> JobView:
    """The same job again, with the same seed, but for what the body changes."""
    changed: dict[str, Any] = {} if changes is None else changes.model_dump(exclude_unset=True)
    if changed.get("config") is not None:
        changed["config"] = options.check(changed["config"])
    for option in OPTIONS:  # null leaves what cannot be null as it was
        if option.default is not None and changed.get(option.name, ...) is None:
            del changed[option.name]
    old = ctx.jobs.get(who, job_id)
    if changed.get("read") is not None:
        changed["read"] = {**(old.request.get("read") or {}), **changed["read"]}
    job = ctx.jobs.rerun(who, job_id, plain(checked(JobRequest, {**old.request, **changed}).model_dump()))
    ctx.dispatcher.enqueue(job.id)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job_view(job)


@router.delete("/{job_id}", status_code=204, responses=problems(404, 409))
def delete(ctx: Ctx, who: Writer, job_id: JobId) -> None:
    """Remove a job that has ended, and its results. The upload stays.

    Results in an object store are unreachable at once, and removed within a minute, or when the store is there again.
    """
    ctx.storage.with_room(lambda: ctx.jobs.delete(who, job_id))
    ctx.deletions.clear_folder()


@router.get("/{job_id}/webhooks", responses=problems(404))
def webhooks(ctx: Ctx, who: Reader, job_id: JobId) -> DeliveryList:
    """The webhooks of a job, and what became of them."""
    return DeliveryList(deliveries=[delivery_view(row) for row in ctx.jobs.deliveries(who, job_id)])


@router.get(
    "/{job_id}/events",
    response_class=StreamingResponse,
    responses={
        200: {"description": "events `state` and `progress`", "content": {"text/event-stream": {"schema": {}}}},
        **problems(404),
    },
)
async def events(
    ctx: Ctx,
    who: Reader,
    job_id: JobId,
    after: Annotated[int, Query(ge=0, le=2**62, description="id of the last event that you saw")] = 0,
    last_event_id: Annotated[str | None, Header(pattern=NUMBER_PATTERN)] = None,
    follow: Annotated[bool, Query(description="wait for more until the job has ended")] = True,
) -> StreamingResponse:
    """Events after the cursor (`after`, or Last-Event-ID), then those that come, until the job has ended."""
    await to_thread.run_sync(ctx.jobs.get, who, job_id)  # 404 before the stream begins
    if ctx.streams[who.tenant] >= ctx.settings.max_streams:
        raise busy("too many event streams at the same time", 5.0)
    cursor = int(last_event_id) if last_event_id is not None else after
    ctx.streams[who.tenant] += 1
    return _Counted(_stream(ctx, who, job_id, cursor, follow), lambda: ctx.streams.subtract([who.tenant]))


class _Counted(StreamingResponse):
    """Counted from the moment it is granted: many that come at once would all be let in before the first has begun."""

    def __init__(self, content: AsyncIterator[str], ended: Callable[[], None]) -> None:
        # nginx gathers answers into buffers of its own, unless it is asked not to.
        super().__init__(content, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})
        self._ended = ended

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._ended()


async def _stream(ctx: Context, who: Principal, job_id: str, cursor: int, follow: bool) -> AsyncIterator[str]:
    spoke = time.monotonic()
    yield "retry: 2000\n\n"
    while True:
        job, rows = await to_thread.run_sync(ctx.jobs.events, who, job_id, cursor)
        for row in rows:
            cursor = row.id
            data = json.dumps({"at": row.at, **row.data}, separators=(",", ":"))
            yield f"id: {row.id}\nevent: {row.kind}\ndata: {data}\n\n"
        now = time.monotonic()
        if rows:
            spoke = now
        elif not follow or job.state in ENDED or ctx.stopping.is_set():
            return
        elif now - spoke > HEARTBEAT_S:
            spoke = now
            yield ": still here\n\n"
        if not rows:
            await asyncio.sleep(POLL_S)
