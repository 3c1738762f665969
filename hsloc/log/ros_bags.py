"""ROS bags: ROS 1 by way of rosbags, ROS 2 in SQLite (`.db3`) by Python's own sqlite3.

A database that was copied while its recorder ran, or whose recorder was killed, keeps its newest messages in the
write-ahead log beside it (`-wal`). The two are copied into a temporary folder and read together, so that nothing beside
the user's file is created or changed. A ROS 1 bag without an index, because its recorder was stopped
hard or the file was cut, gets one in a temporary copy, as `rosbag reindex` makes it (wiki.ros.org/Bags/Format/2.0).
"""

from __future__ import annotations

import bz2
import io
import os
import shutil
import sqlite3
import struct
from abc import ABC, abstractmethod
from contextlib import closing, contextmanager
from typing import IO, TYPE_CHECKING, Any, Protocol, cast
from urllib.parse import quote

from hsloc.errors import LogError, LogFormatError
from hsloc.log.container import Channel, RawMessage, guarded, in_runs, plausible_times
from hsloc.log.files import Scratch
from hsloc.log.messages.definitions import long_name
from hsloc.log.summary import Losses, TopicStatistics

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sized
    from contextlib import AbstractContextManager
    from pathlib import Path

    from hsloc.warnings import RunWarning

    class _Reader(Protocol):
        connections: list[Any]
        message_count: int

        def __enter__(self) -> _Reader: ...
        def __exit__(self, *error: object) -> object: ...
        def messages(self, connections: Collection[Any]) -> Iterator[tuple[Any, int, bytes]]: ...


_RUN = 1024
"""Messages in one run."""


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
            self._open()
        except LogFormatError:
            if not self._is_reindexed():
                raise
            self._open()

    def _open(self) -> None:
        with self._guarded(), self._reader() as reader:
            self.channels = {k: self._channel(k, each) for k, each in enumerate(reader.connections)}
            self.statistics = {}
            self._count(reader)

    def _is_reindexed(self) -> bool:
        """Whether a bag with an index could be made of what is whole of a file without one; it is read from then on."""
        copy = self._scratch.folder / "reindexed.bag"
        try:
            chunks = _reindex(self._file, copy)
        except OSError as error:
            raise LogError(
                f"{self.path}: has no index, and a copy with one cannot be written ({error.strerror or error}); set "
                "TMPDIR to a folder with space"
            ) from error
        if not chunks:
            return False
        self._file = copy
        self.losses_at_opening.truncated_files += 1
        self.losses_at_opening.note(f"{self.path}: has no index, or a wrong one: its {chunks} whole chunks are read")
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

    def _count(self, reader: _Reader) -> None:
        numbers = self._numbers(reader)
        damage = Losses()
        with self._guarded(damage):
            for connection, log_time, _ in reader.messages(reader.connections):
                number = numbers[self._key(connection)]
                self.statistics.setdefault(number, TopicStatistics()).add(log_time, log_time, 1, 0)
        self._require_some(damage)
        counted, promised = sum(item.count for item in self.statistics.values()), reader.message_count
        if not damage.reasons and counted < promised:
            self.losses_at_opening.truncated_files += 1
            self.losses_at_opening.note(f"{self.path}: holds {counted} messages of {promised} that it speaks of")

    def _guarded(self, losses: Losses | None = None) -> AbstractContextManager[None]:
        remedy = "`rosbag reindex` (or of version 1.2 `rosbag fix`)"
        return guarded(f"{self.path}: cannot be read as a {self.format}", remedy, losses)


_BAG_MAGIC, _BAG_HEADER_BYTES = b"#ROSBAG V2.0\n", 4096
_MOST_HEADER, _MOST_CHUNK = 1 << 20, 1 << 28
"""Largest header and chunk (bytes) that are believed: recorders write chunks of 768 kB. Operations of the records:"""
_MESSAGE, _INDEX_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x07"


def _reindex(source: Path, target: Path) -> int:
    """Write a bag of the whole chunks of another, with a new index; the number of chunks."""
    connections: dict[bytes, tuple[bytes, bytes]] = {}
    infos: list[bytes] = []
    with source.open("rb") as stream, target.open("wb") as out:
        if stream.read(len(_BAG_MAGIC)) != _BAG_MAGIC:
            return 0
        out.write(_BAG_MAGIC + b" " * _BAG_HEADER_BYTES)
        while (record := _bag_record(stream)) is not None:
            fields, data = _bag_fields(record[0]), record[1]
            if fields.get(b"op") == _CONNECTION:
                connections.setdefault(fields.get(b"conn", b""), record)
            content = _chunk_content(fields, data) if fields.get(b"op") == _CHUNK else None
            if content is None:
                continue
            entries = _chunk_index(content, connections)
            at = struct.pack("<Q", out.tell())
            out.write(_packed(*record))
            version = {b"ver": struct.pack("<I", 1)}
            for conn, places in entries.items():
                head = {b"op": _INDEX, **version, b"conn": conn, b"count": _count_of(places)}
                out.write(_packed(_bag_header(head), b"".join(places)))
            times = sorted(
                (place[:8] for places in entries.values() for place in places), key=struct.Struct("<II").unpack
            )
            if times:
                span = {b"start_time": times[0], b"end_time": times[-1], b"count": _count_of(entries)}
                counts = b"".join(conn + _count_of(places) for conn, places in entries.items())
                infos.append(_packed(_bag_header({b"op": _CHUNK_INFO, **version, b"chunk_pos": at, **span}), counts))
        end = out.tell()
        out.write(b"".join(_packed(*each) for each in connections.values()) + b"".join(infos))
        header = _bag_header(
            {b"op": _INDEX_HEADER, b"index_pos": struct.pack("<Q", end), b"conn_count": _count_of(connections),
             b"chunk_count": _count_of(infos)}
        )  # fmt: skip
        out.seek(len(_BAG_MAGIC))
        out.write(_packed(header, b" " * (_BAG_HEADER_BYTES - 8 - len(header))))
    return len(infos)


def _bag_record(stream: IO[bytes]) -> tuple[bytes, bytes] | None:
    """Header and data of the next record; None where it is not whole."""
    parts = []
    for most in (_MOST_HEADER, _MOST_CHUNK):
        size = int.from_bytes(stream.read(4), "little")
        parts.append(stream.read(size) if size <= most else b"")
        if len(parts[-1]) < size:
            return None
    return (parts[0], parts[1]) if parts[0] else None


def _bag_fields(header: bytes) -> dict[bytes, bytes]:
    found, at = {}, 0
    while at + 4 <= len(header):
        size = int.from_bytes(header[at : at + 4], "little")
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        found[name] = value
        at += 4 + size
    return found


def _bag_header(fields: dict[bytes, bytes]) -> bytes:
    items = [name + b"=" + value for name, value in fields.items()]
    return b"".join(_count_of(item) + item for item in items)


def _packed(header: bytes, data: bytes) -> bytes:
    return _count_of(header) + header + _count_of(data) + data


def _count_of(items: Sized) -> bytes:
    return len(items).to_bytes(4, "little")


def _chunk_content(fields: dict[bytes, bytes], data: bytes) -> bytes | None:
    """What a chunk holds, unpacked; None where it is damaged."""
    size = int.from_bytes(fields.get(b"size", b""), "little")
    compression = fields.get(b"compression", b"none")
    if size > _MOST_CHUNK or compression not in (b"none", b"bz2", b"lz4"):
        return None
    try:
        if compression == b"bz2":
            data = bz2.BZ2Decompressor().decompress(data, size)
        elif compression == b"lz4":
            import lz4.frame

            data = lz4.frame.LZ4FrameDecompressor().decompress(data, size)
    except (OSError, EOFError, RuntimeError, ValueError):
        return None
    return data if len(data) == size else None


def _chunk_index(content: bytes, connections: dict[bytes, tuple[bytes, bytes]]) -> dict[bytes, list[bytes]]:
    """Time (8 bytes) and place (4) of each message of a chunk, by connection; connections are noted."""
    found: dict[bytes, list[bytes]] = {}
    stream = io.BytesIO(content)
    at = 0
    while (record := _bag_record(stream)) is not None:
        fields = _bag_fields(record[0])
        conn, time = fields.get(b"conn", b""), fields.get(b"time", b"")
        if fields.get(b"op") == _CONNECTION and len(conn) == 4:
            connections.setdefault(conn, record)
        elif fields.get(b"op") == _MESSAGE and conn in connections and len(time) == 8:
            found.setdefault(conn, []).append(time + at.to_bytes(4, "little"))
        at = stream.tell()
    return found


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
        self._in_order_of_time = True
        self._lowest, self._highest = -(1 << 63), (1 << 63) - 1
        with self._guarded(), self._connected() as connection:
            self._read_topics(connection)
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
                    if not self._lowest <= log_time <= self._highest:
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
        self._require_some(damage)

    def _guarded(self, losses: Losses | None = None) -> AbstractContextManager[None]:
        return guarded(
            f"{self.path}: cannot be read as a {self.format}", f"`sqlite3 {self.path.name} .recover`", losses
        )
