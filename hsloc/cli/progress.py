"""Progress on a terminal: one line on stderr, nothing anywhere else."""

from __future__ import annotations

import sys
import time

_EVERY = 0.1


class ProgressLine:
    """A line that is written over and over, on a terminal alone. Use it in a `with`: the line goes at the end."""

    def __init__(self, quiet: bool = False) -> None:
        self._on = not quiet and sys.stderr.isatty()
        self._begin = time.monotonic()
        self._phase = ""
        self._next = 0.0
        self._length = 0

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(self, *_: object) -> None:
        self._write("")

    @property
    def elapsed(self) -> float:
        """Seconds since the phase began."""
        return time.monotonic() - self._begin

    def show(self, phase: str, share: float, note: str = "") -> None:
        """A bar at `share` of 1, at most ten times a second."""
        now = time.monotonic()
        if phase != self._phase:
            self._phase, self._begin = phase, now
        if not self._on or now < self._next:
            return
        self._next = now + _EVERY
        share = min(max(share, 0.0), 1.0)
        width = 28
        filled = round(share * width)
        self._write(f"{phase:<9} [{'#' * filled}{'.' * (width - filled)}] {100 * share:3.0f} %  {note}")

    def _write(self, text: str) -> None:
        if self._on:
            sys.stderr.write("\r" + text.ljust(self._length) + ("" if text else "\r"))
            sys.stderr.flush()
            self._length = len(text)
