"""Job processes that misbehave: each ends in the right state with a reason, and the API does not notice."""

from __future__ import annotations

import errno
import os
import re
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from imports import need_no_import
from live_service import free_port, go_on, submit, upload, wait, with_coverage
from waiting import LIMIT_S, until

from hsloc_service.execution import job_process
from hsloc_service.execution.processes import marked
from hsloc_service.storage import Storage

if TYPE_CHECKING:
    from collections.abc import Callable

    from fastapi.testclient import TestClient
    from live_service import Live

LIMITS: dict[str, Any] = {
    "job_memory_bytes": 1 << 29,
    "job_cpu_s": LIMIT_S,
    "job_wall_s": LIMIT_S,
    "job_output_bytes": 64 << 20,
    "max_attempts": 2,
    "slots": 2,
}
"""Of time there is enough for all jobs but those that are to run out of it."""
TOO_SHORT: dict[str, dict[str, Any]] = {"cpu_limit": {"job_cpu_s": 1.0}, "wall_limit": {"job_wall_s": 3.0}}


@pytest.mark.parametrize(
    ("word", "state", "reason", "attempts"),
    [
        (b"ignore-term 600", "failed", "wall_limit", 1),
        (b"silent", "failed", "wall_limit", 1),
        (b"allocate", "failed", "out_of_memory", 1),
        (b"spin", "failed", "cpu_limit", 1),
        (b"fill", "failed", "output_limit", 1),
        (b"fill-one", "failed", "output_limit", 1),
        (b"abort", "crashed", "signal", 1),
        (b"exit 3", "crashed", "exit", 1),
        (b"lie", "crashed", "exit", 1),
        (b"nonsense", "crashed", "protocol", 1),
        (b"kill-self", "crashed", "attempts", 2),
        (b"bad-input", "failed", "invalid_input", 1),
    ],
)
def test_ends_with_a_reason(
    make_client: Callable[..., TestClient], word: bytes, state: str, reason: str, attempts: int
) -> None:
    client = make_client(**LIMITS | TOO_SHORT.get(reason, {}))
    job = submit(client, word)
    if reason in TOO_SHORT:
        wait(client, job, states=("running",))  # the API answers meanwhile
    ended = wait(client, job)
    assert (ended["state"], ended["reason"], ended["attempt"]) == (state, reason, attempts)
    assert ended["message"]
    log = re.findall(r"event: log\ndata: .*?\"lines\":\[(.*?)\]", client.get(f"/v1/jobs/{job}/events").text)
    assert log == (['"last words"'] if word == b"exit 3" else [])
    storage = client.app.state.context.storage  # type: ignore[attr-defined]
    assert list(marked(f"{storage.instance}:")) == []
    until(lambda: not list(storage.work.iterdir()), "the folder of the attempt is gone")
    assert list(storage.results.iterdir()) == []


def is_sleep(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().startswith(b"sleep\0")
    except OSError:  # it has ended
        return False


def test_cancel_ends_what_ignores_sigterm_and_leaves_the_group(make_client: Callable[..., TestClient]) -> None:
    client = make_client()
    mark = f"{client.app.state.context.storage.instance}:"  # type: ignore[attr-defined]
    job = submit(client, b"ignore-term 600")
    wait(client, job, states=("running",))
    # A child and a child in a session of its own. There are also the job and, with bubblewrap, two processes above it.
    until(lambda: sum(map(is_sleep, marked(mark))), "two children sleep", lambda count: count == 2)
    client.post(f"/v1/jobs/{job}/cancel")
    assert wait(client, job)["state"] == "cancelled"
    assert list(marked(mark)) == []


def test_sigterm_puts_running_jobs_back_and_leaves_no_process(make_live: Callable[..., Live]) -> None:
    live = make_live(**with_coverage())
    with live.client() as client:
        job = submit(client, b"held-first")
        wait(client, job, states=("running",))
        with client.stream("GET", f"/v1/jobs/{job}/events") as events:
            assert live.end(signal.SIGTERM) == 0
            # An open stream does not hold the server up: it is ended by the server, and not cut off, which is an error.
            assert events.read()
    instance = (live.data / "instance").read_text()
    assert list(marked(f"{instance}:")) == []
    live.start()
    with live.client() as client:
        ended = wait(client, job)
        assert (ended["state"], ended["attempt"]) == ("succeeded", 2)


def test_kill_9_loses_nothing(make_live: Callable[..., Live]) -> None:
    live = make_live()
    with live.client() as client:
        jobs = [submit(client, b"ignore-term 1")] + [submit(client) for _ in range(5)]
        wait(client, jobs[0], states=("running",))
        time.sleep(0.5)
    live.end(signal.SIGKILL)
    instance = (live.data / "instance").read_text()
    live.start()  # kills the grandchildren that outlived the server
    with live.client() as client:
        for job in jobs:
            assert wait(client, job)["state"] == "succeeded"
    assert list(marked(f"{instance}:")) == []
    assert len(list((live.data / "results").iterdir())) == len(jobs)


def test_a_second_server_is_refused_the_folder(make_live: Callable[..., Live]) -> None:
    live = make_live()
    first = live.process
    live.port = free_port()
    with pytest.raises(RuntimeError, match="another hsloc service is using this folder"):
        live.start()
    assert first is not None
    first.send_signal(signal.SIGTERM)
    first.wait(LIMIT_S)


def test_the_process_has_no_secret_of_the_server(make_live: Callable[..., Live]) -> None:
    token = "a-token-of-the-operator-0123456789"
    live = make_live(HSLOC_TOKEN=token)
    with live.client() as client:
        client.headers["Authorization"] = f"Bearer {token}"
        job = submit(client, b"held")
        wait(client, job, states=("running",))
        instance = (live.data / "instance").read_text()
        pids = until(lambda: list(marked(instance)), "the job's process is there")
        environment = Path(f"/proc/{pids[0]}/environ").read_bytes()
        assert token.encode() not in environment
        client.post(f"/v1/jobs/{job}/cancel")
        wait(client, job)
    until(lambda: not any((live.data / "work").iterdir()), "what the job left is removed")
    for path in live.data.rglob("*"):
        if path.is_file() and os.access(path, os.R_OK):
            assert token.encode() not in path.read_bytes()


def test_invalid_output_of_a_process_does_no_harm(client: TestClient, tmp_path: Path) -> None:
    """Neither the slot, which must note it, nor the readers of the list, which must get JSON."""
    job = submit(client, b"mad")
    shown = until(
        lambda: client.get(f"/v1/jobs/{job}").json(), "there is progress", lambda found: found["progress"] is not None
    )
    assert (shown["progress"]["phase"], shown["progress"]["done"], shown["progress"]["scans"]) == ("?", 0.5, 7)
    go_on(tmp_path / "data", job)
    ended = wait(client, job)
    assert (ended["state"], ended["reason"], ended["message"], ended["attempt"]) == ("failed", "mad?", "NaN: ?", 1)
    good = wait(client, submit(client, b"mad-end"))
    assert good["summary"] == {"warnings": ["?"], "metrics": {"ape": [None, None, 1.5]}}
    assert len(client.get("/v1/jobs").json()["jobs"]) == 2


def test_an_output_that_is_a_link_is_no_output(client: TestClient, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "folder").mkdir(parents=True)
    (elsewhere / "secret.txt").write_text("of somebody else")
    ended = wait(client, submit(client, f"link {elsewhere}".encode()))
    assert (ended["state"], ended["reason"]) == ("crashed", "exit")
    assert sorted(path.name for path in elsewhere.iterdir()) == ["folder", "secret.txt"]


def test_jobs_wait_while_the_disk_is_full(client: TestClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Who would start them now would see each of them fail, one after the other, until none is left."""
    active = submit(client, b"held")
    wait(client, active, states=("running",))
    jobs = [submit(client) for _ in range(3)]
    looks: list[int] = []

    def full(_: Storage) -> int:
        looks.append(1)
        return (1 << 20) - 1  # above half of the floor: the active one goes on

    monkeypatch.setattr(Storage, "free_bytes", full)
    go_on(tmp_path / "data", active)
    assert wait(client, active)["state"] == "succeeded"
    seen = len(looks)
    until(lambda: len(looks) >= seen + 2, "the slot has looked for a job")
    assert {client.get(f"/v1/jobs/{job}").json()["state"] for job in jobs} == {"queued"}
    monkeypatch.undo()
    assert {wait(client, job)["state"] for job in jobs} == {"succeeded"}


def test_what_cannot_be_started_is_not_tried_again_at_once(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[float] = []

    def refused(*_: object) -> None:
        tries.append(time.monotonic())
        raise OSError(errno.EAGAIN, "no more processes")

    monkeypatch.setattr(job_process, "start_job", refused)
    ended = wait(client, submit(client))
    assert (ended["state"], ended["reason"], len(tries)) == ("crashed", "attempts", 3)
    assert tries[2] - tries[0] > 1.5


@pytest.mark.parametrize("word", [b"fifo", b"hard-link"])
def test_an_inspection_reads_only_files_of_the_process(client: TestClient, word: bytes) -> None:
    found = client.post("/v1/inspect", json={"log": upload(client, word)}).json()
    assert (found["format"], found["view"], found["map_image"]) == (word.decode(), None, None)


def test_a_server_loads_nothing_that_only_jobs_need() -> None:
    heavy = {"numpy", "numba", "scipy", "matplotlib", "PIL", "fsspec", "mcap", "rosbags"}
    need_no_import("import hsloc_service.main", heavy)
