"""Resumable uploads: tus 1.0.0 with creation, creation-with-upload, checksum, expiration and termination.

The file that comes of it is the same as by `/v1/files`, with the same id.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
from email.utils import formatdate
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Depends, Header, Request, Response

from service.errors import ServiceError
from service.http import metrics
from service.http.context import Ctx, Reader, Writer, problems
from service.http.files_routes import FileId
from service.tables import FileRow

VERSION = "1.0.0"
EXTENSIONS = "creation,creation-with-upload,checksum,expiration,termination"
ALGORITHMS = ("sha1", "sha256", "md5")
OFFSET_TYPE = "application/offset+octet-stream"

Resumable = Annotated[str | None, Header(alias="Tus-Resumable", examples=[VERSION])]
Number = Annotated[str | None, Header(pattern=r"^[0-9]{1,18}$", examples=["0"])]
Text = Annotated[str | None, Header(max_length=4096)]
_BODY = {"content": {OFFSET_TYPE: {"schema": {"type": "string", "format": "binary"}}}}


def _version(tus_resumable: Resumable = None) -> None:
    if tus_resumable != VERSION:
        headers = {"Tus-Version": VERSION, "Tus-Resumable": VERSION}
        raise ServiceError(412, "tus_version", f"Tus-Resumable must be {VERSION}", headers)


router = APIRouter(prefix="/v1/tus", tags=["tus"])
_checked = [Depends(_version)]


@router.options("", status_code=204, response_class=Response, responses=problems())
@router.options("/{file_id}", status_code=204, responses=problems(), include_in_schema=False)
def options(ctx: Ctx, who: Reader) -> Response:
    """What this server can do."""
    del who
    return Response(
        status_code=204,
        headers={
            "Tus-Resumable": VERSION,
            "Tus-Version": VERSION,
            "Tus-Extension": EXTENSIONS,
            "Tus-Max-Size": str(ctx.settings.max_upload_bytes),
            "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
        },
    )


@router.post(
    "",
    status_code=201,
    response_class=Response,
    dependencies=_checked,
    responses=problems(409, 412, 413, 415, 460, 507),
    openapi_extra={"requestBody": {"required": False, **_BODY}},
)
async def create(
    request: Request,
    ctx: Ctx,
    who: Writer,
    upload_length: Number = None,
    upload_metadata: Text = None,
    upload_checksum: Text = None,
) -> Response:
    """Begin an upload; its address is in Location. The metadata `filename` is its label."""
    if upload_length is None:
        raise ServiceError(400, "tus_length", "Upload-Length is missing")
    name = metadata(upload_metadata).get("filename", "log")
    checksum = parse_checksum(upload_checksum)
    size = int(upload_length)
    row = await to_thread.run_sync(ctx.files.create, who, name, size)
    content = request.headers.get("content-type") == OFFSET_TYPE
    if content or size == 0:
        with ctx.receiver.writer(row.id):
            row = await ctx.receiver.append(who, row.id, 0, request.stream(), checksum)
    headers = _headers(row)
    return Response(status_code=201, headers={**headers, "Location": f"/v1/tus/{row.id}"})


@router.head("/{file_id}", response_class=Response, dependencies=_checked, responses=problems(404, 412))
def head(ctx: Ctx, who: Reader, file_id: FileId) -> Response:
    """How much is safe."""
    row = ctx.files.get(who, file_id)
    headers = _headers(row)
    if row.size is not None:
        headers["Upload-Length"] = str(row.size)
    return Response(status_code=200, headers=headers)


@router.patch(
    "/{file_id}",
    status_code=204,
    response_class=Response,
    dependencies=_checked,
    responses=problems(404, 409, 412, 413, 415, 423, 460, 507),
    openapi_extra={"requestBody": {"required": True, **_BODY}},
)
async def patch(
    request: Request,
    ctx: Ctx,
    who: Writer,
    file_id: FileId,
    upload_offset: Number = None,
    upload_checksum: Text = None,
) -> Response:
    """Append the body at Upload-Offset."""
    if request.headers.get("content-type") != OFFSET_TYPE:
        raise ServiceError(415, "tus_type", f"Content-Type must be {OFFSET_TYPE}")
    if upload_offset is None:
        raise ServiceError(400, "tus_offset", "Upload-Offset is missing")
    checksum = parse_checksum(upload_checksum)
    with ctx.receiver.writer(file_id):
        row = await ctx.receiver.append(who, file_id, int(upload_offset), request.stream(), checksum)
    if row.state == "complete":
        metrics.UPLOADED.inc(row.size or 0)
    return Response(status_code=204, headers=_headers(row))


@router.delete("/{file_id}", status_code=204, dependencies=_checked, responses=problems(404, 409, 412, 423))
async def terminate(ctx: Ctx, who: Writer, file_id: FileId) -> Response:
    """Give an upload up; the address is gone afterwards."""
    await to_thread.run_sync(ctx.files.get, who, file_id)
    with ctx.receiver.writer(file_id):
        await to_thread.run_sync(ctx.storage.with_room, lambda: ctx.files.delete(who, file_id))
        ctx.receiver.forget(file_id)
    return Response(status_code=204, headers={"Tus-Resumable": VERSION})


def metadata(text: str | None) -> dict[str, str]:
    """Upload-Metadata: pairs of a key and base64, separated by commas. Raises ServiceError 400."""
    found: dict[str, str] = {}
    for pair in (text or "").split(","):
        key, _, value = pair.strip().partition(" ")
        if not key:
            continue
        try:
            found[key] = base64.b64decode(value, validate=True).decode("utf-8")
        except (binascii.Error, ValueError) as error:
            raise ServiceError(400, "tus_metadata", f"Upload-Metadata: {key[:60]!r} is not base64 of UTF-8") from error
    return found


def parse_checksum(text: str | None) -> tuple[str, bytes] | None:
    """Upload-Checksum: an algorithm and base64. Raises ServiceError 400."""
    if text is None:
        return None
    algorithm, _, value = text.partition(" ")
    try:
        digest = base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        digest = b""
    if algorithm not in ALGORITHMS or len(digest) != hashlib.new(algorithm).digest_size:
        raise ServiceError(400, "tus_checksum", f"Upload-Checksum must be one of {', '.join(ALGORITHMS)}, then base64")
    return algorithm, digest


def _headers(row: FileRow) -> dict[str, str]:
    headers = {"Tus-Resumable": VERSION, "Upload-Offset": str(row.received), "Cache-Control": "no-store"}
    if row.expires is not None:
        headers["Upload-Expires"] = formatdate(row.expires, usegmt=True)
    return headers
