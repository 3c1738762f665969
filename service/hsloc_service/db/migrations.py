"""From one schema of the database to the next. The version is SQLite's `user_version`, set in the same transaction."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import inspect

from hsloc_service.db.tables import SCHEMA_VERSION, Base
from hsloc_service.settings import SettingsError

if TYPE_CHECKING:
    from pathlib import Path

    from sqlalchemy import Connection

STEPS: dict[int, tuple[str, ...]] = {
    # Where results are, which job's map is extended, and results that are still to be removed (a new table).
    1: (
        "ALTER TABLE job ADD COLUMN store VARCHAR",
        "ALTER TABLE job ADD COLUMN resume_of VARCHAR",
        "CREATE INDEX ix_job_resume_of ON job (resume_of)",
    ),
    # The quota without reading every asset of a tenant; indexes that answer what is asked under the write lock.
    2: (
        "ALTER TABLE job ADD COLUMN bytes INTEGER NOT NULL DEFAULT 0",
        "UPDATE job SET bytes = (SELECT coalesce(sum(size), 0) FROM asset WHERE asset.job_id = job.id)",
        "CREATE INDEX job_by_tenant ON job (tenant, state, bytes)",
        "CREATE INDEX file_by_tenant ON file (tenant, size, received)",
        "CREATE INDEX file_by_state ON file (state, size, received)",
    ),
    # Deleted uploads whose bytes are still on the disk, and the last `seq` (new tables); an index to delete jobs by.
    3: ("CREATE INDEX ix_idempotency_job_id ON idempotency (job_id)",),
}
"""What leads from a version to the next one; tables that are new are made afterwards, by `create_all`."""


def migrate(connection: Connection, path: Path) -> tuple[int, int]:
    """Bring the database to `SCHEMA_VERSION`, in the caller's transaction; the versions before and after.

    A new file gets the tables of today. Raises SettingsError, with nothing changed, for a database of a newer hsloc or
    of something else, and for one whose tables are not what its version says.
    """
    before = int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())
    tables = set(inspect(connection).get_table_names())
    if before > SCHEMA_VERSION:
        raise SettingsError(
            f"{path}: written by a newer hsloc (schema {before}, known up to {SCHEMA_VERSION}); "
            "install that version, or give another --data"
        )
    if before == 0 and tables:
        raise SettingsError(f"{path}: not a database of hsloc (no schema version); give another --data")
    if before < SCHEMA_VERSION:  # else nothing is written: a server must start on a full disk, too
        for version in range(before or SCHEMA_VERSION, SCHEMA_VERSION):
            for statement in STEPS[version]:
                connection.exec_driver_sql(statement)
        Base.metadata.create_all(connection)
        connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA_VERSION}")
    _need_columns(connection, path, before or SCHEMA_VERSION)
    return before, SCHEMA_VERSION


def _need_columns(connection: Connection, path: Path, version: int) -> None:
    """Raises SettingsError unless the tables have the columns that the code names."""
    found = inspect(connection)
    tables = set(found.get_table_names())
    for name, table in Base.metadata.tables.items():
        there = {each["name"] for each in found.get_columns(name)} if name in tables else set()
        missing = {column.name for column in table.columns} - there
        if missing:
            raise SettingsError(
                f"{path}: calls itself schema {version}, but table {name} has no column {', '.join(sorted(missing))}; "
                "restore it from a backup, or give another --data"
            )
