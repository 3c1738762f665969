"""Links by which a job is shared: made and revoked by its owner, followed by whoever has them, read-only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from anyio import to_thread
from fastapi import APIRouter, Body, Header, Path, Query, Request, Response
from pydantic import AwareDatetime, BaseModel, Field, FiniteFloat

from hsloc_service.errors import not_found
from hsloc_service.http.context import Ctx, Reader, Visitor, Writer, problems
from hsloc_service.http.guard import SHARED_PREFIX
from hsloc_service.http.jobs_routes import JobId
from hsloc_service.http.results_routes import AssetName, assets_of, file_answer, manifest_of
from hsloc_service.http.schemas import Ident, JobView, Manifest, Strict, known_moment
from hsloc_service.http.validation import SECRET_PATTERN, UUID_PATTERN
from hsloc_service.http.views import shared_view

if TYPE_CHECKING:
    from hsloc_service.auth import Principal
    from hsloc_service.db.tables import ShareRow

router = APIRouter(tags=["shares"])
ShareId = Annotated[str, Path(pattern=UUID_PATTERN, description="id of a link")]
Secret = Annotated[str, Path(pattern=SECRET_PATTERN)]
DAY_S = 86400.0
CORS = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, Content-Type, ETag",
    "Cross-Origin-Resource-Policy": "cross-origin",
}
"""A viewer on another site may read the file in ranges, with the secret of the link and without cookies or tokens."""


class ShareRequest(Strict):
    """How long a link is valid."""

    valid_days: Annotated[FiniteFloat, Field(gt=0.0, le=366.0)] = 7.0


class ShareView(BaseModel):
    """A link by which whoever has it sees a job and its results."""

    id: Ident
    created: AwareDatetime
    expires: AwareDatetime
    secret: str | None = Field(
        default=None,
        description="in the answer that makes the link alone: the page shows the job at `/#shared=<secret>`, and its "
        "files are `/v1/shared/<secret>/results/<name>`",
    )


class ShareList(BaseModel):
    """The links of a job that are valid."""

    shares: list[ShareView]


@router.post("/v1/jobs/{job_id}/shares", status_code=201, responses=problems(404))
def share(ctx: Ctx, who: Writer, job_id: JobId, wanted: Annotated[ShareRequest | None, Body()] = None) -> ShareView:
    """A link by which whoever has it sees this job and its results, until it expires or is revoked."""
    row, secret = ctx.shares.issue(who, job_id, (wanted or ShareRequest()).valid_days * DAY_S)
    return _view(row, secret)


@router.get("/v1/jobs/{job_id}/shares", responses=problems(404))
def list_shares(ctx: Ctx, who: Reader, job_id: JobId) -> ShareList:
    """The links of a job that are valid; their secrets are not kept."""
    return ShareList(shares=[_view(row) for row in ctx.shares.rows(who, job_id)])


@router.delete("/v1/jobs/{job_id}/shares/{share_id}", status_code=204, responses=problems(404))
def revoke(ctx: Ctx, who: Writer, job_id: JobId, share_id: ShareId) -> None:
    """Revoke a link."""
    ctx.shares.revoke(who, job_id, share_id)


@router.get(f"{SHARED_PREFIX}{{secret}}", include_in_schema=False)
def shared_job(ctx: Ctx, who: Visitor, secret: Secret) -> JobView:
    """The job that a link shows."""
    del secret
    return shared_view(ctx.jobs.get(who, _job_id(who)))


@router.get(f"{SHARED_PREFIX}{{secret}}/results", include_in_schema=False)
def shared_manifest(ctx: Ctx, who: Visitor, secret: Secret) -> Manifest:
    """The files of its results."""
    job, rows = assets_of(ctx, who, _job_id(who))
    return manifest_of(job.id, rows, f"{SHARED_PREFIX}{secret}/results")


@router.get(f"{SHARED_PREFIX}{{secret}}/results/{{name}}", include_in_schema=False)
async def shared_asset(
    request: Request,
    ctx: Ctx,
    who: Visitor,
    secret: Secret,
    name: AssetName,
    download: Annotated[bool, Query()] = True,
    if_none_match: Annotated[str | None, Header(max_length=4096)] = None,
) -> Response:
    """One of them, also for a viewer on another site."""
    del secret
    job, rows = await to_thread.run_sync(assets_of, ctx, who, _job_id(who))
    answer = await file_answer(request, ctx, job, rows, name, download=download, if_none_match=if_none_match)
    answer.headers.update(CORS)
    return answer


@router.options(f"{SHARED_PREFIX}{{secret}}/results/{{name}}", include_in_schema=False)
def preflight(who: Visitor, secret: Secret, name: AssetName) -> Response:
    """What a browser asks before a viewer may send headers of its own."""
    del who, secret, name
    allowed = {
        "Access-Control-Allow-Methods": "GET, HEAD",
        "Access-Control-Allow-Headers": "Range, If-Range, If-None-Match",
    }
    # A browser asks for this besides where the viewer is on the internet, and the server in its own network.
    local = {"Access-Control-Allow-Private-Network": "true"}
    return Response(None, 204, {**CORS, **allowed, **local, "Access-Control-Max-Age": "600"})


def _view(row: ShareRow, secret: str | None = None) -> ShareView:
    """A link; its secret is known when it is made alone."""
    return ShareView(id=row.id, created=known_moment(row.created), expires=known_moment(row.expires), secret=secret)


def _job_id(who: Principal) -> str:
    if who.job_id is None:
        raise not_found("link", "")
    return who.job_id
