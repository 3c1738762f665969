"""The application: parts put together, routes, and one shape of error."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anyio import to_thread
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from hsloc.version import __version__
from hsloc_service import config_schema as options
from hsloc_service.auth import Tokens
from hsloc_service.call_timeout import BoundedExecutor
from hsloc_service.db.database import Database
from hsloc_service.errors import ServiceError, StoreError, is_disk_full
from hsloc_service.execution.dispatcher import LocalDispatcher
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.http import (
    events_routes,
    files_routes,
    jobs_routes,
    metrics,
    results_routes,
    run_routes,
    schema_routes,
    system_routes,
    tus,
)
from hsloc_service.http.context import Context
from hsloc_service.http.guard import PUBLIC, PUBLIC_PREFIX, Guard, problem
from hsloc_service.http.schemas import RunRequest
from hsloc_service.jobs.leases import Leases
from hsloc_service.jobs.repository import Jobs
from hsloc_service.logs import log
from hsloc_service.results.deletion_queue import Removals
from hsloc_service.results.stores import ResultStores
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage
from hsloc_service.uploads.repository import Files
from hsloc_service.uploads.upload_stream import Receiver
from hsloc_service.webhooks import WebhookSender

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from hsloc_service.settings import Settings

ROUTES = (files_routes, tus, jobs_routes, events_routes, results_routes, run_routes, schema_routes, system_routes)
WEB = Path(__file__).parent.parent / "web"
_CODES = {404: "not_found", 405: "method", 413: "too_large", 400: "bad_request", 416: "range"}


def create_app(settings: Settings) -> FastAPI:
    """The service on its data folder, which it locks. Its workers start and stop with the application's lifespan.

    Raises SettingsError if the folder cannot be used.
    """
    settings.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    storage = Storage(settings.data, settings.min_free_bytes)
    try:
        database, stores = Database(settings.data / "hsloc.db"), ResultStores(storage, settings)
    except SettingsError:
        storage.close()
        raise
    leases = Leases(database, settings.lease_s, settings.max_attempts)
    dispatcher = LocalDispatcher(
        leases,
        storage,
        settings,
        stores,
        ended=lambda state: metrics.ENDED.labels(state).inc(),
        store_failed=metrics.STORE_ERRORS.inc,
    )
    files = Files(database, storage, settings)
    context = Context(
        settings=settings,
        database=database,
        storage=storage,
        files=files,
        jobs=Jobs(database, storage, settings),
        receiver=Receiver(files, settings),
        dispatcher=dispatcher,
        stores=stores,
        removals=Removals(database, stores, settings.store_timeout_s),
        desk=BoundedExecutor(settings.store_timeout_s),
    )
    helpers = (WebhookSender(database, settings), Housekeeping(database, storage, settings, stores))

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        dispatcher.start()
        for helper in helpers:
            helper.start()
        log("start", version=__version__, slots=settings.slots, data=str(settings.data), results=stores.current.url)
        try:
            yield
        finally:
            context.stopping.set()
            dispatcher.stop()
            for helper in helpers:
                helper.stop()
            database.close()
            storage.close()
            log("stop")

    app = FastAPI(
        title="hsloc",
        version=__version__,
        summary="Upload a log of a robot, get to know where it was.",
        lifespan=lifespan,
        docs_url=None,  # its page loads scripts from elsewhere
        openapi_url=None,  # FastAPI's route makes it on the event loop: see below
        redoc_url=None,
        license_info={"name": "Apache-2.0"},
    )
    app.state.context = context
    app.add_middleware(Guard, settings=settings, tokens=Tokens(database))
    for module in ROUTES:
        app.include_router(module.router)
    _add_page(app)
    _add_errors(app, storage)
    _describe(app)
    return app


def _add_page(app: FastAPI) -> None:
    app.mount("/web", StaticFiles(directory=WEB), name="web")

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(WEB / "index.html", headers={"cache-control": "no-cache"})

    @app.get("/favicon.ico", include_in_schema=False)
    def icon() -> FileResponse:
        return FileResponse(WEB / "icon.svg", media_type="image/svg+xml")

    making = asyncio.Lock()

    @app.get("/openapi.json", include_in_schema=False)
    async def description() -> JSONResponse:
        """Made when first asked for, which takes seconds: in one thread, while all else goes on."""
        async with making:
            if app.openapi_schema is None:
                await to_thread.run_sync(app.openapi)
        return JSONResponse(app.openapi())


def _add_errors(app: FastAPI, storage: Storage) -> None:
    @app.exception_handler(ServiceError)
    async def refused(request: Request, error: ServiceError) -> Response:
        return _answer(error.status, error.code, error.message, _closing(request, error.headers))

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        details = [{"where": [str(p) for p in each["loc"]], "what": each["msg"]} for each in error.errors()][:50]
        first = details[0] if details else {"where": [], "what": "invalid"}
        message = f"{'.'.join(first['where'])[:200]}: {first['what'][:500]}"
        return _answer(422, "invalid", message, _closing(request, {}), details)

    @app.exception_handler(HTTPException)
    async def other(request: Request, error: HTTPException) -> Response:
        headers = _closing(request, dict(error.headers or {}))
        if error.status_code == 405 and (methods := _methods(request)):
            headers["Allow"] = ", ".join(methods)
        return _answer(error.status_code, _CODES.get(error.status_code, "error"), str(error.detail), headers)

    @app.exception_handler(ClientDisconnect)
    async def gone(_request: Request, _error: ClientDisconnect) -> Response:
        return _answer(400, "disconnected", "the connection broke", {"connection": "close"})

    @app.exception_handler(StoreError)
    async def store(request: Request, error: StoreError) -> Response:
        metrics.STORE_ERRORS.inc()
        log("store.error", error=str(error))
        headers = _closing(request, {"Retry-After": "5"})
        return _answer(503, "store", "the results cannot be reached just now; try again", headers)

    @app.exception_handler(OperationalError)
    async def database(_request: Request, error: OperationalError) -> Response:
        log("database.error", error=str(error.orig))
        if is_disk_full(error):
            storage.drop_ballast()
            return _answer(507, "no_space", "the server's disk is full; try again", {"Retry-After": "1"})
        return _answer(503, "database", "the database is busy", {"Retry-After": "1"})


def _methods(request: Request) -> list[str]:
    """Methods of all routes at this address; the router names those of the first alone, RFC 9110 wants them all."""
    routes = [route for module in ROUTES for route in module.router.routes]
    found = [route for route in routes if route.matches(request.scope)[0] is not Match.NONE]
    return sorted({method for route in found for method in getattr(route, "methods", ())})


def _closing(request: Request, headers: dict[str, str]) -> dict[str, str]:
    """After a refusal nobody reads what is left of a large body."""
    if request.method in ("POST", "PUT", "PATCH"):
        return {"connection": "close", **headers}
    return headers


def _answer(status: int, code: str, message: str, headers: dict[str, str], details: Any = None) -> Response:
    return Response(problem(code, message, details), status, headers, "application/json")


def _describe(app: FastAPI) -> None:
    """What FastAPI cannot know: the routes that need a token, the schema of parameters, that no parameter is null."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
            parts = schema.setdefault("components", {})
            parts["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
            models = parts["schemas"]
            models["Config"] = deepcopy(options.options()["config_schema"])
            models["RunRequest"] = RunRequest.model_json_schema(ref_template="#/components/schemas/{model}")
            models["RunRequest"].pop("$defs")  # FastAPI has put them among the others
            for name in ("RunRequest", "JobRequest", "RerunRequest"):
                models[name]["properties"]["config"]["anyOf"][0] = {"$ref": "#/components/schemas/Config"}
            for path, operations in schema["paths"].items():
                if path not in PUBLIC and not path.startswith(PUBLIC_PREFIX):
                    for operation in operations.values():
                        operation["security"] = [{"token": []}]
                for operation in operations.values():
                    for parameter in operation.get("parameters", ()):
                        _not_null(parameter["schema"])
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _not_null(schema: dict[str, Any]) -> None:
    """A parameter that is left out is None to us; on the wire, `null` would be a word like any other."""
    kinds = [kind for kind in schema.get("anyOf", ()) if kind != {"type": "null"}]
    if len(kinds) == 1:
        del schema["anyOf"]
        schema |= kinds[0]
