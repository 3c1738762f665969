"""The process of a job, watched until it is dead: its progress pipe, its limits, the meaning of its exit."""

from __future__ import annotations

import json
import math
import os
import selectors
import signal
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Protocol

from hsloc_service.execution.outcome import Outcome, interrupted
from hsloc_service.execution.processes import end_job, start_job
from hsloc_service.storage import folder_bytes

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc_service.execution.sandbox import Sandbox
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage

MAX_LOG_BYTES = 1 << 16
"""What is kept of an attempt [B]; the rest is left in its folder, which goes with it."""
MAX_LINE = 500
"""Letters of a line that are kept."""
BLOCK = 1 << 14

MAX_LINE_BYTES = 1 << 18
"""Longest line of the pipe [B]; a process that writes more is broken."""
MAX_LINE_DEPTH = 20
"""Deeper than anything that a worker writes; much deeper JSON could not be stored."""
TICK_S = 0.1
POLL_S = 0.5
"""Time between two measurements of the folder's size [s]."""


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
        return [_printable(line.replace(folder, b"")) for line in lines if line.strip()]


def _printable(line: bytes) -> str:
    """Text that every database and terminal takes: without control characters, such as colours."""
    text = line[: 4 * MAX_LINE].decode("utf-8", "replace").expandtabs()
    return "".join(letter for letter in text if letter.isprintable())[:MAX_LINE].rstrip()


class JobMonitor(Protocol):
    """Receives the progress and the output of a process, and decides when it has to stop: see `Heartbeat`."""

    def begin(self) -> None:
        """The process was started."""

    def report(self, phase: str, done: float, total: float, scans: int) -> None:
        """Progress."""

    def log(self, lines: list[str]) -> None:
        """Lines that the process wrote."""

    def flush(self) -> None:
        """The process has ended."""

    def cancel_reason(self) -> str | None:
        """Why it has to stop; None if it may go on."""
        ...


class JobProcess:
    """Starts the process of a job in its folder, and watches it. Used in the thread of one slot."""

    def __init__(
        self, folder: Path, mark: str, heartbeat: JobMonitor, storage: Storage, settings: Settings, sandbox: Sandbox
    ) -> None:
        self._folder, self._mark, self._heartbeat = folder, mark, heartbeat
        self._storage, self._settings, self._sandbox = storage, settings, sandbox
        self._pipe_rest = b""
        self._log = JobLog(folder / "log.txt")
        self._last_line: dict[str, Any] = {}
        """The line with `done` or `failed`, once the process has written it."""

    def run(self) -> Outcome:
        """How the process ended. When this returns, every process of the job is dead. Raises OSError at the start."""
        settings, cache = self._settings, self._storage.cache.absolute()
        process, pipe = start_job(self._sandbox, self._folder, self._mark, settings.job_threads, cache)
        self._heartbeat.begin()
        try:
            outcome = self._watch(process, pipe)
            if outcome is not None:
                if outcome.reason == "cancelled":
                    end_job(process, self._mark, settings.grace_s)
                return outcome
            while self._read(pipe):
                pass
            code = process.returncode
            if self._sandbox.kind == "bubblewrap" and code > 128:
                code = 128 - code  # its word for a process that a signal ended
            return self._exit_outcome(code)
        finally:
            end_job(process, self._mark, 0.0)
            os.close(pipe)
            self._heartbeat.log(self._log.new_lines(ended=True))
            self._heartbeat.flush()

    def _watch(self, process: Any, pipe: int) -> Outcome | None:
        """Read the pipe, renew the lease and check the limits, until the process has ended (None) or has to."""
        begin = size_at = time.monotonic()
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while process.poll() is None:
                if selector.select(TICK_S) and not self._read(pipe):
                    if len(self._pipe_rest) > MAX_LINE_BYTES:
                        return Outcome("crashed", "protocol", "the job's process wrote a line that is too long")
                    time.sleep(TICK_S / 2)  # the pipe is closed, and the process lives on
                now = time.monotonic()
                if now - begin > self._settings.job_wall_s:
                    limit = f"{self._settings.job_wall_s:.0f} s"
                    return Outcome("failed", "wall_limit", f"the job took longer than {limit}")
                if now >= size_at:
                    size_at = now + POLL_S
                    self._heartbeat.log(self._log.new_lines())
                    if (full := self._disk_outcome()) is not None:
                        return full
                reason = self._heartbeat.cancel_reason()
                if reason is not None:
                    return interrupted(reason)
        return None

    def _disk_outcome(self) -> Outcome | None:
        if folder_bytes(self._folder) > self._settings.job_output_bytes:
            return Outcome("failed", "output_limit", "the job wrote more than it is allowed")
        if self._storage.free_bytes() < self._storage.min_free_bytes // 2:
            return Outcome("failed", "disk_full", "the server's disk became full while the job ran")
        return None

    def _read(self, pipe: int) -> bool:
        """Take what the pipe has; False at its end, and after a line that is too long."""
        try:
            block = os.read(pipe, 1 << 16)
        except BlockingIOError:
            return False
        *lines, self._pipe_rest = (self._pipe_rest + block).split(b"\n")
        for line in lines:
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                self._take(parse_line(line))
        return bool(block) and len(self._pipe_rest) <= MAX_LINE_BYTES

    def _take(self, line: dict[str, Any]) -> None:
        if "done" in line or "failed" in line:
            self._last_line = line
        else:
            self._heartbeat.report(str(line["phase"]), float(line["part"]), float(line["total"]), int(line["scans"]))

    def _exit_outcome(self, code: int) -> Outcome:
        """What the exit means. A reason that the process wrote counts; its success counts with exit code 0 only."""
        last, output = self._last_line, self._folder / "output"
        # A link would make us publish, and delete, a folder elsewhere.
        if code == 0 and isinstance(last.get("done"), dict) and output.is_dir() and not output.is_symlink():
            return Outcome("done", summary=last["done"])
        if "failed" in last:
            reason = str(last["failed"])[:40]
            state = "crashed" if reason == "internal_error" else "failed"
            return Outcome(state, reason, str(last.get("message", ""))[:2000])
        if code == -signal.SIGXCPU:
            limit = f"{self._settings.job_cpu_s:.0f} s"
            return Outcome("failed", "cpu_limit", f"the job used more than {limit} of processor time")
        if code == -signal.SIGKILL:
            # Sent by the kernel (no memory) or an operator, so the job is tried again, up to max_attempts.
            return Outcome("again", "killed", "the job's process was killed")
        if code < 0:
            name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
            return Outcome("crashed", "signal", f"the job's process was ended by {name}")
        return Outcome("crashed", "exit", f"the job's process ended with code {code}{self._last_output()}")

    def _last_output(self) -> str:
        """The last line that the process wrote to stdout or stderr, behind a colon."""
        with suppress(OSError):
            text = (self._folder / "log.txt").read_bytes()[-2000:].decode("utf-8", "replace").strip()
            if text:
                return f": {text.splitlines()[-1][:300]}"
        return ""


def parse_line(line: bytes) -> dict[str, Any]:
    """An object of JSON from a process that is not trusted, in values that the database and every JSON reader take.

    NaN, infinity and integers of more than 64 bits become null; half a surrogate pair becomes a question mark,
    and NUL, which PostgreSQL does not take, a replacement character. Raises
    ValueError or RecursionError for what is no object of JSON, or nested too deeply.
    """
    found = _plain(json.loads(line), MAX_LINE_DEPTH)
    if not isinstance(found, dict):
        raise ValueError("not an object")
    return found


def _plain(value: Any, depth: int) -> Any:
    if depth == 0:
        raise ValueError("nested too deeply")
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode().replace("\0", "\ufffd")
    if isinstance(value, dict):
        return {_plain(key, depth): _plain(each, depth - 1) for key, each in value.items()}
    if isinstance(value, list):
        return [_plain(each, depth - 1) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return None if isinstance(value, int) and abs(value) >= 1 << 63 else value
