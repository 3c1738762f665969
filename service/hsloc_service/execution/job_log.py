"""What the process of a job writes to stdout and stderr, in lines, while it runs: for its page, and bounded."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

MAX_LOG_BYTES = 1 << 16
"""What is kept of an attempt [B]; the rest is left in its folder, which goes with it."""
MAX_LINE = 500
"""Letters of a line that are kept."""
BLOCK = 1 << 14


class JobLog:
    """Reads a file that another process appends to."""

    def __init__(self, path: Path) -> None:
        self._path, self._at, self._rest = path, 0, b""

    def new_lines(self, *, ended: bool = False) -> list[str]:
        """The lines since the last call; with `ended` also one without its line break. Never raises OSError."""
        block = b""
        with suppress(OSError), self._path.open("rb") as file:
            file.seek(self._at)
            block = file.read(min(MAX_LOG_BYTES - self._at, MAX_LOG_BYTES if ended else BLOCK))
        self._at += len(block)
        *lines, self._rest = (self._rest + block).split(b"\n")
        if self._at >= MAX_LOG_BYTES and block:
            lines, self._rest = [*lines, "… what follows is not kept".encode()], b""
        if ended and self._rest:
            lines, self._rest = [*lines, self._rest], b""
        # Where the folder is, is the server's business.
        folder = f"{self._path.parent.absolute()}/".encode()
        return [_plain(line.replace(folder, b"")) for line in lines if line.strip()]


def _plain(line: bytes) -> str:
    """Text that every database and terminal takes: without control characters, such as colours."""
    text = line[: 4 * MAX_LINE].decode("utf-8", "replace").expandtabs()
    return "".join(letter for letter in text if letter.isprintable())[:MAX_LINE].rstrip()
