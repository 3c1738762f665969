"""A server that starts on an older database, or on none, deletes nothing; backup and restore."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from typing import TYPE_CHECKING

import pytest
from fastapi.testclient import TestClient
from live_service import Live, settings, submit, upload, wait

from hsloc_service.backup import back_up
from hsloc_service.http.app import create_app
from hsloc_service.settings import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def snapshot(data: Path, target: Path) -> None:
    """The database as it is now, in one file."""
    with closing(sqlite3.connect(data / "hsloc.db")) as source, closing(sqlite3.connect(target)) as copy:
        source.backup(copy)


def put_database(data: Path, source: Path | None) -> None:
    for name in ("hsloc.db", "hsloc.db-wal", "hsloc.db-shm"):
        (data / name).unlink(missing_ok=True)
    if source is not None:
        shutil.copyfile(source, data / "hsloc.db")


@pytest.mark.parametrize("older", [True, False], ids=["older", "missing"])
def test_a_start_on_another_database_keeps_every_file(tmp_path: Path, older: bool) -> None:
    data = tmp_path / "data"
    with TestClient(create_app(settings(tmp_path))) as client:
        snapshot(data, tmp_path / "old.db")
        job = submit(client, b"ok of the user")
        wait(client, job)
        file = client.get(f"/v1/jobs/{job}").json()["request"]["log"]
        kept = upload(client, b"another log")
    snapshot(data, tmp_path / "right.db")
    put_database(data, tmp_path / "old.db" if older else None)
    with TestClient(create_app(settings(tmp_path))) as client:
        assert client.get(f"/v1/jobs/{job}").status_code == 404
        new = submit(client, b"ok")
        wait(client, new)
    quarantine = data / "quarantine"
    assert {p.name for p in (quarantine / "uploads").iterdir()} == {file, kept}
    assert (quarantine / "uploads" / kept).read_bytes() == b"another log"
    assert [p.name for p in (quarantine / "results").iterdir()] == [f"{job}.1"]
    put_database(data, tmp_path / "right.db")
    with TestClient(create_app(settings(tmp_path))) as client:
        assert client.get(f"/v1/jobs/{job}/results/trajectory.tum").content == b"0 ['of', 'the', 'user']\n"
        again = client.post("/v1/jobs", json={"log": kept}).json()["id"]
        assert wait(client, again)["state"] == "succeeded"
    assert [p.name for p in (quarantine / "results").iterdir()] == [f"{new}.1"]  # of the database that was replaced


def test_a_deleted_upload_whose_server_was_killed_is_removed_at_the_next_start(tmp_path: Path) -> None:
    with TestClient(create_app(settings(tmp_path))) as client:
        ident = upload(client, b"x")
        path = client.app.state.context.storage.upload_path(ident)  # type: ignore[attr-defined]
        assert client.delete(f"/v1/files/{ident}").status_code == 204
    path.write_bytes(b"x")  # the row was deleted, and the server was killed before the bytes were removed
    with TestClient(create_app(settings(tmp_path))):
        assert not path.exists()
    assert not (tmp_path / "data" / "quarantine").exists()


def run_backup(live: Live, target: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hsloc.cli.main", "serve", "--data", str(live.data), "--backup", str(target)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_backup_made_under_load_is_a_data_folder(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live(HSLOC_SLOTS="2")
    stop = threading.Event()
    accepted: list[str] = []

    def load() -> None:
        with live.client() as client:
            while not stop.is_set():
                job = submit(client, b"ok")
                accepted.append(job)
                if len(accepted) % 3 == 0:
                    wait(client, job)
                    assert client.delete(f"/v1/jobs/{job}").status_code == 204

    with live.client() as client:
        first = submit(client, b"ok first")
        wait(client, first)
    thread = threading.Thread(target=load)
    thread.start()
    try:
        targets = [tmp_path / f"backup{k}" for k in range(3)]
        done = [run_backup(live, target) for target in targets]
    finally:
        stop.set()
        thread.join()
    assert [each.returncode for each in done] == [0, 0, 0], done[0].stderr
    assert " results" in done[0].stdout
    live.end(signal.SIGKILL)
    with TestClient(create_app(settings(tmp_path, data=targets[-1]))) as client:
        assert client.get(f"/v1/jobs/{first}/results/trajectory.tum").content == b"0 ['first']\n"
        jobs = client.get("/v1/jobs", params={"limit": 200}).json()["jobs"]
        assert {each["id"] for each in jobs} <= {first, *accepted}
        for job in jobs:
            assert wait(client, job["id"])["state"] == "succeeded"
            assert client.get(f"/v1/jobs/{job['id']}/results/metrics.json").status_code == 200
    assert not (targets[-1] / "quarantine").exists()


def test_a_backup_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no data folder of hsloc"):
        back_up(tmp_path / "absent", tmp_path / "backup")
    with TestClient(create_app(settings(tmp_path))) as client:
        ident = upload(client, b"content")
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "mine").touch()
        with pytest.raises(SettingsError, match="exists already"):
            back_up(tmp_path / "data", tmp_path / "full")
        path = client.app.state.context.storage.upload_path(ident)  # type: ignore[attr-defined]
        path.chmod(0o600)
        path.write_bytes(b"rotten!")
        with pytest.raises(SettingsError, match="SHA-256"):
            back_up(tmp_path / "data", tmp_path / "backup")
    assert not (tmp_path / "backup").exists()
    assert not list(tmp_path.glob(".*partial"))
