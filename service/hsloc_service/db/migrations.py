"""From one schema of the database to the next, in one transaction. SQLite's `user_version` has its version, too.

Up to schema 4 there was SQLite only, and the statements are here. From then on each has a script of Alembic in
`scripts/versions`, whose number is its revision.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import delete, insert, inspect, select

from hsloc_service.db.tables import SCHEMA_VERSION, Base, CounterRow
from hsloc_service.settings import SettingsError

if TYPE_CHECKING:
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
FIRST_OF_ALEMBIC = 4
OLDEST_SCHEMA = 5
"""Programs of this schema and later work on today's tables: what came since are tables, indexes, and columns that may
be left out. To be raised with a script that does more: then all servers must be stopped for the upgrade."""
OLDEST = "schema.oldest"


VERSION_TABLE = "alembic_version"


def migrate(connection: Connection, name: str) -> tuple[int, int]:
    """Bring the database to `SCHEMA_VERSION`, in the caller's transaction; the versions before and after.

    An empty one gets the tables of today, and one of a newer hsloc that older ones may use stays as it is. Raises
    SettingsError, with nothing changed, for a database of another newer hsloc or of something else, and for one whose
    tables are not what its version says.
    """
    tables = set(inspect(connection).get_table_names())
    before = _version(connection, tables)
    if before > SCHEMA_VERSION and _oldest(connection, tables) <= SCHEMA_VERSION:
        _need_columns(connection, name, before)
        return before, before
    if before > SCHEMA_VERSION:
        raise SettingsError(
            f"{name}: written by a newer hsloc (schema {before}, known up to {SCHEMA_VERSION}); "
            "install that version, or give another --data or database"
        )
    if before == 0 and tables:
        raise SettingsError(f"{name}: not a database of hsloc (no schema version); give another --data or database")
    if before < SCHEMA_VERSION:  # else nothing is written: a server must start on a full disk, too
        if before > 0:
            for version in range(before, FIRST_OF_ALEMBIC):
                for statement in STEPS[version]:
                    connection.exec_driver_sql(statement)
        if before > 0:
            _run_scripts(connection, stamped=VERSION_TABLE in tables)
        else:
            _stamp(connection, SCHEMA_VERSION)
        Base.metadata.create_all(connection)
        connection.execute(delete(CounterRow).where(CounterRow.name == OLDEST))
        connection.execute(insert(CounterRow).values(name=OLDEST, value=OLDEST_SCHEMA))
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA_VERSION}")
    _need_columns(connection, name, before or SCHEMA_VERSION)
    return before, SCHEMA_VERSION


def _oldest(connection: Connection, tables: set[str]) -> int:
    """The oldest schema whose programs may use the database; its own where it does not say."""
    found = None
    if CounterRow.__tablename__ in tables:
        found = connection.execute(select(CounterRow.value).where(CounterRow.name == OLDEST)).scalar_one_or_none()
    return _version(connection, tables) if found is None else found


def _version(connection: Connection, tables: set[str]) -> int:
    """The version of the schema; 0 if there is none. SQLite's is in the file's header, as before Alembic."""
    if connection.dialect.name == "sqlite":
        return int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())
    if VERSION_TABLE not in tables:
        return 0
    found = str(connection.exec_driver_sql(f"SELECT version_num FROM {VERSION_TABLE}").scalar_one_or_none())
    return int(found) if found.isdecimal() else 0


def _stamp(connection: Connection, version: int) -> None:
    """Note the version as Alembic does, which takes long to import."""
    connection.exec_driver_sql(f"CREATE TABLE {VERSION_TABLE} (version_num VARCHAR(32) NOT NULL PRIMARY KEY)")
    connection.exec_driver_sql(f"INSERT INTO {VERSION_TABLE} VALUES ('{version}')")


def _run_scripts(connection: Connection, stamped: bool) -> None:
    """Run those of Alembic's scripts that the database has not had."""
    from alembic import command
    from alembic.config import Config

    if not stamped:
        _stamp(connection, FIRST_OF_ALEMBIC)
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).with_name("scripts")).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def _need_columns(connection: Connection, place: str, version: int) -> None:
    """Raises SettingsError unless the tables have the columns that the code names."""
    found = inspect(connection)
    tables = set(found.get_table_names())
    for name, table in Base.metadata.tables.items():
        there = {each["name"] for each in found.get_columns(name)} if name in tables else set()
        missing = {column.name for column in table.columns} - there
        if missing:
            raise SettingsError(
                f"{place}: calls itself schema {version}, but table {name} has no column {', '.join(sorted(missing))}; "
                "restore it from a backup, or give another --data or database"
            )
