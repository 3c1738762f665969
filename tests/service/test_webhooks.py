"""Webhooks: signed, retried, and never to a private address."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import http.client
import json
import shutil
import socket
import ssl
import subprocess
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import TYPE_CHECKING, Any

import pytest
from live_service import settings, submit, wait
from waiting import until

from hsloc_service import webhooks
from hsloc_service.db.database import Database
from hsloc_service.db.tables import DeliveryRow

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from fastapi.testclient import TestClient


class Receiver(HTTPServer):
    """Answers with the statuses that it is given, then 200."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.statuses: list[int] = []
        self.got: list[tuple[dict[str, str], bytes]] = []


class Handler(BaseHTTPRequestHandler):
    server: Receiver

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["content-length"]))
        self.server.got.append(({k.lower(): v for k, v in self.headers.items()}, body))
        status = self.server.statuses.pop(0) if self.server.statuses else 200
        self.send_response(status)
        if status == 302:
            self.send_header("Location", "/elsewhere")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def deliveries(client: TestClient, job: str) -> dict[str, Any]:
    """The one webhook of a job, when it was delivered or given up."""
    (found,) = until(
        lambda: client.get(f"/v1/jobs/{job}/webhooks").json()["deliveries"],
        "the webhook was delivered or given up",
        lambda shown: bool(shown) and shown[0]["state"] != "pending",
    )
    return dict(found)


def test_signed_and_retried(make_client: Callable[..., TestClient], receiver: Receiver) -> None:
    client = make_client(webhook_private=True, webhook_backoff_s=0.05)
    receiver.statuses = [500, 302]
    job = submit(client, webhook=f"http://127.0.0.1:{receiver.server_port}/hook?x=1")
    wait(client, job)
    found = deliveries(client, job)
    assert (found["state"], found["attempts"], found["last_status"]) == ("delivered", 3, 200)
    assert len({headers["hsloc-event-id"] for headers, _ in receiver.got}) == 1
    secret = client.get("/v1/webhook-secret").json()["secret"]
    headers, body = receiver.got[-1]
    stamp, mac = (part.split("=")[1] for part in headers["hsloc-signature"].split(","))
    assert hmac.compare_digest(mac, hmac.new(secret.encode(), f"{stamp}.".encode() + body, hashlib.sha256).hexdigest())
    assert json.loads(body)["job"] == job
    assert json.loads(body)["state"] == "succeeded"


def test_given_up_after_some_attempts(make_client: Callable[..., TestClient], receiver: Receiver) -> None:
    client = make_client(webhook_private=True, webhook_backoff_s=0.01, webhook_attempts=3)
    receiver.statuses = [500] * 10
    job = submit(client, webhook=f"http://127.0.0.1:{receiver.server_port}/")
    wait(client, job)
    found = deliveries(client, job)
    assert (found["state"], found["attempts"]) == ("given_up", 3)


@pytest.mark.parametrize(
    "host",
    [
        *("127.0.0.1", "localhost", "[::1]", "10.0.0.1", "169.254.169.254", "[::ffff:127.0.0.1]", "0.0.0.0"),
        "2130706433",
        # Reserved, but public to some versions of Python.
        *("192.0.0.8", "[64:ff9b:1::7f00:1]", "[::ffff:0:7f00:1]", "[fec0::1]"),
        # What a gateway makes an IPv4 address of: NAT64, 6to4, IPv4-compatible, Teredo.
        *("[64:ff9b::7f00:1]", "[64:ff9b::a9fe:a9fe]", "[2002:a00:1::1]", "[::a00:1]", "[2001:0:7f00:1::]"),
    ],
)
def test_private_addresses_are_refused(host: str) -> None:
    with pytest.raises(webhooks.ForbiddenAddress) as error:
        webhooks.post(f"http://{host}:1/", b"", {}, private=False)
    assert str(error.value) == f"{host.strip('[]')} leads to an address that is not public"


def test_other_schemes_and_user_names_are_refused() -> None:
    for url in ("file:///etc/passwd", "ftp://x/", "http://user:password@example.com/", "http://"):
        with pytest.raises(ValueError):
            webhooks.post(url, b"", {}, private=False)


def test_a_receiver_that_answers_by_drips_is_cut_off() -> None:
    """It would hold up everybody's webhooks: each byte is within the time-out of the line."""
    cut_off = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            line, _ = listening.accept()
            with line, contextlib.suppress(OSError):
                line.sendall(b"HTTP/1.1 ")
                for _ in range(600):  # a minute
                    time.sleep(0.1)
                    line.sendall(b" ")
                return
            cut_off.set()

        thread = threading.Thread(target=drip)
        thread.start()
        begin = time.monotonic()
        with pytest.raises((OSError, http.client.HTTPException)):
            webhooks.post(f"http://127.0.0.1:{listening.getsockname()[1]}/", b"{}", {}, private=True, within_s=1.0)
        assert time.monotonic() - begin > 0.9
        thread.join()
        assert cut_off.is_set()


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl to make a certificate with")
def test_over_tls_to_whom_the_certificate_names(
    receiver: Receiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "cert.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    command += ["-addext", "subjectAltName=DNS:localhost", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(command, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    receiver.socket = context.wrap_socket(receiver.socket, server_side=True)
    port = receiver.server_port
    with pytest.raises(ssl.SSLCertVerificationError):
        webhooks.post(f"https://localhost:{port}/", b"{}", {}, private=True)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    assert webhooks.post(f"https://localhost:{port}/x", b"{}", {}, private=True) == 200
    assert receiver.got[-1][1] == b"{}"
    with pytest.raises(ssl.SSLCertVerificationError):
        webhooks.post(f"https://127.0.0.1:{port}/", b"{}", {}, private=True)


def test_a_tenant_with_many_webhooks_does_not_hold_up_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    database = Database(tmp_path / "other.db")
    now = time.time()
    with database.write() as session:
        for k, tenant in enumerate(["many"] * 20 + ["single"] * 2):
            session.add(
                DeliveryRow(
                    id=f"{tenant}-{k}", tenant=tenant, job_id="x", url="x", body="", next_at=now - 100 + k, created=now
                )
            )
    order: list[str] = []

    def unreachable(url: str, body: bytes, headers: dict[str, str], private: bool) -> int:
        order.append(headers["Hsloc-Event-Id"].partition("-")[0])
        raise TimeoutError

    monkeypatch.setattr(webhooks, "post", unreachable)
    deliverer = webhooks.WebhookSender(database, settings(tmp_path))
    while deliverer.deliver_next():
        assert len(order) <= 22
    database.close()
    assert len(order) == 22
    assert order[:4] in (["many", "single"] * 2, ["single", "many"] * 2)
