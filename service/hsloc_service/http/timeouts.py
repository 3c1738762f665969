"""uvicorn's HTTP/1.1 protocol with the time-outs that it lacks.

Bare uvicorn never closes a connection whose request does not come: five hundred of them are five hundred for ever.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any, cast

from uvicorn.protocols.http.h11_impl import H11Protocol


class TimeoutProtocol(H11Protocol):
    """Patient, but not for ever: with headers, with bodies, with answers that nobody takes."""

    header_timeout_s = 5.0
    body_timeout_s = 10.0
    write_timeout_s = 60.0
    max_connections = 4096

    _check: asyncio.TimerHandle | None = None
    _heard = 0.0
    _awaiting_since: float | None = None
    _stuck_since: float | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client is there: its headers must follow soon."""
        super().connection_made(transport)
        if len(self.connections) > self.max_connections:
            transport.abort()
            return
        self._heard = self._awaiting_since = time.monotonic()
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Something came."""
        self._heard = time.monotonic()
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
        """It does again."""
        self._stuck_since = None
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Over."""
        if self._check is not None:
            self._check.cancel()
            self._check = None
        super().connection_lost(exc)

    def _idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _watch(self) -> None:
        """Look about once a second: one timer a connection, however many packets come."""
        if self.transport.is_closing():
            return
        now = time.monotonic()
        late = (
            (self._awaiting_since is not None and now - self._awaiting_since > self.header_timeout_s)
            or (self._body_is_awaited() and now - self._heard > self.body_timeout_s)
            or (self._stuck_since is not None and now - self._stuck_since > self.write_timeout_s)
        )
        if late:
            # Not close(): that would wait for a client that takes nothing.
            self.transport.abort()
            return
        self._check = self.loop.call_later(1.0, self._watch)

    def _body_is_awaited(self) -> bool:
        """Whether it is the client's turn; not while we ourselves have told it to wait."""
        if self._idle() or not self.cycle.more_body:
            return False
        paused = self.flow.read_paused
        if paused:
            self._heard = time.monotonic()
        return not paused


def protocol_class(
    header_timeout_s: float, body_timeout_s: float, write_timeout_s: float, max_connections: int
) -> type[asyncio.Protocol]:
    """The protocol with these limits; uvicorn takes a class."""
    values: dict[str, Any] = {
        "header_timeout_s": header_timeout_s,
        "body_timeout_s": body_timeout_s,
        "write_timeout_s": write_timeout_s,
        "max_connections": max_connections,
    }
    return cast("type[asyncio.Protocol]", type("LimitedProtocol", (TimeoutProtocol,), values))
