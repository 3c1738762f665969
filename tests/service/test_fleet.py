"""Several servers and workers on one PostgreSQL and one store: any may be killed, each job ends once."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import time
from typing import TYPE_CHECKING, Any
from urllib.request import urlopen

import pytest
from live_service import Worker, free_port, go_on, settings, submit, upload, wait, with_coverage
from paths import ROOT
from ruamel.yaml import YAML
from sqlalchemy import text
from waiting import LIMIT_S, until

from hsloc.cli.main import build_parser, main
from hsloc_service.errors import ServiceError
from hsloc_service.execution.input_cache import InputCache
from hsloc_service.http.app import create_app
from hsloc_service.jobs.leases import Claim
from hsloc_service.settings import SettingsError, from_environment
from hsloc_service.storage import Storage
from hsloc_service.work import serve_metrics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from fastapi.testclient import TestClient
    from postgresql import Server

PATCH = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream"}


class Fleet:
    """What servers and workers share."""

    def __init__(self, folder: Path, url: str) -> None:
        self.folder = folder
        self.shared = {"database_url": url, "store_url": f"file://{folder}/store"}
        self.workers: list[Worker] = []

    def worker(self, *arguments: str, **variables: str) -> Worker:
        shared = {f"HSLOC_{name.upper()}": value for name, value in self.shared.items()}
        self.workers.append(Worker(self.folder / f"w{len(self.workers)}", *arguments, **shared, **variables))
        return self.workers[-1]


@pytest.fixture
def fleet(tmp_path: Path, postgresql: Server) -> Iterator[Fleet]:
    made = Fleet(tmp_path, postgresql.new_database())
    yield made
    for worker in made.workers:
        if worker.process.poll() is None:
            worker.end(signal.SIGKILL)


@pytest.fixture
def servers(make_client: Callable[..., TestClient], fleet: Fleet) -> list[TestClient]:
    """Two that run no jobs themselves."""
    return [make_client(data=fleet.folder / name, slots=0, **fleet.shared) for name in ("a", "b")]


def workers_of(client: TestClient) -> list[dict[str, Any]]:
    answer = client.get("/v1/workers")
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()["workers"]
    return [each for each in found if each["kind"] == "worker"]


def upload_by_turns(servers: list[TestClient], content: bytes, block: int) -> str:
    """Each block of an upload at the next server; its id."""
    headers = {"Tus-Resumable": "1.0.0", "Upload-Length": str(len(content))}
    place = servers[-1].post("/v1/tus", headers=headers).headers["location"]
    for k, start in enumerate(range(0, len(content), block)):
        headers = {**PATCH, "Upload-Offset": str(start)}
        sent = servers[k % len(servers)].patch(place, headers=headers, content=content[start : start + block])
        assert sent.status_code == 204, sent.text
    return str(place.rsplit("/", 1)[1])


def test_servers_list_each_other_and_the_dashboard_names_metrics_that_are_there(
    make_client: Callable[..., TestClient], fleet: Fleet
) -> None:
    rates = {"requests_per_s": 0.01, "heartbeat_s": 0.1}
    one, other = (make_client(data=fleet.folder / name, slots=3, **rates, **fleet.shared) for name in ("a", "b"))
    context: Any = one.app.state.context  # type: ignore[attr-defined]
    until(context.servers, "each server knows of the other", lambda count: count == 2)
    text = one.get("/metrics").text
    assert 'hsloc_workers{kind="server"} 2.0' in text
    assert "hsloc_fleet_slots 6.0" in text
    assert one.get("/v1/info").status_code == 429  # of the burst of two, each server grants one
    assert other.get("/v1/info").status_code == 200
    known = set(re.findall(r"^# TYPE (\S+)", text, re.MULTILINE))
    board = json.loads((ROOT / "examples" / "fleet" / "grafana.json").read_text())
    for panel in board["panels"]:
        for target in panel["targets"]:
            named = re.findall(r"\b(?:hsloc|process)_\w+", target["expr"])
            assert {name.removesuffix("_bucket") for name in named} <= known, target["expr"]
            assert named
    assert len({panel["id"] for panel in board["panels"]}) == len(board["panels"])


def test_jobs_and_cancellations_at_one_server_reach_another_at_once(
    make_client: Callable[..., TestClient], fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hsloc_service.execution.dispatcher.IDLE_S", 6000.0)  # it does not look by itself
    takes = make_client(data=fleet.folder / "a", slots=0, **fleet.shared)
    runs = make_client(data=fleet.folder / "b", slots=1, heartbeat_s=3000.0, lease_s=6000.0, **fleet.shared)
    database = runs.app.state.context.database  # type: ignore[attr-defined]
    query = text("SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND query LIKE 'LISTEN %'")

    def listening() -> int:
        with database.read() as session:
            return int(session.execute(query).scalar_one())

    until(listening, "both servers listen", lambda count: count == 2)
    wait(runs, submit(runs))  # it has looked for a job in vain
    job = submit(takes, b"slow 600")
    wait(takes, job, states=("running",))
    takes.post(f"/v1/jobs/{job}/cancel")
    assert wait(takes, job)["state"] == "cancelled"


def test_an_upload_begun_at_one_server_goes_on_at_the_other_and_a_worker_runs_the_job(
    servers: list[TestClient], fleet: Fleet, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = servers
    content = b"slow 0.2 " + os.urandom(5000)
    file = other.get(f"/v1/files/{upload_by_turns(servers, content, 2000)}").json()
    assert (file["state"], file["sha256"]) == ("complete", hashlib.sha256(content).hexdigest())
    assert not list((fleet.folder / "a" / "uploads").iterdir())
    job = other.post("/v1/jobs", json={"log": file["id"]}).json()["id"]
    port = free_port()
    worker = fleet.worker("--slots", "2", "--metrics", str(port), **with_coverage())
    assert wait(one, job)["state"] == "succeeded"
    results = [client.get(f"/v1/jobs/{job}/results/trajectory.tum") for client in servers]
    assert results[0].status_code == 200
    assert results[0].content == results[1].content
    cached = fleet.workers[0].log.parent / "data" / "cache" / "inputs" / file["sha256"]
    assert cached.read_bytes() == content
    (found,) = workers_of(one)
    assert (found["slots"], found["pid"], found["alive"]) == (2, worker.process.pid, True)

    # Asked to stop, it begins nothing more, and ends what it runs.
    job = submit(other, b"held")
    wait(one, job, states=("running",))
    assert workers_of(one)[0]["jobs"] == [job]
    monkeypatch.setattr("hsloc.client.Client.workers", lambda _: one.get("/v1/workers").json()["workers"])
    assert main(["workers"]) == 0
    line = next(each for each in capsys.readouterr().out.splitlines() if each.startswith("| worker"))
    assert [word.strip() for word in line.split("|")][3:6] == [str(worker.process.pid), "2", "1"]
    with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=LIMIT_S) as answer:
        measured = answer.read().decode()
    expected = {'hsloc_jobs_ended_total{state="succeeded"} 1.0', "hsloc_slots 2.0", "hsloc_slots_busy 1.0"}
    assert expected <= set(measured.splitlines())
    assert "hsloc_fleet_slots" not in measured  # which only servers have
    worker.process.send_signal(signal.SIGTERM)
    later = submit(other)
    until(lambda: '"event": "drain"' in worker.log.read_text(), "it has heard that")
    go_on(worker.log.parent / "data", job)
    assert worker.process.wait(LIMIT_S) == 0
    assert one.get(f"/v1/jobs/{job}").json()["attempt"] == 1
    assert wait(one, job)["state"] == "succeeded"
    assert one.get(f"/v1/jobs/{later}").json()["state"] == "queued"
    assert workers_of(one) == []

    # Deleted, its parts go from the store.
    one.post(f"/v1/jobs/{later}/cancel")
    assert one.delete(f"/v1/files/{file['id']}").status_code == 204
    context: Any = one.app.state.context  # type: ignore[attr-defined]
    context.deletions.clear_uploads()
    assert file["id"] not in {name.rpartition(".")[0] for name in context.stores.parts_store.names()}


def test_a_worker_that_is_killed_or_stands_still_does_not_keep_its_job(servers: list[TestClient], fleet: Fleet) -> None:
    one, other = servers
    first = fleet.worker(**with_coverage())
    job = submit(one, b"held-first")
    wait(other, job, states=("running",))
    second = fleet.worker()
    first.process.send_signal(signal.SIGSTOP)  # cut off for longer than its lease
    ended = wait(other, job)
    assert (ended["state"], ended["attempt"]) == ("succeeded", 2)
    first.process.send_signal(signal.SIGCONT)
    job = submit(one, b"slow 1")
    assert wait(other, job)["state"] == "succeeded"
    assert one.get(f"/v1/jobs/{job}/events").text.count('"succeeded"') == 1
    until(lambda: '"state": "lost"' in first.log.read_text(), "it came back, and threw its work away")
    for worker in (first, second):
        assert worker.end() == 0


def test_a_job_outlives_a_restart_of_the_database(servers: list[TestClient], fleet: Fleet, postgresql: Server) -> None:
    one, _ = servers
    worker = fleet.worker(HSLOC_LEASE_S="100")
    job = submit(one, b"held")
    wait(one, job, states=("running",))
    postgresql.stop("immediate")
    answer = one.get(f"/v1/jobs/{job}")
    assert (answer.status_code, answer.json()["code"]) == (503, "database")
    time.sleep(1.0)
    postgresql.start()
    until(lambda: one.get(f"/v1/jobs/{job}").status_code, "the database is back", lambda status: status != 503)
    go_on(worker.log.parent / "data", job)
    ended = wait(one, job)
    assert (ended["state"], ended["attempt"]) == ("succeeded", 1), worker.log.read_text()


def test_parts_that_nothing_is_made_of_are_swept(servers: list[TestClient]) -> None:
    one, _ = servers
    file, receiving = upload(one, b"one"), one.post("/v1/tus", headers={"Tus-Resumable": "1.0.0", "Upload-Length": "9"})
    context: Any = one.app.state.context  # type: ignore[attr-defined]
    store, parts = context.stores.parts_store, context.files.parts
    ident = receiving.headers["location"].rsplit("/", 1)[1]
    for name in (f"{file}.1", f"{ident}.1"):
        staged = context.storage.work / name
        staged.mkdir()
        (staged / "part").write_bytes(b"left")
        store.publish(staged, name, [])
    # A last block that was stored, but whose upload was not completed, is sent again, and the first is removed.
    for content in (b"wrong bit", b"right bit"):
        staged = context.storage.work / content.decode().replace(" ", "-")
        staged.mkdir()
        (staged / "part").write_bytes(content)
        parts.add(ident, 0, staged, 9, last=True)
    assert b"".join(parts.blocks(ident)) == b"right bit"
    # A block that came too late is refused, and its object is removed.
    names, late = set(store.names()), context.storage.work / "late"
    late.mkdir()
    (late / "part").write_bytes(b"late")
    with pytest.raises(ServiceError, match="another request wrote"):
        parts.add(ident, 5, late, 4, last=True)
    assert set(store.names()) == names
    assert parts.sweep() == 1
    assert f"{ident}.1" in store.names()
    assert b"".join(parts.blocks(file)) == b"one"


def test_while_the_store_is_away_uploads_are_put_off_and_nothing_is_lost(
    servers: list[TestClient], fleet: Fleet
) -> None:
    one, other = servers
    deleted, _ = (upload(client) for client in servers)
    headers = {"Tus-Resumable": "1.0.0", "Upload-Length": "9"}
    place = one.post("/v1/tus", headers=headers).headers["location"]
    assert one.patch(place, headers={**PATCH, "Upload-Offset": "0"}, content=b"slow").status_code == 204
    store, away = fleet.folder / "store", fleet.folder / "away"
    store.rename(away)
    answer = one.patch(place, headers={**PATCH, "Upload-Offset": "4"}, content=b" 0.1 ")
    assert (answer.status_code, answer.json()["code"], answer.headers["retry-after"]) == (503, "store", "5")
    assert not store.exists()
    assert one.delete(f"/v1/files/{deleted}").status_code == 204
    context: Any = one.app.state.context  # type: ignore[attr-defined]
    assert context.deletions.clear_uploads() == 0
    assert other.head(place, headers={"Tus-Resumable": "1.0.0"}).headers["upload-offset"] == "4"
    away.rename(store)
    assert context.deletions.clear_uploads() == 1
    assert other.patch(place, headers={**PATCH, "Upload-Offset": "4"}, content=b" 0.1 ").status_code == 204
    file = one.get(f"/v1/files/{place.rsplit('/', 1)[1]}").json()
    assert (file["state"], file["sha256"]) == ("complete", hashlib.sha256(b"slow 0.1 ").hexdigest())
    assert not [path for name in "ab" for path in (fleet.folder / name / "work").iterdir()]


def test_copies_of_inputs_are_bounded(servers: list[TestClient], tmp_path: Path) -> None:
    one, _ = servers
    context: Any = one.app.state.context  # type: ignore[attr-defined]
    ids = [upload(one, bytes([k]) * 1000) for k in range(3)]
    storage = Storage(tmp_path / "cache")
    cache = InputCache(storage, context.files.parts, 2500)
    killed = storage.cache / "inputs" / ".unfinished"  # of a worker of an older version that was killed
    killed.parent.mkdir()
    killed.write_bytes(bytes([9]) * 900)
    os.utime(killed, (0, 0))

    class Once:
        def retry(self, what: str, work: Callable[[], None], timeout_s: float) -> None:
            work()

    for k, ident in enumerate(ids):
        claim = Claim(ident, "local", "w:1", 1, "", {"log": ident}, {})
        with cache.files(claim, Once()) as files:  # type: ignore[arg-type]
            assert files[ident].read_bytes() == bytes([k]) * 1000
            os.utime(files[ident], (k, k))
    left = sorted(path.read_bytes()[0] for path in (storage.cache / "inputs").iterdir())
    assert left == [1, 2]  # what was used longest ago went
    storage.close()


@pytest.mark.parametrize(
    ("variables", "reason"),
    [
        ({}, "set HSLOC_DATABASE_URL=postgresql://"),
        ({"HSLOC_DATABASE_URL": "postgresql://x/y"}, "set HSLOC_STORE_URL"),
        ({"HSLOC_DATABASE_URL": "postgresql://x/y", "HSLOC_STORE_URL": "file:///x", "HSLOC_SLOTS": "0"}, "slots is 0"),
        ({"HSLOC_RESULTS_URL": "file:///x", "HSLOC_STORE_URL": "file:///x"}, "store_url and results_url are both set"),
    ],
)
def test_a_worker_that_shares_nothing_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    variables: dict[str, str],
    reason: str,
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert main(["work", "--data", str(tmp_path / "data")]) == 1
    assert reason in capsys.readouterr().err
    assert not (tmp_path / "data").exists()
    for wrong in ("here", "192.0.2.1:9100"):
        with pytest.raises(SettingsError, match=f"--metrics.*{wrong}"):
            serve_metrics(wrong)


def test_a_store_that_cannot_be_used_is_named_by_its_setting(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="HSLOC_STORE_URL is 'nowhere'"):
        create_app(settings(tmp_path, store_url="nowhere"))


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket of moto's S3; the URL of a prefix in it."""
    server = pytest.importorskip("moto.server", reason="S3 IS NOT TESTED: pip install 'hsloc[dev]'")
    s3fs = pytest.importorskip("s3fs", reason="S3 IS NOT TESTED: pip install 'hsloc[dev]'")
    running = server.ThreadedMotoServer("127.0.0.1", 0)
    running.start()
    host, port = running.get_host_and_port()
    for name, value in (("ACCESS_KEY_ID", "x"), ("SECRET_ACCESS_KEY", "x"), ("DEFAULT_REGION", "us-east-1")):
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    s3fs.S3FileSystem(skip_instance_cache=True).mkdir("hsloc-test")
    yield "s3://hsloc-test/fleet"
    running.stop()


@pytest.mark.filterwarnings("ignore")  # of moto and botocore
def test_uploads_and_results_in_s3(bucket: str, make_client: Callable[..., TestClient], fleet: Fleet) -> None:
    fleet.shared["store_url"] = bucket
    one, other = (make_client(data=fleet.folder / name, slots=0, **fleet.shared) for name in ("a", "b"))
    content = b"ok " + os.urandom((5 << 20) + 7)
    file = upload_by_turns([one, other], content, 1 << 20)
    context: Any = other.app.state.context  # type: ignore[attr-defined]
    assert len(context.files.parts.of(file)) == 6
    job = other.post("/v1/jobs", json={"log": file}).json()["id"]
    worker = fleet.worker()
    assert wait(one, job)["state"] == "succeeded", worker.log.read_text()
    manifest = one.get(f"/v1/jobs/{job}/results").json()["assets"]
    for asset in manifest:
        answer = other.get(f"/v1/jobs/{job}/results/{asset['name']}")
        assert hashlib.sha256(answer.content).hexdigest() == asset["sha256"]
    assert one.delete(f"/v1/jobs/{job}").status_code == 204
    assert one.delete(f"/v1/files/{file}").status_code == 204
    context.deletions.clear()
    context.deletions.clear_uploads()
    assert context.stores.current.names() == context.stores.parts_store.names() == []


def in_container(document: Any) -> list[tuple[list[str], dict[str, str]]]:
    """Command and variables of what a compose file or the documents of Kubernetes start as hsloc."""
    if isinstance(document, dict):
        services = [each for each in document["services"].values() if each["image"] == "hsloc"]
        return [(each.get("command", ["hsloc", "serve"]), each["environment"]) for each in services]
    (variables,) = (each["data"] for each in document if each["kind"] == "ConfigMap")
    pods = [each["spec"]["template"]["spec"] for each in document if each["kind"] == "Deployment"]
    for pod in pods:
        for container in pod["containers"]:
            assert {mount["name"] for mount in container["volumeMounts"]} == {each["name"] for each in pod["volumes"]}
            assert container["envFrom"] == [{"configMapRef": {"name": "hsloc"}}, {"secretRef": {"name": "hsloc"}}]
    return [(container["command"], variables) for pod in pods for container in pod["containers"]]


@pytest.mark.parametrize("name", ["compose.fleet.yaml", "examples/fleet/service-kubernetes.yaml"])
def test_the_examples_of_a_fleet_are_what_this_version_takes(name: str) -> None:
    documents = list(YAML(typ="safe").load_all((ROOT / name).read_text()))
    started = in_container(documents[0] if len(documents) == 1 else documents)
    commands = []
    for command, variables in started:
        words = (
            " ".join(command).partition("hsloc ")[2]
            if command[0] == "hsloc"
            else command[-1].partition("exec hsloc ")[2]
        )
        arguments = build_parser().parse(words.split())
        commands.append(arguments.command)
        known = {key: str(value) for key, value in variables.items() if key != "PGPASSWORD"}
        chosen = from_environment(known, slots=arguments.slots)
        assert chosen.database_url.startswith("postgresql://")
        assert chosen.store_url
        assert chosen.slots == (0 if arguments.command == "serve" else 1)
    assert set(commands) == {"serve", "work"}
    stops = [each["spec"]["template"]["spec"] for each in documents if each and each.get("kind") == "Deployment"]
    assert all(pod["terminationGracePeriodSeconds"] > 600 for pod in stops if pod["containers"][0]["name"] == "worker")
