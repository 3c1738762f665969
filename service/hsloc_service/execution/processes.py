"""Starting a job's process, and ending its processes: all of them, also those that left the group."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hsloc_service.execution.sandbox import Sandbox

MARK = "HSLOC_JOB"
"""Environment variable that every process of a job inherits: `<instance>:<job>.<attempt>`."""
_KEPT = ("PATH", "LANG", "LC_ALL", "TZ", "PYTHONPATH", "VIRTUAL_ENV")
_KEPT_PREFIXES = ("OPENBLAS_", "OMP_", "MKL_", "NPY_", "NUMBA_")
"""What a job's process sees of the server's environment: no token, no password; but all that decides the last bits of
its arithmetic, which are to be those of `hsloc replay` in the same environment."""


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


def start_job(
    sandbox: Sandbox, folder: Path, mark: str, threads: int, cache: Path
) -> tuple[subprocess.Popen[bytes], int]:
    """The process of a job in a session and process group of its own; the reading end of its pipe. Raises OSError."""
    folder = folder.absolute()
    environment = {k: v for k, v in os.environ.items() if k in _KEPT or k.startswith(_KEPT_PREFIXES)}
    environment |= sandbox.caches(folder, cache)
    environment |= {
        MARK: mark,
        "HOME": str(folder / "tmp"),
        "TMPDIR": str(folder / "tmp"),
        "PYTHONUNBUFFERED": "1",
        "NUMBA_NUM_THREADS": str(threads),
        "OMP_NUM_THREADS": str(threads),
        "OPENBLAS_NUM_THREADS": str(threads),
    }
    reading, writing = os.pipe()
    # In a process namespace the worker's parent is number 1: bubblewrap's own process there.
    parent = 1 if sandbox.kind == "bubblewrap" else os.getpid()
    command = [*sandbox.command, str(folder), "--fd", str(writing), "--parent", str(parent)]
    try:
        with (folder / "log.txt").open("wb") as output:
            process = subprocess.Popen(
                sandbox.wrap(command, folder, linked_files(folder)),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=(writing,),
                cwd=folder,
                env=environment,
                start_new_session=True,
            )
    except OSError:
        os.close(reading)
        raise
    finally:
        os.close(writing)
    os.set_blocking(reading, False)
    return process, reading


def linked_files(folder: Path) -> list[Path]:
    """The uploads that `prepare` linked into the folder of a job."""
    return [Path(os.readlink(path)) for path in sorted(folder.glob("*/*")) if path.is_symlink()]
