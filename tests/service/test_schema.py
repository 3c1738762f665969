"""The database's schema: an old one is brought up to date, a foreign one is refused in one line."""

from __future__ import annotations

import ast
import sqlite3
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from fastapi.testclient import TestClient
from live_service import settings, wait
from sqlalchemy import event

from hsloc_service.auth import ANYBODY
from hsloc_service.db import database, migrations
from hsloc_service.db.database import Database
from hsloc_service.db.tables import SCHEMA_VERSION, JobRow
from hsloc_service.housekeeping import Housekeeping
from hsloc_service.http.app import create_app
from hsloc_service.jobs.leases import Leases
from hsloc_service.jobs.repository import JobFilter, Jobs
from hsloc_service.results.deletion_queue import DeletionQueue
from hsloc_service.results.stores import ResultStores
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage
from hsloc_service.uploads.repository import need_quota
from hsloc_service.webhooks import WebhookSender

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sqlalchemy import Connection

FIRST = Path(__file__).parent / "schema1.sql"
"""The database of hsloc at schema 1 after kill -9: jobs that succeeded, failed, were cancelled, ran and waited."""
TOKEN = "a-token-of-the-first-schema"
SUCCEEDED, RUNNING = "4f84f19f-5047-474b-b70d-c4002dffa5c1", "19135a1f-f827-49d2-8d2f-f7bc60789f8e"
FAILED, WAITING = "3205ac20-a13a-4d97-a473-8c533be90110", "d54c5710-86d2-4cac-b0bb-de504833e55d"


def version(path: Path) -> int:
    with sqlite3.connect(path) as connection:
        found = int(connection.execute("PRAGMA user_version").fetchone()[0])
    connection.close()
    return found


def columns(path: Path, table: str) -> set[str]:
    with sqlite3.connect(path) as connection:
        found = {row[1] for row in connection.execute(f"PRAGMA table_info({table})")}
    connection.close()
    return found


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A data folder as schema 1 left it; the path of its database."""
    data = tmp_path / "data"
    for folder in ("uploads", f"results/{SUCCEEDED}.1", f"work/{RUNNING}.1"):
        (data / folder).mkdir(parents=True)
    path = data / "hsloc.db"
    with sqlite3.connect(path) as connection:
        connection.executescript(FIRST.read_text())
        # It was written on 26 November 2026: its unfinished upload is to be as young as it was then.
        connection.execute("UPDATE file SET expires = ? WHERE expires IS NOT NULL", (time.time() + 3600.0,))
        for row in connection.execute("SELECT id FROM file WHERE state = 'complete'").fetchall():
            (data / "uploads" / row[0]).write_bytes(b"ok")
    connection.close()
    (data / "results" / f"{SUCCEEDED}.1" / "metrics.json").write_text("{}\n")
    (data / "results" / f"{SUCCEEDED}.1" / "trajectory.tum").write_text("7 []\n")
    return path


@pytest.fixture
def client(old: Path, tmp_path: Path) -> Iterator[TestClient]:
    assert version(old) == 1
    with TestClient(create_app(settings(tmp_path)), raise_server_exceptions=False) as made:
        made.headers["Authorization"] = f"Bearer {TOKEN}"
        yield made


def test_a_data_folder_of_schema_1_opens_with_everything_in_it(client: TestClient, old: Path) -> None:
    assert version(old) == SCHEMA_VERSION
    jobs = {job["id"]: job for job in client.get("/v1/jobs").json()["jobs"]}
    assert len(jobs) == 5
    assert (jobs[SUCCEEDED]["state"], jobs[SUCCEEDED]["request"]["seed"]) == ("succeeded", 7)
    assert jobs[FAILED]["message"] == "run.mcap: no scan"
    answer = client.get(f"/v1/jobs/{SUCCEEDED}/results/trajectory.tum")
    assert answer.content == b"7 []\n"
    assert answer.headers["etag"] == '"bb3bf29c29d099503eba622ca7c090b8d1b77d3f785141830ba9c199c8086e5b"'
    assert len(client.get(f"/v1/jobs/{SUCCEEDED}/events").text.split("\n\n")) > 3
    # What ran and what waited when the old server was killed runs now.
    assert wait(client, RUNNING)["state"] == "succeeded"
    assert wait(client, WAITING)["state"] == "succeeded"
    assert len(client.get("/v1/files").json()["files"]) == 5


def test_what_was_asked_of_schema_1_may_be_asked_again(client: TestClient) -> None:
    log = client.get(f"/v1/jobs/{SUCCEEDED}").json()["request"]["log"]
    body = {"log": log, "seed": 7, "webhook": "http://127.0.0.1:9/x"}
    same = client.post("/v1/jobs", json=body, headers={"Idempotency-Key": "office-1"})
    assert (same.status_code, same.json()["id"]) == (200, SUCCEEDED)
    again = client.post(f"/v1/jobs/{SUCCEEDED}/rerun", json={"seed": 9})
    assert again.status_code == 201, again.text
    assert wait(client, again.json()["id"])["state"] == "succeeded"
    assert client.delete(f"/v1/jobs/{SUCCEEDED}").status_code == 204


def test_the_version_is_stored_and_opening_again_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "hsloc.db"
    for _ in range(2):
        Database(path).close()
        assert version(path) == SCHEMA_VERSION
    assert {"store", "resume_of"} <= columns(path, "job")


def test_old_and_new_databases_have_the_same_columns(old: Path, tmp_path: Path) -> None:
    Database(old).close()
    Database(tmp_path / "new.db").close()
    for table in migrations.Base.metadata.tables:  # type: ignore[attr-defined]
        assert columns(old, table) == columns(tmp_path / "new.db", table) != set()


def indexes(path: Path) -> list[str]:
    with sqlite3.connect(path) as connection:
        found = connection.execute("SELECT sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL")
        statements = sorted(row[0] for row in found)
    connection.close()
    return statements


def test_old_and_new_databases_have_the_same_indexes(old: Path, tmp_path: Path) -> None:
    Database(old).close()
    Database(tmp_path / "new.db").close()
    assert indexes(old) == indexes(tmp_path / "new.db") != []


def test_the_quota_counts_results_of_before(client: TestClient, old: Path) -> None:
    with sqlite3.connect(old) as connection:
        (found,) = connection.execute("SELECT bytes FROM job WHERE id = ?", [SUCCEEDED]).fetchone()
    connection.close()
    assert found == sum(each["size"] for each in client.get(f"/v1/jobs/{SUCCEEDED}/results").json()["assets"]) > 0


def test_no_query_of_a_submission_reads_the_rows_of_a_tenant(tmp_path: Path) -> None:
    """It is asked under the lock that all tenants share: a hundred thousand rows of one took it for a second."""
    base = Database(tmp_path / "hsloc.db")
    asked: list[str] = []
    with base.write() as session:
        connection = session.connection()
        event.listen(connection, "before_cursor_execute", lambda *now: asked.append(now[2]))
        need_quota(session, ANYBODY, 10)
    base.close()
    assert len(asked) == 2
    with sqlite3.connect(tmp_path / "hsloc.db") as plain:
        for statement in asked:
            plan = plain.execute(f"EXPLAIN QUERY PLAN {statement}", [0] * statement.count("?")).fetchall()
            assert "USING COVERING INDEX" in plan[0][3], plan
    plain.close()


def test_what_is_asked_again_and_again_does_not_read_all_jobs(tmp_path: Path) -> None:
    """SQLite chooses by the form of a query alone; claims went through all jobs of a tenant that had ended."""
    base, chosen = Database(tmp_path / "hsloc.db"), settings(tmp_path)
    storage = Storage(chosen.data)
    stores = ResultStores(storage, chosen)
    deletions = DeletionQueue(base, storage, stores, 30.0)
    asked: list[tuple[str, Any]] = []
    event.listen(base._engine, "before_cursor_execute", lambda *now: asked.append((now[2], now[3])))
    calls: dict[str, Callable[[], object]] = {
        "job_waiting": lambda: Leases(base, 30.0).claim("one:1"),
        "job_by_end": lambda: Housekeeping(base, storage, chosen, deletions)._delete_jobs(1.0, (0.0, 0)),
        "delivery_by_state": WebhookSender(base, chosen).deliver_next,
        "job_by_name": lambda: Jobs(base, storage, chosen).list(ANYBODY, JobFilter(order="name")),
    }
    with base.write() as session:
        session.add(JobRow(seq=1, id="1", tenant="a", file_id="1", log_name="a", request={"log": "1"}, created=1.0))
    with sqlite3.connect(tmp_path / "hsloc.db") as plain:
        for index, call in calls.items():
            asked.clear()
            call()
            plans = [
                row[3]
                for statement, values in list(asked)
                if statement.startswith("SELECT")
                for row in plain.execute(f"EXPLAIN QUERY PLAN {statement}", values)
            ]
            assert any(index in line for line in plans), (index, plans)
            assert not [line for line in plans if line.startswith(("SCAN job", "SCAN delivery")) or "ix_job" in line]
    plain.close()
    base.close()
    storage.close()


def test_the_journal_is_durable(tmp_path: Path) -> None:
    base = Database(tmp_path / "hsloc.db")
    with base.read() as session:
        connection = session.connection()
        assert connection.exec_driver_sql("PRAGMA journal_mode").scalar_one() == "wal"
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar_one() == 2
    base.close()


def test_one_housekeeper_at_a_time(tmp_path: Path, database_url: str) -> None:
    base = Database(database_url or tmp_path / "hsloc.db")
    with base.elected("housekeeping") as first, base.elected("housekeeping") as second:
        assert first
        assert second is not base.shared
    with base.elected("housekeeping") as again:
        assert again
    base.close()


def test_a_migration_that_fails_leaves_the_old_database(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = columns(old, "job")
    monkeypatch.setitem(migrations.STEPS, 1, (*migrations.STEPS[1], "ALTER TABLE absent ADD COLUMN x"))
    with pytest.raises(SettingsError, match="cannot be used as database: no such table: absent"):
        Database(old)
    assert (version(old), columns(old, "job")) == (1, before)
    monkeypatch.undo()
    Database(old).close()
    assert version(old) == SCHEMA_VERSION


JOB_COLUMNS = ("tag", "priority", "not_before", "sweep", "title", "labels", "notes")
STEPS = "; ".join((*migrations.STEPS[1], *migrations.STEPS[2]))


@pytest.mark.parametrize(
    ("statements", "expected"),
    [
        (f"PRAGMA user_version={SCHEMA_VERSION + 1}", f"newer hsloc .schema {SCHEMA_VERSION + 1}, known up to"),
        (
            "; ".join(
                (
                    *migrations.STEPS[1],
                    *migrations.STEPS[2],
                    *(f"ALTER TABLE job ADD COLUMN {name}" for name in JOB_COLUMNS),
                    "DROP TABLE asset",
                    f"PRAGMA user_version={SCHEMA_VERSION}",
                )
            ),
            "table asset has no column job_id, media_type, name",
        ),
        ("PRAGMA user_version=2", "table job has no column resume_of, store"),
        ("PRAGMA user_version=0", "not a database of hsloc"),
    ],
)
def test_a_database_that_does_not_fit_is_refused_in_one_line(old: Path, statements: str, expected: str) -> None:
    with sqlite3.connect(old) as connection:
        connection.executescript(statements)
    connection.close()
    before = old.read_bytes()
    with pytest.raises(SettingsError, match=expected) as error:
        Database(old)
    assert "\n" not in str(error.value)
    assert str(old) in str(error.value)
    assert old.read_bytes()[100:] == before[100:]  # but for the header, where the journal's mode is noted


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hsloc.db"
    path.write_bytes(b"not a database, but long enough to be read as one" * 100)
    with pytest.raises(SettingsError, match="file is not a database"):
        Database(path)


def test_programs_of_the_schema_before_go_on_with_a_newer_one(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rolling upgrade: a server of the version before is killed and starts again beside one of the next."""
    Database(old).close()
    monkeypatch.setattr(migrations, "SCHEMA_VERSION", migrations.OLDEST_SCHEMA)
    Database(old).close()
    assert version(old) == SCHEMA_VERSION
    monkeypatch.setattr(migrations, "SCHEMA_VERSION", migrations.OLDEST_SCHEMA - 1)
    with pytest.raises(SettingsError, match="newer hsloc"):
        Database(old)


def test_a_script_since_the_oldest_schema_takes_nothing_from_older_programs() -> None:
    """It adds tables, indexes, and columns that an older INSERT may leave out."""
    for path in sorted((Path(migrations.__file__).parent / "scripts" / "versions").glob("schema_*.py")):
        if int(path.stem.removeprefix("schema_")) <= migrations.OLDEST_SCHEMA:
            continue
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        done = {
            call.func.attr
            for call in calls
            if isinstance(call.func, ast.Attribute) and ast.unparse(call.func)[:3] == "op."
        }
        assert done <= {"add_column", "create_table", "create_index"}, path
        for column in (ast.unparse(call) for call in calls if ast.unparse(call.func) == "sa.Column"):
            assert "nullable=True" in column or "server_default=" in column, column


def test_a_full_disk_does_not_keep_a_server_from_starting(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ballast = old.with_name("ballast")
    ballast.write_bytes(bytes(10))

    def migrate(connection: Connection, path: str) -> tuple[int, int]:
        if ballast.exists() or full:
            raise sqlite3.OperationalError("database or disk is full")
        return migrations.migrate(connection, path)

    full = False
    monkeypatch.setattr(database, "migrate", migrate)
    Database(old).close()
    assert not ballast.exists()
    assert version(old) == SCHEMA_VERSION
    full = True
    with pytest.raises(SettingsError, match="disk is full; make room on its disk"):
        Database(old)
