"""Sweeps as jobs of the service: all or none, one table, cancelled and deleted together."""

from __future__ import annotations

import csv
import io
import json
import time
from typing import TYPE_CHECKING, Any

import pytest
from live_service import settings, submit, upload, wait
from waiting import until

from hsloc.cli.main import main
from hsloc.sweep.table import COLUMNS
from hsloc_service.housekeeping import Housekeeping

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from fastapi.testclient import TestClient
    from live_service import Live


def ended(client: Any, sweep: str) -> dict[str, Any]:
    def get() -> dict[str, Any]:
        found: dict[str, Any] = client.get(f"/v1/sweeps/{sweep}").json()
        return found

    return until(get, "the sweep has ended", lambda found: bool(found["ended"]))


def test_logs_by_configurations_by_seeds_are_jobs_with_one_table(client: TestClient) -> None:
    good, bad = upload(client, b"ok", "office.mcap"), upload(client, b"exit 3", "office.mcap")
    request = {
        "name": "nightly",
        "logs": [good, bad],
        "seeds": [0, 7],
        "run": {"preset": "default", "config": {"hide": {"budget": 100, "restarts": 2}}, "priority": 3},
        "configs": {"usual": {}, "few": {"config": {"hide": {"budget": 50}}}},
    }
    answer = client.post("/v1/sweeps", json=request, headers={"Idempotency-Key": "one"})
    assert answer.status_code == 201, answer.text
    sweep = answer.json()["id"]
    assert client.get(answer.headers["location"]).json()["jobs"] == 8
    key = {"Idempotency-Key": "one"}
    again = client.post("/v1/sweeps", json=request, headers=key)
    assert (again.status_code, again.json()["id"]) == (200, sweep)
    assert client.post("/v1/sweeps", json={**request, "seeds": [1]}, headers=key).status_code == 409
    assert ended(client, sweep)["states"] == {"crashed": 4, "succeeded": 4}
    table = client.get(f"/v1/sweeps/{sweep}/table").json()
    assert [(row["run"], row["state"]) for row in table["rows"]] == [
        ("office-usual-seed0", "succeeded"), ("office-usual-seed7", "succeeded"),
        ("office-few-seed0", "succeeded"), ("office-few-seed7", "succeeded"),
        ("office-2-usual-seed0", "crashed"), ("office-2-usual-seed7", "crashed"),
        ("office-2-few-seed0", "crashed"), ("office-2-few-seed7", "crashed"),
    ]  # fmt: skip
    assert set(table["rows"][0]) == set(COLUMNS)
    assert "ended with code" in table["rows"][4]["error"]
    job = client.get(f"/v1/jobs/{table['jobs'][2]}").json()
    assert (job["request"]["config"], job["request"]["seed"]) == ({"hide": {"budget": 50, "restarts": 2}}, 0)
    found = list(csv.DictReader(io.StringIO(client.get(f"/v1/sweeps/{sweep}/table.csv").text)))
    assert [row["run"] for row in found] == [row["run"] for row in table["rows"]]
    assert client.get(f"/v1/sweeps/{sweep}/table.md").text.startswith("| run")
    listed = client.get("/v1/jobs", params={"sweep": sweep, "state": "crashed"}).json()["jobs"]
    assert {each["id"] for each in listed} == set(table["jobs"][4:])
    submit(client)
    assert [each["id"] for each in client.get("/v1/sweeps").json()["sweeps"]] == [sweep]
    assert client.delete(f"/v1/jobs/{table['jobs'][0]}").status_code == 204
    assert client.get(f"/v1/sweeps/{sweep}").json()["states"]["deleted"] == 1
    assert client.get(f"/v1/sweeps/{sweep}/table").json()["rows"][0]["state"] == "deleted"
    assert client.delete(f"/v1/sweeps/{sweep}").status_code == 204
    assert client.get(f"/v1/sweeps/{sweep}").status_code == 404
    assert client.get(f"/v1/jobs/{table['jobs'][1]}").status_code == 404
    assert client.get(f"/v1/files/{good}").status_code == 200


def test_a_sweep_is_cancelled_and_deleted_as_a_whole(client: TestClient) -> None:
    slow = upload(client, b"slow 600")
    sweep = client.post("/v1/sweeps", json={"logs": [slow], "seeds": list(range(5))}).json()["id"]
    wait(client, client.get(f"/v1/sweeps/{sweep}/table").json()["jobs"][0], states=("running",))
    assert client.delete(f"/v1/sweeps/{sweep}").json()["code"] == "active"
    assert client.post(f"/v1/sweeps/{sweep}/cancel").status_code == 202
    assert ended(client, sweep)["states"] == {"cancelled": 5}
    context: Any = client.app.state.context  # type: ignore[attr-defined]
    old = Housekeeping(
        context.database, context.storage, settings(context.storage.root, retention_s=1.0), context.deletions
    )
    old.tidy(time.time() + 10.0)
    assert client.get(f"/v1/sweeps/{sweep}").status_code == 404


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"logs": []}, "logs"),
        ({"seeds": [1, 1]}, "seeds: one is named twice"),
        ({"seeds": [-1]}, "seeds"),
        ({"run": {"seed": 3}}, "run.seed"),
        ({"configs": {"a/b": {}}}, "configs"),
        ({"configs": {"a": {"config": {"hide": {"budgets": 1}}}}}, "config.hide.budgets is unknown"),
        ({"configs": {"a": {"matcher": "none"}}}, "matcher"),
        ({"run": {"resume": "3f0c1a52-8f5d-4c3b-9a51-0d6f0c1d2e3f"}}, "run.resume"),
    ],
)
def test_a_sweep_that_does_not_fit_makes_no_job(client: TestClient, changes: dict[str, Any], expected: str) -> None:
    answer = client.post("/v1/sweeps", json={"logs": [upload(client)], **changes})
    assert answer.status_code == 422
    assert expected in answer.text
    assert client.get("/v1/jobs").json()["jobs"] == []


def test_all_jobs_of_a_sweep_are_queued_or_none(make_client: Callable[..., TestClient]) -> None:
    client = make_client(max_queued=4, slots=0)
    log = upload(client)
    answer = client.post("/v1/sweeps", json={"logs": [log], "seeds": list(range(5))})
    assert (answer.status_code, answer.json()["message"]) == (413, "the sweep has 5 runs; at most 4 jobs may wait")
    assert client.post("/v1/sweeps", json={"logs": [log], "seeds": [0, 1, 2]}).status_code == 201
    answer = client.post("/v1/sweeps", json={"logs": [log], "seeds": [3, 4]})
    assert (answer.status_code, answer.json()["message"]) == (429, "3 jobs are waiting already; the limit is 4")
    missing = "3f0c1a52-8f5d-4c3b-9a51-0d6f0c1d2e3f"
    assert client.post("/v1/sweeps", json={"logs": [log[:-1] + "0" if log[-1] != "0" else missing]}).status_code == 404
    assert len(client.get("/v1/jobs").json()["jobs"]) == 3
    assert len(client.get("/v1/sweeps").json()["sweeps"]) == 1


def test_the_command_has_a_service_do_the_runs(
    make_live: Callable[..., Live], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    live = make_live()
    for name, content in (("a.mcap", "ok"), ("b.mcap", "exit 3")):
        (tmp_path / name).write_text(content)
    words = [
        "sweep",
        str(tmp_path / "a.mcap"),
        str(tmp_path / "b.mcap"),
        "--vary",
        "hide.budget=50,100",
        "--service",
        live.url,
    ]
    assert main([*words, "--out", str(tmp_path / "out"), "-q", "--json"]) == 1
    table = json.loads(capsys.readouterr().out)
    assert [(row["run"], row["state"]) for row in table] == [
        ("a-hide.budget=50-seed0", "done"), ("a-hide.budget=100-seed0", "done"),
        ("b-hide.budget=50-seed0", "failed"), ("b-hide.budget=100-seed0", "failed"),
    ]  # fmt: skip
    assert json.loads((tmp_path / "out" / "sweep.json").read_text()) == table
    assert main([*words, "--out", str(tmp_path), "--shard", "0/2"]) == 2
    assert "leave out --shard and --merge" in capsys.readouterr().err
