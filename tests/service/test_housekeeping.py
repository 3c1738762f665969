"""What goes with time, and what must not."""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from live_service import settings, submit, wait
from sqlalchemy.exc import OperationalError

from hsloc_service.housekeeping import Housekeeping
from hsloc_service.settings import SettingsError, from_environment, parse_size
from hsloc_service.storage import Storage

if TYPE_CHECKING:
    from collections.abc import Callable

    from fastapi.testclient import TestClient


def test_old_jobs_go_with_results_and_uploads_but_active_ones_stay(make_client: Callable[..., TestClient]) -> None:
    client = make_client(retention_s=100.0)
    old = submit(client)
    wait(client, old)
    active = submit(client, b"slow 30")
    context = client.app.state.context  # type: ignore[attr-defined]
    tidy = Housekeeping(context.database, context.storage, context.settings, context.stores).tidy
    tidy(time.time() + 50.0)
    assert client.get(f"/v1/jobs/{old}").status_code == 200
    tidy(time.time() + 150.0)
    assert client.get(f"/v1/jobs/{old}").status_code == 404
    assert list(context.storage.results.iterdir()) == []
    assert client.get(f"/v1/jobs/{active}").status_code == 200
    assert len(list(context.storage.uploads.iterdir())) == 1  # the active job's
    client.post(f"/v1/jobs/{active}/cancel")
    wait(client, active)


def test_without_retention_nothing_goes(make_client: Callable[..., TestClient]) -> None:
    client = make_client()
    job = submit(client)
    wait(client, job)
    context = client.app.state.context  # type: ignore[attr-defined]
    Housekeeping(context.database, context.storage, context.settings, context.stores).tidy(time.time() + 1e9)
    assert client.get(f"/v1/jobs/{job}/results").status_code == 200


def test_settings_from_variables(tmp_path: Path) -> None:
    found = from_environment({"HSLOC_MAX_UPLOAD_BYTES": "2G", "HSLOC_REQUIRE_TOKEN": "yes"}, data=tmp_path, slots=None)
    assert (found.max_upload_bytes, found.require_token, found.data, found.slots) == (2 << 30, True, tmp_path, 1)
    assert parse_size("3k") == 3072
    assert from_environment({"HSLOC_DATA": "/logs"}).data != Path("/logs")
    assert from_environment({"HSLOC_SERVE_DATA": "/srv"}).data == Path("/srv")
    for name, value in (("SLOTS", "many"), ("SLOTS", "0"), ("REQUIRE_TOKEN", "perhaps"), ("HEARTBEAT_S", "60")):
        with pytest.raises(SettingsError):
            from_environment({f"HSLOC_{name}": value})
    assert settings(tmp_path).retention_s is None


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
