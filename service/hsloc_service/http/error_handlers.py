"""Exceptions as answers: every error has the shape `{"code", "message", "details"}`."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import DatabaseError, DataError, InterfaceError, OperationalError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from hsloc_service.errors import ServiceError, StoreError, is_disk_full
from hsloc_service.http import metrics
from hsloc_service.http.guard import problem
from hsloc_service.logs import log

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fastapi import FastAPI
    from starlette.routing import BaseRoute

    from hsloc_service.storage import Storage

_CODES = {404: "not_found", 405: "method", 413: "too_large", 400: "bad_request", 416: "range"}


def add_error_handlers(app: FastAPI, storage: Storage, routes: Sequence[BaseRoute]) -> None:
    """Answers for refusals, invalid requests, broken connections, and a store or database that does not answer."""

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
        if error.status_code == 405 and (methods := _methods(routes, request)):
            headers["Allow"] = ", ".join(methods)
        return _answer(error.status_code, _CODES.get(error.status_code, "error"), str(error.detail), headers)

    @app.exception_handler(ClientDisconnect)
    async def disconnected(_request: Request, _error: ClientDisconnect) -> Response:
        return _answer(400, "disconnected", "the connection broke", {"connection": "close"})

    @app.exception_handler(StoreError)
    async def store(request: Request, error: StoreError) -> Response:
        metrics.STORE_ERRORS.inc()
        log("store.error", error=str(error))
        headers = _closing(request, {"Retry-After": "5"})
        return _answer(503, "store", "the results cannot be reached just now; try again", headers)

    @app.exception_handler(DatabaseError)
    async def damaged(_request: Request, error: DatabaseError) -> Response:
        log("database.damaged", logging.ERROR, error=str(error.orig), remedy="restore a backup: hsloc serve --backup")
        return _answer(500, "database", "the server's database is damaged; report it", {"connection": "close"})

    @app.exception_handler(DataError)
    async def untaken(request: Request, error: DataError) -> Response:
        log("database.refused", error=str(error.orig))
        message = "a text holds a character that the database does not take"
        return _answer(422, "invalid", message, _closing(request, {}))

    @app.exception_handler(OperationalError)
    @app.exception_handler(InterfaceError)
    async def database(_request: Request, error: OperationalError | InterfaceError) -> Response:
        log("database.error", error=str(error.orig))
        if isinstance(error, OperationalError) and is_disk_full(error):
            storage.drop_ballast()
            return _answer(507, "no_space", "the server's disk is full; try again", {"Retry-After": "1"})
        return _answer(503, "database", "the database is busy", {"Retry-After": "1"})


def _methods(routes: Sequence[BaseRoute], request: Request) -> list[str]:
    """Methods of all routes at this address (RFC 9110); the router's own answer names those of the first route only."""
    found = [route for route in routes if route.matches(request.scope)[0] is not Match.NONE]
    return sorted({method for route in found for method in getattr(route, "methods", ())})


def _closing(request: Request, headers: dict[str, str]) -> dict[str, str]:
    """Headers that end the connection after a refusal, so that the rest of a large body need not be read."""
    if request.method in ("POST", "PUT", "PATCH"):
        return {"connection": "close", **headers}
    return headers


def _answer(status: int, code: str, message: str, headers: dict[str, str], details: Any = None) -> Response:
    return Response(problem(code, message, details), status, headers, "application/json")
