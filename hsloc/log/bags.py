"""ROS 1 bags, by way of rosbags."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, cast

from hsloc.errors import LogFormatError
from hsloc.log.container import Channel, RawMessage, guarded, in_runs
from hsloc.log.messages.definitions import long_name
from hsloc.log.summary import Losses, TopicStatistics

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
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


class BagContainer:
    """A ROS 1 bag, whatever its name. `shown` is the name for messages to people, where the file is a copy of another.

    The decoders get the definitions that the bag carries, as with MCAP; rosbags is asked for raw messages alone.
    Raises LogFormatError, whatever rosbags, its databases and its decompressors raise.
    """

    format = "ROS 1 bag"
    profile = "ros1"

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        self.path = shown or path
        self._file = path
        self.channels: dict[int, Channel] = {}
        self.statistics: dict[int, TopicStatistics] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.losses_at_opening = Losses()
        self.warnings: list[RunWarning] = []
        with self._guarded(), self._reader() as reader:
            for number, connection in enumerate(reader.connections):
                self.channels[number] = self._channel(number, connection)
            self._count(reader)

    def runs(self, wanted: Collection[int], losses: Losses) -> Iterator[list[RawMessage]]:
        """As `Container.runs`."""
        return in_runs(self.messages(wanted, losses), _RUN)

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

    def verify(self) -> Losses:
        """Read everything and count what is damaged."""
        losses = self.losses_at_opening.copy()
        for _ in self.messages(self.channels, losses):
            pass
        return losses

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
        # What is damaged further on is counted when it is read for its own sake.
        if damage.reasons and not self.statistics:
            raise LogFormatError(damage.reasons[0])
        counted, promised = sum(item.count for item in self.statistics.values()), reader.message_count
        if not damage.reasons and counted < promised:
            self.losses_at_opening.truncated_files += 1
            self.losses_at_opening.note(f"{self.path}: holds {counted} messages of {promised} that it speaks of")

    def _guarded(self, losses: Losses | None = None) -> AbstractContextManager[None]:
        return guarded(f"{self.path}: cannot be read as a {self.format}", "`rosbag reindex`", losses)
