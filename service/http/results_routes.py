"""Results: named files of a manifest, never paths."""

from __future__ import annotations

import io
import zipfile
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Header, Path, Query
from fastapi.responses import FileResponse, Response, StreamingResponse

from service.errors import ServiceError, not_found
from service.http.context import Context, Ctx, Reader, problems
from service.http.jobs_routes import JobId
from service.http.schemas import AssetView, Manifest
from service.storage import MEDIA_TYPES, safe_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from service.principal import Principal
    from service.tables import AssetRow, JobRow

router = APIRouter(prefix="/v1/jobs", tags=["results"])
AssetName = Annotated[str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$", examples=["trajectory.tum"])]
SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)
"""A report may run its own script, but in an origin of its own and without the network."""
_KINDS = sorted({kind.partition(";")[0] for kind in MEDIA_TYPES.values()} | {"application/octet-stream"})
_BINARY: dict[str, Any] = {"description": "the bytes", "content": {kind: {"schema": {}} for kind in _KINDS}}


@router.get("/{job_id}/results", responses=problems(404, 409))
def manifest(ctx: Ctx, who: Reader, job_id: JobId) -> Manifest:
    """Names, sizes and SHA-256 of all files of the results."""
    _, rows = _assets(ctx, who, job_id)
    base = f"/v1/jobs/{job_id}/results"
    views = [
        AssetView(name=r.name, size=r.size, sha256=r.sha256, media_type=r.media_type, href=f"{base}/{r.name}")
        for r in rows
    ]
    return Manifest(job=job_id, assets=views)


@router.get(
    "/{job_id}/results.zip",
    response_class=StreamingResponse,
    responses={
        200: {"description": "the archive", "content": {"application/zip": {"schema": {"type": "string"}}}},
        **problems(404, 409),
    },
)
def archive(ctx: Ctx, who: Reader, job_id: JobId) -> StreamingResponse:
    """All files of the results in one archive, not compressed."""
    job, rows = _assets(ctx, who, job_id)
    name = safe_name(job.log_name.rsplit(".", 1)[0], "results")
    headers = {"Content-Disposition": f'attachment; filename="{name}-results.zip"'}
    return StreamingResponse(_zip(ctx, job, rows), media_type="application/zip", headers=headers)


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
def asset(
    ctx: Ctx,
    who: Reader,
    job_id: JobId,
    name: AssetName,
    download: Annotated[bool, Query(description="as attachment")] = True,
    if_none_match: Annotated[str | None, Header(max_length=4096)] = None,
) -> Response:
    """One file; ranges, ETag (its SHA-256) and If-None-Match work."""
    job, rows = _assets(ctx, who, job_id)
    row = next((row for row in rows if row.name == name), None)
    if row is None:
        raise not_found("asset", name)
    tag = f'"{row.sha256}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache", "Content-Security-Policy": SANDBOX}
    if if_none_match is not None and (tag in if_none_match or if_none_match.strip() == "*"):
        return Response(status_code=304, headers=headers)
    path = ctx.storage.open_path(job.folder or "", row.name)
    if not path.is_file():
        raise not_found("asset", name)
    return FileResponse(
        path,
        headers=headers,
        media_type=row.media_type,
        filename=row.name,
        content_disposition_type="attachment" if download else "inline",
    )


def _assets(ctx: Context, who: Principal, job_id: str) -> tuple[JobRow, Sequence[AssetRow]]:
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


def _zip(ctx: Context, job: JobRow, rows: Sequence[AssetRow]) -> Iterator[bytes]:
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED, allowZip64=True) as target:
        for row in rows:
            info = zipfile.ZipInfo(row.name)
            info.external_attr = 0o644 << 16
            path = ctx.storage.open_path(job.folder or "", row.name)
            with path.open("rb") as file, target.open(info, "w", force_zip64=row.size > 1 << 31) as entry:
                while block := file.read(1 << 18):
                    entry.write(block)
                    yield sink.take()
    yield sink.take()
