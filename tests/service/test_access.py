"""Who may do what: every route of the OpenAPI with every kind of token, and what pages of other sites may do."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import select
import socket
import sqlite3
import time
import uuid
from typing import TYPE_CHECKING, Any

import pytest
from fastapi.testclient import TestClient
from live_service import settings, submit, upload, wait
from waiting import LIMIT_S, until

from hsloc.cli.main import main as program
from hsloc_service.auth import Tokens
from hsloc_service.http.app import create_app
from hsloc_service.http.openapi import describe

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from live_service import Live

PUBLIC = {("get", "/healthz"), ("get", "/readyz")}
READ = {
    ("get", "/v1/compare"),
    ("get", "/v1/files"),
    ("get", "/v1/files/{file_id}"),
    ("get", "/v1/info"),
    ("get", "/v1/jobs"),
    ("get", "/v1/jobs/{job_id}"),
    ("get", "/v1/jobs/{job_id}/events"),
    ("get", "/v1/jobs/{job_id}/results"),
    ("get", "/v1/jobs/{job_id}/shares"),
    ("get", "/v1/jobs/{job_id}/results.zip"),
    ("get", "/v1/jobs/{job_id}/results/{name}"),
    ("get", "/v1/jobs/{job_id}/webhooks"),
    ("get", "/v1/labels"),
    ("get", "/v1/options"),
    ("get", "/v1/schemas"),
    ("get", "/v1/sweeps"),
    ("get", "/v1/sweeps/{sweep_id}"),
    ("get", "/v1/sweeps/{sweep_id}/matrix"),
    ("get", "/v1/sweeps/{sweep_id}/table"),
    ("get", "/v1/sweeps/{sweep_id}/table.csv"),
    ("get", "/v1/sweeps/{sweep_id}/table.md"),
    ("get", "/v1/schemas/{name}"),
    ("head", "/v1/tus/{file_id}"),
    ("options", "/v1/tus"),
}
ADMIN = {("get", "/v1/audit"), ("get", "/metrics"), ("get", "/v1/webhook-secret"), ("get", "/v1/workers")}
WRITE = {
    ("delete", "/v1/files/{file_id}"),
    ("delete", "/v1/jobs/{job_id}"),
    ("delete", "/v1/jobs/{job_id}/shares/{share_id}"),
    ("patch", "/v1/jobs/{job_id}"),
    ("delete", "/v1/sweeps/{sweep_id}"),
    ("delete", "/v1/tus/{file_id}"),
    ("patch", "/v1/tus/{file_id}"),
    ("post", "/v1/files"),
    ("post", "/v1/sample-log"),
    ("post", "/v1/jobs"),
    ("post", "/v1/jobs/{job_id}/cancel"),
    ("post", "/v1/jobs/{job_id}/rerun"),
    ("post", "/v1/jobs/{job_id}/shares"),
    ("post", "/v1/run"),
    ("post", "/v1/sweeps"),
    ("post", "/v1/sweeps/{sweep_id}/cancel"),
    ("post", "/v1/tus"),
    ("put", "/v1/files/{file_id}"),
}


class World:
    """Two tenants; one has a file, an upload in progress and a finished job."""

    def __init__(self, client: TestClient) -> None:
        self.client = client
        tokens = Tokens(client.app.state.context.database)  # type: ignore[attr-defined]
        self.tokens = {
            "owner": tokens.issue("one"),
            "other": tokens.issue("two"),
            "reader": tokens.issue("one", ("read",)),
            "expired": tokens.issue("one", expires=time.time() - 1.0),
            "wrong": "hsl_00000000_nothing",
        }
        revoked = tokens.issue("one")
        assert tokens.revoke(revoked.split("_")[1])
        self.tokens["revoked"] = revoked
        client.headers["Authorization"] = f"Bearer {self.tokens['owner']}"
        self.job = submit(client)
        wait(client, self.job)
        self.file = str(client.get(f"/v1/jobs/{self.job}").json()["request"]["log"])
        self.share = str(client.post(f"/v1/jobs/{self.job}/shares").json()["id"])
        self.sweep = str(client.post("/v1/sweeps", json={"logs": [self.file]}).json()["id"])
        headers = {"Tus-Resumable": "1.0.0", "Upload-Length": "9"}
        self.upload = client.post("/v1/tus", headers=headers).headers["location"].rsplit("/", 1)[1]
        del client.headers["Authorization"]

    def send(self, method: str, path: str, who: str | None) -> Any:
        """A request that would succeed for the owner."""
        headers = {} if who is None else {"Authorization": f"Bearer {self.tokens[who]}"}
        file = self.upload if "/tus/" in path else self.file
        url = path.replace("{file_id}", file).replace("{job_id}", self.job).replace("{sweep_id}", self.sweep)
        url = url.replace("{share_id}", self.share)
        url = url.replace("{name}", "run-metrics" if "/schemas/" in path else "trajectory.tum")
        options: dict[str, Any] = {"params": {"job": self.job}} if path == "/v1/compare" else {}
        if "/tus" in path:
            headers |= {"Tus-Resumable": "1.0.0", "Upload-Length": "9"}
            if method == "patch":
                headers |= {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
                options["content"] = b"123"
        elif path == "/v1/jobs" and method == "post":
            options["json"] = {"log": self.file}
        elif method == "patch":
            options["json"] = {"title": "another"}
        elif path == "/v1/sweeps" and method == "post":
            options["json"] = {"logs": [self.file]}
        elif path == "/v1/run":
            options["files"] = {"log": b"ok"}
        elif method in ("put", "post"):
            options["content"] = b"" if "/jobs/" in path or "/sweeps/" in path else b"ok"
        return self.client.request(method.upper(), url, headers=headers, **options)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    app = create_app(settings(tmp_path_factory.mktemp("access"), require_token=True, refusals_per_s=1e6))
    with TestClient(app, raise_server_exceptions=False) as client:
        yield World(client)


def test_every_route_is_checked(world: World) -> None:
    schema = describe(world.client.app, complete=True)  # type: ignore[arg-type]
    routes = {(method, path) for path, operations in schema["paths"].items() for method in operations}
    assert routes == PUBLIC | READ | WRITE | ADMIN
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            assert ("security" in operation) == ((method, path) not in PUBLIC)


@pytest.mark.parametrize(("method", "path"), sorted(READ | WRITE | ADMIN))
@pytest.mark.parametrize("who", [None, "wrong", "expired", "revoked"])
def test_no_valid_token_no_answer(world: World, method: str, path: str, who: str | None) -> None:
    answer = world.send(method, path, who)
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"].startswith("Bearer")


@pytest.mark.parametrize(("method", "path"), sorted(WRITE | ADMIN))
def test_a_reader_may_not_write(world: World, method: str, path: str) -> None:
    answer = world.send(method, path, "reader")
    assert (answer.status_code, answer.json()["code"]) == (403, "scope")


@pytest.mark.parametrize(("method", "path"), sorted(READ))
def test_a_reader_may_read(world: World, method: str, path: str) -> None:
    assert world.send(method, path, "reader").status_code in (200, 204)


@pytest.mark.parametrize(
    ("method", "path"),
    sorted(r for r in READ | WRITE if "_id}" in r[1] or r == ("post", "/v1/jobs")),
)
def test_another_tenant_finds_nothing(world: World, method: str, path: str) -> None:
    assert world.send(method, path, "other").status_code == 404
    assert world.send("get", "/v1/files/{file_id}", "owner").status_code == 200  # and has changed nothing
    assert world.send("get", "/v1/jobs/{job_id}", "owner").json()["state"] == "succeeded"


def test_lists_show_ones_own(world: World) -> None:
    assert world.send("get", "/v1/jobs", "other").json()["jobs"] == []
    mine = [each["id"] for each in world.send("get", "/v1/jobs", "owner").json()["jobs"]]
    assert world.job in mine


def test_a_large_body_without_a_token_is_not_read(make_live: Callable[..., Live]) -> None:
    live = make_live(HSLOC_REQUIRE_TOKEN="1")
    head = f"POST /v1/files HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\nContent-Length: 100000000\r\n\r\n"
    sent = 0
    with socket.create_connection(("127.0.0.1", live.port), LIMIT_S) as line:
        line.sendall(head.encode())
        try:
            while sent < 100_000_000:
                sent += line.send(bytes(65536))
        except OSError:
            pass  # the server has closed
    assert sent < 20_000_000  # LINGER_BYTES, and what the kernel's buffers took
    with socket.create_connection(("127.0.0.1", live.port), LIMIT_S) as line:
        line.sendall(head.encode())
        assert line.recv(4096).startswith(b"HTTP/1.1 401")
    assert list((live.data / "uploads").iterdir()) == []


def test_a_refusal_reaches_a_client_that_sends_on(make_live: Callable[..., Live]) -> None:
    live = make_live()
    unknown = {"Authorization": "Bearer hsl_unknown"}
    cases = [("POST", "/v1/jobs", unknown, 401), ("POST", "/v1/jobs", {}, 413), ("PATCH", "/v1/files", {}, 405)]
    for method, path, headers, status in cases * 5:
        line = http.client.HTTPConnection("127.0.0.1", live.port, timeout=LIMIT_S)
        line.request(method, path, bytes(5_000_000), headers)  # reads nothing before all is sent
        answer = line.getresponse()
        assert answer.status == status
        assert json.loads(answer.read())["message"]
        line.close()
    # Of two that send nothing more, one is waited for; the other had asked whether to send its body, and is not.
    host = f"127.0.0.1:{live.port}\r\nAuthorization: Bearer hsl_unknown"
    head = f"POST /v1/jobs HTTP/1.1\r\nHost: {host}\r\nContent-Length: 9\r\n"
    with contextlib.ExitStack() as stack:
        silent, asks = (
            stack.enter_context(socket.create_connection(("127.0.0.1", live.port), LIMIT_S)) for _ in range(2)
        )
        silent.sendall(f"{head}\r\n".encode())
        assert silent.recv(4096).startswith(b"HTTP/1.1 401")
        asks.sendall(f"{head}Expect: 100-continue\r\n\r\n".encode())
        while asks.recv(4096):
            pass
        assert not ended(silent)
        while silent.recv(4096):
            pass


def ended(line: socket.socket) -> bool:
    """Whether the other side has closed the connection."""
    return bool(select.select([line], [], [], 0)[0]) and line.recv(1, socket.MSG_PEEK) == b""


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "evil.example:8000", ""])
def test_other_names_of_this_server_are_refused(client: TestClient, host: str) -> None:
    assert client.get("/v1/jobs", headers={"Host": host}).status_code == 421


def test_pages_of_other_sites_are_refused(client: TestClient) -> None:
    assert client.get("/v1/jobs", headers={"Origin": "http://evil.example"}).status_code == 403
    assert client.post("/v1/files", content=b"x", headers={"Sec-Fetch-Site": "cross-site"}).status_code == 403
    assert client.get("/v1/jobs", headers={"Origin": "null"}).status_code == 403
    assert client.get("/v1/jobs", headers={"Origin": "http://testserver"}).status_code == 200


def test_headers_of_every_answer(client: TestClient) -> None:
    for path in ("/", "/healthz", "/v1/jobs", "/v1/nothing", "/web/app.js", f"/v1/jobs/{uuid.uuid4()}"):
        headers = client.get(path).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert "default-src 'self'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in headers


def test_guessing_tokens_is_slowed_down(make_client: Callable[..., TestClient]) -> None:
    client = make_client(require_token=True)
    codes = [client.get("/v1/jobs", headers={"Authorization": f"Bearer {k}"}).status_code for k in range(30)]
    assert codes[0] == 401
    assert codes[-1] == 429


def test_too_many_requests(make_client: Callable[..., TestClient]) -> None:
    client = make_client(requests_per_s=0.5)
    answers = [client.get("/v1/files") for _ in range(40)]
    refused = [answer for answer in answers if answer.status_code == 429]
    assert refused
    assert int(refused[0].headers["retry-after"]) >= 1


def test_upload_of_another_tenant_is_no_log_of_mine(world: World) -> None:
    world.client.headers["Authorization"] = f"Bearer {world.tokens['other']}"
    mine = upload(world.client)
    answer = world.client.post("/v1/jobs", json={"log": mine, "map": {"yaml": world.file, "image": mine}})
    del world.client.headers["Authorization"]
    assert answer.status_code == 404


def test_made_up_methods_are_one_series(client: TestClient) -> None:
    for k in range(50):
        client.request(f"MADE{k}", "/nowhere", headers={"Authorization": "Bearer wrong"})
    lines = client.get("/metrics").text.splitlines()
    assert not [line for line in lines if "MADE" in line]
    assert [line for line in lines if 'hsloc_requests_total{method="other"' in line]


def test_a_misspelt_query_is_refused(client: TestClient) -> None:
    answer = client.get("/v1/jobs", params={"sate": "failed"})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid")
    assert "query.sate: is unknown here; known are before, " in answer.json()["message"]
    assert client.get("/v1/info", params={"x": "1"}).status_code == 422
    assert client.get("/v1/jobs", params={"state": "failed", "limit": 5}).status_code == 200


def test_the_address_that_a_client_claims_does_not_count(make_live: Callable[..., Live]) -> None:
    """Each refused request takes a token of the address; claimed ones would be a fresh bucket each."""
    live = make_live(HSLOC_TOKEN="a-token-of-the-operator-0123456789", HSLOC_REFUSALS_PER_S="0.01")
    with live.client() as client:
        statuses = [client.get("/v1/jobs", headers={"X-Forwarded-For": f"10.0.0.{k}"}).status_code for k in range(5)]
    assert statuses == [401, 429, 429, 429, 429]


def test_metrics_and_logs_name_what_operators_ask_for(make_live: Callable[..., Live]) -> None:
    live = make_live()
    with live.client() as client:
        wait(client, submit(client))
        # It is counted when the folder of the attempt is gone.
        text = until(
            lambda: client.get("/metrics").text, "the job is counted", lambda it: "hsloc_job_seconds_bucket" in it
        )
    for name in ("hsloc_job_seconds_bucket", "hsloc_job_wait_seconds_bucket", "process_resident_memory_bytes"):
        assert name in text, name
    assert re.search(r'hsloc_build_info\{version="[0-9.]+[^"]*"\} 1', text)
    assert '"tenant": "local"' in live.log.read_text()


def test_a_busy_port_is_found_before_anything_is_recovered(
    make_live: Callable[..., Live], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    live = make_live()
    other = tmp_path / "other"
    assert program(["serve", "--data", str(other), "--port", str(live.port)]) == 1
    assert f"127.0.0.1:{live.port}: cannot be listened at: Address already in use" in capsys.readouterr().err
    assert not other.exists()


@pytest.mark.parametrize("options", [("--port", "0"), ("--new-token", "lab")])
def test_a_data_folder_that_cannot_be_made_is_one_line(
    options: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    for folder, reason in ((tmp_path / "file", "File exists"), (tmp_path / "file" / "data", "Not a directory")):
        assert program(["serve", "--data", str(folder), *options]) == 1
        assert capsys.readouterr().err == (
            f"hsloc: error: {folder}: cannot be used as data folder ({reason}); give another --data\n"
        )


def test_a_damaged_database_is_an_answer_and_a_line_in_the_log(make_live: Callable[..., Live]) -> None:
    live = make_live()
    with live.client() as client:
        for _ in range(30):
            upload(client, b"x")
    live.end()
    path = live.data / "hsloc.db"
    with sqlite3.connect(path) as database:
        size = int(database.execute("PRAGMA page_size").fetchone()[0])
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'file'").fetchone()
    with path.open("r+b") as file:
        file.seek((root - 1) * size)
        file.write(b"\xff" * size)
    try:
        live.start()
    except RuntimeError as error:
        assert "Traceback" not in str(error)  # noqa: PT017
        assert "cannot be used as database" in str(error)  # noqa: PT017
        return
    with live.client() as client:
        answer = client.get("/v1/files")
        assert (answer.status_code, answer.json()["code"]) == (500, "database")
    assert "Traceback" not in live.log.read_text()
