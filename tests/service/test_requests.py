"""Several logs, relations and maps that are extended: the bytes of `hsloc replay`, and who may name what."""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
import uuid
from typing import TYPE_CHECKING, Any

import pytest
from live_service import submit, upload, wait, without_command
from mcap.reader import make_reader
from mcap.writer import Writer
from paths import RECORDINGS
from waiting import until

from hsloc.cli.main import main
from hsloc_service.auth import Tokens
from hsloc_service.db.tables import AssetRow
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.http.schemas import JobRequest
from hsloc_service.results.store import Asset
from hsloc_service.settings import Settings
from hsloc_service.stored_request import ALWAYS, ALWAYS_READ, plain

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from fastapi.testclient import TestClient
    from live_service import Live
    from postgresql import Server

pytestmark = pytest.mark.unmeasured

OFFICE = RECORDINGS / "office.mcap"
REAL = Settings().worker_command


def cut(path: Path, at_s: float, end_s: float, folder: Path) -> list[Path]:
    """The messages of a log before and after a moment, as two files of one name."""
    paths = [folder / part / "run.mcap" for part in ("first", "second")]
    for k, target in enumerate(paths):
        target.parent.mkdir()
        with path.open("rb") as source, target.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2")
            known: dict[int, int] = {}
            origin: int | None = None
            for schema, channel, message in make_reader(source).iter_messages():
                origin = message.log_time if origin is None else origin
                late = message.log_time - origin >= at_s * 1e9
                if late != bool(k) or message.log_time - origin > end_s * 1e9:
                    continue
                if channel.id not in known:
                    assert schema is not None
                    ident = writer.register_schema(schema.name, schema.encoding, schema.data)
                    known[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, ident, channel.metadata
                    )
                writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
            writer.finish()  # type: ignore[no-untyped-call]
    return paths


def replay(folder: Path, *arguments: str) -> None:
    """`hsloc replay` in a folder; in this process, as the start of another takes longer than the run."""
    with contextlib.chdir(folder):
        assert main(["replay", "-q", *arguments]) == 0


def same_bytes(client: TestClient, job: str, folder: Path) -> None:
    ended = wait(client, job)
    assert ended["state"] == "succeeded", ended
    names = {each["name"] for each in client.get(f"/v1/jobs/{job}/results").json()["assets"]}
    theirs = {path.name for path in folder.iterdir()}
    assert theirs <= names
    for name in sorted(theirs - {"timings.json"}):
        found = client.get(f"/v1/jobs/{job}/results/{name}").content
        assert without_command(name, found) == without_command(name, (folder / name).read_bytes()), name


def test_two_parts_then_an_extended_map_scored_by_relations(
    make_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    client = make_client(worker_command=REAL, job_memory_bytes=4 << 30)
    parts = cut(OFFICE, 4.0, 9.0, tmp_path)
    logs = [upload(client, path.read_bytes(), "run.mcap") for path in parts]
    replay(tmp_path, *map(str, parts), "--mode", "slam", "--out", "drawn")  # first: a job keeps nothing it compiles
    drawn = client.post("/v1/jobs", json={"logs": logs, "mode": "slam"})
    assert drawn.status_code == 201, drawn.text
    assert drawn.json()["log"] == "run.mcap, run.mcap"
    same_bytes(client, drawn.json()["id"], tmp_path / "drawn")
    lines = (tmp_path / "drawn" / "trajectory.tum").read_text().splitlines()
    assert float(lines[-1].split()[0]) - float(lines[0].split()[0]) > 7.5  # both parts are in it

    # The next run begins where these end, and is scored by what the first one found for the time of both.
    first, last = lines[-40].split(), lines[-1].split()
    (tmp_path / "some.relations").write_text(f"{first[0]} {last[0]} 0.1 0 0 0 0 0\n# a comment\n1 2 0 0 0 0 0 0\n")
    more = {
        "log": upload(client, OFFICE.read_bytes(), "office.mcap"),
        "relations": upload(client, (tmp_path / "some.relations").read_bytes(), "some.relations"),
        "resume": drawn.json()["id"],
        "read": {"start_s": 5.0, "end_s": 12.0},
        "config": {"graph_mapper": {"passes": 2}},  # not those of the map: there is a warning that names its file
    }
    (tmp_path / "other.yaml").write_text("graph_mapper: {passes: 2}\n")
    replay(
        tmp_path / "drawn",
        *(str(OFFICE), "--resume", "map.npz", "--relations", str(tmp_path / "some.relations")),
        *("--start", "5", "--end", "12", "--config", str(tmp_path / "other.yaml")),
        *("--out", str(tmp_path / "extended")),
    )
    extended = client.post("/v1/jobs", json=more)
    assert extended.status_code == 201, extended.text
    same_bytes(client, extended.json()["id"], tmp_path / "extended")
    metrics = json.loads((tmp_path / "extended" / "metrics.json").read_text())
    assert metrics["run"]["map"] == "map.npz, extended"
    assert any(each["code"] == "map_parameters_differ" for each in metrics["warnings"])
    assert (metrics["relations"]["matched"], metrics["relations"]["unmatched"]) == (1, 1)
    summary = client.get(f"/v1/jobs/{extended.json()['id']}").json()["summary"]
    assert summary["metrics"]["relations"] == metrics["relations"]

    on_it = {"log": more["log"], "resume": more["resume"], "mode": "localise", "unknown_start": True}
    on_map = ("--mode", "localise", "--map", "map.npz", "--unknown-start", "--end", "6")
    replay(tmp_path / "drawn", str(OFFICE), *on_map, "--out", str(tmp_path / "localised"))
    localised = client.post("/v1/jobs", json={**on_it, "read": {"end_s": 6.0}})
    assert localised.status_code == 201, localised.text
    same_bytes(client, localised.json()["id"], tmp_path / "localised")
    metrics = json.loads((tmp_path / "localised" / "metrics.json").read_text())
    assert (metrics["run"]["mode"], metrics["run"]["map"]) == ("localise", "map.npz")


def test_relations_that_cannot_be_read_are_refused_at_once(make_client: Callable[..., TestClient]) -> None:
    client = make_client(worker_command=REAL, job_memory_bytes=4 << 30)
    log = upload(client, OFFICE.read_bytes(), "office.mcap")
    relations = upload(client, b"1 2 0 0 0 0 0 0\n1 2 3\n", "wrong.relations")
    job = client.post("/v1/jobs", json={"log": log, "relations": relations}).json()["id"]
    ended = wait(client, job)
    assert (ended["state"], ended["reason"]) == ("failed", "invalid_input"), ended
    assert ended["message"].startswith("wrong.relations, line 2: 3 columns")
    phases = [row["phase"] for row in events(client, job) if "phase" in row]
    assert "replay" not in phases


def events(client: TestClient, job: str) -> list[dict[str, Any]]:
    text = client.get(f"/v1/jobs/{job}/events", params={"follow": "false"}).text
    return [json.loads(line[6:]) for line in text.splitlines() if line.startswith("data: ")]


def mapped(client: TestClient, content: bytes = b"ok") -> str:
    """A job of the fake worker that left a map."""
    job = submit(client, content)
    wait(client, job)
    context = client.app.state.context  # type: ignore[attr-defined]
    content = b"a saved map"
    folder = context.storage.results / f"{job}.1"
    (folder / "map.npz").write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    with context.database.write() as session:
        asset = Asset("map.npz", len(content), digest, "application/octet-stream")
        session.add(AssetRow(job_id=job, **{name: getattr(asset, name) for name in asset.__slots__}))
    return job


def refused(client: TestClient, status: int, **request: Any) -> str:
    answer = client.post("/v1/jobs", json=request)
    assert answer.status_code == status, answer.text
    return str(answer.json()["message"])


def test_only_a_job_that_drew_a_map_can_be_extended(client: TestClient) -> None:
    log = upload(client)
    localised = submit(client)
    wait(client, localised)
    assert "drew no map" in refused(client, 422, log=log, resume=localised)
    failed = submit(client, b"bad-input")
    wait(client, failed)
    assert "is failed; only a succeeded one" in refused(client, 422, log=log, resume=failed)
    running = submit(client, b"slow 600")
    wait(client, running, states=("running",))
    assert "is running; only a succeeded one" in refused(client, 422, log=log, resume=running)
    client.post(f"/v1/jobs/{running}/cancel")
    assert "there is no job" in refused(client, 404, log=log, resume=str(uuid.uuid4()))
    assert "resume" in refused(client, 422, log=log, resume="latest")


def test_what_contradicts_itself_is_refused(client: TestClient) -> None:
    log, other, job = upload(client), upload(client), mapped(client)
    assert "either `log`, or `logs`" in refused(client, 422)
    assert "either `log`, or `logs`" in refused(client, 422, log=log, logs=[log, other])
    assert "named twice" in refused(client, 422, logs=[log, log])
    assert "logs" in refused(client, 422, logs=[])
    assert "leave out one" in refused(client, 422, log=log, resume=job, map={"yaml": log, "image": other})
    assert "graph mapper" in refused(client, 422, log=log, resume=job, mapper="point")
    plan = {"yaml": log, "image": other}
    for change in ({"resume": job}, {"mode": "localise"}, {"mapper": "point"}, {"config": {"mapper": "point"}}):
        assert "leave out `align_to`, or" in refused(client, 422, log=log, align_to=plan, **change)
    again = submit(client, b"ok", align_to=plan)
    assert client.post(f"/v1/jobs/{again}/rerun", json={"mode": "localise"}).status_code == 422
    answer = client.post(f"/v1/jobs/{again}/rerun", json={"mode": "localise", "align_to": None})
    assert "align_to" not in answer.json()["request"]
    again = submit(client, b"ok", resume=job)
    answer = client.post(f"/v1/jobs/{again}/rerun", json={"mapper": "point"})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid")
    assert "graph mapper" in answer.json()["message"]


def test_a_text_that_the_database_does_not_take_is_refused(
    make_client: Callable[..., TestClient], postgresql: Server
) -> None:
    client = make_client(database_url=postgresql.new_database())
    request = {"log": upload(client), "webhook": "http://receiver/\0"}
    for answer in (client.get("/v1/jobs", params={"search": "a\0b"}), client.post("/v1/jobs", json=request)):
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid")
        assert answer.json()["message"] == "a text holds a character that the database does not take"


def test_what_belongs_to_others_is_not_there(make_client: Callable[..., TestClient]) -> None:
    client = make_client(require_token=True)
    tokens = Tokens(client.app.state.context.database)  # type: ignore[attr-defined]
    owner, other = tokens.issue("one"), tokens.issue("two")
    client.headers["Authorization"] = f"Bearer {owner}"
    theirs, job = upload(client), mapped(client)
    client.headers["Authorization"] = f"Bearer {other}"
    mine = upload(client)
    assert "there is no job" in refused(client, 404, log=mine, resume=job)
    assert "relations: there is no file" in refused(client, 404, log=mine, relations=theirs)
    assert "log: there is no file" in refused(client, 404, logs=[mine, theirs])
    for name in ("map", "align_to"):
        for part in ("yaml", "image"):
            chart = {"yaml": mine, "image": mine, part: theirs}
            assert f"{name}.{part}: there is no file" in refused(client, 404, log=mine, **{name: chart})
    assert client.get("/v1/jobs").json()["jobs"] == []
    begun = client.post("/v1/tus", headers={"Tus-Resumable": "1.0.0", "Upload-Length": "9"}).headers["location"]
    assert "not finished" in refused(client, 409, log=mine, relations=begun.rsplit("/", 1)[1])


def test_what_an_active_job_reads_stays(make_client: Callable[..., TestClient]) -> None:
    client = make_client(retention_s=100.0)
    drawn = mapped(client)
    logs, relations = [upload(client, b"slow 600"), upload(client)], upload(client)
    job = client.post("/v1/jobs", json={"logs": logs, "relations": relations, "resume": drawn}).json()["id"]
    wait(client, job, states=("running",))
    for file in (*logs, relations):
        assert client.delete(f"/v1/files/{file}").json()["code"] == "in_use"
    assert client.delete(f"/v1/jobs/{drawn}").json()["code"] == "in_use"
    context = client.app.state.context  # type: ignore[attr-defined]
    Housekeeping(context.database, context.storage, context.settings, context.deletions).tidy(time.time() + 150.0)
    assert client.get(f"/v1/jobs/{drawn}/results/map.npz").content == b"a saved map"
    assert len(client.get("/v1/files").json()["files"]) == 3
    client.post(f"/v1/jobs/{job}/cancel")
    wait(client, job)
    charts = {name: {"yaml": upload(client), "image": upload(client)} for name in ("map", "align_to")}
    on_plan = submit(client, b"slow 600", **charts)
    for file in (ident for chart in charts.values() for ident in chart.values()):
        assert client.delete(f"/v1/files/{file}").json()["code"] == "in_use"
    client.post(f"/v1/jobs/{on_plan}/cancel")
    assert client.delete(f"/v1/jobs/{drawn}").status_code == 204
    assert client.post(f"/v1/jobs/{job}/rerun").status_code == 404  # what it extended is gone


def test_a_saved_map_that_was_changed_is_not_extended(make_client: Callable[..., TestClient]) -> None:
    client = make_client(max_attempts=2)
    drawn = mapped(client)
    storage = client.app.state.context.storage  # type: ignore[attr-defined]
    for content in (b"another map", b"short"):
        (storage.results / f"{drawn}.1" / "map.npz").write_bytes(content)
        ended = wait(client, submit(client, b"ok", resume=drawn))
        assert (ended["state"], ended["reason"]) == ("crashed", "attempts")
        assert "map.npz" in ended["message"]


def test_the_folder_of_an_attempt_has_the_inputs_of_the_request(client: TestClient) -> None:
    drawn = mapped(client)
    logs = [upload(client, b"slow 600", "run.mcap"), upload(client, b"part two", "run.mcap")]
    relations = upload(client, b"1 2 0 0 0 0 0 0", "../a relation")
    job = client.post("/v1/jobs", json={"logs": logs, "relations": relations, "resume": drawn}).json()["id"]
    until(
        lambda: (client.get(f"/v1/jobs/{job}").json()["progress"] or {}).get("phase"),
        "the process runs",  # the folder is made after the job was claimed
        lambda phase: phase == "replay",
    )
    storage = client.app.state.context.storage  # type: ignore[attr-defined]
    folder = storage.work / f"{job}.1"
    found = json.loads((folder / "job.json").read_text())
    assert found["logs"] == ["input/run.mcap", "input-2/run.mcap"]
    assert [(folder / place).read_bytes() for place in found["logs"]] == [b"slow 600", b"part two"]
    assert (folder / "relations" / found["relations"]).read_bytes() == b"1 2 0 0 0 0 0 0"
    assert (folder / found["resume"]).read_bytes() == b"a saved map"
    client.post(f"/v1/jobs/{job}/cancel")
    wait(client, job)


def test_all_of_it_in_one_request(client: TestClient) -> None:
    drawn = mapped(client)
    files = [("log", ("a.mcap", b"ok")), ("log", ("b.mcap", b"ok")), ("relations", ("r", b"1 2 0 0 0 0 0 0"))]
    answer = client.post("/v1/run", files=files, data={"request": json.dumps({"resume": drawn})})
    assert answer.status_code == 201, answer.text
    job = answer.json()
    assert (job["log"], job["request"]["resume"]) == ("a.mcap, b.mcap", drawn)
    assert len(job["request"]["logs"]) == 2
    assert wait(client, job["id"])["state"] == "succeeded"
    for data in ({"request": '{"logs": []}'}, {"request": '{"resume": "x"}'}, {"request": "[]"}):
        assert client.post("/v1/run", files=files, data=data).status_code == 422
    twice = [*files, ("relations", ("r", b"x"))]
    assert client.post("/v1/run", files=twice).status_code == 422
    assert len(client.get("/v1/files").json()["files"]) == 4  # none of the refused


def test_every_example_of_the_api_fits_it(client: TestClient) -> None:
    from hsloc_service.http.schemas import JobRequest

    schema = client.get("/openapi.json").json()["components"]["schemas"]["JobRequest"]
    assert len(schema["examples"]) >= 2
    named = set()
    for example in schema["examples"]:
        JobRequest.model_validate(example)
        named |= set(example)
    assert {"log", "logs", "relations", "resume", "align_to"} <= named


def test_what_has_not_changed_is_304_and_the_rest_is_compressed(make_live: Callable[..., Live]) -> None:
    live = make_live()
    with live.client() as client:
        jobs = [submit(client, seed=seed, config={"hide": {"budget": 300}}) for seed in range(20)]
        for job in jobs:
            wait(client, job)
        full = client.get("/v1/jobs", headers={"Accept-Encoding": "identity"})
        packed = client.get("/v1/jobs", headers={"Accept-Encoding": "gzip"})
        assert packed.headers["content-encoding"] == "gzip"
        assert int(packed.headers["content-length"]) < len(full.content) / 5
        assert packed.json() == full.json()
        again = client.get("/v1/jobs", headers={"If-None-Match": packed.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
        submit(client)
        assert client.get("/v1/jobs", headers={"If-None-Match": packed.headers["etag"]}).status_code == 200


def test_a_request_is_kept_as_version_0_1_kept_it() -> None:
    """An Idempotency-Key from before an update still finds its job: new options that are as usual are left out."""
    request = JobRequest.model_validate({"log": str(uuid.uuid4()), "read": {"start_s": 1.0}})
    kept = plain(request.model_dump())
    assert set(kept) == {"log", *ALWAYS}
    assert set(kept["read"]) == set(ALWAYS_READ)
    more = JobRequest.model_validate({"log": request.log, "max_ape": 0.1, "read": {"stamps": "log"}})
    assert {"max_ape", *kept} == set(plain(more.model_dump()))
    assert plain(more.model_dump())["read"]["stamps"] == "log"
