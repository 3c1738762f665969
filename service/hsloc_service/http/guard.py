"""Checks of every request before a byte of its body is read: host, origin, token, rate, size.

Plain ASGI, around the whole application: FastAPI reads bodies before it asks its dependencies.
"""

from __future__ import annotations

import json
import logging
import random
import secrets
import time
from typing import TYPE_CHECKING, Any

from anyio import to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import Message

from hsloc_service.auth import ANYBODY, Principal
from hsloc_service.db.database import UNREACHABLE
from hsloc_service.errors import BrokenAnswer, ServiceError, busy
from hsloc_service.http import metrics
from hsloc_service.logs import log, request_id

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.types import ASGIApp, Receive, Scope, Send

    from hsloc_service.auth import Tokens
    from hsloc_service.jobs.shares import Shares
    from hsloc_service.settings import Settings

PUBLIC = ("/", "/healthz", "/readyz", "/openapi.json", "/favicon.ico")
PUBLIC_PREFIX = "/web/"
SHARED_PREFIX = "/v1/shared/"
"""Behind it a secret takes the place of a token; pages of other sites, such as viewers, may read there."""
UPLOADS = ("/v1/files", "/v1/tus", "/v1/run")
"""Paths whose bodies may be large; they count their bytes themselves."""
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
SMALL_BODY = 256 << 10
SECURITY = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}


class Guard:
    """The outermost layer."""

    def __init__(
        self, app: ASGIApp, settings: Settings, tokens: Tokens, shares: Shares, servers: Callable[[], int] = lambda: 1
    ) -> None:
        self._app, self._settings, self._tokens, self._shares = app, settings, tokens, shares
        self._rates, self._servers = Rates(settings.requests_per_s), servers
        self._closed = settings.require_token
        """Whether a token is required: by the settings, or because one was made meanwhile."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request pass, or answer it."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return
        begin, status, inner = time.perf_counter(), 0, scope
        ident = secrets.token_hex(8)
        request_id.set(ident)

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY.items():
                    headers.setdefault(name, value)
                headers.setdefault("cache-control", "no-store")
                headers["x-request-id"] = ident
            await send(message)

        try:
            try:
                scope.setdefault("state", {})["principal"] = await self._admit(scope)
            except ServiceError as error:
                await refuse(error, answer)
                return
            try:
                inner, send_on = _without_head(scope, answer)
                await self._app(inner, self._counted(scope, receive), send_on)
            except BrokenAnswer as error:
                # Returning before the end makes uvicorn close the connection.
                log("answer.broken", logging.WARNING, route=_route(inner), error=str(error))
        finally:
            route = _route(inner)
            seconds = time.perf_counter() - begin
            # A method is any word that a client makes up: each would be a series of its own, kept for ever.
            method = scope["method"] if scope["method"] in METHODS else "other"
            metrics.REQUESTS.labels(method, route, str(status)).inc()
            if not route.endswith("/events"):
                metrics.LATENCY.labels(route).observe(seconds)
            if status >= 400 or not route.startswith(("/healthz", "/readyz", "/metrics")):
                who = scope.get("state", {}).get("principal")
                log(
                    "request",
                    method=scope["method"],
                    route=route,
                    status=status,
                    ms=round(seconds * 1000, 1),
                    tenant=None if who is None else who.tenant,
                )

    async def _admit(self, scope: Scope) -> Principal | None:
        headers = Headers(scope=scope)
        self._need_host(scope, headers)
        path = scope["path"]
        if path in PUBLIC or path.startswith(PUBLIC_PREFIX):
            return None
        client = (scope.get("client") or ("unknown", 0))[0]
        try:
            who = await (self._visitor(path) if path.startswith(SHARED_PREFIX) else self._principal(headers))
        except UNREACHABLE as error:
            log("database.error", error=str(error.orig))
            raise ServiceError(503, "database", "the database is busy", {"Retry-After": "1"}) from error
        if who is None:
            slow = self._settings.refusals_per_s
            self._take(("refused", client), slow, 20.0 * slow)
            if path.startswith(SHARED_PREFIX):
                raise ServiceError(404, "not_found", "this link is unknown, expired or revoked")
            missing = "authorization" not in headers
            raise ServiceError(
                401,
                "token",
                "send a token: Authorization: Bearer hsl_…" if missing else "this token is unknown, expired or revoked",
                {"WWW-Authenticate": 'Bearer realm="hsloc"'},
            )
        self._take(("tenant", who.tenant), self._settings.requests_per_s, 2.0 * self._settings.requests_per_s)
        if random.random() < self._settings.fault_fail_requests:
            raise ServiceError(503, "fault_injection", "this server fails requests on purpose", {"Retry-After": "1"})
        return who

    def _take(self, who: tuple[str, str], per_s: float, burst: float) -> None:
        """Count a request; of servers that share a database each grants its part of the rate."""
        share = self._servers()
        self._rates.take(who, per_s / share, max(burst / share, 1.0))

    def _need_host(self, scope: Scope, headers: Headers) -> None:
        """Refuse requests that a page of another site makes: by rebinding its name, by a form or by a script."""
        host = headers.get("host", "")
        allowed = self._settings.allowed_hosts
        name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
        if "*" not in allowed and name.lower() not in allowed:
            raise ServiceError(421, "host", "this Host is not served here; see --allowed-host")
        if scope["path"].startswith(SHARED_PREFIX):
            return
        origin = headers.get("origin")
        if origin is not None and origin.split("://", 1)[-1].lower() != host.lower():
            raise ServiceError(403, "origin", "requests from other sites are refused")
        if scope["method"] not in ("GET", "HEAD") and headers.get("sec-fetch-site") == "cross-site":
            raise ServiceError(403, "origin", "requests from other sites are refused")

    async def _principal(self, headers: Headers) -> Principal | None:
        kind, _, token = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and token:
            return await to_thread.run_sync(self._tokens.principal, token.strip())
        if "authorization" in headers:
            return None
        if not self._closed:
            # `hsloc serve --new-token` writes to the database of a server that runs.
            self._closed = await to_thread.run_sync(self._tokens.any)
        return None if self._closed else ANYBODY

    async def _visitor(self, path: str) -> Principal | None:
        row = await to_thread.run_sync(self._shares.find, path.removeprefix(SHARED_PREFIX).partition("/")[0])
        return None if row is None else Principal(row.tenant, frozenset(), row.id, row.job_id)

    def _counted(self, scope: Scope, receive: Receive) -> Receive:
        """Bodies other than uploads are small; counted as received, whatever Content-Length says."""
        if scope["path"].startswith(UPLOADS):
            return receive
        count = 0

        async def counted() -> Message:
            nonlocal count
            message = await receive()
            count += len(message.get("body", b""))
            if count > SMALL_BODY:
                # FastAPI passes on its own kind of exception only.
                raise HTTPException(413, f"at most {SMALL_BODY} bytes are taken here")
            return message

        return counted


def _route(scope: Scope) -> str:
    """The path of a request as its route has it, without what a client put in."""
    return getattr(scope.get("route"), "path", "other")


def _without_head(scope: Scope, send: Send) -> tuple[Scope, Send]:
    """HEAD as a GET whose body is dropped (RFC 9110); tus has a HEAD of its own."""
    if scope["method"] != "HEAD" or scope["path"].startswith("/v1/tus/"):
        return scope, send
    ended = False

    async def headers_only(message: Message) -> None:
        nonlocal ended
        if message["type"] == "http.response.start":
            await send(message)
        elif not ended:
            ended = True
            await send({"type": "http.response.body", "body": b""})

    return {**scope, "method": "GET", "hsloc_head": True}, headers_only


class Rates:
    """Token buckets in memory: a guard against floods, not a quota (those are in the database)."""

    def __init__(self, default: float) -> None:
        self._default = default
        self._buckets: dict[tuple[str, str], tuple[float, float]] = {}

    def take(self, who: tuple[str, str], per_s: float, burst: float) -> None:
        """Raises ServiceError 429 if the bucket is empty."""
        now = time.monotonic()
        level, at = self._buckets.get(who, (burst, now))
        level = min(burst, level + (now - at) * per_s)
        if level < 1.0:
            raise busy("too many requests", (1.0 - level) / per_s)
        if len(self._buckets) > 10_000:
            self._buckets.clear()
        self._buckets[who] = (level - 1.0, now)


async def refuse(error: ServiceError, send: Send) -> None:
    """Answer without reading the body; the connection ends, so that the rest of it need not be read."""
    body = problem(error.code, error.message)
    headers = {"content-type": "application/json", "content-length": str(len(body)), "connection": "close"}
    headers |= {name.lower(): value for name, value in error.headers.items()}
    raw = [(name.encode(), value.encode()) for name, value in headers.items()]
    await send({"type": "http.response.start", "status": error.status, "headers": raw})
    await send({"type": "http.response.body", "body": body})


def problem(code: str, message: str, details: Any = None) -> bytes:
    """The body of every answer that is not a success."""
    return json.dumps({"code": code, "message": message, "details": details}).encode()
