"""Progress on a terminal: one line on stderr, nothing anywhere else."""

from __future__ import annotations

import sys
import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

_EVERY = 0.1
_TICK = 0.5


class ProgressLine:
    """A line that is written over and over, on a terminal alone. Use it in a `with`: the line goes at the end."""

    def __init__(self, quiet: bool = False) -> None:
        self._on = not quiet and sys.stderr.isatty()
        self._begin = time.monotonic()
        self._phase = ""
        self._next = 0.0
        self._length = 0
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._moving: Callable[[float], tuple[float, str]] | None = None
        """Share and note after so many seconds of the phase."""

    def __enter__(self) -> ProgressLine:
        if self._on:
            threading.Thread(target=self._tick, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._write("")

    @property
    def elapsed(self) -> float:
        """Seconds since the phase began."""
        return time.monotonic() - self._begin

    def show(self, phase: str, share: float, note: str = "") -> None:
        """A bar at `share` of 1, at most ten times a second."""
        self._moving = None
        now = self._enter(phase)
        if self._on and now >= self._next:
            self._next = now + _EVERY
            self._draw(share, note)

    def show_clock(self, phase: str, expected_s: float, note: str = "") -> None:
        """A bar that moves by itself, over about `expected_s` seconds: for work that reports nothing."""
        self._enter(phase)
        self._moving = lambda elapsed: (min(elapsed / expected_s, 0.99), f"{elapsed:.0f} s, {note}")

    def show_count(self, phase: str, done: int, total: int, note: str) -> None:
        """A bar at `done` of `total`, with the seconds of the phase, which go on between the calls."""
        self._enter(phase)
        self._moving = lambda elapsed: (done / max(total, 1), f"{done} of {total} {note}, {elapsed:.0f} s")

    def _enter(self, phase: str) -> float:
        now = time.monotonic()
        if phase != self._phase:
            self._phase, self._begin = phase, now
        return now

    def _tick(self) -> None:
        while not self._ended.wait(_TICK):
            moving = self._moving
            if moving is not None:
                self._draw(*moving(self.elapsed))

    def _draw(self, share: float, note: str) -> None:
        width = 28
        filled = round(min(max(share, 0.0), 1.0) * width)
        self._write(f"{self._phase:<9} [{'#' * filled}{'.' * (width - filled)}] {100 * share:3.0f} %  {note}")

    def _write(self, text: str) -> None:
        if self._on:
            with self._lock:
                sys.stderr.write("\r" + text.ljust(self._length) + ("" if text else "\r"))
                sys.stderr.flush()
                self._length = len(text)
