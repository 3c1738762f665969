"""Commands of `hsloc` as processes that need not import the service again, which takes a second at each start.

They are forked from a process of this file, one of each process that runs tests, which has imported the service, has
run nothing of it and has no thread: but for the imports they are as `python -m hsloc.cli.main` would be, with a process
id, an environment, an output and signals of their own.
"""

from __future__ import annotations

import atexit
import ctypes
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

_PR_SET_PDEATHSIG = 1
POSSIBLE = hasattr(os, "pidfd_open")
IMPORTED = ("hsloc.cli.main", "hsloc.cli.serve", "hsloc.cli.work", "hsloc_service.main", "hsloc_service.work")


class Forked:
    """A command as a process, with what tests use of `subprocess.Popen`."""

    def __init__(self, arguments: list[str], environment: dict[str, str], log: Path) -> None:
        self.args = ["hsloc", *arguments]
        self.returncode: int | None = None
        request = {"arguments": arguments, "environment": environment, "log": str(log), "folder": str(Path.cwd())}
        self.pid = int(_ask(fork=request))

    def poll(self) -> int | None:
        """The exit code, negative for that of a signal; None while it runs."""
        if self.returncode is None:
            self.returncode = _ask(end_of=self.pid)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end. Raises subprocess.TimeoutExpired."""
        if self.poll() is None:
            descriptor = os.pidfd_open(self.pid)
            try:
                poll = select.poll()
                poll.register(descriptor, select.POLLIN)
                if not poll.poll(None if timeout is None else timeout * 1000.0):
                    raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
            finally:
                os.close(descriptor)
        code = self.poll()
        assert code is not None
        return code

    def send_signal(self, which: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, which)


@cache
def _template() -> Any:
    """The connection to the process that forks the others."""
    ours, theirs = socket.socketpair()
    with theirs:
        environment = {k: v for k, v in os.environ.items() if k != "COVERAGE_PROCESS_CONFIG"}
        command = [sys.executable, "-P", __file__, str(theirs.fileno()), str(os.getpid())]
        process = subprocess.Popen(command, env=environment, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
    stream = ours.makefile("rw")

    def end() -> None:
        stream.close()
        ours.close()
        process.wait()

    atexit.register(end)
    return stream


def _ask(**request: object) -> Any:
    stream = _template()
    stream.write(json.dumps(request) + "\n")
    stream.flush()
    return json.loads(stream.readline())


def main() -> None:
    """Answer requests until their connection is closed; in the processes that are forked, the command."""
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    descriptor, parent = map(int, sys.argv[1:])
    if os.getppid() != parent:
        return
    modules = [importlib.import_module(name) for name in IMPORTED]
    (threads,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("Threads:"))
    assert threads.split()[1] == "1", "a lock that another thread holds would be held for ever in what is forked"
    with socket.socket(fileno=descriptor) as connection, connection.makefile("rw") as stream:
        for line in stream:
            request = json.loads(line)
            if "fork" not in request:
                answer = _end_of(request["end_of"])
            elif (answer := os.fork()) == 0:
                break
            stream.write(json.dumps(answer) + "\n")
            stream.flush()
        else:
            return
    _become(**request["fork"])
    modules[0].program()


def _end_of(process: int) -> int | None:
    found, status = os.waitpid(process, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def _become(arguments: list[str], environment: dict[str, str], log: str, folder: str) -> None:
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)
    sys.argv = ["hsloc", *arguments]
    sys.path.insert(0, folder)


if __name__ == "__main__":
    main()
