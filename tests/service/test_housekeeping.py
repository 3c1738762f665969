"""What goes with time, and what must not."""

from __future__ import annotations

import re
import sqlite3
import threading
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from live_service import settings, submit, wait
from sqlalchemy import func, insert, select
from sqlalchemy.exc import OperationalError

from hsloc_service.db.tables import EventRow, FileRow, IdempotencyRow, JobRow
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.settings import SettingsError, from_environment, parse_size
from hsloc_service.storage import Storage

if TYPE_CHECKING:
    from collections.abc import Callable

    from fastapi.testclient import TestClient
    from postgresql import Server


def test_old_jobs_go_with_results_and_uploads_but_active_ones_stay(make_client: Callable[..., TestClient]) -> None:
    client = make_client(retention_s=100.0)
    old = submit(client)
    wait(client, old)
    active = submit(client, b"slow 600")
    context = client.app.state.context  # type: ignore[attr-defined]
    tidy = Housekeeping(context.database, context.storage, context.settings, context.deletions).tidy
    tidy(time.time() + 50.0)
    assert client.get(f"/v1/jobs/{old}").status_code == 200
    tidy(time.time() + 150.0)
    assert client.get(f"/v1/jobs/{old}").status_code == 404
    assert list(context.storage.results.iterdir()) == []
    assert client.get(f"/v1/jobs/{active}").status_code == 200
    assert len(list(context.storage.uploads.iterdir())) == 1  # the active job's
    client.post(f"/v1/jobs/{active}/cancel")
    wait(client, active)


def test_a_server_whose_clock_is_wrong_uses_that_of_the_database(
    make_client: Callable[..., TestClient], postgresql: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = make_client(slots=0, database_url=postgresql.new_database())
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3600.0)
    submit(client)
    (waits,) = re.findall(r"^hsloc_oldest_queued_seconds (\S+)$", client.get("/metrics").text, re.MULTILINE)
    assert 0.0 <= float(waits) < 60.0
    tus = {"Tus-Resumable": "1.0.0"}
    place = client.post("/v1/tus", headers={**tus, "Upload-Length": "9"}).headers["location"]
    kind = {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    sent = client.patch(place, headers={**tus, **kind}, content=b"half")
    assert sent.headers["upload-expires"] == client.head(place, headers=tus).headers["upload-expires"]


def test_without_retention_nothing_goes(make_client: Callable[..., TestClient]) -> None:
    client = make_client()
    job = submit(client)
    wait(client, job)
    context = client.app.state.context  # type: ignore[attr-defined]
    Housekeeping(context.database, context.storage, context.settings, context.deletions).tidy(time.time() + 1e9)
    assert client.get(f"/v1/jobs/{job}/results").status_code == 200


def test_settings_from_variables(tmp_path: Path) -> None:
    found = from_environment({"HSLOC_MAX_UPLOAD_BYTES": "2G", "HSLOC_REQUIRE_TOKEN": "yes"}, data=tmp_path, slots=None)
    assert (found.max_upload_bytes, found.require_token, found.data, found.slots) == (2 << 30, True, tmp_path, 1)
    assert parse_size("3k") == 3072
    assert from_environment({"HSLOC_DATA": "/logs"}).data != Path("/logs")
    assert from_environment({"HSLOC_SERVE_DATA": "/srv"}).data == Path("/srv")
    for name, value in (("SLOTS", "many"), ("SLOTS", "-1"), ("REQUIRE_TOKEN", "perhaps"), ("HEARTBEAT_S", "60")):
        with pytest.raises(SettingsError):
            from_environment({f"HSLOC_{name}": value})
    assert settings(tmp_path).retention_s is None


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("RETENTION_S", "-5"),  # everything was deleted
        ("RETENTION_S", "0"),
        ("RETENTION_S", "nan"),
        ("UPLOAD_TTL_S", "inf"),
        ("JOB_WALL_S", "-1"),
        ("JOB_WALL_S", "1e30"),
        ("TENANT_BYTES", "0"),
        ("MAX_CONNECTIONS", "-1"),
        ("WEBHOOK_ATTEMPTS", "0"),
        ("MIN_FREE_BYTES", "-1"),
        ("FAULT_FAIL_JOBS", "1.5"),
        ("FAULT_FAIL_JOBS", "nan"),
        ("ALLOWED_HOSTS", ","),
    ],
)
def test_a_setting_without_sense_is_refused(variable: str, value: str) -> None:
    with pytest.raises(SettingsError, match=rf"^{variable.lower()} is .*(must|give)"):
        from_environment({f"HSLOC_{variable}": value})


@pytest.mark.parametrize(
    ("name", "remedy"), [("HSLOC_RETENTON_S", "did you mean HSLOC_RETENTION_S"), ("HSLOC_XYZZY", "remove it")]
)
def test_a_misspelt_variable_is_refused(name: str, remedy: str) -> None:
    with pytest.raises(SettingsError, match=remedy):
        from_environment({name: "5"})
    from_environment({"HSLOC_TOKEN": "x", "HSLOC_DATA": "/logs", "HSLOCATION": "x"})


def test_retention_of_many_jobs_does_not_delay_requests(make_client: Callable[..., TestClient]) -> None:
    """Before, 8,000 jobs were one transaction: 66 s, in which no upload and no heartbeat was written."""
    client = make_client(retention_s=100.0, tenant_bytes=1 << 40)
    context = client.app.state.context  # type: ignore[attr-defined]
    count = 1500
    with context.database.write() as session:
        ids = [str(uuid.uuid4()) for _ in range(count)]
        file = {"tenant": "local", "name": "a", "state": "complete", "received": 1, "size": 1, "created": 1.0}
        session.execute(insert(FileRow), [{"id": each, **file} for each in ids])
        job = {"tenant": "local", "log_name": "a", "state": "succeeded", "created": 1.0, "ended": 2.0}
        values = [{"id": each, "file_id": each, "request": {"log": each}, "folder": f"{each}.1", **job} for each in ids]
        session.execute(insert(JobRow), values)
        event = {"tenant": "local", "at": 1.0, "kind": "state", "data": {}}
        session.execute(insert(EventRow), [{"job_id": each, **event} for each in ids for _ in range(3)])
        key = {"tenant": "local", "sha256": "0", "created": time.time()}
        session.execute(insert(IdempotencyRow), [{"key": each, "job_id": each, **key} for each in ids])
    tidy = Housekeeping(context.database, context.storage, context.settings, context.deletions).tidy
    thread = threading.Thread(target=tidy, args=(time.time(),))
    left = set()
    thread.start()
    while thread.is_alive():
        with context.database.write() as session:
            left.add(session.scalar(select(func.count()).select_from(JobRow)))
        time.sleep(0.02)
    thread.join()
    assert client.get("/v1/jobs").json()["jobs"] == []
    assert client.get("/v1/files").json()["files"] == []
    assert len(left) > 5  # others wrote between its 60 batches


@pytest.mark.parametrize(
    ("code", "words", "full"),
    [
        (sqlite3.SQLITE_FULL, "in other words", True),
        (sqlite3.SQLITE_ERROR, "no such table: full", False),
        (None, "database or disk is full", False),
    ],
)
def test_a_full_disk_is_known_by_its_code_and_not_by_words(
    tmp_path: Path, code: int | None, words: str, full: bool
) -> None:
    storage = Storage(tmp_path, 0)
    storage.restore_ballast()
    (tmp_path / "ballast").touch()
    cause = sqlite3.OperationalError(words)
    if code is not None:
        cause.sqlite_errorcode = code
    tries = []

    def work() -> None:
        tries.append((tmp_path / "ballast").exists())
        if len(tries) == 1:
            raise OperationalError("delete", {}, cause)

    if full:
        storage.with_room(work)
        assert tries == [True, False]
    else:
        with pytest.raises(OperationalError):
            storage.with_room(work)
    storage.close()
