"""A hostile job: what it can reach of the server, its files, other tenants and the network."""

from __future__ import annotations

import os
import shutil
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from fastapi.testclient import TestClient
from live_service import settings, submit, upload, wait
from waiting import until

from hsloc_service.execution import limits
from hsloc_service.execution.sandbox import bubblewrap_problem, choose_sandbox
from hsloc_service.http.app import create_app
from hsloc_service.settings import Settings, SettingsError
from hsloc_service.storage import folder_bytes, remove_tree

if TYPE_CHECKING:
    from collections.abc import Callable

    from live_service import Live

pytestmark = pytest.mark.unmeasured

KINDS = ["bubblewrap", "landlock"]
RECORDINGS = Path(__file__).parents[2] / "recordings"


def need(kind: str) -> None:
    if kind == "bubblewrap" and (reason := bubblewrap_problem()) is not None:
        pytest.skip(f"BUBBLEWRAP IS NOT TESTED: {reason} (apt-get install bubblewrap)")
    if kind == "landlock" and limits.landlock_abi() < limits.MIN_LANDLOCK_ABI:
        pytest.skip("LANDLOCK IS NOT TESTED: the kernel has none")


def other_program(live: Live) -> socket.socket:
    """A socket in a folder, as databases have them."""
    found = socket.socket(socket.AF_UNIX)
    found.bind(str(live.data.parent / "line"))
    found.listen()
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_a_hostile_job_reaches_nothing(make_live: Callable[..., Live], kind: str) -> None:
    need(kind)
    live = make_live(HSLOC_SANDBOX=kind)
    assert live.process is not None
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(("127.0.0.1", 0))
    listener.setblocking(False)
    other = other_program(live)
    with live.client() as client:
        for _ in range(3):
            upload(client, b"of somebody else")
        job = submit(client, f"attack {live.port} {live.process.pid} {listener.getsockname()[1]}".encode())
        ended = wait(client, job)
        assert ended["state"] == "succeeded", ended
        report = client.get(f"/v1/jobs/{job}/results/report.json").json()
        names = {asset["name"] for asset in client.get(f"/v1/jobs/{job}/results").json()["assets"]}
    other.close()
    assert len(report) == 14
    with pytest.raises(BlockingIOError):
        listener.recv(1)
    listener.close()
    allowed = {name for name, answer in report.items() if not answer.startswith("refused")}
    # In a process namespace the number may be that of a process of the job's own.
    assert allowed <= ({"signal to the server"} if kind == "bubblewrap" else set()), report
    assert names == {"metrics.json", "report.json", "trajectory.tum"}
    assert not (live.data / "results" / "planted").exists()
    assert live.process.poll() is None


def test_without_a_sandbox_the_same_job_does_reach_things(make_live: Callable[..., Live]) -> None:
    """That the attacks above are real; and the second name of the database is not published even so."""
    live = make_live(HSLOC_SANDBOX="none")
    assert live.process is not None
    with live.client() as client, other_program(live):
        upload(client, b"of somebody else")
        job = submit(client, f"attack {live.port} {live.process.pid} 9".encode())
        wait(client, job)
        report = client.get(f"/v1/jobs/{job}/results/report.json").json()
        names = {asset["name"] for asset in client.get(f"/v1/jobs/{job}/results").json()["assets"]}
    for name in (
        *("read database", "link database", "change permissions", "change times", "list uploads"),
        *("environment of the server", "socket of another program", "tcp"),
    ):
        assert report[name].startswith("done"), report
    assert "stolen.db" not in names


def digests(folder: Path, kind: str) -> dict[str, str]:
    """Names and SHA-256 of the results of a short run, but for its wall times."""
    changes = {"worker_command": Settings().worker_command, "job_memory_bytes": 4 << 30}
    with TestClient(create_app(settings(folder, sandbox=kind, **changes))) as client:
        log = upload(client, (RECORDINGS / "office.mcap").read_bytes(), "office.mcap")
        job = client.post("/v1/jobs", json={"log": log, "read": {"end_s": 3.0}}).json()["id"]
        ended = wait(client, job)
        assert ended["state"] == "succeeded", ended
        assets = client.get(f"/v1/jobs/{job}/results").json()["assets"]
    return {asset["name"]: asset["sha256"] for asset in assets if asset["name"] != "timings.json"}


@pytest.fixture(scope="module")
def without_sandbox(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return digests(tmp_path_factory.mktemp("without-sandbox"), "none")


@pytest.mark.parametrize("kind", KINDS)
def test_a_job_in_a_sandbox_computes_the_same(tmp_path: Path, without_sandbox: dict[str, str], kind: str) -> None:
    need(kind)
    assert digests(tmp_path, kind) == without_sandbox


def test_folders_nested_deeply_end_the_job_and_can_be_removed(tmp_path: Path) -> None:
    with TestClient(create_app(settings(tmp_path, sandbox="none"))) as client:
        job = submit(client, b"nest 3000")
        ended = wait(client, job)
        assert ended["state"] in ("failed", "succeeded"), ended
        until(lambda: not list((tmp_path / "data" / "work").iterdir()), "the folder of the attempt is gone")
    deep = tmp_path / "data" / "work" / f"{job}.9"
    deep.mkdir()
    here = os.getcwd()
    try:
        os.chdir(deep)
        for _ in range(3000):
            os.mkdir("d")
            os.chdir("d")
    finally:
        os.chdir(here)
    assert folder_bytes(deep) == float("inf")
    with TestClient(create_app(settings(tmp_path, sandbox="none"))) as client:  # before: RecursionError at the start
        assert client.get("/readyz").status_code == 200
    assert not deep.exists()


def test_a_tree_without_permissions_is_removed(tmp_path: Path) -> None:
    inner = tmp_path / "a" / "b" / "c"
    inner.mkdir(parents=True)
    (inner / "file").touch()
    (tmp_path / "outside").mkdir()
    (tmp_path / "a" / "link").symlink_to(tmp_path / "outside")
    inner.chmod(0o000)
    inner.parent.chmod(0o000)
    remove_tree(tmp_path / "a")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["outside"]
    remove_tree(tmp_path / "absent")


def test_where_no_sandbox_can_be_had_the_server_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(limits, "landlock_abi", lambda: 0)
    for expected in ("auto", "bubblewrap", "landlock"):
        with pytest.raises(SettingsError, match=r"cannot be kept apart.*install bubblewrap.*HSLOC_SANDBOX=none"):
            choose_sandbox(expected, tmp_path, ())
    for allowed in ("none", "if-possible"):
        assert choose_sandbox(allowed, tmp_path, ()).kind == "none"
    with pytest.raises(SettingsError, match="sandbox is 'chroot'"):
        settings(tmp_path, sandbox="chroot")


def test_a_job_in_a_sandbox_is_cancelled(make_client: Callable[..., TestClient]) -> None:
    need("bubblewrap")
    client = make_client(sandbox="bubblewrap")
    job = submit(client, b"ignore-term 600")
    wait(client, job, states=("running",))
    time.sleep(0.5)
    client.post(f"/v1/jobs/{job}/cancel")
    assert wait(client, job)["state"] == "cancelled"
