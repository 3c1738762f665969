"""Results in every kind of store: the same requests, the same answers; all of a result is seen, or nothing."""

from __future__ import annotations

import hashlib
import io
import signal
import time
import uuid
import zipfile
from typing import TYPE_CHECKING, Any

import fsspec
import pytest
from fastapi import HTTPException
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from live_service import settings, submit, upload, wait
from sqlalchemy import select
from waiting import until

from hsloc_service.auth import ANYBODY
from hsloc_service.db.tables import AssetRow, JobRow
from hsloc_service.errors import ServiceError
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.http.app import create_app
from hsloc_service.http.results_routes import parse_range
from hsloc_service.results.store import BLOCK, Asset, FolderStore, ResultStore, collect
from hsloc_service.results.stores import ObjectStore, ResultStores
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage
from hsloc_service.uploads.repository import need_quota

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from live_service import Live

KINDS = ("folder", "memory", "file")
NAME = f"{uuid.UUID(int=1)}.1"


def url_of(kind: str, folder: Path) -> str:
    return {"folder": "", "memory": f"memory://{uuid.uuid4()}", "file": f"file://{folder}/mounted"}[kind]


@pytest.fixture(params=KINDS)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return url_of(request.param, tmp_path)


@pytest.fixture
def client(make_client: Callable[..., TestClient], url: str) -> TestClient:
    return make_client(results_url=url)


@pytest.fixture
def store(url: str, tmp_path: Path) -> Iterator[ResultStore]:
    storage = Storage(tmp_path / "data")
    yield ResultStores(storage, settings(tmp_path, results_url=url)).current
    storage.close()


def output(folder: Path, **files: bytes) -> tuple[Path, list[Asset]]:
    """A job's output, and its manifest."""
    place = folder / "output"
    place.mkdir()
    for name, content in files.items():
        (place / name).write_bytes(content)
    return place, collect(place)


def kept(client: TestClient) -> list[str]:
    """The results that the store holds."""
    names: list[str] = client.app.state.context.stores.current.names()  # type: ignore[attr-defined]
    return names


def test_a_store_gives_back_what_it_was_given(store: ResultStore, tmp_path: Path) -> None:
    content = bytes(range(256)) * 40
    place, assets = output(tmp_path, a=content, empty=b"")
    assert store.names() == []
    store.publish(place, NAME, assets)
    assert store.names() == [NAME]
    assert store.read(NAME, "a", 0, len(content)) == content
    assert store.read(NAME, "a", 300, 7) == content[300:307]
    assert store.read(NAME, "empty", 0, 0) == b""
    with pytest.raises(FileNotFoundError):
        store.read(NAME, "b", 0, 1)
    store.remove(NAME)
    store.remove(NAME)
    assert store.names() == []
    with pytest.raises(FileNotFoundError):
        store.read(NAME, "a", 0, 1)


@pytest.mark.parametrize("name", ["..", "../x", "a/b", "", ".x", "x" * 200, "a\n"])
def test_no_name_leads_out_of_a_store(store: ResultStore, name: str) -> None:
    for work in (
        lambda: store.read(NAME, name, 0, 1),
        lambda: store.read(name, "a", 0, 1),
        lambda: store.remove(name),
    ):
        with pytest.raises(ValueError, match="is not the name of"):
            work()


def test_a_job_runs_and_its_results_are_named_by_a_manifest(client: TestClient) -> None:
    job = submit(client, seed=7)
    ended = wait(client, job)
    assert (ended["state"], ended["reason"], ended["attempt"]) == ("succeeded", None, 1)
    manifest = client.get(f"/v1/jobs/{job}/results").json()
    assert [each["name"] for each in manifest["assets"]] == ["metrics.json", "trajectory.tum"]
    for each in manifest["assets"]:
        answer = client.get(each["href"])
        assert hashlib.sha256(answer.content).hexdigest() == each["sha256"]
        assert len(answer.content) == each["size"]
        assert answer.headers["etag"] == f'"{each["sha256"]}"'
        assert "sandbox" in answer.headers["content-security-policy"]
    assert client.get(f"/v1/jobs/{job}/results/trajectory.tum").text == "7 []\n"


def test_ranges_and_etags(client: TestClient) -> None:
    job = submit(client)
    wait(client, job)
    path = f"/v1/jobs/{job}/results/trajectory.tum"
    whole = client.get(path)
    part = client.get(path, headers={"Range": "bytes=2-3"})
    assert (part.status_code, part.content) == (206, whole.content[2:4])
    assert client.get(path, headers={"Range": "bytes=99-"}).status_code == 416
    assert client.get(path, headers={"If-None-Match": whole.headers["etag"]}).status_code == 304
    assert client.get(path, headers={"If-Range": '"other"', "Range": "bytes=2-3"}).status_code == 200


def test_all_results_in_one_archive(client: TestClient) -> None:
    job = submit(client)
    wait(client, job)
    answer = client.get(f"/v1/jobs/{job}/results.zip")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        assert archive.read("trajectory.tum") == b"0 []\n"


def test_only_plain_files_of_the_output_become_results(client: TestClient) -> None:
    job = submit(client, b"tricks")
    wait(client, job)
    names = [each["name"] for each in client.get(f"/v1/jobs/{job}/results").json()["assets"]]
    assert names == ["metrics.json", "trajectory.tum"]
    for name in ("passwd", "..%2f..%2fhsloc.db", "%2e%2e%2fhsloc.db", "%2e%2e", "sub"):
        assert client.get(f"/v1/jobs/{job}/results/{name}").status_code in (404, 422)


def test_delete_removes_results_but_not_what_is_active(client: TestClient) -> None:
    job = submit(client)
    wait(client, job)
    assert kept(client) == [f"{job}.1"]
    assert client.delete(f"/v1/jobs/{job}").status_code == 204
    assert client.get(f"/v1/jobs/{job}").status_code == 404
    client.app.state.context.deletions.clear()  # type: ignore[attr-defined]
    assert kept(client) == []
    active = submit(client, b"slow 600")
    file = client.get(f"/v1/jobs/{active}").json()["request"]["log"]
    assert client.delete(f"/v1/jobs/{active}").status_code == 409
    assert client.delete(f"/v1/files/{file}").status_code == 409
    client.post(f"/v1/jobs/{active}/cancel")
    wait(client, active)
    assert client.delete(f"/v1/files/{file}").status_code == 204


def test_an_empty_and_a_large_file_are_read_in_blocks(client: TestClient, tmp_path: Path) -> None:
    job = submit(client)
    wait(client, job)
    content = (bytes(range(251)) * (BLOCK // 100))[: BLOCK * 2 + 12345]  # 251 is prime: no two blocks are alike
    place, assets = output(tmp_path, large=content, empty=b"")
    context = client.app.state.context  # type: ignore[attr-defined]
    store, name = context.stores.current, f"{job}.2"
    store.publish(place, name, assets)
    sizes: list[int] = []
    reader = store.open(name, "large")
    reader.close()
    plain_read = type(reader).read

    def spy(self: Any, start: int, size: int) -> bytes:
        sizes.append(size)
        block: bytes = plain_read(self, start, size)
        return block

    with context.database.write() as session:
        row = session.query(JobRow).filter_by(id=job).one()
        row.folder = name
        session.query(AssetRow).filter_by(job_id=job).delete()
        session.add_all(AssetRow(job_id=job, **{k: getattr(a, k) for k in a.__slots__}) for a in assets)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(reader), "read", spy)
        answer = client.get(f"/v1/jobs/{job}/results/large")
        assert answer.content == content
        assert answer.headers["content-length"] == str(len(content))
        tail = client.get(f"/v1/jobs/{job}/results/large", headers={"Range": f"bytes={BLOCK - 1}-{BLOCK}"})
        assert tail.content == content[BLOCK - 1 : BLOCK + 1]
        assert client.get(f"/v1/jobs/{job}/results/empty").content == b""
        with zipfile.ZipFile(io.BytesIO(client.get(f"/v1/jobs/{job}/results.zip").content)) as archive:
            assert archive.testzip() is None
            assert archive.read("large") == content
            assert archive.read("empty") == b""
    assert max(sizes) <= BLOCK


def test_retention_takes_results_with_it(make_client: Callable[..., TestClient], url: str) -> None:
    client = make_client(results_url=url, retention_s=100.0)
    wait(client, submit(client))
    assert len(kept(client)) == 1
    context = client.app.state.context  # type: ignore[attr-defined]
    Housekeeping(context.database, context.storage, context.settings, context.deletions).tidy(time.time() + 150.0)
    assert kept(client) == []
    assert client.get("/v1/jobs").json()["jobs"] == []


def test_results_count_in_the_quota(client: TestClient) -> None:
    wait(client, submit(client, b"ok"))
    with client.app.state.context.database.read() as session:  # type: ignore[attr-defined]
        need_quota(session, ANYBODY, most=2 + 8)  # the log, and two files of 3 and 5 bytes
        with pytest.raises(ServiceError, match="uploads take 2 and your results 8 of 9 bytes") as error:
            need_quota(session, ANYBODY, most=9)
    assert error.value.status == 507


def test_a_job_is_refused_when_results_have_used_the_quota_up(make_client: Callable[..., TestClient], url: str) -> None:
    client = make_client(results_url=url, tenant_bytes=9)
    file = upload(client)
    wait(client, client.post("/v1/jobs", json={"log": file}).json()["id"])
    refused = client.post("/v1/jobs", json={"log": file})
    assert (refused.status_code, refused.json()["code"]) == (507, "no_space")
    assert client.post("/v1/files", content=b"x").status_code == 507


def test_abandoned_attempts_are_swept_and_nothing_else(client: TestClient, tmp_path: Path) -> None:
    job = submit(client)
    wait(client, job)
    context = client.app.state.context  # type: ignore[attr-defined]
    active = submit(client, b"slow 600")
    wait(client, active, states=("running",))
    place, assets = output(tmp_path, a=b"x")
    unknown = sorted([f"{job}.7", f"{uuid.uuid4()}.1"])
    for name in (*unknown, f"{active}.1"):  # two of another database; one that is being stored just now
        copy = tmp_path / name
        copy.mkdir()
        (copy / "a").write_bytes((place / "a").read_bytes())
        context.stores.current.publish(copy, name, assets)
    waiting = submit(client)
    with context.database.write() as session:  # a server was killed when it had stored what its first attempt computed
        session.scalars(select(JobRow).where(JobRow.id == waiting)).one().attempt = 1
    copy = tmp_path / f"{waiting}.1"
    copy.mkdir()
    (copy / "a").write_bytes((place / "a").read_bytes())
    context.stores.current.publish(copy, copy.name, assets)
    assert sorted(context.deletions.sweep(context.stores.current)) == unknown
    assert sorted(kept(client)) == sorted([f"{job}.1", f"{active}.1", *unknown])
    assert client.get(f"/v1/jobs/{job}/results/metrics.json").status_code == 200
    client.post(f"/v1/jobs/{active}/cancel")
    wait(client, active)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_two_servers_share_a_bucket(tmp_path: Path, kind: str) -> None:
    shared = url_of(kind, tmp_path)
    first, second = ObjectStore(shared, "one"), ObjectStore(shared, "two")
    place, assets = output(tmp_path, a=b"x")
    first.publish(place, NAME, assets)
    assert (first.names(), second.names()) == ([NAME], [])


def test_results_stay_where_they_were_when_the_setting_changes(tmp_path: Path) -> None:
    def get(job: str, client: TestClient) -> Any:
        return client.get(f"/v1/jobs/{job}/results/trajectory.tum")

    elsewhere = f"memory://{uuid.uuid4()}"
    with TestClient(create_app(settings(tmp_path))) as client:
        here = submit(client)
        wait(client, here)
    with TestClient(create_app(settings(tmp_path, results_url=elsewhere))) as client:
        there = submit(client)
        wait(client, there)
        assert get(here, client).status_code == get(there, client).status_code == 200
    with TestClient(create_app(settings(tmp_path))) as client:
        assert get(here, client).status_code == 200
        gone = get(there, client)
        assert (gone.status_code, gone.json()["code"]) == (503, "store")
        assert client.delete(f"/v1/jobs/{there}").status_code == 204
        assert client.app.state.context.deletions.clear() == 0  # type: ignore[attr-defined]
    with TestClient(create_app(settings(tmp_path, results_url=elsewhere))) as client:
        until(lambda: not kept(client), "the first round of the housekeeping has removed it")


def test_a_map_in_a_store_that_is_not_set_any_more_cannot_be_extended(tmp_path: Path) -> None:
    with TestClient(create_app(settings(tmp_path, results_url=f"memory://{uuid.uuid4()}"))) as client:
        drawn = submit(client)
        wait(client, drawn)
        with client.app.state.context.database.write() as session:  # type: ignore[attr-defined]
            session.add(AssetRow(job_id=drawn, name="map.npz", size=1, sha256="00", media_type="x"))
    with TestClient(create_app(settings(tmp_path))) as client:
        ended = wait(client, submit(client, b"ok", resume=drawn))
        assert (ended["state"], ended["reason"]) == ("failed", "store")
        assert "in a store that this server is not set to" in ended["message"]
        assert "memory://" not in ended["message"]  # where the server keeps results is not the tenant's business


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ("bucket/prefix", "must be a URL"),
        ("nonsense://x", "cannot be used"),
        ("s3://key:secret@bucket/x", "leave user, password"),
        ("simplecache::s3://bucket", "must be a URL"),
    ],
)
def test_a_url_that_cannot_be_used_is_refused_in_one_line(tmp_path: Path, wrong: str, expected: str) -> None:
    with pytest.raises(SettingsError, match=expected) as error:
        create_app(settings(tmp_path, results_url=wrong))
    assert "\n" not in str(error.value)
    assert "secret" not in str(error.value)
    create_app(settings(tmp_path)).state.context.storage.close()  # the folder is free again


def test_a_file_system_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: Any, **__: Any) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(fsspec, "url_to_fs", missing)
    with pytest.raises(SettingsError, match="pip install s3fs"):
        ObjectStore("s3://bucket/prefix", "one")


@given(st.text(alphabet="bytes=-0123456789, ", max_size=20), st.integers(0, 30))
def test_a_range_is_a_part_of_the_file_or_refused(text: str, size: int) -> None:
    try:
        span = parse_range(text, size)
    except HTTPException:
        return  # what is refused, and how, is tested below
    assert span is None or 0 <= span.start < span.stop <= size


@given(st.integers(0, 40), st.integers(0, 40), st.integers(1, 30))
def test_ranges_are_those_of_the_standard(first: int, last: int, size: int) -> None:
    content = list(range(size))

    def taken(text: str) -> list[int] | str | None:
        try:
            span = parse_range(text, size)
        except HTTPException:
            return "416"
        return None if span is None else content[span.start : span.stop]

    assert taken(f"bytes={first}-") == (content[first:] if first < size else "416")
    assert taken(f"bytes=-{last}") == (content[-last:] if last else "416")
    both = None if last < first else content[first : last + 1] if first < size else "416"
    assert taken(f"bytes={first}-{last}") == both


def test_the_folder_is_the_default(tmp_path: Path) -> None:
    storage = Storage(tmp_path / "data")
    assert isinstance(ResultStores(storage, settings(tmp_path)).current, FolderStore)
    storage.close()


def test_kill_9_between_storing_and_commit_loses_nothing(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live(HSLOC_RESULTS_URL=f"file://{tmp_path}/mounted")
    with live.client() as client:
        jobs = [submit(client, b"ok %d" % k, seed=k) for k in range(12)]
    for pause in (0.35, 0.55):
        time.sleep(pause)
        live.end(signal.SIGKILL)
        live.start()
    instance = (live.data / "instance").read_text()
    with live.client() as client:
        for k, job in enumerate(jobs):
            assert wait(client, job)["state"] == "succeeded"
            for each in client.get(f"/v1/jobs/{job}/results").json()["assets"]:
                assert hashlib.sha256(client.get(each["href"]).content).hexdigest() == each["sha256"]
            assert client.get(f"/v1/jobs/{job}/results/trajectory.tum").text.startswith(f"{k} ")
    live.end()
    live.start()  # and sweeps, when it has started
    folder = tmp_path / "mounted" / instance
    until(lambda: len(list(folder.iterdir())) <= len(jobs), "what was abandoned is swept")
    assert sorted(path.name.partition(".")[0] for path in folder.iterdir()) == sorted(jobs)
