"""The client and `hsloc submit`, against servers that behave badly on purpose."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import threading
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from live_service import free_port
from paths import RECORDINGS
from waiting import LIMIT_S

from hsloc.cli.main import main
from hsloc.client import Client, ClientError
from hsloc_service.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from live_service import Live


REAL = {
    "HSLOC_WORKER_COMMAND": ",".join(Settings().worker_command),
    "HSLOC_SANDBOX": "none",  # in which a job could not keep what it compiles
    "HSLOC_JOB_MEMORY_BYTES": "4G",
}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run one.mcap"
    path.write_bytes(b"ok " + os.urandom(3_000_000))
    return path


def test_upload_submit_wait_download_through_faults(make_live: Callable[..., Live], log: Path, tmp_path: Path) -> None:
    live = make_live(HSLOC_FAULT_DROP_UPLOADS="0.3", HSLOC_FAULT_FAIL_REQUESTS="0.15")
    client = Client(live.url, attempts=30, block=1_100_000)
    seen: list[int] = []
    ident = client.upload(log, lambda done, total: seen.append(done))
    assert seen[-1] == log.stat().st_size
    job = client.submit(ident, seed=4)
    assert client.wait(job["id"], every_s=0.1)["state"] == "succeeded"
    paths = client.download(job["id"], tmp_path / "out")
    assert {path.name for path in paths} == {"metrics.json", "trajectory.tum"}
    assert (tmp_path / "out" / "trajectory.tum").read_text().startswith("4 ")
    with live.client() as plain:
        found: list[Any] = []
        while not found:
            answer = plain.get("/v1/jobs")
            found = answer.json()["jobs"] if answer.status_code == 200 else []
    assert len(found) == 1  # however often it was sent


def test_waiting_outlives_a_server_that_is_killed(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live()
    (tmp_path / "slow.mcap").write_bytes(b"slow 1")
    client = Client(live.url)
    job = client.submit(client.upload(tmp_path / "slow.mcap"))
    ended: list[dict[str, Any]] = []
    waiter = threading.Thread(target=lambda: ended.append(client.wait(job["id"])))
    waiter.start()
    time.sleep(0.7)
    live.end(signal.SIGKILL)
    live.start()
    waiter.join(LIMIT_S)
    assert ended[0]["state"] == "succeeded"


def test_refusals_are_reported_at_once(make_live: Callable[..., Live], log: Path) -> None:
    live = make_live(HSLOC_TOKEN="a-token-of-the-operator-0123456789", HSLOC_MAX_UPLOAD_BYTES="1M")
    with pytest.raises(ClientError, match="send a token") as refused:
        Client(live.url).upload(log)
    assert refused.value.status == 401
    with pytest.raises(ClientError, match="at most 1048576 are taken"):
        Client(live.url, "a-token-of-the-operator-0123456789").upload(log)
    with pytest.raises(ClientError, match=r"cannot be reached"):
        Client("http://127.0.0.1:1", attempts=2).job("x")
    with pytest.raises(ClientError, match="begins with http"):
        Client("localhost:8000")
    empty = log.with_name("empty.mcap")
    empty.touch()
    with pytest.raises(ClientError, match=r"empty\.mcap: is empty \(0 bytes\); copy it again, or record again"):
        Client(live.url, "a-token-of-the-operator-0123456789").upload(empty)
    with pytest.raises(ClientError, match=r"no such file"):
        Client(live.url).upload(log.parent / "not there")


class Done(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def submit(live: Live, *arguments: str) -> Done:
    """`hsloc submit`."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(["submit", "--url", live.url, *arguments])
    return Done(code, out.getvalue(), err.getvalue())


def test_the_command(make_live: Callable[..., Live], log: Path, tmp_path: Path) -> None:
    live = make_live()
    done = submit(live, str(log), "--wait", "--out", str(tmp_path / "got"), "--seed", "8")
    assert done.returncode == 0, done.stderr
    assert "succeeded" in done.stdout
    assert (tmp_path / "got" / "trajectory.tum").read_text().startswith("8 ")
    assert "hsloc: warning: the stamps are 3.0 s apart; check the clocks\n" in done.stderr
    assert done.stderr.count("hsloc: warning:") == 1
    assert "verdict: check\n" in done.stdout
    assert " ".join(done.stdout.split()).endswith("APE rmse 1.23 cm 0.45°")
    log.write_bytes(b"bad-input")
    failed = submit(live, str(log), "--wait")
    assert failed.returncode == 1
    assert "run.mcap: no scan" in failed.stdout
    missing = submit(live, str(log.parent / "nothing.mcap"))
    assert missing.returncode == 1
    assert missing.stderr.count("\n") == 1
    assert "Traceback" not in missing.stderr


def test_failing_on_purpose(make_live: Callable[..., Live], log: Path) -> None:
    live = make_live(HSLOC_FAULT_FAIL_JOBS="1")
    done = submit(live, str(log), "--wait")
    assert done.returncode == 1
    assert "fault_injection" in done.stdout


def test_the_command_sends_what_replay_takes(make_live: Callable[..., Live], log: Path, tmp_path: Path) -> None:
    live = make_live()
    (tmp_path / "two.mcap").write_bytes(b"second part")
    (tmp_path / "some.relations").write_text("1 2 0 0 0 0 0 0\n")
    done = submit(
        live,
        *("-q", str(log), str(tmp_path / "two.mcap"), "--relations", str(tmp_path / "some.relations")),
        *("--alignment", "origin", "--no-odom", "--scan-topic", "/a", "--scan-topic", "/b", "--start", "2"),
        *("--laser-pose", "1,2,3", "--deskew", "--mode", "slam"),
    )
    assert done.returncode == 0, done.stderr
    client = Client(live.url)
    job = client.job(done.stdout.strip())
    request = job["request"]
    assert job["log"] == "run one.mcap, two.mcap"
    assert len(request["logs"]) == 2
    names = [client.request("GET", f"/v1/files/{ident}").json()["name"] for ident in request["logs"]]
    assert names == ["run one.mcap", "two.mcap"]
    assert client.request("GET", f"/v1/files/{request['relations']}").json()["name"] == "some.relations"
    assert (request["alignment"], request["no_odometry"], request["mode"]) == ("origin", True, "slam")
    read = {key: value for key, value in request["read"].items() if value is not None}
    assert read == {"scan_topic": "/a,/b", "start_s": 2.0, "laser_pose": [1.0, 2.0, 3.0], "deskew": True}
    assert client.wait(job["id"], every_s=0.1)["state"] == "succeeded"
    refused = submit(live, str(log), "--resume", job["id"])
    assert refused.returncode == 1
    assert "drew no map" in refused.stderr
    assert refused.stderr.count("\n") == 1


def test_a_job_whose_result_does_not_keep_a_limit_is_below_threshold(
    make_live: Callable[..., Live], capsys: pytest.CaptureFixture[str]
) -> None:
    """A limit, --duration and --set travel to the job; the answer is an outcome of the job and exit code 4."""
    live = make_live(**REAL)
    argv = ["submit", str(RECORDINGS / "slip.mcap"), "--url", live.url, "--wait", "-q", "--duration", "4"]
    assert main([*argv, "--set", "matcher.budget=150", "--max-ape", "0.0001", "--min-localised", "0.9"]) == 4
    printed = capsys.readouterr()
    assert [line[:40] for line in printed.err.splitlines()] == ["hsloc: limit not kept: --max-ape 0.0001:"]
    job = Client(live.url).request("GET", f"/v1/jobs/{printed.out.strip()}").json()
    assert (job["state"], job["outcome"]) == ("succeeded", "below_threshold")
    assert job["summary"]["limits"][0].startswith("--max-ape 0.0001: the RMSE of the position is ")
    assert job["request"]["read"]["end_s"] == 4.0
    assert job["request"]["config"] == {"hide": {"budget": 150}}
    assert main([*argv, "--max-ape", "1", "--matcher", "hs"]) == 0
    job = Client(live.url).request("GET", f"/v1/jobs/{capsys.readouterr().out.strip()}").json()
    assert job["outcome"] == "ok"
    assert job["summary"]["metrics"]["run"]["matcher"] == "harmony_search"


def test_a_reference_is_uploaded_and_named_without_the_servers_folders(
    make_live: Callable[..., Live], tmp_path: Path
) -> None:
    live = make_live(**REAL)
    assert main(["replay", str(RECORDINGS / "slip.mcap"), "-q", "--end", "4", "--out", str(tmp_path / "here")]) == 0
    argv = ["submit", str(RECORDINGS / "slip.mcap"), "--url", live.url, "-q", "--end", "4"]
    argv += ["--reference", str(tmp_path / "here" / "reference.tum"), "--out", str(tmp_path / "there")]
    assert main(argv) == 0
    found, expected = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("there", "here"))
    assert found["log"]["reference"] == "reference.tum"
    assert found["ape"]["trans_part"]["rmse"] == pytest.approx(expected["ape"]["trans_part"]["rmse"], abs=1e-6)
    for name in ("config.yaml", "report.html", "metrics.json"):
        assert str(live.data) not in (tmp_path / "there" / name).read_text()
    assert "--reference=reference.tum" in (tmp_path / "there" / "config.yaml").read_text()


class Clock:
    """Stands in for the module `time`: a sleep takes none."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_a_closed_port_is_given_up_within_seconds(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("hsloc.client.time", clock)
    with pytest.raises(ClientError, match=r"cannot be reached.*refused.*is the server running, and the address right"):
        Client(f"http://127.0.0.1:{free_port()}").upload(log)
    assert 1.0 < clock.now < 10.0
