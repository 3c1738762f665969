"""What a person notes about jobs, and links by which a job is seen without a token."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest
from live_service import submit, upload, wait
from paths import RECORDINGS
from sqlalchemy import select, update

from hsloc_service.auth import Tokens
from hsloc_service.db.tables import ShareRow
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from fastapi.testclient import TestClient


@pytest.mark.parametrize("database_url", ["sqlite", "postgresql"], indirect=True)
def test_jobs_are_found_by_title_labels_and_notes(make_client: Callable[..., TestClient], database_url: str) -> None:
    client = make_client(**({"database_url": database_url, "store_url": "memory://shares"} if database_url else {}))
    first, second = submit(client), submit(client)
    expected = {"title": "Hall 3", "labels": ["floor 2", "50 %", "floor 2"], "notes": "people at the door"}
    assert client.patch(f"/v1/jobs/{first}", json=expected).json()["labels"] == ["floor 2", "50 %"]
    client.patch(f"/v1/jobs/{second}", json={"labels": ["floor 22"]})
    assert client.get("/v1/labels").json()["labels"] == ["50 %", "floor 2", "floor 22"]

    def found(**query: str) -> list[str]:
        return [job["id"] for job in client.get("/v1/jobs", params=query).json()["jobs"]]

    assert found(label="floor 2") == [first]
    assert found(label="floor") == []
    assert found(search="FLOOR 2") == [second, first]
    assert found(search="hall") == found(search="the door") == found(label="50 %", search="hall") == [first]
    wait(client, first)
    again = client.post(f"/v1/jobs/{first}/rerun").json()
    assert (again["title"], again["labels"], again["notes"]) == ("Hall 3", ["floor 2", "50 %"], None)
    assert client.patch(f"/v1/jobs/{first}", json={"title": None}).json()["notes"] == "people at the door"
    for wrong in ({"labels": ["a,b"]}, {"labels": [" a"]}, {"title": "x" * 201}, {"state": "failed"}):
        assert client.patch(f"/v1/jobs/{first}", json=wrong).status_code == 422, wrong


def test_a_log_is_read_before_it_is_run(make_client: Callable[..., TestClient], tmp_path: Path) -> None:
    client = make_client(worker_command=Settings().worker_command, sandbox="none", job_memory_bytes=4 << 30)
    log = upload(client, (RECORDINGS / "hall.mcap").read_bytes(), "hall.mcap")
    reader = Tokens(client.app.state.context.database).issue("local", ("read",))  # type: ignore[attr-defined]
    for path in ("/v1/inspect", "/v1/sample-log"):
        for key, status in ((reader, 403), ("wrong", 401)):
            headers = {"Authorization": f"Bearer {key}"}
            assert client.post(path, json={"log": log}, headers=headers).status_code == status
    client.headers["Authorization"] = f"Bearer {Tokens(client.app.state.context.database).issue('local')}"  # type: ignore[attr-defined]
    found = client.post("/v1/inspect", json={"log": log}).json()
    assert (found["format"], found["scan_topic"], found["odom_topic"]) == ("mcap", "/scan", "/odom")
    assert found["map_image"].startswith("data:image/png;base64,")
    assert {each["topic"] for each in found["topics"]} >= {"/scan", "/odom", "/map"}
    assert found["findings"] is not None
    wrong = client.post("/v1/inspect", json={"log": upload(client, b"no log at all", "x.mcap")})
    assert (wrong.status_code, wrong.json()["code"]) == (422, "invalid_input")
    assert wrong.json()["message"].startswith("x.mcap: ")
    assert client.get("/v1/jobs").json()["jobs"] == []
    assert list((tmp_path / "data" / "work").iterdir()) == []


def test_a_link_shows_one_job_until_it_is_revoked_or_expires(make_client: Callable[..., TestClient]) -> None:
    client = make_client(require_token=True)
    database = client.app.state.context.database  # type: ignore[attr-defined]
    client.headers["Authorization"] = f"Bearer {Tokens(database).issue('mine')}"
    job, other = submit(client, webhook="http://127.0.0.1:9/key"), submit(client)
    wait(client, job)
    client.patch(f"/v1/jobs/{job}", json={"title": "Hall 3", "notes": "not for others"})
    made = client.post(f"/v1/jobs/{job}/shares", json={"valid_days": 2}).json()
    link = f"/v1/shared/{made['secret']}"
    (listed,) = client.get(f"/v1/jobs/{job}/shares").json()["shares"]
    assert (listed["id"], listed["secret"]) == (made["id"], None)
    key = client.headers.pop("Authorization")  # from here on without a token, on a page of another site
    client.headers["Origin"] = "https://viewer.example.com"
    seen = client.get(link).json()
    assert (seen["id"], seen["title"], seen["notes"], "webhook" in seen["request"]) == (job, "Hall 3", None, False)
    manifest = client.get(f"{link}/results").json()
    (href,) = [each["href"] for each in manifest["assets"] if each["name"] == "trajectory.tum"]
    part = client.get(href, headers={"Range": "bytes=0-2"})
    assert (part.status_code, part.content, part.headers["access-control-allow-origin"]) == (206, b"0 [", "*")
    assert "Content-Range" in part.headers["access-control-expose-headers"]
    asked = client.options(href, headers={"Access-Control-Request-Headers": "range"})
    assert (asked.status_code, "Range" in asked.headers["access-control-allow-headers"]) == (204, True)
    assert client.post(link).status_code == client.delete(link).status_code == 405
    for path in (f"/v1/jobs/{job}", "/v1/jobs"):
        assert client.get(path, headers={"Origin": ""}).status_code in (401, 403)
        assert client.get(path, headers={"Authorization": f"Bearer {made['secret']}", "Origin": ""}).status_code != 200
    del client.headers["Origin"]
    client.headers["Authorization"] = key
    assert client.delete(f"/v1/jobs/{other}/shares/{made['id']}").status_code == 404
    assert client.delete(f"/v1/jobs/{job}/shares/{made['id']}").status_code == 204
    assert client.get(link).status_code == client.get(href).status_code == 404
    late = client.post(f"/v1/jobs/{job}/shares").json()["secret"]
    assert client.get(f"/v1/shared/{late}").status_code == 200
    with database.write() as session:
        session.execute(update(ShareRow).values(expires=time.time() - 1.0))
    assert client.get(f"/v1/shared/{late}").status_code == 404
    assert client.get(f"/v1/jobs/{job}/shares").json() == {"shares": []}
    noted = client.get("/v1/audit").json()["entries"]
    assert [each["action"] for each in noted[:3]] == ["share.issue", "share.revoke", "share.issue"]
    assert noted[1]["target"] == noted[2]["target"] == f"{job}/{made['id']}"
    context = client.app.state.context  # type: ignore[attr-defined]
    Housekeeping(database, context.storage, context.settings, context.deletions).tidy(time.time())
    with database.read() as session:
        assert session.scalar(select(ShareRow)) is None
