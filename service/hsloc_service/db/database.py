"""The database, by path or URL: SQLite for one server, PostgreSQL where several share it.

SQLite runs in WAL mode: durable before the answer, one writer at a time, never a deadlock between readers and writers.
On PostgreSQL writers run side by side. What they must not do at the same time is guarded by row locks (`FOR UPDATE`,
whose conditions are checked again when the lock is had) and by the locks of this module, which SQLite does not need.
"""

from __future__ import annotations

import hashlib
import sqlite3
import threading
import time
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Engine, create_engine, event, make_url, text
from sqlalchemy.exc import ArgumentError, DBAPIError, InterfaceError, OperationalError
from sqlalchemy.orm import Session

from hsloc.errors import install_hint
from hsloc_service.db.migrations import migrate
from hsloc_service.logs import log
from hsloc_service.settings import SettingsError
from hsloc_service.storage import BALLAST

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from sqlalchemy import Connection

    from hsloc_service.settings import Settings

SQLITE = "hsloc.db"
"""Name of the database in the data folder."""
CHANNEL = "hsloc"
_POSTGRESQL: dict[str, Any] = {
    "connect_timeout": 10,
    # A database that is cut off must not hold up a thread for the two hours of TCP.
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 15000,
    # A server that stands still in a transaction must not hold up the others for ever.
    "options": "-c lock_timeout=15s -c idle_in_transaction_session_timeout=60s",
}
"""Parameters of libpq."""


class Database:
    """Sessions on a database, brought to today's schema. `where` is the file of SQLite, or the URL of PostgreSQL.

    Raises SettingsError for what is no database of ours, or one of a newer hsloc, or cannot be reached.
    """

    def __init__(self, where: Path | str) -> None:
        self._engine, self.name = _engine(where)
        self.shared = self._engine.dialect.name != "sqlite"
        """Whether other servers may use it at the same time."""
        self._reading = (
            self._engine.execution_options(isolation_level="REPEATABLE READ") if self.shared else self._engine
        )
        self._writing = nullcontext() if self.shared else threading.Lock()
        try:
            try:
                self._migrate()
            except (OperationalError, sqlite3.OperationalError):
                if not isinstance(where, Path):
                    raise
                # SQLite needs a little room to open, too; a server that does not start can delete nothing.
                where.with_name(BALLAST).unlink(missing_ok=True)
                self._engine.dispose()
                self._migrate()
        except SettingsError:
            self._engine.dispose()
            raise
        except (DBAPIError, sqlite3.Error) as error:
            self._engine.dispose()
            cause = " ".join(str(error.orig if isinstance(error, DBAPIError) else error).split())
            raise SettingsError(f"{self.name}: cannot be used as database: {cause}; {self._remedy(error)}") from error

    def _remedy(self, error: Exception) -> str:
        if self.shared:
            return "see that the server runs, and that HSLOC_DATABASE_URL names it"
        return "make room on its disk and see that it can be written" if _of_the_disk(error) else "give another --data"

    def _migrate(self) -> None:
        with self._engine.connect().execution_options(write=True) as connection:
            if self.shared:
                _lock(connection, "migration")  # servers may start at the same time
            before, after = migrate(connection, self.name)
            connection.commit()
        if 0 < before < after:
            log("database.migrated", before=before, after=after)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """One consistent view; nothing is written."""
        with Session(self._reading, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction that is committed, and on the disk, when the block ends.

        SQLite's takes the write lock at once. The lock of this process queues the threads fairly; SQLite's own makes
        them sleep and race.
        """
        with (
            self._writing,
            self._engine.connect().execution_options(write=True) as connection,
            Session(connection, expire_on_commit=False) as session,
        ):
            yield session
            session.commit()

    def lock(self, session: Session, name: str) -> None:
        """Be alone, until the transaction ends, with what has this name."""
        if self.shared:
            _lock(session.connection(), name)

    def lock_tenant(self, session: Session, tenant: str) -> None:
        """Be alone with the quota, the keys and the references between uploads and jobs of a tenant."""
        if self.shared:
            _lock(session.connection(), "tenants", shared=True)
            _lock(session.connection(), f"tenant {tenant}")

    @contextmanager
    def elected(self, name: str) -> Iterator[bool]:
        """Whether this server does what only one does at a time: False for all others while the block runs."""
        if not self.shared:
            yield True
            return
        # Without a transaction, which the database would end when nothing happens in it.
        with self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            key = {"key": _lock_key(name)}
            mine = bool(connection.execute(text("SELECT pg_try_advisory_lock(:key)"), key).scalar_one())
            try:
                yield mine
            finally:
                if mine:
                    connection.execute(text("SELECT pg_advisory_unlock(:key)"), key)

    @contextmanager
    def listening(self) -> Iterator[Callable[[float], Iterable[str]]]:
        """What `notify` sends, by a connection of its own: texts that come within a time [s]. PostgreSQL only."""
        with self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.execute(text(f"LISTEN {CHANNEL}"))
            driver: Any = connection.connection.driver_connection
            try:
                yield lambda within_s: (each.payload for each in driver.notifies(timeout=within_s))
            finally:
                connection.invalidate()  # else the next one to use it would listen, too

    def now(self, session: Session) -> float:
        """Seconds since 1970 by the clock of the database, which all its clients share.

        Of this moment, as leases need it after a wait for a lock; `clock` is of the begin of the transaction.
        """
        if self.shared:
            return float(session.execute(text("SELECT extract(epoch FROM clock_timestamp())")).scalar_one())
        return float(session.execute(text("SELECT (julianday('now') - 2440587.5) * 86400.0")).scalar_one())

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()


def clock(session: Session) -> float:
    """Seconds since 1970, for what servers compare that share a database: by its clock, asked once in a transaction.

    The clock of one machine may be wrong by hours: its webhooks would wait for hours, or uploads be deleted too early.
    """
    if session.get_bind().dialect.name != "postgresql":
        return time.time()
    if "clock" not in session.info:
        session.info["clock"] = float(session.execute(text("SELECT extract(epoch FROM now())")).scalar_one())
    return float(session.info["clock"])


def notify(session: Session, message: str) -> None:
    """Send a text to who listens on the same PostgreSQL when the transaction is committed; with SQLite, nothing."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_notify(:channel, :message)"), {"channel": CHANNEL, "message": message})


UNREACHABLE = (OperationalError, InterfaceError)
"""What a database raises that is away, restarted or locked, which passes."""


def is_unreachable(error: Exception) -> bool:
    """Whether PostgreSQL was away or restarted, which passes."""
    return isinstance(error, UNREACHABLE)


def open_database(settings: Settings) -> Database:
    """The database that the settings name: a URL, else SQLite in the data folder. Raises SettingsError."""
    return Database(database_place(settings))


def database_place(settings: Settings) -> Path | str:
    """File or URL of the database that the settings name."""
    if not settings.database_url:
        return settings.data / SQLITE
    if settings.database_url.startswith("sqlite:///"):
        return Path(settings.database_url.removeprefix("sqlite:///"))
    return settings.database_url


def _engine(where: Path | str) -> tuple[Engine, str]:
    """The engine, and the name of the database for messages: without its password."""
    if isinstance(where, Path):
        engine = create_engine(
            f"sqlite:///{where}", pool_size=16, max_overflow=48, connect_args={"check_same_thread": False}
        )
        _prepare_sqlite(engine)
        return engine, str(where)
    try:
        url = make_url(where)
    except ArgumentError as error:
        raise SettingsError("HSLOC_DATABASE_URL is not a URL such as postgresql://user@host/hsloc") from error
    name = url.render_as_string(hide_password=True)
    if url.drivername not in ("postgresql", "postgresql+psycopg"):
        raise SettingsError(f"HSLOC_DATABASE_URL is {name}; it must begin with postgresql:// or sqlite:///")
    try:
        engine = create_engine(
            url.set(drivername="postgresql+psycopg"),
            pool_size=8,
            max_overflow=8,  # PostgreSQL allows 100 by default, for all servers and workers together
            pool_pre_ping=True,
            connect_args=_POSTGRESQL,
        )
    except ModuleNotFoundError as error:
        raise SettingsError(f"HSLOC_DATABASE_URL is {name}: {install_hint('postgresql')}") from error
    return engine, name


def _lock_key(name: str) -> int:
    """PostgreSQL's advisory locks are known by 64 bits."""
    return int.from_bytes(hashlib.sha256(f"hsloc {name}".encode()).digest()[:8], "big", signed=True)


def _lock(connection: Connection, name: str, shared: bool = False) -> None:
    call = "pg_advisory_xact_lock_shared" if shared else "pg_advisory_xact_lock"
    connection.execute(text(f"SELECT {call}(:key)"), {"key": _lock_key(name)})


def _of_the_disk(error: Exception) -> bool:
    """Whether it is not what is in the file that is wrong."""
    return isinstance(error, OperationalError | sqlite3.OperationalError)


def _prepare_sqlite(engine: Engine) -> None:
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
