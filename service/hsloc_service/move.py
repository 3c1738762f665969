"""A data folder's database moved to PostgreSQL: all rows in one transaction, or none. The server must be stopped."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

from sqlalchemy import delete, func, insert, select

from hsloc_service.db.database import SQLITE, Database
from hsloc_service.db.tables import Base, CounterRow, FileRow, JobRow
from hsloc_service.settings import SettingsError
from hsloc_service.storage import Storage

if TYPE_CHECKING:
    from sqlalchemy import Table
    from sqlalchemy.orm import Session

    from hsloc_service.settings import Settings

BATCH = 1000
"""Rows that are copied at once."""


class MoveReport(NamedTuple):
    """What was moved."""

    jobs: int
    uploads: int
    rows: int


def move(settings: Settings, url: str) -> MoveReport:
    """Copy the database of the data folder to an empty one at `url`; uploads and results stay where they are.

    The folder's own database is left as it is. Raises SettingsError while a server runs on the folder, for a folder
    without a database, and for a database that holds something already.
    """
    if settings.database_url:
        raise SettingsError("HSLOC_DATABASE_URL is set; leave it out to move the database of the data folder")
    if not url.startswith("postgresql"):
        raise SettingsError(f"{url.partition(':')[0]}: a move is to PostgreSQL; give postgresql://user@host/database")
    path = settings.data / SQLITE
    if not path.is_file():
        raise SettingsError(f"{settings.data}: no data folder of hsloc; name it with --data")
    with (
        closing(Storage(settings.data, settings.min_free_bytes)),  # raises where a server runs
        closing(Database(path)) as source,
        closing(Database(url)) as target,
    ):
        return _copy(source, target)


def _copy(source: Database, target: Database) -> MoveReport:
    tables = Base.metadata.sorted_tables
    counts: dict[str, int] = {}
    with source.read() as old, target.write() as new:
        target.lock(new, "migration")
        for table in tables:
            if table.name != CounterRow.__tablename__ and new.scalar(select(func.count()).select_from(table)):
                raise SettingsError(f"{target.name}: its table {table.name} has rows; give an empty database")
        new.execute(delete(CounterRow))  # the marks of its own migration, which the old one has, too
        for table in tables:
            counts[table.name] = _copy_table(old, new, table)
            _continue_numbers(new, table)
    return MoveReport(counts[JobRow.__tablename__], counts[FileRow.__tablename__], sum(counts.values()))


def _continue_numbers(session: Session, table: Table) -> None:
    """Let the rows that the database numbers go on after the highest number."""
    column = table.autoincrement_column
    if column is not None:
        highest = session.scalar(select(func.max(column))) or 0
        sequence = func.pg_get_serial_sequence(table.name, column.name)
        session.execute(select(func.setval(sequence, highest + 1, False)))


def _copy_table(old: Session, new: Session, table: Table) -> int:
    count = 0
    found = old.execute(select(table).execution_options(yield_per=BATCH))
    for batch in found.mappings().partitions():
        new.execute(insert(table), [dict(row) for row in batch])
        count += len(batch)
    return count
