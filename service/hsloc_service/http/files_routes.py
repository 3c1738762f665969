"""Uploads by one request: the body is the file."""

from __future__ import annotations

import base64
import binascii
import re
from typing import TYPE_CHECKING, Annotated

from anyio import to_thread
from fastapi import APIRouter, Header, Path, Query, Request, Response

from hsloc_service.auth import Principal
from hsloc_service.db.tables import FileRow
from hsloc_service.errors import ServiceError
from hsloc_service.http import metrics
from hsloc_service.http.context import Context, Ctx, Reader, Writer, problems
from hsloc_service.http.schemas import FileList, FileView
from hsloc_service.http.validation import UUID_PATTERN
from hsloc_service.http.views import file_view
from hsloc_service.uploads.repository import sample_log

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

router = APIRouter(prefix="/v1", tags=["files"])
FileId = Annotated[str, Path(pattern=UUID_PATTERN, description="id of an upload")]
Name = Annotated[
    str, Query(max_length=255, description="what you call it; a label, never a path", examples=["run.mcap"])
]
Digest = Annotated[
    str | None,
    Header(description="`sha-256=:<base64>:` (RFC 9530); the upload is refused if it does not fit", max_length=200),
]
_BODY = {
    "requestBody": {
        "required": True,  # on the wire, no body and a body of no bytes are one thing: an empty file, which is refused
        "description": "the bytes of the file, at least one; any size, streamed to the disk",
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary", "minLength": 1}}},
    }
}


@router.post("/files", status_code=201, openapi_extra=_BODY, responses=problems(409, 413, 460, 507))
async def upload(request: Request, ctx: Ctx, who: Writer, name: Name = "log", repr_digest: Digest = None) -> FileView:
    """Upload a log, or a file of a map, as the raw body."""
    wanted = parse_digest(repr_digest)
    row = await to_thread.run_sync(ctx.files.create, who, name, _length(request))
    return file_view(await _take(request.stream(), ctx, who, row, wanted))


@router.post("/sample-log", status_code=201, responses=problems(413, 507))
async def sample(ctx: Ctx, who: Writer) -> FileView:
    """A log to try the service with, as an upload of yours: a minute of a simulated office, with its map."""
    path = await to_thread.run_sync(sample_log, ctx.storage)
    row = await to_thread.run_sync(ctx.files.create, who, "office.mcap", path.stat().st_size)

    async def body() -> AsyncIterator[bytes]:
        yield await to_thread.run_sync(path.read_bytes)

    return file_view(await _take(body(), ctx, who, row, None))


@router.put("/files/{file_id}", status_code=201, openapi_extra=_BODY, responses=problems(404, 409, 413, 423, 460, 507))
async def put(
    request: Request,
    response: Response,
    ctx: Ctx,
    who: Writer,
    file_id: FileId,
    name: Name = "log",
    repr_digest: Digest = None,
) -> FileView:
    """Upload under an id that you choose (a UUID), so that the request can be sent again.

    A finished upload stays what it is: with a `Repr-Digest` that fits the answer is 200, else 409. An unfinished one
    starts again.
    """
    wanted = parse_digest(repr_digest)
    try:
        row = await to_thread.run_sync(ctx.files.get, who, file_id)
    except ServiceError:
        row = await to_thread.run_sync(ctx.files.create, who, name, _length(request), file_id)
    else:
        if row.state == "complete" and wanted is not None and wanted.hex() == row.sha256:
            response.status_code = 200
            return file_view(row)
        with ctx.receiver.writer(file_id):
            await to_thread.run_sync(ctx.files.restart, who, file_id, _length(request))
        row = await to_thread.run_sync(ctx.files.get, who, file_id)
    return file_view(await _take(request.stream(), ctx, who, row, wanted))


@router.get("/files", responses=problems(404))
def list_files(
    ctx: Ctx,
    who: Reader,
    before: Annotated[str | None, Query(pattern=UUID_PATTERN, description="`next` of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> FileList:
    """Your uploads, newest first."""
    rows = ctx.files.list(who, limit, before)
    return FileList(files=[file_view(row) for row in rows], next=rows[-1].id if len(rows) == limit else None)


@router.get("/files/{file_id}", responses=problems(404))
def get(ctx: Ctx, who: Reader, file_id: FileId) -> FileView:
    """One upload."""
    return file_view(ctx.files.get(who, file_id))


@router.delete("/files/{file_id}", status_code=204, responses=problems(404, 409, 423))
async def delete(ctx: Ctx, who: Writer, file_id: FileId) -> None:
    """Remove an upload; refused while an active job needs it."""
    await to_thread.run_sync(ctx.files.get, who, file_id)
    with ctx.receiver.writer(file_id):
        await to_thread.run_sync(ctx.storage.with_room, lambda: ctx.files.delete(who, file_id))
        ctx.receiver.forget(file_id)


def parse_digest(text: str | None) -> bytes | None:
    """The SHA-256 of a Repr-Digest; other algorithms are left alone, as RFC 9530 says."""
    if text is None:
        return None
    found = re.search(r"(?:^|,)\s*sha-256=:([A-Za-z0-9+/=]+):", text)
    if found is None:
        return None
    try:
        digest = base64.b64decode(found[1], validate=True)
    except binascii.Error:
        digest = b""
    if len(digest) != 32:
        raise ServiceError(400, "digest", "Repr-Digest: sha-256 must be 32 bytes in base64 between colons")
    return digest


async def _take(
    body: AsyncIterator[bytes], ctx: Context, who: Principal, row: FileRow, wanted: bytes | None
) -> FileRow:
    """The whole body; an upload by one request is whole or gone."""
    with ctx.receiver.writer(row.id):
        try:
            checksum = None if wanted is None else ("sha256", wanted)
            row = await ctx.receiver.append(who, row.id, 0, body, checksum)
            if row.state != "complete":
                if row.size is not None:
                    raise ServiceError(400, "short", f"{row.received} of {row.size} bytes came")
                row = await ctx.receiver.finish(row.id)
        except BaseException:
            ctx.receiver.forget(row.id)
            await to_thread.run_sync(ctx.files.delete, who, row.id)
            raise
    metrics.UPLOADED.inc(row.size or 0)
    return row


def _length(request: Request) -> int | None:
    text = request.headers.get("content-length")
    return int(text) if text is not None and text.isdecimal() else None
