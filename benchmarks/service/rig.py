"""A server to be mistreated: `hsloc serve` on loopback with the tests' fake worker, started, killed, started again."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from network import Machine

FAKE_WORKER = Path(__file__).parents[2] / "tests" / "service" / "fake_worker.py"


class Server:
    def __init__(self, data: Path, real: bool = False, machine: Machine | None = None, **variables: str) -> None:
        self.data, self.machine = data, machine
        self.host = "127.0.0.1" if machine is None else machine.address
        self.port = 8000
        if machine is None:
            with socket.socket() as found:
                found.bind((self.host, 0))
                self.port = int(found.getsockname()[1])
        self.url = f"http://{self.host}:{self.port}"
        self.process: subprocess.Popen[bytes] | None = None
        self.variables = {"HSLOC_MIN_FREE_BYTES": "1M", **variables}
        if not real:
            self.variables.setdefault("HSLOC_WORKER_COMMAND", f"{sys.executable},-P,{FAKE_WORKER}")

    def start(self) -> Server:
        command = [sys.executable, "-m", "hsloc.cli.main", "serve", "--data", str(self.data), "--port", str(self.port)]
        if self.machine is not None:
            command = [*self.machine.prefix, *command, "--host", self.host, "--open-to-all"]
        with (self.data.parent / f"{self.data.name}.log").open("ab") as log:
            self.process = subprocess.Popen(command, env=os.environ | self.variables, stdout=log, stderr=log)
        self.wait_ready()
        return self

    def wait_ready(self, seconds: float = 300.0) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{self.url}/healthz", timeout=2.0) as answer:
                if answer.status == 200:
                    return
            if self.process is not None and self.process.poll() is not None:
                raise RuntimeError("the server ended: see its log")
            time.sleep(0.05)
        raise RuntimeError("the server does not answer")

    def end(self, which: int = signal.SIGTERM) -> int:
        assert self.process is not None
        self.process.send_signal(which)
        return self.process.wait(30.0)

    def memory_mib(self, peak: bool = False) -> float:
        assert self.process is not None
        name = "VmHWM" if peak else "VmRSS"
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith(name):
                return int(line.split()[1]) / 1024
        return 0.0


class Worker:
    """`hsloc work` with the tests' fake worker."""

    def __init__(self, data: Path, machine: Machine | None = None, **variables: str) -> None:
        self.data, self.machine = data, machine
        self.variables = {
            "HSLOC_MIN_FREE_BYTES": "1M",
            "HSLOC_WORKER_COMMAND": f"{sys.executable},-P,{FAKE_WORKER}",
            **variables,
        }
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> Worker:
        command = [sys.executable, "-m", "hsloc.cli.main", "work", "--data", str(self.data)]
        if self.machine is not None:
            command = [*self.machine.prefix, *command]
        with (self.data.parent / f"{self.data.name}.log").open("ab") as log:
            self.process = subprocess.Popen(command, env=os.environ | self.variables, stdout=log, stderr=log)
        return self

    def end(self, which: int = signal.SIGTERM) -> int:
        assert self.process is not None
        self.process.send_signal(which)
        return self.process.wait(60.0)


def kill_all(*each: Server | Worker) -> None:
    """End what still runs, however a script ends."""
    for one in each:
        if one.process is not None and one.process.poll() is None:
            one.process.kill()


def jobs_processes(data: Path) -> list[int]:
    """Processes of jobs that are alive."""
    from hsloc_service.execution.processes import marked

    instance = data / "instance"
    return list(marked(instance.read_text().strip() + ":")) if instance.exists() else []
