"""What happens to a job, as server-sent events with a cursor."""

from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Annotated

from anyio import to_thread
from fastapi import APIRouter, Header, Query
from fastapi.responses import StreamingResponse

from hsloc_service.db.tables import ENDED
from hsloc_service.errors import busy
from hsloc_service.http.context import Context, Ctx, Reader, problems
from hsloc_service.http.jobs_routes import JobId

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from starlette.types import Receive, Scope, Send

    from hsloc_service.auth import Principal

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])
POLL_S = 0.4
HEARTBEAT_S = 10.0
"""A comment is sent so often, so that both sides notice a dead connection."""


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
    last_event_id: Annotated[str | None, Header(pattern=r"^[0-9]{1,18}$")] = None,
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
