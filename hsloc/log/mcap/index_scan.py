"""The first walk over an MCAP file: from head to head of its records, chunks skipped and not read.

It makes a directory: which segments there are and when they start, what is defined, how many messages each channel
has. No summary section is needed for it, so a file whose recorder was killed reads like any other.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from operator import itemgetter
from struct import error as StructError
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from hsloc.errors import LogFormatError
from hsloc.log.container import RecorderClock, plausible_times
from hsloc.log.mcap import records
from hsloc.log.mcap.records import ChunkHead, Damage, Opcode
from hsloc.log.no_log import COPY_AGAIN, EMPTY
from hsloc.log.summary import Losses, TopicStatistics

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

MAX_METADATA = 1000
"""Maximum number of metadata records that are read. Internal: guards the memory against a hostile file."""
_LOOSE_BYTES = 1 << 20
"""Messages outside of chunks are taken together up to this size."""


class Segment(NamedTuple):
    """A chunk, or a run of messages outside of chunks (`head` is None), and its place in the file.

    `channels` are the channels that have messages in it, None where only reading shows them.
    """

    start_ns: int
    at: int
    length: int
    head: ChunkHead | None
    channels: frozenset[int] | None


@dataclass(slots=True)
class ChunkIndex:
    """What a file holds. `losses` are those found on the walk, by what the records' heads say."""

    path: Path
    profile: str = ""
    library: str = ""
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.ChannelRecord] = field(default_factory=dict)
    statistics: dict[int, TopicStatistics] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    losses: Losses = field(default_factory=Losses)
    clock: RecorderClock = field(default_factory=RecorderClock)
    plausible_ns: tuple[int, int] = (0, (1 << 63) - 1)
    """Between which log times messages are believed."""

    def knows(self, opcode: int, data: bytes, at: int) -> bool:
        """Whether a schema or channel was defined before: recorders repeat them in every chunk."""
        try:
            (number,) = records.NUMBER.unpack_from(data, at + records.PREFIX.size)
        except StructError:
            return False
        return number in (self.schemas if opcode == Opcode.SCHEMA else self.channels)

    def define(self, opcode: int, content: bytes | memoryview, at: int, losses: Losses) -> None:
        """Take in a schema or channel; the first definition of a number stands."""
        try:
            if len(content) > records.MAX_RECORD_BYTES:
                raise Damage(f"a definition of {len(content)} bytes")
            if opcode == Opcode.SCHEMA:
                schema = records.parse_schema(content)
                self.schemas.setdefault(schema.id, schema)
                return
            record = records.parse_channel(content)
            self.channels.setdefault(record.id, record)
        except Damage as error:
            losses.damaged_chunks += 1
            losses.note(f"{self.path}: near byte {at}: {error}")

    def count_times(self, channel: int, times: NDArray[np.uint64]) -> None:
        """Add log times (uint64) of a channel to its statistics."""
        if not len(times):
            return
        ordered = np.sort(times)
        gap = int(np.diff(ordered).max()) if len(ordered) > 1 else 0
        statistics = self.statistics.setdefault(channel, TopicStatistics())
        statistics.add(int(ordered[0]), int(ordered[-1]), len(ordered), gap)


class IndexScan:
    """The walk; `run` returns the directory. Raises LogFormatError for what is no MCAP at all, and OSError."""

    def __init__(self, path: Path, stream: BinaryIO, size: int) -> None:
        self.directory = ChunkIndex(path)
        self.stream = stream
        self.size = size
        self.losses = self.directory.losses
        self.loose: list[tuple[int, int, int, int]] = []
        self.chunk: Segment | None = None
        self.index: dict[int, NDArray[np.uint64]] = {}
        self.places: dict[int, NDArray[np.uint64]] = {}
        self.index_is_whole = True
        self.chunks_of_summary: list[int] | None = None
        self._samples: list[int] = []

    def run(self) -> ChunkIndex:
        """From the magic to the footer, or as far as it goes."""
        path = self.directory.path
        if self.size == 0:
            raise LogFormatError(f"{path}: {EMPTY}")
        if self.stream.read(len(records.MAGIC)) != records.MAGIC:
            raise LogFormatError(f"{path}: is not an MCAP file; {COPY_AGAIN}")
        at = len(records.MAGIC)
        finished = False
        while at < self.size:
            self.stream.seek(at)
            head = self.stream.read(records.MESSAGE.size)
            if len(head) < records.PREFIX.size:
                break
            opcode, length = records.PREFIX.unpack_from(head)
            following = at + records.PREFIX.size + length
            if opcode == 0 or opcode == records.MAGIC[0] or following > self.size:
                self.index_is_whole = False  # The rest of the last chunk's index may be what is damaged.
                resumed = self._resume(at)
                if resumed is None:
                    break
                self.losses.damaged_chunks += 1
                self.losses.bytes_lost += resumed - at
                self.losses.note(f"{path}: byte {at}: no record; reading goes on at byte {resumed}")
                at = resumed
                continue
            self._record(opcode, at, length, head)
            at = following
            if opcode == Opcode.FOOTER:
                finished = True
                break
        self.index_is_whole &= finished
        self._close_chunk()
        self._close_loose()
        if not finished:
            self.losses.truncated_files += 1
            self.losses.bytes_lost += max(self.size - at, 0)
            self.losses.note(f"{path}: ends at byte {self.size} without its footer")
        self._settle_times()
        self.directory.segments.sort(key=itemgetter(0, 1))
        return self.directory

    def _count(self, by_channel: dict[int, NDArray[np.uint64]]) -> None:
        """Add the log times of a segment to the statistics, without those that its other messages contradict."""
        ordered = np.sort(np.concatenate(list(by_channel.values())))
        if not len(ordered):
            return
        # Quartiles, which a few wrong times do not move; of very few messages the one in the middle.
        quarter = len(ordered) // 4 if len(ordered) > 7 else (len(ordered) - 1) // 2
        inner = int(ordered[quarter]), int(ordered[-1 - quarter])
        self._samples += inner
        low, high = plausible_times(inner)
        for channel, times in by_channel.items():
            wrong = (times < max(low, 0)) | (times > high)
            self.directory.count_times(channel, times[~wrong] if wrong.any() else times)
            if wrong.any():
                self.directory.statistics.setdefault(channel, TopicStatistics()).count += int(wrong.sum())

    def _settle_times(self) -> None:
        """Find out which log times can be believed; start segments by these, and count messages by them."""
        directory = self.directory
        if self._samples:
            low, high = plausible_times(sorted(self._samples))
            directory.plausible_ns = max(low, 0), high
        low, high = directory.plausible_ns
        last = next((s.start_ns for s in directory.segments if low <= s.start_ns <= high), 0)
        for number, segment in enumerate(directory.segments):
            if low <= segment.start_ns <= high:
                last = segment.start_ns
            else:
                directory.segments[number] = segment._replace(start_ns=last)
        for statistics in directory.statistics.values():
            if statistics.first_ns is not None and statistics.last_ns is not None:
                statistics.first_ns = min(max(statistics.first_ns, low), high)
                statistics.last_ns = min(max(statistics.last_ns, low), high)

    def _content(self, at: int, length: int, limit: int = records.MAX_RECORD_BYTES) -> bytes:
        if length > limit:
            raise Damage(f"a record of {length} bytes")
        self.stream.seek(at + records.PREFIX.size)
        return self.stream.read(length)

    def _record(self, opcode: int, at: int, length: int, head: bytes) -> None:
        directory = self.directory
        try:
            if opcode == Opcode.MESSAGE:
                self._message(at, length, head)
            elif opcode == Opcode.MESSAGE_INDEX:
                self._message_index(at, length)
            elif opcode == Opcode.CHUNK:
                self._chunk(at, length)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                directory.define(opcode, self._content(at, length), at, self.losses)
            elif opcode == Opcode.HEADER:
                directory.profile, directory.library = records.parse_header(self._content(at, length))
            elif opcode == Opcode.METADATA and len(directory.metadata) < MAX_METADATA:
                name, values = records.parse_metadata(self._content(at, length))
                directory.metadata[name] = values
        except Damage as error:
            if opcode == Opcode.MESSAGE_INDEX:
                self.index_is_whole = False
                return
            self.losses.damaged_chunks += 1
            self.losses.note(f"{directory.path}: byte {at}: {error}")

    def _message(self, at: int, length: int, head: bytes) -> None:
        if length < records.MESSAGE_FIELDS:
            raise Damage("message record too short")
        _, _, channel, _, log_time, _ = records.MESSAGE.unpack(head)
        size = records.PREFIX.size + length
        if self.loose:
            first = self.loose[0][0]
            previous = self.loose[-1]
            if at != previous[0] + previous[1] or at + size - first > _LOOSE_BYTES:
                self._close_loose()
        self.loose.append((at, size, channel, log_time))

    def _close_loose(self) -> None:
        """Make a segment of the messages outside of chunks that stand together."""
        if not self.loose:
            return
        start = min(log_time for *_, log_time in self.loose)
        first, (last, size, *_) = self.loose[0][0], self.loose[-1]
        by_channel: dict[int, list[int]] = {}
        for *_, channel, log_time in self.loose:
            by_channel.setdefault(channel, []).append(log_time)
        self._count({channel: np.array(times, dtype=np.uint64) for channel, times in by_channel.items()})
        channels, written = ([each[k] for each in self.loose] for k in (2, 3))
        self.directory.clock.take(np.array(channels, np.int64), np.array(written, np.uint64).astype(np.int64))
        self.directory.segments.append(Segment(start, first, last + size - first, None, frozenset(by_channel)))
        self.loose = []

    def _chunk(self, at: int, length: int) -> None:
        self._close_chunk()
        if length > records.MAX_CHUNK_BYTES:
            raise Damage(f"a chunk of {length} bytes, at most {records.MAX_CHUNK_BYTES} are read")
        self.stream.seek(at + records.PREFIX.size)
        head = records.parse_chunk_head(self.stream.read(min(length, 128)), length)
        data_at = at + records.PREFIX.size + head.data_at
        self.chunk = Segment(head.start_ns, data_at, head.data_size, head, None)

    def _message_index(self, at: int, length: int) -> None:
        """Log times of one channel in the chunk before: statistics without unpacking anything."""
        if self.chunk is None:
            return
        content = self._content(at, length, limit=64 << 20)
        if length < 6 or (length - 6) % 16:
            raise Damage("message index of an odd size")
        rows = np.frombuffer(content, dtype="<u8", offset=6) if length > 6 else np.zeros(0, np.uint64)
        channel = records.NUMBER.unpack_from(content)[0]
        self.index[channel], self.places[channel] = rows[::2], rows[1::2]

    def _close_chunk(self) -> None:
        """The chunk's indexes are complete when something else follows."""
        if self.chunk is not None:
            channels = frozenset(self.index) if self.index and self.index_is_whole else None
            if channels:
                self._count({channel: self.index[channel] for channel in channels})
                order = np.argsort(np.concatenate([self.places[channel] for channel in self.index]), kind="stable")
                times = np.concatenate([*self.index.values()]).astype(np.int64)
                numbers = np.repeat([*self.index], [len(each) for each in self.index.values()])
                self.directory.clock.take(numbers[order], times[order])
            self.directory.segments.append(self.chunk._replace(channels=channels))
        self.chunk = None
        self.index, self.places = {}, {}
        self.index_is_whole = True

    def _resume(self, at: int) -> int | None:
        """Where to go on behind damage: the next chunk that the summary at the end of the file knows."""
        if self.chunks_of_summary is None:
            self.chunks_of_summary = sorted(self._summary_offsets())
        number = bisect_right(self.chunks_of_summary, at)
        return self.chunks_of_summary[number] if number < len(self.chunks_of_summary) else None

    def _summary_offsets(self) -> list[int]:
        """Where chunks and the summary itself start, if the file ends with a footer; else nothing."""
        tail = len(records.MAGIC) + records.PREFIX.size + 20
        if self.size < tail:
            return []
        self.stream.seek(self.size - tail)
        data = self.stream.read(tail)
        if not data.endswith(records.MAGIC) or data[0] != Opcode.FOOTER:
            return []
        summary = records.parse_footer(data[records.PREFIX.size :])
        if not 0 < summary < self.size:
            return []
        return [offset for offset in self._chunk_offsets(summary) if offset < summary] + [summary]

    def _chunk_offsets(self, at: int) -> Iterator[int]:
        while at + records.PREFIX.size < self.size:
            self.stream.seek(at)
            opcode, length = records.PREFIX.unpack(self.stream.read(records.PREFIX.size))
            following = at + records.PREFIX.size + length
            if opcode == Opcode.FOOTER or following > self.size:
                return
            if opcode == Opcode.CHUNK_INDEX and length >= 24:
                yield int.from_bytes(self.stream.read(24)[16:], "little")
            at = following
