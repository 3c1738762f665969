"""What is in a log, and what is wrong with it, before it is run; for the page."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from pydantic import BaseModel, Field, ValidationError

from hsloc_service import config_schema as options
from hsloc_service.errors import ServiceError, conflict
from hsloc_service.http.context import Ctx, Writer
from hsloc_service.http.schemas import JobRequest
from hsloc_service.stored_request import files_of, plain

router = APIRouter(prefix="/v1", tags=["jobs"])


class Inspection(BaseModel):
    """A log as `hsloc info` and `hsloc check` show it, and the map that it would be localised on."""

    format: str
    duration_s: float
    topics: list[dict[str, Any]] = Field(description="topic, type, count, rate_hz of each")
    scan_topic: str | None = Field(description="what would be read, as far as that is clear without a choice")
    odom_topic: str | None
    truth_topic: str | None
    initial_pose: list[float] | None = Field(description="x, y [m] and yaw [rad] that the log states")
    findings: list[dict[str, Any]] | None = Field(
        description="severity, text, remedy, topic, count, the worst first; null for logs that are too large to check"
    )
    warnings: list[str]
    view: dict[str, Any] | None = Field(default=None, description="the map as the page draws it")
    map_image: str | None = Field(default=None, description="its picture, as a `data:` address")


@router.post("/inspect", include_in_schema=False)
def inspect(ctx: Ctx, who: Writer, request: JobRequest) -> Inspection:
    """Read the log of a request without running it: topics, findings, the map. Nothing is kept."""
    if request.config is not None:
        request.config = options.check(request.config)
    wanted, names = plain(request.model_dump()), {}
    for ident in files_of(wanted):
        row = ctx.files.get(who, ident)
        if row.state != "complete":
            raise conflict("incomplete", f"the upload of file {ident} is not finished")
        names[ident] = row.name
    try:
        return Inspection(**ctx.inspector.inspect(who, {**wanted, "resume": None, "relations": None}, names))
    except ValidationError as error:
        raise ServiceError(503, "inspection", "the process that read the log did not end as it should") from error
