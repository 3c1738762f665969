"""The application: its parts put together, its routes, its lifespan."""

from __future__ import annotations

from contextlib import asynccontextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import APIRouter, Depends, FastAPI
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

import hsloc.report
from hsloc.version import __version__
from hsloc_service.auth import Tokens
from hsloc_service.call_timeout import BoundedExecutor
from hsloc_service.execution.warm_up import WarmUp
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.http import (
    files_routes,
    inspect_routes,
    jobs_routes,
    metrics,
    results_routes,
    run_routes,
    shares_routes,
    sweeps_routes,
    system_routes,
    tus,
)
from hsloc_service.http.context import Context, known_query
from hsloc_service.http.guard import Guard
from hsloc_service.http.middleware import Conditional, Lingering, add_error_handlers
from hsloc_service.http.openapi import add_openapi
from hsloc_service.jobs.repository import Jobs
from hsloc_service.jobs.shares import Shares
from hsloc_service.jobs.sweeps import Sweeps
from hsloc_service.jobs.workers import Presence
from hsloc_service.logs import log
from hsloc_service.parts import open_parts
from hsloc_service.settings import WORKER
from hsloc_service.uploads.repository import Files
from hsloc_service.uploads.upload_stream import UploadReceiver
from hsloc_service.webhooks import WebhookSender

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from fastapi.routing import APIRoute

    from hsloc_service.settings import Settings

ROUTERS = tuple(
    module.router
    for module in (
        files_routes,
        tus,
        inspect_routes,
        jobs_routes,
        results_routes,
        run_routes,
        shares_routes,
        sweeps_routes,
        system_routes,
    )
)
WEB = Path(__file__).parent.parent / "web"
VIEWER = Path(hsloc.report.__file__).parent / "viewer"
"""The map view, which report.html embeds."""


def create_app(settings: Settings) -> FastAPI:
    """The service on its data folder, which it locks. Its workers start and stop with the application's lifespan.

    Raises SettingsError if the folder cannot be used.
    """
    context = open_context(settings)
    app = FastAPI(
        title="hsloc",
        version=__version__,
        summary="Localisation and mapping of recorded 2D-lidar logs: upload a log, get the trajectory and the map.",
        lifespan=lambda _: running(context),
        docs_url=None,  # its page loads scripts from another site
        openapi_url=None,  # FastAPI's own route builds the description on the event loop: see `add_openapi`
        redoc_url=None,
        license_info={"name": "Apache-2.0"},
    )
    app.state.context = context
    app.add_middleware(Conditional)
    app.add_middleware(
        Guard, settings=settings, tokens=Tokens(context.database), shares=context.shares, servers=context.servers
    )
    app.add_middleware(Lingering)
    app.router.routes.extend(_api().routes)
    _add_page(app)
    add_error_handlers(app, context.storage, [route for router in ROUTERS for route in router.routes])
    add_openapi(app)
    return app


def open_context(settings: Settings) -> Context:
    """The parts of a service on its data folder; nothing runs yet. Raises SettingsError."""
    parts = open_parts(settings, ended=metrics.attempt_ended, store_failed=metrics.STORE_ERRORS.inc)
    database, storage = parts.database, parts.storage
    files, jobs = Files(database, storage, settings, parts.upload_parts), Jobs(database, storage, settings)
    return Context(
        settings=settings,
        database=database,
        storage=storage,
        files=files,
        jobs=jobs,
        shares=Shares(database),
        sweeps=Sweeps(jobs),
        receiver=UploadReceiver(files, settings),
        dispatcher=parts.dispatcher,
        inspector=parts.inspector,
        stores=parts.stores,
        deletions=parts.deletions,
        store_calls=BoundedExecutor(settings.store_timeout_s),
    )


@asynccontextmanager
async def running(context: Context) -> AsyncIterator[None]:
    """The lifespan: slots, webhooks and housekeeping run inside it; the data folder is closed behind it."""
    settings, database, storage = context.settings, context.database, context.storage
    helpers: list[WebhookSender | Housekeeping | WarmUp | Presence] = [
        WebhookSender(database, settings),
        Housekeeping(database, storage, settings, context.deletions),
    ]
    if context.dispatcher.sandbox_kind != "none" and settings.worker_command == WORKER:
        helpers.append(WarmUp(storage.cache.absolute()))
    if database.shared:
        slots = settings.slots
        beat_s, lease_s, owner = settings.heartbeat_s, settings.lease_s, context.dispatcher.owner
        context.presence = Presence(database, owner, "server", slots, beat_s, lease_s=lease_s)
        helpers.append(context.presence)
    context.dispatcher.start()
    for helper in helpers:
        helper.start()
    log(
        "start",
        version=__version__,
        slots=settings.slots,
        data=str(settings.data),
        results=context.stores.current.url,
        sandbox=context.dispatcher.sandbox_kind,
    )
    try:
        yield
    finally:
        context.stopping.set()
        context.dispatcher.stop()
        for helper in helpers:
            helper.stop()
        database.close()
        storage.close()
        log("stop")


def operation_id(route: APIRoute) -> str:
    """`jobs_submit`: the names of functions in generated clients."""
    return "_".join([*(str(tag) for tag in route.tags), route.name])


@cache
def _api() -> APIRouter:
    """All routes, once in a process: FastAPI takes 0.2 s to prepare them, at an application's first request."""
    made = APIRouter(generate_unique_id_function=operation_id)
    for router in ROUTERS:
        made.include_router(router, dependencies=[Depends(known_query)])
    return made


def _add_page(app: FastAPI) -> None:
    app.mount("/web/viewer", StaticFiles(directory=VIEWER), name="viewer")
    app.mount("/web", StaticFiles(directory=WEB), name="web")

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(WEB / "index.html", headers={"cache-control": "no-cache"})

    @app.get("/favicon.ico", include_in_schema=False)
    def icon() -> FileResponse:
        return FileResponse(WEB / "icon.svg", media_type="image/svg+xml")
