"""A running server, and requests that tests send to it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import forked_commands
import httpx2 as httpx
from mcap.reader import make_reader
from waiting import LIMIT_S, until

from hsloc.client import ENDED
from hsloc_service.settings import Settings

FAKE = (sys.executable, "-P", str(Path(__file__).parents[1] / "service" / "fake_worker.py"))
IN_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""Parent of folders whose thousands of commits would wait for a disk, 5 ms each."""
_COVERAGE = "COVERAGE_PROCESS_CONFIG"
SMALL: dict[str, Any] = {
    "min_free_bytes": 1 << 20,
    "grace_s": 0.3,
    "heartbeat_s": 0.5,
    "lease_s": 5.0,
    "job_memory_bytes": 1 << 30,
    "worker_command": FAKE,
}


def settings(folder: Path, **changes: Any) -> Settings:
    return Settings(**{"data": folder / "data", **SMALL, **changes})


def upload(client: Any, content: bytes = b"ok", name: str = "run.mcap") -> str:
    answer = client.post("/v1/files", params={"name": name}, content=content)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def submit(client: Any, content: bytes = b"ok", **request: Any) -> str:
    answer = client.post("/v1/jobs", json={"log": upload(client, content), **request})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def wait(client: Any, job: str, states: tuple[str, ...] = ENDED) -> dict[str, Any]:
    """The job when it has ended (or is in one of the states)."""

    def get() -> dict[str, Any]:
        found: dict[str, Any] = client.get(f"/v1/jobs/{job}").json()
        return found

    return until(get, f"the job is {' or '.join(states)}", lambda found: found["state"] in states)


def go_on(data: Path, job: str) -> None:
    """Let a job on "held" end: a service on the folder `data` runs it for the first time."""
    folder = data / "work" / f"{job}.1"
    until((folder / "job.json").exists, "the job's folder is there")
    (folder / "go on").touch()


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def with_coverage() -> dict[str, str]:
    """The variables of a server or worker whose coverage counts: one that ends by itself, or by SIGTERM."""
    return {_COVERAGE: os.environ[_COVERAGE]} if _COVERAGE in os.environ else {}


def environment(**variables: str) -> dict[str, str]:
    """The variables of a server or worker that keeps tests short.

    Coverage is not measured, unless they are `with_coverage()` as well: it doubles what a start takes, to 3 s, and is
    lost where the process is killed, as most are.
    """
    return {k: v for k, v in os.environ.items() if not k.startswith("HSLOC_") and k != _COVERAGE} | {
        "HSLOC_MIN_FREE_BYTES": "1M",
        "HSLOC_GRACE_S": "0.3",
        "HSLOC_HEARTBEAT_S": "0.5",
        "HSLOC_LEASE_S": "5",
        "HSLOC_WORKER_COMMAND": ",".join(FAKE),
        **variables,
    }


def start(
    log: Path, arguments: list[str], variables: dict[str, str]
) -> forked_commands.Forked | subprocess.Popen[bytes]:
    """A command of `hsloc` as a process; it writes to `log`."""
    chosen = environment(**variables)
    if (
        forked_commands.POSSIBLE
        and _COVERAGE not in chosen
        and not any(name.startswith("PYTHON") for name in variables)
    ):
        return forked_commands.Forked(arguments, chosen, log)
    with log.open("ab") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "hsloc.cli.main", *arguments], env=chosen, stdout=file, stderr=file
        )


class Worker:
    """`hsloc work` as a process."""

    def __init__(self, folder: Path, *arguments: str, **variables: str) -> None:
        folder.mkdir(exist_ok=True)
        self.log = folder / "worker.log"
        self.process = start(self.log, ["work", "--data", str(folder / "data"), *arguments], variables)

    def end(self, which: int = signal.SIGTERM) -> int:
        """Send a signal; the exit code."""
        self.process.send_signal(which)
        return self.process.wait(LIMIT_S)


class Live:
    """`hsloc serve` as a process."""

    def __init__(self, folder: Path, **variables: str) -> None:
        self.data, self.port, self._variables = folder / "data", free_port(), variables
        self.process: forked_commands.Forked | subprocess.Popen[bytes] | None = None
        self.log = folder / "server.log"

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> Live:
        arguments = ["serve", "--data", str(self.data), "--port", str(self.port)]
        self.process = start(self.log, arguments, self._variables)
        with self.client() as client:

            def is_ready() -> bool:
                assert self.process is not None
                if self.process.poll() is not None:
                    raise RuntimeError(self.log.read_text())
                with contextlib.suppress(httpx.HTTPError):
                    return bool(client.get("/readyz").status_code == 200)
                return False

            until(is_ready, f"the server has started, see {self.log}")
        return self

    def end(self, which: int = signal.SIGTERM) -> int:
        assert self.process is not None
        self.process.send_signal(which)
        return self.process.wait(LIMIT_S)

    def client(self) -> httpx.Client:
        """Without the certificates of authorities, which take longer to load than most tests take."""
        return httpx.Client(base_url=self.url, timeout=LIMIT_S, verify=False)


def without_command(name: str, content: bytes) -> Any:
    """A file of the results without the line "run it again with": the service names no folders in it."""
    if name != "run.mcap":
        return re.sub(rb"hsloc (?:replay|map) [^\n<]*", b"", content)
    reader = make_reader(BytesIO(content))
    config = [without_command(each.name, each.data) for each in reader.iter_attachments()]
    return config, [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
