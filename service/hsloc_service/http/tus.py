"""Resumable uploads: tus 1.0.0 with creation, creation-with-upload, checksum, expiration and termination.

The file that comes of it is the same as by `/v1/files`, with the same id.
"""

from __future__ import annotations

import base64
import re
from email.utils import formatdate
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Header, Request, Response

from hsloc_service.db.tables import FileRow
from hsloc_service.errors import ServiceError
from hsloc_service.http import metrics
from hsloc_service.http.context import Ctx, Reader, Writer, problems
from hsloc_service.http.files_routes import FileId
from hsloc_service.http.validation import NUMBER_PATTERN

VERSION = "1.0.0"
EXTENSIONS = "creation,creation-with-upload,checksum,expiration,termination"
ALGORITHMS = ("sha1", "sha256", "md5")
OFFSET_TYPE = "application/offset+octet-stream"

_BASE64 = "(?:[A-Za-z0-9+/]{4})*(?:[A-Za-z0-9+/]{2}==|[A-Za-z0-9+/]{3}=)?"
_PAIR = rf"[!-+\--~]+(?: {_BASE64})?"
METADATA = rf"^(?:{_PAIR}(?:, ?{_PAIR})*)?$"
"""Upload-Metadata: pairs of a key and base64, separated by commas."""
CHECKSUMS = ("^sha1 [A-Za-z0-9+/]{27}=$", "^sha256 [A-Za-z0-9+/]{43}=$", "^md5 [A-Za-z0-9+/]{22}==$")

# The protocol has answers of its own for these (412, 400), so they are described here and checked by hand.
Resumable = Annotated[str | None, Header(alias="Tus-Resumable", include_in_schema=False)]
Number = Annotated[str | None, Header(pattern=NUMBER_PATTERN, include_in_schema=False)]
Text = Annotated[str | None, Header(max_length=4096, include_in_schema=False)]
_NUMBER = {"type": "string", "pattern": NUMBER_PATTERN}
_SIZE = {"type": "string", "pattern": "^[1-9][0-9]{0,17}$"}
_HEADERS: dict[str, dict[str, Any]] = {
    "Tus-Resumable": {"required": True, "example": VERSION, "schema": {"type": "string", "enum": [VERSION]}},
    "Upload-Length": {"required": True, "example": "1929453", "schema": _SIZE},
    "Upload-Offset": {"required": True, "example": "0", "schema": _NUMBER},
    "Upload-Metadata": {
        "required": False,
        "example": "filename cnVuLm1jYXA=",
        "schema": {"type": "string", "pattern": METADATA, "maxLength": 4096},
    },
    "Upload-Checksum": {
        "required": False,
        "example": "sha1 2jmj7l5rSw0yVb/vlWAYkK/YBwk=",
        "schema": {"anyOf": [{"type": "string", "pattern": each} for each in CHECKSUMS]},
    },
}


def _takes(*names: str, body: bool | None = None) -> dict[str, Any]:
    """What the OpenAPI says of a route: its headers, and its body (None: it has none; else whether it must)."""
    headers = [{"name": name, "in": "header", **_HEADERS[name]} for name in ("Tus-Resumable", *names)]
    described: dict[str, Any] = {"parameters": headers}
    if body is not None:
        content = {OFFSET_TYPE: {"schema": {"type": "string", "format": "binary"}}}
        described["requestBody"] = {"required": body, "content": content}
    return described


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
    openapi_extra=_takes("Upload-Length", "Upload-Metadata", "Upload-Checksum", body=False),
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
    if content:
        with ctx.receiver.writer(row.id):
            row = await ctx.receiver.append(who, row.id, 0, request.stream(), checksum)
    headers = _headers(row)
    return Response(status_code=201, headers={**headers, "Location": f"/v1/tus/{row.id}"})


@router.head(
    "/{file_id}",
    response_class=Response,
    dependencies=_checked,
    responses=problems(404, 412),
    openapi_extra=_takes(),
)
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
    openapi_extra=_takes("Upload-Offset", "Upload-Checksum", body=True),
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


@router.delete(
    "/{file_id}",
    status_code=204,
    dependencies=_checked,
    responses=problems(404, 409, 412, 423),
    openapi_extra=_takes(),
)
async def terminate(ctx: Ctx, who: Writer, file_id: FileId) -> Response:
    """Give an upload up; the address is gone afterwards."""
    await to_thread.run_sync(ctx.files.get, who, file_id)
    with ctx.receiver.writer(file_id):
        await to_thread.run_sync(ctx.storage.with_room, lambda: ctx.files.delete(who, file_id))
        ctx.receiver.forget(file_id)
    return Response(status_code=204, headers={"Tus-Resumable": VERSION})


def metadata(text: str | None) -> dict[str, str]:
    """Upload-Metadata as texts; what is not UTF-8 is replaced, for labels alone are read. Raises ServiceError 400."""
    if not text:
        return {}
    if re.fullmatch(METADATA, text) is None:
        raise ServiceError(400, "tus_metadata", "Upload-Metadata must be pairs `key base64`, separated by commas")
    pairs = (pair.strip().partition(" ") for pair in text.split(","))
    return {key: base64.b64decode(value, validate=True).decode("utf-8", "replace") for key, _, value in pairs}


def parse_checksum(text: str | None) -> tuple[str, bytes] | None:
    """Upload-Checksum: an algorithm and base64. Raises ServiceError 400."""
    if text is None:
        return None
    if not any(re.fullmatch(each, text) for each in CHECKSUMS):
        raise ServiceError(400, "tus_checksum", f"Upload-Checksum must be one of {', '.join(ALGORITHMS)}, then base64")
    algorithm, _, value = text.partition(" ")
    return algorithm, base64.b64decode(value, validate=True)


def _headers(row: FileRow) -> dict[str, str]:
    headers = {"Tus-Resumable": VERSION, "Upload-Offset": str(row.received), "Cache-Control": "no-store"}
    if row.expires is not None:
        headers["Upload-Expires"] = formatdate(row.expires, usegmt=True)
    return headers
