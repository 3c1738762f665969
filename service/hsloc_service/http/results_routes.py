"""Results: named files of a manifest, never paths."""

from __future__ import annotations

import io
import re
import zipfile
from typing import TYPE_CHECKING, Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Header, HTTPException, Path, Query, Request
from fastapi.responses import FileResponse, Response, StreamingResponse

from hsloc_service.errors import BrokenAnswer, ServiceError, StoreError, not_found
from hsloc_service.http.context import Context, Ctx, Reader, problems
from hsloc_service.http.jobs_routes import JobId
from hsloc_service.http.schemas import AssetView, Manifest
from hsloc_service.http.validation import ASSET_PATTERN
from hsloc_service.results.store import BLOCK, MEDIA_TYPES
from hsloc_service.storage import safe_name

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Sequence

    from hsloc_service.auth import Principal
    from hsloc_service.db.tables import AssetRow, JobRow
    from hsloc_service.results.store import AssetReader

router = APIRouter(prefix="/v1/jobs", tags=["results"])
AssetName = Annotated[str, Path(pattern=ASSET_PATTERN, examples=["trajectory.tum"])]
SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)
"""A report may run its own script, but in an origin of its own and without the network."""
_OCTETS = "application/octet-stream"
"""First among the kinds: generated clients take the first that they know, and must not parse the bytes."""
_KINDS = (_OCTETS, *sorted({kind.partition(";")[0] for kind in MEDIA_TYPES.values()} - {_OCTETS}))
_BYTES: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
_BINARY: dict[str, Any] = {"description": "the bytes", "content": dict.fromkeys(_KINDS, _BYTES)}
_ZIP: dict[str, Any] = {"description": "the archive", "content": dict.fromkeys((_OCTETS, "application/zip"), _BYTES)}


@router.get("/{job_id}/results", responses=problems(404, 409))
def manifest(ctx: Ctx, who: Reader, job_id: JobId) -> Manifest:
    """Names, sizes and SHA-256 of all files of the results."""
    _, rows = assets_of(ctx, who, job_id)
    return manifest_of(job_id, rows, f"/v1/jobs/{job_id}/results")


def manifest_of(job_id: str, rows: Sequence[AssetRow], base: str) -> Manifest:
    """The manifest, with addresses below `base`."""
    views = [
        AssetView(name=r.name, size=r.size, sha256=r.sha256, media_type=r.media_type, href=f"{base}/{r.name}")
        for r in rows
    ]
    return Manifest(job=job_id, assets=views)


@router.get(
    "/{job_id}/results.zip",
    response_class=StreamingResponse,
    responses={
        200: _ZIP,
        **problems(404, 409),
    },
)
async def archive(ctx: Ctx, who: Reader, job_id: JobId) -> StreamingResponse:
    """All files of the results in one archive, not compressed."""
    job, rows = await to_thread.run_sync(assets_of, ctx, who, job_id)
    name = safe_name(job.log_name.rsplit(".", 1)[0], "results")
    headers = {"Content-Disposition": f'attachment; filename="{name}-results.zip"'}
    readers = await _open(ctx, job, rows, job_id)
    parts = _paced(ctx, _zip(readers, rows))
    return StreamingResponse(await _begun(parts, readers, job_id), media_type="application/zip", headers=headers)


@router.get(
    "/{job_id}/results/{name}",
    response_class=FileResponse,
    responses={
        200: _BINARY,
        206: {**_BINARY, "description": "the range that was asked for"},
        304: {"description": "you have it (If-None-Match)"},
        416: {"description": "there is no such range", "content": {"text/plain": {"schema": {"type": "string"}}}},
        **problems(404, 409),
    },
)
async def asset(
    request: Request,
    ctx: Ctx,
    who: Reader,
    job_id: JobId,
    name: AssetName,
    download: Annotated[bool, Query(description="as attachment")] = True,
    if_none_match: Annotated[str | None, Header(max_length=4096)] = None,
) -> Response:
    """One file; ranges, ETag (its SHA-256) and If-None-Match work."""
    job, rows = await to_thread.run_sync(assets_of, ctx, who, job_id)
    return await file_answer(request, ctx, job, rows, name, download=download, if_none_match=if_none_match)


async def file_answer(
    request: Request,
    ctx: Context,
    job: JobRow,
    rows: Sequence[AssetRow],
    name: str,
    *,
    download: bool,
    if_none_match: str | None,
) -> Response:
    """A file of the results, or what of it the request asks for."""
    row = next((row for row in rows if row.name == name), None)
    if row is None:
        raise not_found("asset", name)
    tag = f'"{row.sha256}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache", "Content-Security-Policy": SANDBOX}
    if if_none_match is not None and (tag in if_none_match or if_none_match.strip() == "*"):
        return Response(status_code=304, headers=headers)
    kind = "attachment" if download else "inline"
    headers |= {"Accept-Ranges": "bytes", "Content-Disposition": f'{kind}; filename="{row.name}"'}
    fits = request.headers.get("if-range") in (None, tag)
    span = parse_range(request.headers.get("range"), row.size) if fits else None
    if span is not None:
        headers["Content-Range"] = f"bytes {span.start}-{span.stop - 1}/{row.size}"
    status, wanted = (200, range(row.size)) if span is None else (206, span)
    headers["Content-Length"] = str(len(wanted))
    if request.scope.get("hsloc_head"):
        return Response(None, status, headers, row.media_type)
    readers = await _open(ctx, job, [row], name)
    parts = _paced(ctx, _blocks(readers[0], wanted))
    return StreamingResponse(await _begun(parts, readers, name), status, headers, row.media_type)


def parse_range(text: str | None, size: int) -> range | None:
    """The bytes that a Range header asks for; None for all of them: no header, several ranges, another unit.

    Raises HTTPException 416 where there is no such byte.
    """
    found = re.fullmatch(r"\s*bytes\s*=\s*(\d{0,18})\s*-\s*(\d{0,18})\s*", text or "")
    if found is None or found[1] == found[2] == "":
        return None
    if found[1] == "":
        start, stop = max(size - int(found[2]), 0), size
    else:
        start, stop = int(found[1]), size if found[2] == "" else min(int(found[2]) + 1, size)
        if found[2] != "" and int(found[2]) < start:
            return None
    if start >= stop:
        raise HTTPException(416, "there is no such range", {"Content-Range": f"bytes */{size}"})
    return range(start, stop)


def assets_of(ctx: Context, who: Principal, job_id: str) -> tuple[JobRow, Sequence[AssetRow]]:
    """A job that succeeded, and the manifest of its results. Raises ServiceError 404 and 409."""
    job, rows = ctx.jobs.assets(who, job_id)
    if job.state != "succeeded":
        raise ServiceError(409, "no_results", f"the job is {job.state}; only succeeded jobs have results")
    return job, rows


class _Sink(io.RawIOBase):
    """What was written since the last look."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        block = bytes(data)  # type: ignore[call-overload]
        self.parts.append(block)
        return len(block)

    def take(self) -> bytes:
        block = b"".join(self.parts)
        self.parts.clear()
        return block


async def _open(ctx: Context, job: JobRow, rows: Sequence[AssetRow], what: str) -> list[AssetReader]:
    """Readers of the assets: what is deleted from now on is still sent whole."""
    store = ctx.stores.of(job.store)
    readers: list[AssetReader] = []

    def open_all() -> None:
        readers.extend(store.open(job.folder or "", row.name) for row in rows)

    try:
        await to_thread.run_sync(open_all)
    except FileNotFoundError as error:
        _close(readers)
        raise not_found("results", what) from error
    return readers


def _close(readers: Sequence[AssetReader]) -> None:
    for reader in readers:
        reader.close()


def _zip(readers: Sequence[AssetReader], rows: Sequence[AssetRow]) -> Iterator[bytes]:
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED, allowZip64=True) as target:
        for reader, row in zip(readers, rows, strict=True):
            info = zipfile.ZipInfo(row.name)
            info.external_attr = 0o644 << 16
            with target.open(info, "w", force_zip64=row.size > 1 << 31) as entry:
                for block in _blocks(reader, range(row.size)):
                    entry.write(block)
                    yield sink.take()
    yield sink.take()


def _blocks(reader: AssetReader, span: range) -> Iterator[bytes]:
    """The bytes of a span, some at a time; one empty block for an empty file."""
    for start in range(span.start, max(span.stop, span.start + 1), BLOCK):
        yield reader.read(start, min(BLOCK, span.stop - start))


async def _paced(ctx: Context, blocks: Iterator[bytes]) -> AsyncIterator[bytes]:
    """The blocks, each waited for outside the event loop and not for ever."""
    while (block := await ctx.store_calls.run(lambda: next(blocks, None))) is not None:
        yield block


async def _begun(parts: AsyncIterator[bytes], readers: Sequence[AssetReader], what: str) -> AsyncIterator[bytes]:
    """The same parts, the first of which is there: a store that does not answer is an error before the answer begins.

    One that fails later breaks the connection off, so that the client sees that something is missing.
    """
    try:
        first = await anext(parts)
    except BaseException as error:
        _close(readers)
        if isinstance(error, FileNotFoundError):
            raise not_found("asset", what) from error
        raise

    async def all_parts() -> AsyncIterator[bytes]:
        try:
            yield first
            async for block in parts:
                yield block
        except (StoreError, OSError) as error:
            raise BrokenAnswer(f"{what}: {error}") from error
        finally:
            _close(readers)

    return all_parts()
