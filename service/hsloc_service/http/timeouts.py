"""uvicorn's HTTP/1.1 protocol with the time-outs that it lacks.

uvicorn alone never closes a connection whose request does not come: five hundred of them stay five hundred.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any, cast

from uvicorn.protocols.http.h11_impl import H11Protocol

RATE_WINDOW = 2.5
"""Time over which the rate of a body is averaged, in body time-outs: a silence below one of them must not decide."""


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
