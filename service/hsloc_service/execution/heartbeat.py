"""The heartbeat of one attempt: it renews the lease, writes the progress, and learns why the attempt has to stop."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from sqlalchemy.exc import DBAPIError

from hsloc_service.db.database import is_unreachable

if TYPE_CHECKING:
    import threading

    from hsloc_service.jobs.leases import Claim, Leases

POLL_S = 0.5
"""Shortest time between two writes of progress [s]."""


class Heartbeat:
    """Lease and progress of a claimed job. Used in the thread of one slot."""

    def __init__(
        self, claim: Claim, leases: Leases, interval_s: float, *, stop: threading.Event, cancel: threading.Event
    ) -> None:
        self._claim, self._leases, self._interval_s = claim, leases, interval_s
        self._stop, self._cancel = stop, cancel
        self._progress: dict[str, Any] | None = None
        self._written: dict[str, Any] | None = None
        self._lines: list[str] = []
        self._checked = self._renewed = 0.0
        self._held_until = time.monotonic() + leases.lease_s
        self._begin = time.monotonic()

    def begin(self) -> None:
        """Measure the speed from now on."""
        self._begin = time.monotonic()

    def report(self, phase: str, done: float, total: float, scans: int) -> None:
        """Keep the newest progress; it is written with the next heartbeat."""
        self._progress = {"phase": phase[:40], "done": done, "total": total, "scans": scans}

    def log(self, lines: list[str]) -> None:
        """Keep what the job's process wrote; it is written with the next heartbeat."""
        self._lines += lines

    def flush(self) -> None:
        """Write the lines that are left, before the attempt ends. What cannot be written is no reason to fail it."""
        if self._lines:
            with suppress(DBAPIError):
                self._leases.beat(self._claim, None, self._lines)
            self._lines = []

    def enter(self, phase: str) -> None:
        """Begin a phase of the supervisor itself, such as `fetch` or `store`."""
        self.report(phase, 0.0, 1.0, 0 if self._progress is None else self._progress["scans"])

    def cancel_reason(self) -> str | None:
        """Why the attempt has to stop: `shutdown`, `lost`, `cancelled`; None if it may go on.

        Cheap enough for ten calls a second: the database is touched when there is progress to write, when the lease is
        due, and at once when the job was cancelled.
        """
        if self._stop.is_set():
            return "shutdown"
        now, cancelled = time.monotonic(), self._cancel.is_set()
        if now < self._checked + min(POLL_S, self._interval_s) and not cancelled:
            return None
        self._checked = now
        fresh = self._progress is not None and self._progress is not self._written
        if not fresh and not self._lines and now < self._renewed + self._interval_s and not cancelled:
            return None
        self._renewed = now
        try:
            reply = self._leases.beat(self._claim, self._next_progress(now) if fresh else None, self._lines)
        except DBAPIError as error:
            if not self._leases.database.shared or not is_unreachable(error):
                raise
            # Until the lease ends no other worker takes the job; a database that restarts is back by then.
            return None if time.monotonic() < self._held_until else "lost"
        self._held_until = now + self._leases.lease_s
        self._lines = []
        return "lost" if not reply.mine else "cancelled" if reply.cancel else None

    def _next_progress(self, now: float) -> dict[str, Any]:
        assert self._progress is not None
        self._written = self._progress
        speed = self._progress["done"] / max(now - self._begin, 1e-3)
        return {**self._progress, "speed": round(speed, 3)}
