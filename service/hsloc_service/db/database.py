"""SQLite in WAL mode: durable before the answer, one writer at a time, never a deadlock between readers and writers."""

from __future__ import annotations

import sqlite3
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from sqlalchemy import Engine, create_engine, event, text
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.orm import Session

from hsloc_service.db.migrations import migrate
from hsloc_service.logs import log
from hsloc_service.settings import SettingsError
from hsloc_service.storage import BALLAST

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


class Database:
    """Sessions on the database of a data folder, brought to today's schema.

    Raises SettingsError for a file that is no database of ours, or one of a newer hsloc.
    """

    def __init__(self, path: Path) -> None:
        self._engine = create_engine(
            f"sqlite:///{path}", pool_size=16, max_overflow=48, connect_args={"check_same_thread": False}
        )
        self._writing = threading.Lock()
        _prepare(self._engine)
        try:
            try:
                self._migrate(path)
            except (OperationalError, sqlite3.OperationalError):
                # SQLite needs a little room to open, too; a server that does not start can delete nothing.
                path.with_name(BALLAST).unlink(missing_ok=True)
                self._engine.dispose()
                self._migrate(path)
        except SettingsError:
            self._engine.dispose()
            raise
        except (DBAPIError, sqlite3.Error) as error:
            self._engine.dispose()
            cause = error.orig if isinstance(error, DBAPIError) else error
            remedy = (
                "make room on its disk and see that it can be written" if _of_the_disk(error) else "give another --data"
            )
            raise SettingsError(f"{path}: cannot be used as database: {cause}; {remedy}") from error

    def _migrate(self, path: Path) -> None:
        with self._engine.connect().execution_options(write=True) as connection:
            before, after = migrate(connection, path)
            connection.commit()
        if 0 < before < after:
            log("database.migrated", before=before, after=after)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """One consistent view; nothing is written."""
        with Session(self._engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction that takes the write lock at once; committed, and on the disk, when the block ends.

        The lock of this process queues the threads fairly; SQLite's own makes them sleep and race.
        """
        with (
            self._writing,
            self._engine.connect().execution_options(write=True) as connection,
            Session(connection, expire_on_commit=False) as session,
        ):
            yield session
            session.commit()

    def now(self, session: Session) -> float:
        """Seconds since 1970 by the clock of the database, which all its clients share."""
        if self._engine.dialect.name == "sqlite":
            return float(session.execute(text("SELECT (julianday('now') - 2440587.5) * 86400.0")).scalar_one())
        return float(session.execute(text("SELECT extract(epoch FROM clock_timestamp())")).scalar_one())

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()


def _of_the_disk(error: Exception) -> bool:
    """Whether it is not what is in the file that is wrong."""
    return isinstance(error, OperationalError | sqlite3.OperationalError)


def _prepare(engine: Engine) -> None:
    @event.listens_for(engine, "connect")
    def connect(connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # the driver must not begin transactions behind our back
        cursor = connection.cursor()
        cursor.execute("PRAGMA journal_mode=WAL")
        cursor.execute("PRAGMA synchronous=FULL")  # NORMAL survives kill -9, but not a power cut
        cursor.execute("PRAGMA busy_timeout=15000")
        cursor.execute("PRAGMA foreign_keys=ON")
        cursor.close()

    @event.listens_for(engine, "begin")
    def begin(connection: Any) -> None:
        # DEFERRED would fail with SQLITE_BUSY when a reader turns writer.
        write = connection.get_execution_options().get("write", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")
