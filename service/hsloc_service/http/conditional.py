"""Conditional and compressed answers: a client that polls gets 304 while nothing changes, and gzip where it does."""

from __future__ import annotations

import gzip
import hashlib
from typing import TYPE_CHECKING

from anyio import to_thread
from starlette.datastructures import Headers, MutableHeaders

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MIN_GZIP_BYTES = 1024
GZIP_LEVEL = 5
KINDS = ("application/json", "text/html", "text/css", "text/javascript", "application/javascript", "image/svg+xml")


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
