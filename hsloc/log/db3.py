"""ROS 2 bags in SQLite (`.db3`), read by Python's own sqlite3.

A database that was copied while its recorder ran, or whose recorder was killed, keeps its newest messages in the
write-ahead log beside it (`-wal`). The two are copied into a temporary folder and read together, so that nothing beside
the user's file is created or changed.
"""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING
from urllib.parse import quote

from hsloc.errors import LogError, LogFormatError
from hsloc.log.container import Channel, RawMessage, guarded, in_runs, plausible_times
from hsloc.log.files import Scratch
from hsloc.log.messages.definitions import long_name
from hsloc.log.summary import Losses, TopicStatistics

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from hsloc.warnings import RunWarning

_RUN = 1024
"""Messages in one run."""


class Db3Container:
    """A `.db3` file. `shown` is the name for messages to people, where the file is a copy of another.

    Raises LogFormatError where it is no bag, whatever SQLite raises.
    """

    format = "ROS 2 bag (SQLite)"
    profile = "ros2"

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        self.path = shown or path
        self._scratch = Scratch()
        self._file = self._with_write_ahead_log(path)
        self._is_copy = self._file != path
        self.channels: dict[int, Channel] = {}
        self.statistics: dict[int, TopicStatistics] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.losses_at_opening = Losses()
        self.warnings: list[RunWarning] = []
        self._in_order_of_time = True
        self._lowest, self._highest = -(1 << 63), (1 << 63) - 1
        with self._guarded(), self._connected() as connection:
            self._read_topics(connection)
            self._count(connection)

    def runs(self, wanted: Collection[int], losses: Losses) -> Iterator[list[RawMessage]]:
        """As `Container.runs`."""
        return in_runs(self.messages(wanted, losses), _RUN)

    def messages(self, wanted: Collection[int], losses: Losses) -> Iterator[RawMessage]:
        """As `Container.messages`."""
        chosen = sorted(set(wanted) & self.channels.keys())
        if not chosen:
            return
        marks = ",".join("?" * len(chosen))
        order = "timestamp, id" if self._in_order_of_time else "id"
        query = f"SELECT timestamp, id, topic_id, data FROM messages WHERE topic_id IN ({marks}) ORDER BY {order}"
        with self._guarded(losses), self._connected() as connection:
            last = 0
            for log_time, number, channel, data in connection.execute(query, chosen):
                if type(data) is not bytes or type(log_time) is not int:
                    continue
                if not self._in_order_of_time:  # Some times are not to be trusted: the order of writing is.
                    if not self._lowest <= log_time <= self._highest:
                        losses.log_times_repaired += 1
                        log_time = last
                    log_time = max(log_time, last)
                last = log_time
                yield max(log_time, 0), number, channel, data

    def verify(self) -> Losses:
        """Read everything and count what is damaged."""
        losses = self.losses_at_opening.copy()
        for _ in self.messages(self.channels, losses):
            pass
        return losses

    def _with_write_ahead_log(self, path: Path) -> Path:
        """The file to open: the path itself, or a copy of it together with its write-ahead log."""
        log = path.with_name(path.name + "-wal")
        try:
            if not log.is_file() or log.stat().st_size == 0:
                return path
            copy = self._scratch.folder / "bag.db3"
            shutil.copyfile(path, copy)
            shutil.copyfile(log, copy.with_name("bag.db3-wal"))
        except OSError as error:
            raise LogError(
                f"{log}: cannot be copied beside its database ({error.strerror or error}); "
                "set TMPDIR to a folder with space"
            ) from error
        return copy

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        """A connection that changes nothing. A name may hold `#`, `?` and `%`: it is quoted in the URI."""
        mode = "mode=rw" if self._is_copy else "mode=ro&immutable=1"
        uri = f"file:{quote(str(self._file.absolute()))}?{mode}"
        with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
            connection.execute("PRAGMA query_only = 1")
            connection.execute("PRAGMA temp_store = MEMORY")
            yield connection

    def _read_topics(self, connection: sqlite3.Connection) -> None:
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise LogFormatError(f"{self.path}: an SQLite database without the tables of a ROS 2 bag")
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (encoding, text) for name, encoding, text in connection.execute(query)}
        for number, topic, typename, encoding in connection.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            form, text = definitions.get(typename, ("", ""))
            name, encoding = long_name(str(typename)), str(encoding or "cdr")
            self.channels[number] = Channel(number, str(topic), name, encoding, form if text else "", text.encode())

    def _count(self, connection: sqlite3.Connection) -> None:
        """Statistics of each topic by its log times, and whether these can be trusted for the order."""
        damage = Losses()
        with self._guarded(damage):
            (total,) = connection.execute("SELECT count(*) FROM messages").fetchone()
            # The inner nine tenths of a log say how long it is: a few times that are far outside are wrong.
            nth = "SELECT timestamp FROM messages ORDER BY timestamp LIMIT 1 OFFSET ?"
            inner = [connection.execute(nth, (n,)).fetchone() for n in (total // 20, total - 1 - total // 20)]
            if total and all(inner):
                low = inner[0][0]
                self._lowest, self._highest = plausible_times((low, inner[1][0]))
            last: dict[int, int] = {}
            for number, log_time in connection.execute("SELECT topic_id, timestamp FROM messages ORDER BY timestamp"):
                statistics = self.statistics.setdefault(number, TopicStatistics())
                if not self._lowest <= log_time <= self._highest:
                    self._in_order_of_time = False
                    log_time = last.get(number, low)
                last[number] = log_time
                statistics.add(max(log_time, 0), max(log_time, 0), 1, 0)
        # What is damaged further on is counted when it is read for its own sake.
        if damage.reasons and not self.statistics:
            raise LogFormatError(damage.reasons[0])

    def _guarded(self, losses: Losses | None = None) -> AbstractContextManager[None]:
        return guarded(
            f"{self.path}: cannot be read as a {self.format}", f"`sqlite3 {self.path.name} .recover`", losses
        )
