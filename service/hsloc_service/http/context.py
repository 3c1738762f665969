"""What the routes share, and how they get at it."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, cast

from fastapi import Depends, Request

from hsloc_service.auth import Principal
from hsloc_service.call_timeout import BoundedExecutor
from hsloc_service.errors import ServiceError
from hsloc_service.execution.dispatcher import Dispatcher
from hsloc_service.execution.inspection import Inspector
from hsloc_service.http.schemas import Problem
from hsloc_service.jobs.repository import Jobs
from hsloc_service.jobs.shares import Shares
from hsloc_service.jobs.sweeps import Sweeps
from hsloc_service.jobs.workers import Presence
from hsloc_service.results.deletion_queue import DeletionQueue
from hsloc_service.results.stores import ResultStores
from hsloc_service.settings import Settings
from hsloc_service.uploads.repository import Files
from hsloc_service.uploads.upload_stream import UploadReceiver

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc_service.db.database import Database
    from hsloc_service.storage import Storage


@dataclass(slots=True)
class Context:
    """The parts of a running service."""

    settings: Settings
    database: Database
    storage: Storage
    files: Files
    jobs: Jobs
    shares: Shares
    sweeps: Sweeps
    receiver: UploadReceiver
    dispatcher: Dispatcher
    inspector: Inspector
    stores: ResultStores
    deletions: DeletionQueue
    store_calls: BoundedExecutor
    stopping: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the server begins to shut down: event streams end."""
    presence: Presence | None = None
    """Where servers share the database: who else is there."""
    streams: Counter[str] = field(default_factory=Counter)
    """Open event streams of each tenant."""

    def servers(self) -> int:
        """How many servers share the database, this one among them."""
        return 1 if self.presence is None else self.presence.servers


def _context(request: Request) -> Context:
    return cast("Context", request.app.state.context)


def _principal(scope: str) -> Callable[[Request], Principal]:
    def principal(request: Request) -> Principal:
        who: Principal = request.state.principal  # the guard has put it there
        who.need(scope)
        return who

    return principal


def _visitor(request: Request) -> Principal:
    who: Principal = request.state.principal
    return who


Ctx = Annotated[Context, Depends(_context)]
Reader = Annotated[Principal, Depends(_principal("read"))]
Writer = Annotated[Principal, Depends(_principal("write"))]
Admin = Annotated[Principal, Depends(_principal("admin"))]
Visitor = Annotated[Principal, Depends(_visitor)]
"""Whoever came by a link: the guard has found its job."""


def known_query(request: Request) -> None:
    """Refuse a misspelt parameter of the query, which would be ignored."""
    known, left = set[str](), [request.scope["route"].dependant]
    while left:
        dependant = left.pop()
        known |= {each.alias for each in dependant.query_params}
        left += dependant.dependencies
    unknown = sorted(set(request.query_params) - known)
    if unknown:
        names = f"known are {', '.join(sorted(known))}" if known else "it takes none"
        raise ServiceError(422, "invalid", f"query.{unknown[0][:60]}: is unknown here; {names}")


_MEANINGS = {
    400: "the request cannot be understood",
    401: "no token, or one that is unknown, expired or revoked",
    403: "the token lacks the scope, or the request comes from another site",
    404: "not there, or not yours",
    409: "the state of the thing does not allow it",
    412: "Tus-Resumable is missing, or of another version",
    413: "too large",
    415: "wrong content type",
    421: "this Host is not served here",
    422: "the request does not fit its schema",
    423: "another request is writing to this upload",
    429: "too many; see Retry-After",
    460: "the checksum does not match",
    503: "not now; see Retry-After",
    507: "the disk or your part of it is full",
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The answers other than success, for the OpenAPI."""
    common = (400, 401, 403, 421, 422, 429, 503)
    return {s: {"model": Problem, "description": _MEANINGS.get(s, "refused")} for s in sorted({*common, *statuses})}
