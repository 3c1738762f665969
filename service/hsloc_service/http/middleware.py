"""What every request and its answer pass: time-outs, exceptions as answers, conditional and compressed answers.

uvicorn alone never closes a connection whose request does not come: five hundred of them stay five hundred, and resets
one whose request it has not read. Every error has the shape `{"code", "message", "details"}`. A client that polls gets
304 while nothing changes, and gzip where it does.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import logging
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast

from anyio import to_thread
from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import DatabaseError, DataError, InterfaceError, OperationalError
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match
from uvicorn.protocols.http.h11_impl import H11Protocol

from hsloc_service.errors import ServiceError, StoreError, is_disk_full
from hsloc_service.http import metrics
from hsloc_service.http.guard import problem
from hsloc_service.http.validation import in_words
from hsloc_service.logs import log

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fastapi import FastAPI
    from starlette.routing import BaseRoute
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from hsloc_service.storage import Storage

RATE_WINDOW = 2.5
"""Time over which the rate of a body is averaged, in body time-outs: a silence below one of them must not decide."""

LINGER_S, LINGER_SILENCE_S = 30.0, 5.0
"""How long a body that was refused is read, and how long nothing may come [s]: as nginx does."""
LINGER_BYTES = 10 << 20
"""How much of it is read: a block of 8 MiB, as our clients send it, and what comes with it."""

_CODES = {404: "not_found", 405: "method", 413: "too_large", 400: "bad_request", 416: "range"}
MIN_GZIP_BYTES = 1024
GZIP_LEVEL = 5
KINDS = ("application/json", "text/html", "text/css", "text/javascript", "application/javascript", "image/svg+xml")


class TimeoutProtocol(H11Protocol):
    """Closes connections whose headers, bodies or reads of the answer take too long."""

    header_timeout_s = 5.0
    body_timeout_s = 10.0
    write_timeout_s = 60.0
    min_body_bytes_per_s = 512
    max_connections = 4096

    _check: asyncio.TimerHandle | None = None
    _heard = 0.0
    _awaiting_since: float | None = None
    _stuck_since: float | None = None
    _window_since: float | None = None
    """Since when the rate of a body is measured; None while no body is awaited."""
    _window_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client connected: its headers must follow soon."""
        super().connection_made(transport)
        if len(self.connections) > self.max_connections:
            transport.abort()
            return
        self._heard = self._awaiting_since = time.monotonic()
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Bytes came."""
        self._heard = time.monotonic()
        self._window_bytes += len(data)
        before = self.cycle
        idle = self._idle()
        super().data_received(data)
        if self.cycle is not before:
            self._awaiting_since = None  # the headers are complete
        elif idle and self._awaiting_since is None:
            self._awaiting_since = self._heard  # the first bytes of another request on the same connection

    def pause_writing(self) -> None:
        """The client does not take its answer."""
        self._stuck_since = time.monotonic()
        super().pause_writing()

    def resume_writing(self) -> None:
        """The client takes its answer again."""
        self._stuck_since = None
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        if self._check is not None:
            self._check.cancel()
            self._check = None
        super().connection_lost(exc)

    def _idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _watch(self) -> None:
        """Check about once a second: one timer for a connection, however many packets come."""
        if self.transport.is_closing():
            return
        now = time.monotonic()
        late = (
            (self._awaiting_since is not None and now - self._awaiting_since > self.header_timeout_s)
            or (self._body_is_awaited() and now - self._heard > self.body_timeout_s)
            or (self._stuck_since is not None and now - self._stuck_since > self.write_timeout_s)
            or self._body_is_slow(now)
        )
        if late:
            # Not close(): that would wait for a client that takes nothing.
            self.transport.abort()
            return
        self._check = self.loop.call_later(1.0, self._watch)

    def _body_is_slow(self, now: float) -> bool:
        """Whether the client sent less than the least rate over a whole window; a pause of ours begins a new one."""
        if not self._body_is_awaited():
            self._window_since = None
            return False
        if self._window_since is None:
            self._window_since, self._window_bytes = now, 0
        seconds = now - self._window_since
        if seconds < RATE_WINDOW * self.body_timeout_s:
            return False
        slow = self._window_bytes < seconds * self.min_body_bytes_per_s
        self._window_since, self._window_bytes = now, 0
        return slow

    def _body_is_awaited(self) -> bool:
        """Whether the client has to send; not while reading is paused because the disk is slower."""
        if self._idle() or not self.cycle.more_body:
            return False
        paused = self.flow.read_paused
        if paused:
            self._heard = time.monotonic()
        return not paused


def protocol_class(
    header_timeout_s: float,
    body_timeout_s: float,
    write_timeout_s: float,
    max_connections: int,
    min_body_bytes_per_s: int,
) -> type[asyncio.Protocol]:
    """The protocol with these limits; uvicorn takes a class."""
    values: dict[str, Any] = {
        "header_timeout_s": header_timeout_s,
        "body_timeout_s": body_timeout_s,
        "write_timeout_s": write_timeout_s,
        "max_connections": max_connections,
        "min_body_bytes_per_s": min_body_bytes_per_s,
    }
    return cast("type[asyncio.Protocol]", type("LimitedProtocol", (TimeoutProtocol,), values))


def add_error_handlers(app: FastAPI, storage: Storage, routes: Sequence[BaseRoute]) -> None:
    """Answers for refusals, invalid requests, broken connections, and a store or database that does not answer."""

    @app.exception_handler(ServiceError)
    async def refused(request: Request, error: ServiceError) -> Response:
        return _answer(error.status, error.code, error.message, _closing(request, error.headers))

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        found = [in_words(each) for each in error.errors()[:50]]
        details = [{"where": where, "what": what} for where, what in found]
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


class Lingering:
    """Reads on for a while where an answer ends the connection before its request was read, and closes it then.

    A connection that is closed with bytes unread is reset, and the reset may overtake the answer (RFC 9112, 9.6). The
    answer goes out at once; its end is kept from uvicorn, which would close, until the client has sent all, too much,
    or nothing for too long.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and its answer back."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # Who waits for `100 Continue` sends nothing after another answer.
        sends = "expect" not in Headers(scope=scope)
        closes, end = False, None

        async def read() -> Message:
            nonlocal sends
            message = await receive()
            sends = message.get("more_body", False)
            return message

        async def answer(message: Message) -> None:
            nonlocal closes, end
            if message["type"] == "http.response.start":
                headers = Headers(raw=message["headers"])
                closes = headers.get("connection") == "close" and "content-length" in headers
            elif closes and sends and not message.get("more_body", False):
                end = {**message, "body": b""}
                message = {**message, "more_body": True}
            await send(message)

        await self._app(scope, read, answer)
        if end is not None:
            await _discard(receive)
            await send(end)


async def _discard(receive: Receive) -> None:
    """Read the rest of a body, within limits."""
    count = 0
    with suppress(TimeoutError):
        async with asyncio.timeout(LINGER_S):
            while count < LINGER_BYTES:
                async with asyncio.timeout(LINGER_SILENCE_S):
                    message = await receive()
                count += len(message.get("body", b""))
                if not message.get("more_body", False):
                    return


class Conditional:
    """Answers to GET that come in one piece: an ETag (of the body), 304 for it, gzip if the client takes it.

    Answers that stream, such as results and events, pass as they are.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and its answer back."""
        if scope["type"] != "http" or scope["method"] != "GET":
            await self._app(scope, receive, send)
            return
        wanted, start = Headers(scope=scope), None

        async def answer(message: Message) -> None:
            nonlocal start
            if message["type"] == "http.response.start" and _is_small_text(message):
                start = message
                return
            if start is not None:
                begin, start = start, None
                if not message.get("more_body", False):
                    await _send(begin, message.get("body", b""), wanted, send)
                    return
                await send(begin)
            await send(message)

        await self._app(scope, receive, answer)


def _is_small_text(start: Message) -> bool:
    headers = Headers(raw=start["headers"])
    kind = headers.get("content-type", "").partition(";")[0]
    return start["status"] == 200 and "etag" not in headers and kind in KINDS


async def _send(start: Message, body: bytes, wanted: Headers, send: Send) -> None:
    headers = MutableHeaders(scope=start)
    # Weak: the bytes on the wire differ by their compression.
    headers["etag"] = tag = f'W/"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers.add_vary_header("Accept-Encoding")
    known = [each.strip() for each in wanted.get("if-none-match", "").split(",")]
    if tag in known:
        del headers["content-length"]
        await send({**start, "status": 304})
        await send({"type": "http.response.body", "body": b""})
        return
    if len(body) >= MIN_GZIP_BYTES and "gzip" in wanted.get("accept-encoding", ""):
        body = await to_thread.run_sync(lambda: gzip.compress(body, GZIP_LEVEL, mtime=0))
        headers["content-encoding"] = "gzip"
    headers["content-length"] = str(len(body))
    await send(start)
    await send({"type": "http.response.body", "body": body})
