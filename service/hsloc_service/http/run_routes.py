"""Everything in one request, for people with curl: `curl -F log=@run.mcap …/v1/run`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.concurrency import run_in_threadpool

from hsloc.options import BY_NAME
from hsloc_service import config_schema as options
from hsloc_service.errors import ServiceError
from hsloc_service.http.context import Context, Ctx, Writer, problems
from hsloc_service.http.schemas import ALIGNED, MAX_LOGS, JobRequest, JobView, RunRequest, checked
from hsloc_service.http.validation import no_json
from hsloc_service.http.views import job_view
from hsloc_service.stored_request import MAPS, UPLOADS, plain

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from hsloc_service.auth import Principal
    from hsloc_service.db.tables import FileRow

router = APIRouter(prefix="/v1", tags=["jobs"])
IMAGES = {name: f"{name}_image" for name in MAPS}
"""By the field of a map's YAML that of its image."""
FILES = ("log", *IMAGES, *IMAGES.values(), *UPLOADS)
FIELD_BYTES = 64 << 10
HEADER_BYTES = 8 << 10
_FILE = {"type": "string", "contentMediaType": "application/octet-stream", "minLength": 1}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["log"],
                    "properties": {
                        "log": {**_FILE, "description": "the log; given several times, the parts of one run"},
                        "map": {**_FILE, "description": "the map's YAML"},
                        "map_image": {**_FILE, "description": "the map's image"},
                        "align_to": {**_FILE, "description": "the YAML of a floor plan, or of another map"},
                        "align_to_image": {**_FILE, "description": "the plan's image"},
                        **{name: {**_FILE, "description": BY_NAME[name].http} for name in UPLOADS},
                        "request": {"$ref": "#/components/schemas/RunRequest"},
                    },
                    "additionalProperties": False,
                    "dependentRequired": {
                        one: [other] for pair in IMAGES.items() for one, other in (pair, reversed(pair))
                    },
                    "if": {"required": ["align_to"]},
                    "then": {"properties": {"request": {"properties": ALIGNED}}},
                }
            }
        },
    }
}


@router.post("/run", status_code=201, openapi_extra=_BODY, responses=problems(409, 413, 415, 507))
async def run(request: Request, response: Response, ctx: Ctx, who: Writer) -> JobView:
    """Upload a log (and a map) and queue a job, in one request. What was uploaded goes if the job cannot be queued."""
    parts = _Parts(request)
    files: dict[str, list[str]] = {}
    text = b"{}"
    try:
        async for name, label in parts.each():
            if name in FILES and (name not in files or (name == "log" and len(files["log"]) < MAX_LOGS)):
                row = await to_thread.run_sync(ctx.files.create, who, label or name, None)
                files.setdefault(name, []).append(row.id)
                await _receive(ctx, who, row, parts)
            elif name == "request":
                text = await parts.text()
            else:
                raise ServiceError(422, "invalid", f"unknown or repeated field {name[:60]!r}")
        wanted = _request(text, files)
        if wanted.config is not None:
            wanted.config = await run_in_threadpool(options.check, wanted.config)
        job, _ = await to_thread.run_sync(ctx.jobs.submit, who, plain(wanted.model_dump()))
    except BaseException:
        for file_id in (each for idents in files.values() for each in idents):
            ctx.receiver.forget(file_id)
            await to_thread.run_sync(ctx.files.delete, who, file_id)
        raise
    ctx.dispatcher.enqueue(job.id)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job_view(job)


async def _receive(ctx: Context, who: Principal, row: FileRow, parts: _Parts) -> None:
    with ctx.receiver.writer(row.id):
        await ctx.receiver.append(who, row.id, 0, parts.body())
        await ctx.receiver.finish(row.id)


def _request(text: bytes, files: dict[str, list[str]]) -> JobRequest:
    if "log" not in files:
        raise ServiceError(422, "invalid", "the field `log` is missing")
    for name, image in IMAGES.items():
        if (name in files) != (image in files):
            raise ServiceError(422, "invalid", f"a map is two files: `{name}` (YAML) and `{image}`")
    try:
        found = json.loads(text)
    except json.JSONDecodeError as error:
        raise ServiceError(422, "invalid", f"request: {no_json(error.msg, error.pos)}") from error
    except (ValueError, RecursionError) as error:
        raise ServiceError(422, "invalid", "request: is no valid JSON in UTF-8") from error
    values, logs = checked(RunRequest, found).model_dump(exclude_unset=True), files["log"]
    values |= {"log": logs[0]} if len(logs) == 1 else {"logs": logs}
    values |= {
        name: {"yaml": files[name][0], "image": files[image][0]} for name, image in IMAGES.items() if name in files
    }
    values |= {name: files[name][0] for name in UPLOADS if name in files}
    return checked(JobRequest, values)


class _Parts:
    """The parts of a multipart body, one after the other, never held in memory or a temporary file."""

    def __init__(self, request: Request) -> None:
        kind, parameters = parse_options_header(request.headers.get("content-type"))
        if kind != b"multipart/form-data" or b"boundary" not in parameters:
            raise ServiceError(415, "multipart", "Content-Type must be multipart/form-data with a boundary")
        self._stream = request.stream()
        self._found: list[tuple[str, Any]] = []
        self._header = [b"", b""]
        self._headers: dict[bytes, bytes] = {}
        self._over = False
        self._parser = MultipartParser(
            parameters[b"boundary"],
            {
                "on_header_field": lambda data, a, b: self._more(0, data[a:b]),
                "on_header_value": lambda data, a, b: self._more(1, data[a:b]),
                "on_header_end": self._header_end,
                "on_headers_finished": self._begin,
                "on_part_data": lambda data, a, b: self._found.append(("data", bytes(data[a:b]))),
                "on_part_end": lambda: self._found.append(("end", None)),
                "on_end": self._finish,
            },
        )

    def _more(self, which: int, data: bytes) -> None:
        self._header[which] += data
        if len(self._header[which]) > HEADER_BYTES or len(self._headers) > 16:
            raise ServiceError(400, "multipart", "the headers of a part are too long")

    def _header_end(self) -> None:
        self._headers[self._header[0].lower()] = self._header[1]
        self._header = [b"", b""]

    def _begin(self) -> None:
        _, parameters = parse_options_header(self._headers.get(b"content-disposition", b""))
        name = parameters.get(b"name", b"").decode("utf-8", "replace")
        label = parameters.get(b"filename", b"").decode("utf-8", "replace")
        self._headers = {}
        self._found.append(("begin", (name, label)))

    def _finish(self) -> None:
        self._over = True

    async def _next(self) -> tuple[str, Any] | None:
        while not self._found:
            try:
                block = await anext(self._stream)
            except StopAsyncIteration:
                if not self._over:
                    raise ServiceError(400, "multipart", "the body ends in the middle") from None
                return None
            try:
                self._parser.write(block)
            except ValueError as error:
                raise ServiceError(400, "multipart", f"not multipart/form-data: {error}") from error
        return self._found.pop(0)

    async def each(self) -> AsyncIterator[tuple[str, str]]:
        """Name and file name of each part; its body is to be read before the next."""
        while (found := await self._next()) is not None:
            if found[0] == "begin":
                yield found[1]

    async def body(self) -> AsyncIterator[bytes]:
        """The body of the part."""
        while (found := await self._next()) is not None and found[0] == "data":
            yield found[1]

    async def text(self) -> bytes:
        """The body of a small part."""
        text = b""
        async for block in self.body():
            text += block
            if len(text) > FIELD_BYTES:
                raise ServiceError(413, "too_large", f"a field may have {FIELD_BYTES} bytes")
        return text
