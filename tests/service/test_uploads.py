"""Uploads: one request, tus 1.0, limits, and what happens when the line breaks."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import socket
import time
import uuid
from typing import TYPE_CHECKING, Any

import httpx2 as httpx
import pytest
from live_service import upload
from waiting import until

from hsloc_service.housekeeping import reconcile
from hsloc_service.uploads.repository import Files

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from fastapi.testclient import TestClient
    from live_service import Live

TUS = {"Tus-Resumable": "1.0.0"}
PATCH = {**TUS, "Content-Type": "application/offset+octet-stream"}


def stored(client: TestClient, file: str) -> bytes:
    path: Path = client.app.state.context.storage.upload_path(file)  # type: ignore[attr-defined]
    return path.read_bytes()


def begin(client: Any, size: int, name: str = "run.mcap", **headers: str) -> str:
    metadata = f"filename {base64.b64encode(name.encode()).decode()}"
    answer = client.post("/v1/tus", headers={**TUS, "Upload-Length": str(size), "Upload-Metadata": metadata, **headers})
    assert answer.status_code == 201, answer.text
    return str(answer.headers["location"])


def offset(client: Any, path: str) -> int:
    answer = client.head(path, headers=TUS)
    assert answer.status_code == 200
    assert answer.headers["cache-control"] == "no-store"
    return int(answer.headers["upload-offset"])


def append(client: Any, path: str, at: int, body: bytes, **headers: str) -> Any:
    return client.patch(path, content=body, headers={**PATCH, "Upload-Offset": str(at), **headers})


def test_a_raw_body_becomes_a_file(client: TestClient) -> None:
    content = os.urandom(3_000_000)
    file = upload(client, content, name="../../etc/<img src=x onerror=alert(1)>")
    found = client.get(f"/v1/files/{file}").json()
    assert found["name"] == "../../etc/<img src=x onerror=alert(1)>"  # a label, given back as it came
    assert (found["state"], found["size"]) == ("complete", len(content))
    assert found["sha256"] == hashlib.sha256(content).hexdigest()
    assert stored(client, file) == content
    assert client.delete(f"/v1/files/{file}").status_code == 204
    assert client.get(f"/v1/files/{file}").status_code == 404


def test_an_upload_without_announced_length(client: TestClient) -> None:
    blocks = [os.urandom(700_000) for _ in range(4)]
    answer = client.post("/v1/files", content=iter(blocks))
    assert answer.json()["sha256"] == hashlib.sha256(b"".join(blocks)).hexdigest()


def test_put_may_be_sent_again(client: TestClient) -> None:
    path, digest = f"/v1/files/{uuid.uuid4()}", hashlib.sha256(b"abc").digest()
    headers = {"Repr-Digest": f"sha-256=:{base64.b64encode(digest).decode()}:"}
    assert client.put(path, content=b"abc", headers=headers).status_code == 201
    assert client.put(path, content=b"abc", headers=headers).status_code == 200
    assert client.put(path, content=b"abc").status_code == 409
    other = client.put(f"/v1/files/{uuid.uuid4()}", content=b"abd", headers=headers)
    assert (other.status_code, other.json()["code"]) == (460, "checksum")
    assert len(client.get("/v1/files").json()["files"]) == 1


@pytest.mark.parametrize("announced", [True, False])
def test_too_large_is_refused_by_bytes_received(make_client: Callable[..., TestClient], announced: bool) -> None:
    client = make_client(max_upload_bytes=2_000_000)
    content = bytes(5_000_000)
    answer = client.post("/v1/files", content=content if announced else iter([content[:1_000_000]] * 5))
    assert answer.status_code == 413
    assert client.get("/v1/files").json()["files"] == []
    context = client.app.state.context  # type: ignore[attr-defined]
    assert list(context.storage.uploads.iterdir()) == []


def test_quota_and_reservation(make_client: Callable[..., TestClient]) -> None:
    client = make_client(tenant_bytes=1000)
    first = begin(client, 800)
    refused = client.post("/v1/tus", headers={**TUS, "Upload-Length": "300"})
    assert (refused.status_code, refused.json()["code"]) == (507, "no_space")
    assert client.delete(first, headers=TUS).status_code == 204
    begin(client, 300)


def test_an_unfinished_upload_that_is_restarted_keeps_to_the_limits(make_client: Callable[..., TestClient]) -> None:
    client = make_client(max_upload_bytes=2000, tenant_bytes=3000)
    ident = begin(client, 1500).rsplit("/", 1)[1]
    refused = client.put(f"/v1/files/{ident}", content=bytes(2001))
    assert (refused.status_code, refused.json()["code"]) == (413, "too_large")
    other = begin(client, 1400)
    full = client.put(f"/v1/files/{ident}", content=bytes(1601))
    assert (full.status_code, full.json()["code"]) == (507, "no_space")
    assert client.get(f"/v1/files/{ident}").json()["size"] == 1500  # as it was
    assert client.put(f"/v1/files/{ident}", content=bytes(1600)).status_code == 201
    assert offset(client, other) == 0


def test_what_was_not_announced_counts_when_it_is_there(make_client: Callable[..., TestClient]) -> None:
    client = make_client(tenant_bytes=1000)
    assert client.post("/v1/files", content=iter([bytes(500), bytes(400)])).status_code == 201
    refused = client.post("/v1/files", content=iter([bytes(60), bytes(60)]))
    assert (refused.status_code, refused.json()["code"]) == (507, "no_space")
    assert [each["size"] for each in client.get("/v1/files").json()["files"]] == [900]
    assert len(list(client.app.state.context.storage.uploads.iterdir())) == 1  # type: ignore[attr-defined]


def test_pages_of_uploads(client: TestClient) -> None:
    files = [upload(client, bytes([k])) for k in range(5)]
    first = client.get("/v1/files", params={"limit": 3}).json()
    rest = client.get("/v1/files", params={"limit": 3, "before": first["next"]}).json()
    assert [each["id"] for each in first["files"] + rest["files"]] == files[::-1]
    assert rest["next"] is None
    info = client.get("/v1/info").json()
    assert (info["upload_bytes"], info["result_bytes"]) == (5, 0)
    assert info["quota_bytes"] > 1 << 30
    assert client.get("/v1/files", params={"before": str(uuid.uuid4())}).status_code == 404


def test_more_than_the_disk_has_is_refused_when_announced(client: TestClient) -> None:
    answer = client.post("/v1/tus", headers={**TUS, "Upload-Length": str(1 << 36)})
    free = client.get("/v1/info").json()["free_bytes"]
    assert answer.status_code == (507 if free < 1 << 36 else 201)


def test_tus_from_beginning_to_end(client: TestClient) -> None:
    content = os.urandom(2_500_000)
    path = begin(client, len(content), "ünïcode.mcap")
    assert offset(client, path) == 0
    assert append(client, path, 0, content[:1_000_000]).headers["upload-offset"] == "1000000"
    wrong = append(client, path, 999_999, content[1_000_000:])
    assert (wrong.status_code, wrong.json()["code"]) == (409, "offset")
    assert offset(client, path) == 1_000_000
    assert append(client, path, 1_000_000, content[1_000_000:]).status_code == 204
    found = client.get(path.replace("tus", "files")).json()
    assert (found["state"], found["name"]) == ("complete", "ünïcode.mcap")
    assert found["sha256"] == hashlib.sha256(content).hexdigest()
    assert append(client, path, len(content), b"x").status_code == 409
    assert offset(client, path) == len(content)


def test_tus_checks_its_headers(client: TestClient) -> None:
    path = begin(client, 10)
    assert client.head(path).status_code == 412
    assert client.patch(path, headers={**TUS, "Upload-Offset": "0"}, content=b"x").status_code == 415
    assert client.patch(path, headers=PATCH, content=b"x").status_code == 400
    assert append(client, path, 0, b"x" * 11).status_code == 413
    assert offset(client, path) == 0
    assert client.post("/v1/tus", headers=TUS).status_code == 400
    assert client.post("/v1/tus", headers={**TUS, "Upload-Length": "-1"}).status_code == 422
    bad = {**TUS, "Upload-Length": "1", "Upload-Metadata": "filename ***"}
    assert client.post("/v1/tus", headers=bad).status_code == 400
    options = client.options("/v1/tus")
    assert options.status_code == 204
    assert set(options.headers["tus-extension"].split(",")) >= {"creation", "checksum", "termination", "expiration"}


def test_metadata_that_is_not_a_text_does_not_matter_but_its_form_does(client: TestClient) -> None:
    for value in ("filename cnVuLm1jYXA=,key /w==", "empty,filename cnVuLm1jYXA=", "filename cnVuLm1jYXA=, key"):
        answer = client.post("/v1/tus", headers={**TUS, "Upload-Length": "1", "Upload-Metadata": value})
        assert answer.status_code == 201, value
        assert client.get(answer.headers["location"].replace("tus", "files")).json()["name"] == "run.mcap"
    for value in (",", "filename  cnVu", "filename cnV"):
        answer = client.post("/v1/tus", headers={**TUS, "Upload-Length": "1", "Upload-Metadata": value})
        assert (answer.status_code, answer.json()["code"]) == (400, "tus_metadata"), value
    for length, status in ((4096, 201), (4097, 422)):
        value = "filename cnVuLm1jYXA=, ".ljust(length, "k")
        answer = client.post("/v1/tus", headers={**TUS, "Upload-Length": "1", "Upload-Metadata": value})
        assert answer.status_code == status, length


def test_the_answer_to_a_refused_method_lists_all_that_there_are(client: TestClient) -> None:
    some = f"{uuid.uuid4()}"
    expected = {
        "/": "GET",
        "/v1/files": "GET, POST",
        f"/v1/files/{some}": "DELETE, GET, PUT",
        f"/v1/jobs/{some}": "DELETE, GET, PATCH",
        f"/v1/tus/{some}": "DELETE, HEAD, OPTIONS, PATCH",
    }
    for path, methods in expected.items():
        answer = client.request("TRACE", path)
        assert (answer.status_code, answer.headers["allow"]) == (405, methods), path


def test_a_body_with_a_wrong_checksum_is_not_taken(client: TestClient) -> None:
    content = os.urandom(1_500_000)
    path = begin(client, len(content))
    right = f"sha1 {base64.b64encode(hashlib.sha1(content).digest()).decode()}"
    spoiled = append(client, path, 0, content[:-1] + b"\0\0"[:1], **{"Upload-Checksum": right})
    if content[-1:] != b"\0":
        assert spoiled.status_code == 460
        assert offset(client, path) == 0
        assert append(client, path, 0, content, **{"Upload-Checksum": right}).status_code == 204
    assert client.get(path.replace("tus", "files")).json()["sha256"] == hashlib.sha256(content).hexdigest()
    assert append(client, begin(client, 1), 0, b"x", **{"Upload-Checksum": "crc32 AAAA"}).status_code == 400


def test_creation_with_upload(client: TestClient) -> None:
    answer = client.post("/v1/tus", content=b"abc", headers={**PATCH, "Upload-Length": "3"})
    assert (answer.status_code, answer.headers["upload-offset"]) == (201, "3")


@pytest.mark.parametrize("body", [b"", iter(())])
def test_an_empty_file_is_refused_with_a_remedy(client: TestClient, body: Any) -> None:
    """Stated to be empty, or found to be so at the end of a stream; a part of an upload may be."""
    for answer in (
        client.post("/v1/files", content=body),
        client.put(f"/v1/files/{uuid.uuid4()}", content=body),
        client.post("/v1/tus", headers={**TUS, "Upload-Length": "0"}),
        client.post("/v1/tus", headers={**PATCH, "Upload-Length": "0"}, content=body),
        client.post("/v1/run", files=[("log", ("run.mcap", b""))]),
    ):
        assert (answer.status_code, answer.json()["code"]) == (400, "empty")
        assert "is empty (0 bytes); copy it again" in answer.json()["message"]
    assert client.get("/v1/files").json()["files"] == []
    path = begin(client, 3)
    assert append(client, path, 0, b"").status_code == 204
    assert append(client, path, 0, b"abc").status_code == 204
    assert client.get(path.replace("tus", "files")).json()["state"] == "complete"


def test_termination(client: TestClient) -> None:
    path = begin(client, 10)
    append(client, path, 0, b"12345")
    assert client.delete(path, headers=TUS).status_code == 204
    assert client.head(path, headers=TUS).status_code == 404
    assert list(client.app.state.context.storage.uploads.iterdir()) == []  # type: ignore[attr-defined]


def test_bytes_beyond_the_offset_do_not_count(client: TestClient) -> None:
    """After a kill the file may be longer than in the database; and a disk may have lost its end."""
    content = os.urandom(3000)
    path = begin(client, len(content))
    append(client, path, 0, content[:1000])
    file = client.app.state.context.storage.upload_path(path.rsplit("/", 1)[1])  # type: ignore[attr-defined]
    with file.open("ab") as longer:
        longer.write(b"never acknowledged")
    assert append(client, path, 1000, content[1000:2000]).status_code == 204
    os.truncate(file, 1500)
    lost = append(client, path, 2000, content[2000:])
    assert lost.status_code == 409
    assert offset(client, path) == 1500
    assert append(client, path, 1500, content[1500:]).status_code == 204
    assert client.get(path.replace("tus", "files")).json()["sha256"] == hashlib.sha256(content).hexdigest()


def test_an_unfinished_upload_expires(make_client: Callable[..., TestClient]) -> None:
    from hsloc_service.housekeeping import Housekeeping

    client = make_client(upload_ttl_s=10.0)
    path, whole = begin(client, 10), upload(client)
    append(client, path, 0, b"12345")
    context = client.app.state.context  # type: ignore[attr-defined]
    tidy = Housekeeping(context.database, context.storage, context.settings, context.deletions).tidy
    tidy(time.time())
    assert offset(client, path) == 5
    tidy(time.time() + 11.0)
    assert client.head(path, headers=TUS).status_code == 404
    assert client.get(f"/v1/files/{whole}").status_code == 200
    assert len(list(context.storage.uploads.iterdir())) == 1


def test_a_broken_connection_keeps_what_arrived_and_only_one_may_write(make_live: Callable[..., Live]) -> None:
    live = make_live(HSLOC_BODY_TIMEOUT_S="600")
    content = os.urandom(5_000_000)
    with live.client() as client:
        path = begin(client, len(content))
        head = (
            f"PATCH {path} HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\nTus-Resumable: 1.0.0\r\n"
            "Content-Type: application/offset+octet-stream\r\nUpload-Offset: 0\r\n"
            f"Content-Length: {len(content)}\r\n\r\n"
        ).encode()
        with socket.create_connection(("127.0.0.1", live.port)) as line:
            line.sendall(head + content[:3_000_000])
            file = live.data / "uploads" / path.rsplit("/", 1)[1]
            until(lambda: file.exists() and file.stat().st_size, "the first bytes are written")
            assert append(client, path, 0, b"x").status_code == 423  # at once: the other may take hours
            assert client.get("/healthz").status_code == 200
        until(lambda: offset(client, path), "what arrived is kept", lambda at: at == 3_000_000)
        until(
            lambda: append(client, path, 3_000_000, content[3_000_000:]).status_code,
            "the upload goes on when the first has let go",
            lambda status: status == 204,
        )
        assert client.get(path.replace("tus", "files")).json()["sha256"] == hashlib.sha256(content).hexdigest()


def test_an_independent_tus_client(make_live: Callable[..., Live]) -> None:
    tusclient = pytest.importorskip("tusclient.client")
    live = make_live()
    content = os.urandom(1_000_000)
    options = {"file_stream": io.BytesIO(content), "chunk_size": 300_000, "upload_checksum": True}
    first = tusclient.TusClient(f"{live.url}/v1/tus").uploader(metadata={"filename": "run.mcap"}, **options)
    first.upload_chunk()
    again = tusclient.TusClient(f"{live.url}/v1/tus").uploader(url=first.url, **options)
    assert again.offset == 300_000
    again.upload()
    found = httpx.get(first.url.replace("tus", "files")).json()
    assert (found["state"], found["sha256"]) == ("complete", hashlib.sha256(content).hexdigest())


def test_a_line_that_breaks_after_the_last_byte_leaves_a_complete_upload(make_live: Callable[..., Live]) -> None:
    """Chunked: all bytes came, the end of the body did not. To the client, offset = length means that it is done."""
    live = make_live()
    with live.client() as client:
        place = begin(client, 10)
    head = (
        f"PATCH {place} HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
        "Content-Type: application/offset+octet-stream\r\nTransfer-Encoding: chunked\r\n\r\na\r\n0123456789\r\n"
    )
    with socket.create_connection(("127.0.0.1", live.port)) as line:
        line.sendall(head.encode())
        time.sleep(0.3)
    ident = place.rsplit("/", 1)[1]
    with live.client() as client:
        found = until(
            lambda: client.get(f"/v1/files/{ident}").json(),
            "the upload is complete",
            lambda shown: shown["state"] == "complete",
        )
        assert found["sha256"] == hashlib.sha256(b"0123456789").hexdigest()
        assert client.post("/v1/jobs", json={"log": ident}).status_code == 201


def test_no_offset_is_the_full_length_before_the_upload_is_complete(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that is killed between the last byte and the commit: the upload must not look complete."""

    def is_killed(*_: Any) -> None:
        raise KeyError("kill -9")

    place = begin(client, 10)
    with monkeypatch.context() as patch:
        patch.setattr(Files, "complete", is_killed)
        assert client.patch(place, headers={**PATCH, "Upload-Offset": "0"}, content=b"0123456789").status_code == 500
    at = offset(client, place)
    assert at < 10
    answer = client.patch(place, headers={**PATCH, "Upload-Offset": str(at)}, content=b"0123456789"[at:])
    assert (answer.status_code, answer.headers["upload-offset"]) == (204, "10")
    assert stored(client, place.rsplit("/", 1)[1]) == b"0123456789"


def test_an_upload_that_an_older_server_left_whole_but_not_complete_goes_on(client: TestClient) -> None:
    place = begin(client, 10)
    client.patch(place, headers={**PATCH, "Upload-Offset": "0"}, content=b"012345678")
    context: Any = client.app.state.context  # type: ignore[attr-defined]
    ident = place.rsplit("/", 1)[1]
    path = context.storage.upload_path(ident)
    path.write_bytes(b"0123456789")
    path.chmod(0o400)
    context.files.advance(ident, 10)
    reconcile(context.database, context.storage, context.deletions)
    assert (offset(client, place), path.stat().st_mode & 0o777) == (9, 0o600)
    assert client.patch(place, headers={**PATCH, "Upload-Offset": "9"}, content=b"9").status_code == 204
    assert client.get(f"/v1/files/{ident}").json()["sha256"] == hashlib.sha256(b"0123456789").hexdigest()


def test_an_upload_does_not_expire_while_bytes_come(make_live: Callable[..., Live]) -> None:
    live = make_live(HSLOC_UPLOAD_TTL_S="3", HSLOC_HOUSEKEEPING_S="0.2")

    def slow() -> Iterator[bytes]:
        for _ in range(14):
            yield b"x" * 1000
            time.sleep(0.3)

    with live.client() as client:
        answer = client.post("/v1/files", params={"name": "slow"}, content=slow())
        assert (answer.status_code, answer.json()["size"]) == (201, 14_000)
        place = client.post("/v1/tus", headers={**TUS, "Upload-Length": "10"}).headers["location"]
        until(lambda: client.head(place, headers=TUS).status_code == 404, "what is given up expires")
