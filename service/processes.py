"""Ending a job's processes: all of them, also those that left the group."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator

MARK = "HSLOC_JOB"
"""Environment variable that every process of a job inherits: `<instance>:<job>.<attempt>`."""


def end_job(process: subprocess.Popen[bytes], mark: str, grace_s: float) -> None:
    """SIGTERM, a time of grace, SIGKILL; returns when no process of the job is left."""
    if grace_s > 0.0 and process.poll() is None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGTERM)
        deadline = time.monotonic() + grace_s
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
    kill_group(process.pid)
    process.wait()
    kill_marked(mark)


def kill_group(group: int) -> None:
    """SIGKILL to a whole process group."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)


def kill_marked(mark: str, seconds: float = 5.0) -> int:
    """SIGKILL, again and again, to all whose mark begins like this, until none is left; how many there were.

    A process group can be left (setsid), an environment is inherited. Stopped first, so that none forks on meanwhile.
    """
    found: set[int] = set()
    deadline = time.monotonic() + seconds
    while pids := list(marked(mark)):
        found.update(pids)
        for which in (signal.SIGSTOP, signal.SIGKILL):
            for pid in pids:
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, which)
        if time.monotonic() > deadline:
            break
        time.sleep(0.01)
    return len(found)


def marked(mark: str) -> Iterator[int]:
    """Processes (not zombies) whose environment holds a mark that begins like this; none where there is no /proc."""
    wanted = f"{MARK}={mark}".encode()
    proc = Path("/proc")
    if not proc.is_dir():
        return
    for path in proc.iterdir():
        if path.name.isdigit() and int(path.name) != os.getpid():
            with suppress(OSError):
                variables = (path / "environ").read_bytes().split(b"\0")
                if any(variable.startswith(wanted) for variable in variables):
                    yield int(path.name)
