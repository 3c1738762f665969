"""Jobs through the API, with the fake worker."""

from __future__ import annotations

import json
import time
import uuid
from typing import TYPE_CHECKING, Any

import pytest
from live_service import go_on, submit, upload, wait
from waiting import until

from hsloc_service.http.validation import IN_WORDS, TAG_PATTERN, URL_PATTERN, UUID_PATTERN

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from fastapi.testclient import TestClient


def test_the_same_idempotency_key_makes_one_job(client: TestClient) -> None:
    request = {"log": upload(client), "seed": 3}
    first = client.post("/v1/jobs", json=request, headers={"Idempotency-Key": "k"})
    again = client.post("/v1/jobs", json=request, headers={"Idempotency-Key": "k"})
    assert (first.status_code, again.status_code) == (201, 200)
    assert first.json()["id"] == again.json()["id"]
    other = client.post("/v1/jobs", json={**request, "seed": 4}, headers={"Idempotency-Key": "k"})
    assert (other.status_code, other.json()["code"]) == (409, "idempotency")
    assert len(client.get("/v1/jobs").json()["jobs"]) == 1


def test_a_running_job_reports_its_progress(client: TestClient, tmp_path: Path) -> None:
    job = submit(client, b"held")

    def shown() -> dict[str, Any]:
        asked = time.time()
        return {**client.get(f"/v1/jobs/{job}").json(), "asked": asked}

    first = until(shown, "there is progress", lambda found: found["progress"] is not None)
    assert (first["progress"]["phase"], first["progress"]["text"]) == ("replay", "replay")
    fraction = first["progress"]["fraction"]
    assert 0.0 < fraction < 0.9
    later = until(shown, "there is more", lambda found: found["progress"]["fraction"] > fraction)
    for age_s in (later["progress"]["age_s"], later["heartbeat_age_s"]):
        assert 0.0 <= age_s <= time.time() - first["asked"]  # both were written again since then
    go_on(tmp_path / "data", job)
    assert wait(client, job)["progress"] is None


def test_a_job_that_compiles_says_so_in_words(client: TestClient, tmp_path: Path) -> None:
    job = submit(client, b"compiling")
    found = until(lambda: client.get(f"/v1/jobs/{job}").json(), "there is progress", lambda found: found["progress"])
    progress = found["progress"]
    assert progress["text"] == "compiling the search kernels, once on this machine, about 20 s"
    assert (progress["phase"], progress["total"], progress["fraction"]) == ("compile", 0.0, 0.0)
    assert progress["done"] >= 1.0
    go_on(tmp_path / "data", job)
    assert wait(client, job)["state"] == "succeeded"


def test_events_have_a_cursor(client: TestClient) -> None:
    job = submit(client, b"slow 0.6")
    wait(client, job)
    text = client.get(f"/v1/jobs/{job}/events").text
    blocks = [
        dict(line.split(": ", 1) for line in block.splitlines()) for block in text.split("\n\n") if "id: " in block
    ]
    assert [json.loads(b["data"])["state"] for b in blocks if b["event"] == "state"] == [
        "queued",
        "running",
        "succeeded",
    ]
    assert sum(b["event"] == "progress" for b in blocks) <= 1  # older progress is replaced
    last = blocks[-2]["id"]
    rest = client.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": last}).text
    assert rest.count("id: ") == 1
    assert f"id: {blocks[-1]['id']}\n" in rest


def test_a_waiting_job_is_cancelled_at_once_and_a_running_one_when_its_process_ended(client: TestClient) -> None:
    running, waiting = submit(client, b"slow 600"), submit(client, b"slow 600")
    wait(client, running, states=("running",))
    assert client.post(f"/v1/jobs/{waiting}/cancel").json()["state"] == "cancelled"
    assert client.post(f"/v1/jobs/{running}/cancel").json()["state"] == "cancelling"
    ended = wait(client, running)
    assert (ended["state"], ended["reason"]) == ("cancelled", "cancelled")
    assert client.post(f"/v1/jobs/{running}/cancel").json()["state"] == "cancelled"


def test_run_again_keeps_the_seed_and_takes_changes(client: TestClient) -> None:
    job = submit(client, seed=5)
    wait(client, job)
    again = client.post(f"/v1/jobs/{job}/rerun").json()
    assert (again["request"]["seed"], again["rerun_of"]) == (5, job)
    changed = client.post(f"/v1/jobs/{job}/rerun", json={"seed": 6, "matcher": "icp"}).json()
    assert (changed["request"]["seed"], changed["request"]["matcher"]) == (6, "icp")
    assert wait(client, changed["id"])["state"] == "succeeded"
    chart = {"yaml": upload(client), "image": upload(client)}
    more = {"map": chart, "read": {"start_s": 1.0, "end_s": 9.0}, "webhook": "https://example.com/a", "tag": "big"}
    second = client.post(f"/v1/jobs/{job}/rerun", json=more).json()["request"]
    assert {key: second[key] for key in ("map", "webhook", "tag")} == {
        key: more[key] for key in ("map", "webhook", "tag")
    }
    kept = client.post(f"/v1/jobs/{changed['id']}/rerun", json={"read": {"end_s": 9.0}}).json()
    third = client.post(f"/v1/jobs/{kept['id']}/rerun", json={"read": {"start_s": 2.0}, "priority": 3}).json()
    assert (third["request"]["read"]["start_s"], third["request"]["read"]["end_s"]) == (2.0, 9.0)
    assert (third["request"]["priority"], third["request"]["matcher"]) == (3, "icp")
    other = {"map": {"yaml": str(uuid.uuid4()), "image": chart["image"]}}
    assert client.post(f"/v1/jobs/{job}/rerun", json=other).status_code == 404


def test_the_queue_has_an_end(make_client: Callable[..., TestClient]) -> None:
    client = make_client(max_queued=2)
    file = upload(client, b"slow 600")
    jobs = [client.post("/v1/jobs", json={"log": file}).json()["id"]]
    wait(client, jobs[0], states=("running",))
    jobs += [client.post("/v1/jobs", json={"log": file}).json()["id"] for _ in range(2)]
    queues = [client.get(f"/v1/jobs/{job}").json()["queue"] for job in jobs]
    assert queues == [None, {"ahead": 0, "wait_s": None}, {"ahead": 1, "wait_s": None}]
    refused = client.post("/v1/jobs", json={"log": file})
    assert (refused.status_code, refused.json()["code"]) == (429, "too_many")
    assert int(refused.headers["retry-after"]) >= 1
    for job in reversed(jobs):
        client.post(f"/v1/jobs/{job}/cancel")


def test_pages_of_the_list(client: TestClient) -> None:
    jobs = [submit(client) for _ in range(5)]
    first = client.get("/v1/jobs", params={"limit": 3}).json()
    rest = client.get("/v1/jobs", params={"limit": 3, "before": first["next"]}).json()
    assert [each["id"] for each in first["jobs"] + rest["jobs"]] == jobs[::-1]
    assert rest["next"] is None


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"seed": False}, "seed"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"preset": "nice"}, "preset"),
        ({"unknown": 1}, "unknown"),
        ({"initial_pose": [1, 2]}, "initial_pose"),
        ({"initial_pose": [1, 2, "x"]}, "initial_pose"),
        ({"webhook": "file:///etc/passwd"}, "webhook"),
        ({"config": {"hide": {"memory": 3}}}, "config.hide.memory"),
        ({"config": {"hide": {"memory_size": "3"}}}, "config.hide.memory_size"),
        ({"config": {"matcher": "magic"}}, "config.matcher"),
        ({"config": {"graph_mapper": {"passes": 0}}}, "config.graph_mapper.passes must be from 1 to 1e+09"),
        ({"config": {"localiser": {"window_min": -1}}}, "config.localiser.window_min must be from 1e-09 to"),
        ({"config": {"graph_mapper": {"occupancy": {"hit_probability": 0.5}}}}, "both excluded"),
        ({"config": {"graph_mapper": {"joint_registration": {"gates": []}}}}, "gates must be a list of 1 to"),
    ],
)
def test_a_request_that_does_not_fit_is_refused_with_its_place(
    client: TestClient, change: dict[str, object], where: str
) -> None:
    answer = client.post("/v1/jobs", json={"log": upload(client), **change})
    assert answer.status_code == 422
    assert where in answer.json()["message"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b'{"log": bad}', "body: is no valid JSON: expecting value at character 9"),
        (b'{"log": "a",}', "body: is no valid JSON: "),
        (b"log=1", "body: is no valid JSON: expecting value at character 1"),
        (b"[]", "body: must be an object of JSON, sent with Content-Type: application/json"),
    ],
)
def test_a_body_that_is_no_json_is_called_that(client: TestClient, text: bytes, expected: str) -> None:
    answer = client.post("/v1/jobs", content=text, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    assert answer.json()["message"].startswith(expected)
    assert answer.json()["details"][0]["where"] == ["body"]
    log = [("log", ("run.mcap", b"ok"))]
    answer = client.post("/v1/run", files=log, data={"request": '{"seed": x}'})
    assert answer.json()["message"] == "request: is no valid JSON: expecting value at character 10"


def test_what_an_id_or_a_name_must_be_is_said_without_a_regular_expression(client: TestClient) -> None:
    an_id = "must be an id (a UUID in lower case), such as 3f0c1a52-"
    for answer, where in (
        (client.get("/v1/jobs/run.mcap"), "path.job_id"),
        (client.get("/v1/files/7"), "path.file_id"),
        (client.post("/v1/jobs", json={"log": "run.mcap"}), "body.log"),
        (client.post("/v1/run", files=[("log", b"ok")], data={"request": '{"resume": "x"}'}), "request.resume"),
    ):
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid")
        assert answer.json()["message"].startswith(f"{where}: {an_id}")


def test_every_pattern_of_the_api_has_words(client: TestClient) -> None:
    def patterns(node: Any) -> Iterator[str]:
        if isinstance(node, dict):
            found = node.get("pattern")
            yield from [found] if isinstance(found, str) else []
        for each in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
            yield from patterns(each)

    found = set(patterns(client.get("/openapi.json").json()))
    assert UUID_PATTERN in found
    assert found <= set(IN_WORDS)
    answer = client.post("/v1/jobs", json={"log": str(uuid.uuid4()), "tag": "A b", "webhook": "ftp://here"})
    assert [each["what"] for each in answer.json()["details"]] == [IN_WORDS[URL_PATTERN], IN_WORDS[TAG_PATTERN]]


def test_not_a_number_is_no_number(client: TestClient) -> None:
    body = b'{"log": "%s", "initial_pose": [NaN, 0, 0]}' % upload(client).encode()
    answer = client.post("/v1/jobs", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 422


def test_a_log_that_is_not_there(client: TestClient) -> None:
    assert client.post("/v1/jobs", json={"log": str(uuid.uuid4())}).status_code == 404


def test_a_large_json_body_is_refused(client: TestClient) -> None:
    answer = client.post("/v1/jobs", content=b"[" * (1 << 20), headers={"content-type": "application/json"})
    assert answer.status_code == 413
    deep = client.post("/v1/jobs", content=b"[" * 100_000, headers={"content-type": "application/json"})
    assert deep.status_code in (400, 422)


def test_everything_in_one_request(client: TestClient) -> None:
    files = {"log": ("my run.mcap", b"ok")}
    for name in ("map", "align_to"):
        files |= {name: (f"{name}.yaml", b"image: m.pgm"), f"{name}_image": (f"{name}.pgm", b"P5")}
    answer = client.post("/v1/run", files=files, data={"request": '{"seed": 9}'})
    assert answer.status_code == 201, answer.text
    job = answer.json()
    assert (job["log"], job["request"]["seed"]) == ("my run.mcap", 9)
    for name in ("map", "align_to"):
        parts = [client.get(f"/v1/files/{job['request'][name][part]}").json()["name"] for part in ("yaml", "image")]
        assert parts == [f"{name}.yaml", f"{name}.pgm"]
    assert wait(client, job["id"])["state"] == "succeeded"


def test_a_one_shot_that_cannot_be_queued_leaves_no_file(client: TestClient) -> None:
    for data in ({"request": '{"seed": "x"}'}, {"request": "{"}, {"nonsense": "1"}):
        answer = client.post("/v1/run", files={"log": b"ok"}, data=data)
        assert answer.status_code == 422, answer.text
    assert client.post("/v1/run", files={"map": b"ok"}).status_code == 422
    half = client.post("/v1/run", files={"log": b"ok", "align_to": b"image: m.pgm"})
    assert half.status_code == 422
    assert half.json()["message"] == "a map is two files: `align_to` (YAML) and `align_to_image`"
    broken = client.post("/v1/run", content=b"--x\r\n", headers={"content-type": "multipart/form-data; boundary=x"})
    assert broken.status_code == 400
    assert client.get("/v1/files").json()["files"] == []
    assert list(client.app.state.context.storage.uploads.iterdir()) == []  # type: ignore[attr-defined]


def test_options_have_a_schema(client: TestClient) -> None:
    options = client.get("/v1/options").json()
    assert options["config_schema"]["properties"]["matcher"]["enum"] == ["hide", "harmony_search", "icp", "exact", "hs"]
    assert {"name": "seed", "default": 0}.items() <= next(
        each for each in options["run"] if each["name"] == "seed"
    ).items()
    assert set(options["presets"]) == {"default", "paper", "paper-literal"}
    for values in options["presets"].values():  # a preset passes its own schema
        answer = client.post("/v1/jobs", json={"log": upload(client), "config": values})
        assert answer.status_code == 201, answer.text


def test_health_and_metrics(client: TestClient) -> None:
    submit(client)
    assert client.get("/healthz").json() == {"status": "ok"}
    assert client.get("/readyz").status_code == 200
    text = client.get("/metrics").text
    assert 'hsloc_jobs{state="queued"}' in text
    assert "hsloc_request_seconds_bucket" in text


def test_the_number_of_a_deleted_job_is_not_given_out_again(client: TestClient) -> None:
    first, second = submit(client), submit(client)
    wait(client, second)
    wait(client, first)
    number = client.get(f"/v1/jobs/{second}").json()["seq"]
    assert client.delete(f"/v1/jobs/{second}").status_code == 204
    assert client.get(f"/v1/jobs/{submit(client)}").json()["seq"] > number
