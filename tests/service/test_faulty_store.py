"""A store that refuses, hangs, loses bytes or fails half-way: accepted jobs are kept, and the API answers."""

from __future__ import annotations

import asyncio
import functools
import threading
import time
import uuid
import zipfile
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any, ClassVar

import fsspec
import pytest
from fastapi.testclient import TestClient
from fsspec.implementations.memory import MemoryFileSystem
from live_service import settings, submit, wait
from sqlalchemy import select
from waiting import LIMIT_S, until

from hsloc_service.call_timeout import BoundedExecutor
from hsloc_service.db.tables import JobRow
from hsloc_service.execution import retry
from hsloc_service.http import results_routes
from hsloc_service.http.app import create_app

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

HANG_S = 60.0
"""A call that hangs is let go by its test. After this time somebody waited for it who must not."""
PATIENT_S, IMPATIENT_S = 600.0, 0.3
"""Time limits of calls: longer than any of them hangs, and one that they are to miss."""


class Faulty(MemoryFileSystem):  # type: ignore[misc]
    """Memory, with a fault that a test sets."""

    protocol = "faulty"
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    fault = ""
    puts = 0
    release = threading.Event()
    hanging: ClassVar[set[int]] = set()
    """The threads whose call hangs just now."""
    outlasted = False

    @classmethod
    def _strip_protocol(cls, path: Any) -> Any:
        return super()._strip_protocol(path.removeprefix("faulty://"))

    def _suffer(self, call: str = "") -> None:
        if Faulty.fault == "refuse":
            raise ConnectionError("the bucket does not answer")
        if Faulty.fault == "forbid":
            raise PermissionError("access denied")
        if Faulty.fault in ("hang", f"hang {call}"):
            Faulty.hanging.add(threading.get_ident())
            Faulty.outlasted |= not Faulty.release.wait(HANG_S)
            Faulty.hanging.discard(threading.get_ident())

    def put_file(self, lpath: str, rpath: str, *args: Any, **kwargs: Any) -> None:
        self._suffer("put")
        Faulty.puts += 1
        if Faulty.fault == "second" and Faulty.puts > 1:
            raise ConnectionError("the line broke")
        super().put_file(lpath, rpath, *args, **kwargs)
        if Faulty.fault == "truncate":
            self.pipe_file(rpath, self.cat_file(rpath)[:-1])

    def cat_file(self, path: str, start: int | None = None, end: int | None = None, **kwargs: Any) -> bytes:
        self._suffer()
        if Faulty.fault == "late" and start:
            raise ConnectionError("the line broke")
        content: bytes = super().cat_file(path, start, end, **kwargs)
        return content[:-1] if Faulty.fault == "short" else content

    def ls(self, *args: Any, **kwargs: Any) -> Any:
        self._suffer()
        return super().ls(*args, **kwargs)

    def rm(self, *args: Any, **kwargs: Any) -> None:
        self._suffer()
        super().rm(*args, **kwargs)


fsspec.register_implementation("faulty", Faulty, clobber=True)


@pytest.fixture(autouse=True)
def _fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(retry, "FIRST_WAIT_S", 0.05)
    monkeypatch.setattr(retry, "MAX_WAIT_S", 0.2)
    monkeypatch.setattr(Faulty, "store", {})
    monkeypatch.setattr(Faulty, "pseudo_dirs", [""])
    monkeypatch.setattr(Faulty, "fault", "")
    monkeypatch.setattr(Faulty, "puts", 0)
    monkeypatch.setattr(Faulty, "release", threading.Event())
    monkeypatch.setattr(Faulty, "hanging", set())
    monkeypatch.setattr(Faulty, "outlasted", False)
    yield
    heal()
    for thread in threading.enumerate():
        if thread.name == "store":
            thread.join(LIMIT_S)  # what hung must not go on in the next test
    assert not Faulty.outlasted, "somebody waited for a store that hangs"


def heal() -> None:
    """The store answers again, also what it was asked before."""
    Faulty.fault = ""
    Faulty.release.set()


@pytest.fixture
def url() -> str:
    return f"faulty://{uuid.uuid4()}"


@pytest.fixture
def client(make_client: Callable[..., TestClient], url: str) -> TestClient:
    return make_client(results_url=url, store_timeout_s=PATIENT_S)


def stored(job: str) -> list[str]:
    """The objects of a job."""
    return [path.rsplit("/", 1)[1] for path in list(Faulty.store) if job in path]


def wait_for_store(client: TestClient, job: str) -> None:
    """Until the job's process has ended, and its results are being stored."""

    def phase() -> object:
        return (client.get(f"/v1/jobs/{job}").json()["progress"] or {}).get("phase")

    until(phase, "the job waits for the store", lambda found: found == "store")


def failures() -> float:
    from hsloc_service.http.metrics import REGISTRY

    return REGISTRY.get_sample_value("hsloc_store_errors_total") or 0.0


def lease_until(client: TestClient, job: str) -> float:
    """How long the worker holds a job that runs."""
    with client.app.state.context.database.read() as session:  # type: ignore[attr-defined]
        return float(session.scalars(select(JobRow.lease_until).where(JobRow.id == job)).one())


def asset(client: TestClient, job: str, name: str) -> bytes:
    """A file of the results from a store that answers again; a client that is impatient may miss it at first."""
    answer = until(
        lambda: client.get(f"/v1/jobs/{job}/results/{name}"), f"{name} can be read", lambda it: it.status_code == 200
    )
    return bytes(answer.content)


@pytest.mark.parametrize("fault", ["refuse", "forbid", "hang", "truncate", "second"])
def test_a_job_waits_for_its_store_and_nothing_is_seen_before(
    make_client: Callable[..., TestClient], url: str, fault: str
) -> None:
    client = make_client(results_url=url, store_timeout_s=IMPATIENT_S if fault == "hang" else PATIENT_S)
    before = failures()
    Faulty.fault = fault
    job = submit(client, seed=3)
    wait_for_store(client, job)
    until(lambda: failures() >= before + 2, "it was tried again")
    lease = lease_until(client, job)
    until(lambda: lease_until(client, job) > lease, "the job is held meanwhile")
    found = client.get(f"/v1/jobs/{job}").json()
    assert (found["state"], found["attempt"]) == ("running", 1)
    assert client.get(f"/v1/jobs/{job}/results").json()["code"] == "no_results"
    assert client.get(f"/v1/jobs/{job}/results/metrics.json").status_code == 409
    heal()
    ended = wait(client, job)
    assert (ended["state"], ended["attempt"]) == ("succeeded", 1)  # what was computed was kept
    assert asset(client, job, "trajectory.tum") == b"3 []\n"


def test_a_store_that_hangs_does_not_delay_others(client: TestClient) -> None:
    job = submit(client)
    wait(client, job)
    Faulty.fault = "hang"
    readers, answers = read_at_once(client, job)
    until(lambda: len(Faulty.hanging) >= 40, "as many calls hang as there are threads for all routes")
    for _ in range(20):
        assert client.get(f"/v1/jobs/{job}/results").status_code == 200
    assert (len(answers), Faulty.outlasted) == (0, False)
    heal()
    for reader in readers:
        reader.join(LIMIT_S)
    assert [answer.status_code for answer in answers] == [200] * 100


def test_readers_of_a_store_that_hangs_are_answered(make_client: Callable[..., TestClient], url: str) -> None:
    client = make_client(results_url=url, store_timeout_s=IMPATIENT_S)
    job = submit(client)
    wait(client, job)
    Faulty.fault = "hang"
    readers, answers = read_at_once(client, job)
    for reader in readers:
        reader.join(LIMIT_S)
    assert not Faulty.outlasted
    assert [answer.status_code for answer in answers] == [503] * 100
    assert answers[0].json()["code"] == "store"
    assert int(answers[0].headers["retry-after"]) >= 1
    heal()
    # The calls that hung have ended, and there is room for others.
    assert asset(client, job, "metrics.json") == b"{}\n"


def read_at_once(client: TestClient, job: str) -> tuple[list[threading.Thread], list[Any]]:
    """A hundred who read results of a job; their answers, as they come."""
    answers: list[Any] = []

    def read(path: str) -> None:
        answers.append(client.get(f"/v1/jobs/{job}/{path}"))

    paths = ["results/metrics.json", "results.zip"]
    readers = [threading.Thread(target=read, args=(paths[k % 2],)) for k in range(100)]
    for reader in readers:
        reader.start()
    return readers, answers


def test_many_readers_wait_for_their_turn() -> None:
    busy = most = 0
    lock, three = threading.Lock(), threading.Barrier(3)

    def read(k: int) -> int:
        nonlocal busy, most
        with lock:
            busy += 1
            most = max(most, busy)
        three.wait(LIMIT_S)
        time.sleep(0.03)
        with lock:
            busy -= 1
        return k

    async def all_at_once() -> list[int]:
        executor = BoundedExecutor(timeout_s=LIMIT_S, max_calls=3)
        return list(await asyncio.gather(*(executor.run(functools.partial(read, k)) for k in range(30))))

    assert asyncio.run(all_at_once()) == list(range(30))
    assert most == 3


@pytest.mark.parametrize("fault", ["refuse", "short"])
def test_reading_fails_with_a_type(client: TestClient, fault: str) -> None:
    job = submit(client)
    wait(client, job)
    Faulty.fault = fault
    for path in ("results/metrics.json", "results.zip"):
        answer = client.get(f"/v1/jobs/{job}/{path}")
        assert (answer.status_code, answer.json()["code"]) == (503, "store")
    assert client.get(f"/v1/jobs/{job}/results").status_code == 200  # the manifest is ours
    tag = client.get(f"/v1/jobs/{job}/results").json()["assets"][0]["sha256"]
    same = client.get(f"/v1/jobs/{job}/results/metrics.json", headers={"If-None-Match": f'"{tag}"'})
    assert same.status_code == 304


def test_an_object_that_is_gone_is_not_found(client: TestClient) -> None:
    job = submit(client)
    wait(client, job)
    Faulty.store.clear()
    assert client.get(f"/v1/jobs/{job}/results/metrics.json").status_code == 404
    assert client.get(f"/v1/jobs/{job}/results.zip").status_code == 404


def test_a_line_that_breaks_in_the_middle_is_no_whole_answer(client: TestClient, monkeypatch: Any) -> None:
    job = submit(client)
    wait(client, job)
    monkeypatch.setattr(results_routes, "BLOCK", 2)
    Faulty.fault = "late"
    part = client.get(f"/v1/jobs/{job}/results/trajectory.tum")
    assert len(part.content) < int(part.headers["content-length"])
    with pytest.raises(zipfile.BadZipFile):
        zipfile.ZipFile(BytesIO(client.get(f"/v1/jobs/{job}/results.zip").content))


def test_a_job_that_waits_for_its_store_can_be_cancelled(client: TestClient) -> None:
    Faulty.fault = "hang"
    job = submit(client)
    wait_for_store(client, job)
    until(lambda: Faulty.hanging, "the store hangs")
    client.post(f"/v1/jobs/{job}/cancel")
    assert wait(client, job)["state"] == "cancelled"
    assert Faulty.hanging
    heal()
    assert wait(client, submit(client))["state"] == "succeeded"  # the slot is free


def test_a_server_that_is_stopped_meanwhile_keeps_the_job(tmp_path: Path, url: str) -> None:
    chosen = settings(tmp_path, results_url=url, store_timeout_s=PATIENT_S)
    Faulty.fault = "hang put"
    with TestClient(create_app(chosen)) as client:
        job = submit(client, seed=5)
        wait_for_store(client, job)
        until(lambda: Faulty.hanging, "the store hangs")
    assert Faulty.hanging  # the call that hangs does not hold the server
    Faulty.fault = ""
    with TestClient(create_app(chosen)) as client:
        ended = wait(client, job)
        assert (ended["state"], ended["attempt"]) == ("succeeded", 2)
        assert client.get(f"/v1/jobs/{job}/results/trajectory.tum").content == b"5 []\n"


def test_what_a_broken_attempt_left_behind_is_swept(client: TestClient) -> None:
    Faulty.fault = "second"
    job = submit(client)
    wait_for_store(client, job)
    until(lambda: stored(job), "a part was stored")
    assert stored(job) == ["metrics.json"]
    client.post(f"/v1/jobs/{job}/cancel")
    wait(client, job)
    Faulty.fault = ""
    context = client.app.state.context  # type: ignore[attr-defined]
    assert context.deletions.sweep(context.stores.current) == []
    assert stored(job) == []


def test_deleting_does_not_wait_for_the_store_and_is_completed_later(client: TestClient) -> None:
    job = submit(client)
    wait(client, job)
    Faulty.fault = "hang"
    assert client.delete(f"/v1/jobs/{job}").status_code == 204
    assert not Faulty.outlasted
    assert client.get(f"/v1/jobs/{job}/results/metrics.json").status_code == 404
    deletions = client.app.state.context.deletions  # type: ignore[attr-defined]
    assert replace(deletions, timeout_s=IMPATIENT_S).clear() == 0
    assert len(stored(job)) == 2
    Faulty.fault = ""
    assert deletions.clear() == 1
    assert stored(job) == []
    assert deletions.clear() == 0


def test_a_server_starts_while_its_store_is_away(tmp_path: Path, url: str) -> None:
    Faulty.fault = "hang"
    with TestClient(create_app(settings(tmp_path, results_url=url, store_timeout_s=PATIENT_S))) as client:
        assert client.get("/readyz").status_code == 200
        assert client.post("/v1/files", content=b"ok").status_code == 201
        until(lambda: Faulty.hanging, "the housekeeping waits for the store")
        assert not Faulty.outlasted
        heal()  # else the end would wait for the housekeeping


def test_a_disk_that_is_not_mounted_is_away_and_nothing_is_gone(
    make_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    mounted, aside = tmp_path / "mounted", tmp_path / "aside"
    client = make_client(results_url=f"file://{mounted}", store_timeout_s=PATIENT_S)
    first, doomed = submit(client, seed=1), submit(client, seed=2)
    assert {wait(client, job)["state"] for job in (first, doomed)} == {"succeeded"}
    mounted.rename(aside)
    answer = client.get(f"/v1/jobs/{first}/results/metrics.json")
    assert (answer.status_code, answer.json()["code"]) == (503, "store")
    assert client.get(f"/v1/jobs/{first}/results.zip").status_code == 503
    waiting = submit(client, seed=3)
    wait_for_store(client, waiting)
    assert client.delete(f"/v1/jobs/{doomed}").status_code == 204
    deletions = client.app.state.context.deletions  # type: ignore[attr-defined]
    assert deletions.clear() == 0
    assert not mounted.exists()  # made again, it would be on another disk, and hidden when the right one is there again
    aside.rename(mounted)
    assert wait(client, waiting)["state"] == "succeeded"
    assert client.get(f"/v1/jobs/{first}/results/metrics.json").status_code == 200
    assert deletions.clear() == 1
    assert sorted(path.name for path in next(mounted.iterdir()).iterdir()) == sorted([f"{first}.1", f"{waiting}.1"])


def test_a_results_folder_that_is_not_mounted_at_the_start_is_waited_for(tmp_path: Path) -> None:
    mounted, aside = tmp_path / "mounted", tmp_path / "aside"
    chosen = settings(tmp_path, results_url=f"file://{mounted}", store_timeout_s=PATIENT_S)
    with TestClient(create_app(chosen)) as client:
        first = submit(client)
        wait(client, first)
    mounted.rename(aside)
    with TestClient(create_app(chosen)) as client:
        second = submit(client)
        before = failures()
        wait_for_store(client, second)
        until(lambda: failures() >= before + 2, "it was tried again")
        assert not mounted.exists()  # it would be on the disk beneath, and hidden by the mount
        assert client.get(f"/v1/jobs/{first}/results/metrics.json").status_code == 503
        aside.rename(mounted)
        assert wait(client, second)["state"] == "succeeded"
        for job in (first, second):
            assert client.get(f"/v1/jobs/{job}/results/metrics.json").status_code == 200
