"""ROS bags: ROS 1 by way of rosbags, ROS 2 in SQLite (`.db3`) by Python's own sqlite3.

A database that was copied while its recorder ran, or whose recorder was killed, keeps its newest messages in the
write-ahead log beside it (`-wal`). The two are copied into a temporary folder and read together, so that nothing beside
the user's file is created or changed. A ROS 1 bag without an index, because its recorder was stopped
hard or the file was cut, gets one in a temporary copy, as `rosbag reindex` makes it (wiki.ros.org/Bags/Format/2.0);
so does one with a damaged chunk, which would end it otherwise.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from abc import ABC, abstractmethod
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any, Protocol, cast
from urllib.parse import quote

import numpy as np

from hsloc.errors import LogError, LogFormatError
from hsloc.log.bag_index import reindex
from hsloc.log.container import (
    STEP_NS,
    Channel,
    RawMessage,
    RecorderClock,
    guarded,
    in_runs,
    out_of_line,
    plausible_times,
)
from hsloc.log.files import Scratch
from hsloc.log.messages.definitions import long_name
from hsloc.log.no_log import missing_of_database
from hsloc.log.summary import Losses, TopicStatistics
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from numpy.typing import NDArray

    class _Reader(Protocol):
        connections: list[Any]
        indexes: dict[int, list[Any]]
        message_count: int

        def __enter__(self) -> _Reader: ...
        def __exit__(self, *error: object) -> object: ...
        def messages(self, connections: Collection[Any]) -> Iterator[tuple[Any, int, bytes]]: ...


_RUN = 1024
"""Messages in one run."""
_WRITTEN = [("channel", "i8"), ("time", "i8")]
"""Channel and log time (ns) of a message."""


_WAL_HEAD, _FRAME_HEAD = 32, 24
"""Bytes before the frames of a write-ahead log, and before the page in each (sqlite.org/fileformat2.html)."""
_HOT_JOURNAL = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
"""How a rollback journal begins that SQLite rolls back; of a finished transaction it is zeros or empty."""


def _frames_of(log: Path) -> int:
    """Frames of a write-ahead log that were written since it was last begun anew, with the one that is cut at its end.

    Frames before that have other salts; they are in the database already.
    """
    size = log.stat().st_size
    with log.open("rb") as stream:
        head = stream.read(_WAL_HEAD)
        if len(head) < _WAL_HEAD:
            return 1
        page, salts = int.from_bytes(head[8:12], "big"), head[16:24]
        if not 512 <= page <= 65536:
            return 1
        count = 0
        for at in range(_WAL_HEAD, size, _FRAME_HEAD + page):
            stream.seek(at)
            if not salts.startswith(stream.read(_FRAME_HEAD)[8:16]):
                break
            count += 1
    return count


class _Bag(ABC):
    """What both kinds have in common; `shown` is the name for messages to people, where the file is a copy."""

    def __init__(self, shown: Path) -> None:
        self.path = shown
        self.channels: dict[int, Channel] = {}
        self.statistics: dict[int, TopicStatistics] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.losses_at_opening = Losses()
        self.warnings: list[RunWarning] = []

    @abstractmethod
    def messages(self, wanted: Collection[int], losses: Losses) -> Iterator[RawMessage]:
        """As `Container.messages`."""

    def runs(self, wanted: Collection[int], losses: Losses) -> Iterator[list[RawMessage]]:
        """As `Container.runs`."""
        return in_runs(self.messages(wanted, losses), _RUN)

    def verify(self) -> Losses:
        """Read everything and count what is damaged."""
        losses = self.losses_at_opening.copy()
        for _ in self.messages(self.channels, losses):
            pass
        return losses

    def _note_steps(self, written: NDArray[np.void]) -> bool:
        """A warning where messages (n,) in the order of writing, of `_WRITTEN`, show that the clock was set back.

        Returns whether log times of single messages are wrong.
        """
        clock = RecorderClock()
        clock.take(written["channel"], written["time"])
        self.warnings = clock.warnings(self.path, self.statistics.values())
        return clock.has_single_errors

    def _require_some(self, damage: Losses) -> None:
        """Raise LogFormatError where counting met damage before the first message.

        What is damaged further on is counted when it is read for its own sake.
        """
        if damage.reasons and not self.statistics:
            raise LogFormatError(damage.reasons[0])


class BagContainer(_Bag):
    """A ROS 1 bag, whatever its name. `shown` is the name for messages to people, where the file is a copy of another.

    The decoders get the definitions that the bag carries, as with MCAP; rosbags is asked for raw messages alone.
    Raises LogFormatError, whatever rosbags, its databases and its decompressors raise.
    """

    format = "ROS 1 bag"
    profile = "ros1"

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        super().__init__(shown or path)
        self._file = path
        self._scratch = Scratch()
        try:
            is_damaged = self._open()
        except LogFormatError:
            if not self._is_reindexed():
                raise
            self._open()
        else:
            if is_damaged and self._is_reindexed():
                self._open()

    def _open(self) -> bool:
        """Whether the bag is damaged on the way."""
        with self._guarded(), self._reader() as reader:
            self.channels = {k: self._channel(k, each) for k, each in enumerate(reader.connections)}
            self.statistics = {}
            return self._count(reader)

    def _is_reindexed(self) -> bool:
        """Whether a sound bag could be made of what is whole of a file; it is read from then on."""
        copy = self._scratch.folder / "reindexed.bag"
        try:
            chunks, damaged, had_index = reindex(self._file, copy)
        except OSError as error:
            raise LogError(
                f"{self.path}: has no index, and a copy with one cannot be written ({error.strerror or error}); set "
                "TMPDIR to a folder with space"
            ) from error
        if not chunks:
            return False
        self._file = copy
        losses = self.losses_at_opening
        if had_index and damaged:
            losses.damaged_chunks += damaged
            losses.note(f"{self.path}: {damaged} of its chunks are damaged: {chunks} are read as far as they go")
        else:
            losses.truncated_files += 1
            losses.note(f"{self.path}: has no index, or a wrong one: its {chunks} chunks are read as far as they go")
        return True

    def messages(self, wanted: Collection[int], losses: Losses) -> Iterator[RawMessage]:
        """As `Container.messages`; rosbags yields in the order of time."""
        chosen = set(wanted)
        with self._guarded(losses), self._reader() as reader:
            numbers = self._numbers(reader)
            connections = [c for c in reader.connections if numbers[self._key(c)] in chosen]
            if not connections:
                return
            for position, (connection, log_time, data) in enumerate(reader.messages(connections)):
                number = numbers[self._key(connection)]
                if number in chosen:  # A damaged bag yields messages of connections that were not asked for.
                    yield max(log_time, 0), position, number, data

    def _reader(self) -> _Reader:
        from rosbags.rosbag1 import Reader

        return cast("_Reader", Reader(self._file))

    @staticmethod
    def _key(connection: Any) -> tuple[int, int]:
        # Connections are not hashable for both formats; ids alone repeat between the files of a folder.
        return connection.id, id(connection.owner)

    def _numbers(self, reader: _Reader) -> dict[tuple[int, int], int]:
        return {self._key(connection): number for number, connection in enumerate(reader.connections)}

    def _channel(self, number: int, connection: Any) -> Channel:
        definition = connection.msgdef
        form = {0: "", 1: "ros1msg", 2: "ros2idl"}[definition.format.value]
        topic, typename = str(connection.topic), long_name(str(connection.msgtype))
        return Channel(number, topic, typename, "ros1", form, definition.data.encode())

    def _count(self, reader: _Reader) -> bool:
        """Statistics of each topic; whether the bag is damaged on the way."""
        numbers = self._numbers(reader)
        damage = Losses()
        with self._guarded(damage):
            for connection, log_time, _ in reader.messages(reader.connections):
                number = numbers[self._key(connection)]
                self.statistics.setdefault(number, TopicStatistics()).add(log_time, log_time, 1, 0)
        self._require_some(damage)
        entries = ((each.chunk_pos, each.offset, k, each.time) for k, index in reader.indexes.items() for each in index)
        written = np.sort(np.fromiter(entries, dtype=[("chunk", "i8"), ("offset", "i8"), *_WRITTEN]))
        if self._note_steps(written):
            text = f"{self.path}: log times of single messages are out of line with those around them in the file"
            remedy = "rewrite the bag with the stamps of its headers (wiki.ros.org/rosbag/Cookbook)"
            self.warnings.append(RunWarning(WarningCode.CLOCK_SET, text, remedy))
        counted, promised = sum(item.count for item in self.statistics.values()), reader.message_count
        if not damage.reasons and counted < promised:
            self.losses_at_opening.truncated_files += 1
            self.losses_at_opening.note(f"{self.path}: holds {counted} messages of {promised} that it speaks of")
        return bool(damage.reasons)

    def _guarded(self, losses: Losses | None = None) -> AbstractContextManager[None]:
        remedy = "`rosbag reindex` (or of version 1.2 `rosbag fix`)"
        return guarded(f"{self.path}: cannot be read as a {self.format}", remedy, losses)


class Db3Container(_Bag):
    """A `.db3` file. `shown` is the name for messages to people, where the file is a copy of another.

    Raises LogFormatError where it is no bag, whatever SQLite raises.
    """

    format = "ROS 2 bag (SQLite)"
    profile = "ros2"

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        super().__init__(shown or path)
        self._scratch = Scratch()
        self._file = self._with_its_log(path)
        self._is_copy = self._file != path
        self._is_rolled_back = self._is_copy and self._has_hot_journal()
        self._in_order_of_time = True
        self._wrong: set[int] = set()
        self._lowest, self._highest = -(1 << 63), (1 << 63) - 1
        with self._guarded(), self._connected() as connection:
            self._read_topics(connection)
            self._note_uncommitted(connection)
            self._count(connection)

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
                    if number in self._wrong or not self._lowest <= log_time <= self._highest:
                        losses.log_times_repaired += 1
                        log_time = last
                    log_time = max(log_time, last)
                last = log_time
                yield max(log_time, 0), number, channel, data

    def _with_its_log(self, path: Path) -> Path:
        """The file to open: the path itself, or a copy of it together with its write-ahead log or rollback journal."""
        log = path
        try:
            for ending in ("-wal", "-journal"):
                log = path.with_name(path.name + ending)
                if log.is_file() and log.stat().st_size:
                    copy = self._scratch.folder / "bag.db3"
                    shutil.copyfile(path, copy)
                    shutil.copyfile(log, copy.with_name(copy.name + ending))
                    return copy
        except OSError as error:
            raise LogError(
                f"{log}: cannot be copied beside its database ({error.strerror or error}); "
                "set TMPDIR to a folder with space"
            ) from error
        return path

    def _has_hot_journal(self) -> bool:
        journal = self._file.with_name(f"{self._file.name}-journal")
        if not journal.is_file():
            return False
        with journal.open("rb") as stream:
            return stream.read(len(_HOT_JOURNAL)) == _HOT_JOURNAL

    def _note_uncommitted(self, connection: sqlite3.Connection) -> None:
        """A loss where the log beside the database holds a transaction that was never committed, or is cut."""
        if not self._is_copy:
            return
        unread = 0
        log = self._file.with_name(self._file.name + "-wal")
        if log.is_file():
            # The checkpoint, which changes the copy alone, says how many frames SQLite takes: those up to a commit.
            (_, taken, _) = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
            unread = _frames_of(log) - max(taken, 0)
            what = f"its write-ahead log (-wal) ends within a transaction: {unread} of its pages were never committed"
        elif self._is_rolled_back:
            unread = 1
            what = "its recorder ended within a transaction, which is rolled back by the journal (-journal)"
        if unread > 0:
            self.losses_at_opening.truncated_files += 1
            self.losses_at_opening.note(
                f"{self.path}: {what}, and the messages in it are lost; if the recorder's disk has them still, copy "
                "database and log again after it has ended"
            )

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        """A connection that changes nothing. A name may hold `#`, `?` and `%`: it is quoted in the URI."""
        mode = "mode=rw" if self._is_copy else "mode=ro&immutable=1"
        uri = f"file:{quote(os.fsencode(self._file.absolute()))}?{mode}"
        with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
            connection.execute("PRAGMA query_only = 1")
            connection.execute("PRAGMA temp_store = MEMORY")
            yield connection

    def _read_topics(self, connection: sqlite3.Connection) -> None:
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            cut = "; its write-ahead log (-wal) ends before the first commit" * self._is_copy
            raise LogFormatError(f"{self.path}: an SQLite database without the tables of a ROS 2 bag{cut}")
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
            rows = connection.execute("SELECT topic_id, timestamp, id FROM messages ORDER BY id")
            written = np.fromiter(rows, dtype=[*_WRITTEN, ("id", "i8")])
            if self._note_steps(written):
                self._distrust(written)
        self._require_some(damage)

    def _distrust(self, written: NDArray[np.void]) -> None:
        """Read in the order of writing where that is the order of all log times but some; note which are wrong."""
        wrong = (written["time"] < self._lowest) | (written["time"] > self._highest)
        for channel in np.unique(written["channel"]):
            rows = np.flatnonzero((written["channel"] == channel) & ~wrong)
            wrong[rows] = out_of_line(written["time"][rows])
        if np.diff(written["time"][~wrong]).min(initial=0) > -STEP_NS:
            self._in_order_of_time = False
            self._wrong = set(written["id"][wrong].tolist())

    def _guarded(self, losses: Losses | None = None) -> AbstractContextManager[None]:
        complaint = f"{self.path}: {missing_of_database(self._file)}cannot be read as a {self.format}"
        return guarded(complaint, f"`sqlite3 {self.path.name} .recover`", losses)
