"""MCAP files, read in spite of damage.

Opening walks over the records' heads (chunks are skipped, not read) and makes a list of segments with their time
ranges; no summary section is needed for it, so a file whose recorder was killed reads like any other. Reading
loads one segment after the other in the order of their start times and merges what overlaps.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left, bisect_right
from operator import itemgetter
from struct import error as StructError
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from hsloc.errors import LogError, LogFormatError
from hsloc.log import mcap_records as records
from hsloc.log.container import Channel, RawMessage
from hsloc.log.definitions import long_name
from hsloc.log.mcap_records import ChunkHead, Damage, Opcode, UnknownCompression
from hsloc.log.summary import Losses, TopicStatistics

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

MAX_HELD_BYTES = 256 << 20
"""Payload held back for the sake of order, at most."""
MAX_TOTAL_RATIO = 100
"""Bytes a file may unpack to, as a multiple of its own size ..."""
FREE_UNPACKED_BYTES = 4 << 30
"""... but in any case as many as this: maps of unknown cells pack 1 : 8000."""
MAX_METADATA = 1000
_FEW = 4096
"""Messages held back that are rather sorted anew with each segment (a sorted list is a heap as well)."""
_LOOSE_BYTES = 1 << 20
"""Messages outside of chunks are taken together up to this size."""


class Segment(NamedTuple):
    """A chunk, or a run of messages outside of chunks (`head` is None), and where it stands in the file.

    `channels` are the channels that have messages in it, None where only reading can tell.
    """

    start_ns: int
    at: int
    length: int
    head: ChunkHead | None
    channels: frozenset[int] | None


class McapContainer:
    """One MCAP file. Raises LogFormatError where the file cannot be opened, or is no MCAP at all."""

    format = "mcap"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.profile = ""
        self.library = ""
        self.channels: dict[int, Channel] = {}
        self.statistics: dict[int, TopicStatistics] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.losses_at_opening = Losses()
        self.warnings: list[str] = []
        self.attachments: list[tuple[str, int]] = []
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.ChannelRecord] = {}
        self._segments: list[Segment] = []
        self._unpacked = 0
        try:
            self._size = path.stat().st_size
            with path.open("rb") as stream:
                _Walk(self, stream, self._size).run()
            self._segments.sort(key=itemgetter(0, 1))
            self._read_what_the_index_does_not_tell()
        except OSError as error:
            raise LogFormatError(f"{path}: cannot be read ({error.strerror or error})") from error

    def messages(self, wanted: Collection[int], losses: Losses) -> Iterator[RawMessage]:
        """As `Container.messages`: segments are merged exactly, unless more than 256 MB would be held back."""
        chosen = frozenset(wanted)
        segments = [s for s in self._segments if s.channels is None or s.channels & chosen]
        heap: list[RawMessage] = []
        held = 0
        last = 0
        self._unpacked = 0
        try:
            with self.path.open("rb") as stream:
                for index, segment in enumerate(segments):
                    horizon = segments[index + 1].start_ns if index + 1 < len(segments) else 1 << 64
                    found = self._load(stream, segment, chosen, losses)
                    if len(heap) < _FEW:
                        found = sorted(heap + found) if heap else found
                        split = bisect_left(found, horizon, key=itemgetter(0))
                        if split:
                            losses.late_messages += bisect_left(found, last, hi=split, key=itemgetter(0))
                            last = max(last, found[split - 1][0])
                        yield from found[:split]
                        # Copies, so that not the whole chunk stays in memory for a few messages.
                        heap = [(*message[:3], bytes(message[3])) for message in found[split:]]
                        held = sum(len(message[3]) for message in heap)
                    else:
                        for message in found:
                            heapq.heappush(heap, (*message[:3], bytes(message[3])))
                            held += len(message[3])
                    while heap and (heap[0][0] < horizon or held > MAX_HELD_BYTES):
                        message = heapq.heappop(heap)
                        held -= len(message[3])
                        losses.late_messages += message[0] < last
                        last = max(last, message[0])
                        yield message
        except OSError as error:
            raise LogError(f"{self.path}: cannot be read ({error.strerror or error})") from error

    def verify(self) -> Losses:
        """Read every segment and count what is damaged."""
        losses = self.losses_at_opening.copy()
        for _ in self.messages(self.channels, losses):
            pass
        return losses

    def _load(
        self, stream: BinaryIO, segment: Segment, wanted: frozenset[int] | None, losses: Losses
    ) -> list[RawMessage]:
        """Messages of a segment in the order of time; of all channels where `wanted` is None."""
        stream.seek(segment.at)
        data = stream.read(segment.length)
        try:
            if segment.head is not None:
                data = self._unpack(segment.head, data)
        except UnknownCompression as error:
            losses.unknown_compression[str(error)[:40]] += 1
            losses.note(f"{self.path}: chunk at byte {segment.at}: unknown compression {str(error)[:40]!r}")
            return []
        except Damage as error:
            losses.damaged_chunks += 1
            losses.note(f"{self.path}: chunk at byte {segment.at}: {error}")
            return []
        found = self._split(data, segment, wanted, losses)
        found.sort(key=itemgetter(0, 1))
        return found

    def _unpack(self, head: ChunkHead, data: bytes) -> bytes:
        if head.size <= records.MAX_CHUNK_BYTES and self._unpacked + head.size > max(
            FREE_UNPACKED_BYTES, MAX_TOTAL_RATIO * self._size
        ):
            raise Damage(f"the file would unpack to more than {MAX_TOTAL_RATIO} times its size")
        unpacked = records.decompress(head, data)
        self._unpacked += len(unpacked)
        return unpacked

    def _split(self, data: bytes, segment: Segment, wanted: frozenset[int] | None, losses: Losses) -> list[RawMessage]:
        found: list[RawMessage] = []
        append = found.append
        unpack = records.MESSAGE.unpack_from
        view = memoryview(data)
        # Unique and in the order of the file, as an uncompressed chunk may be larger than its place in it.
        base = segment.at << 32
        at, end = 0, len(data)
        head_size, prefix_size = records.MESSAGE.size, records.PREFIX.size
        while end - at >= prefix_size:
            if end - at >= head_size:
                opcode, length, channel, _, log_time, _ = unpack(data, at)
            else:
                opcode, length = records.PREFIX.unpack_from(data, at)
            following = at + prefix_size + length
            if following > end or opcode == 0 or (opcode == 5 and length < records.MESSAGE_FIELDS):
                break
            if opcode == 5:
                if wanted is None or channel in wanted:
                    append((log_time, base + at, channel, view[at + head_size : following]))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and not self._knows(opcode, data, at):
                self._define(opcode, view[at + prefix_size : following], segment.at, losses)
            at = following
        if at < end:
            losses.damaged_chunks += 1
            losses.bytes_lost += end - at
            losses.note(f"{self.path}: chunk at byte {segment.at}: its last {end - at} bytes are no records")
        return found

    def _knows(self, opcode: int, data: bytes, at: int) -> bool:
        """Whether a schema or channel was defined before: recorders repeat them in every chunk."""
        try:
            (number,) = records.NUMBER.unpack_from(data, at + records.PREFIX.size)
        except StructError:
            return False
        return number in (self._schemas if opcode == Opcode.SCHEMA else self._channels)

    def _define(self, opcode: int, content: bytes | memoryview, at: int, losses: Losses) -> None:
        """Take in a schema or channel; the first definition of a number stands."""
        try:
            if len(content) > records.MAX_RECORD_BYTES:
                raise Damage(f"a definition of {len(content)} bytes")
            if opcode == Opcode.SCHEMA:
                schema = records.parse_schema(content)
                self._schemas.setdefault(schema.id, schema)
                return
            record = records.parse_channel(content)
            self._channels.setdefault(record.id, record)
        except Damage as error:
            losses.damaged_chunks += 1
            losses.note(f"{self.path}: near byte {at}: {error}")

    def _read_what_the_index_does_not_tell(self) -> None:
        """Read the segments whose channels are unknown, and all of them if a channel is not defined."""
        indexed = {channel for s in self._segments for channel in s.channels or ()}
        # Either may stand in the chunks alone, even where the summary repeats the other.
        schemas = {record.schema_id for record in self._channels.values()} - {0}
        everything = not (indexed <= self._channels.keys() and schemas <= self._schemas.keys())
        # What is damaged is counted when it is read for its own sake.
        ignored = Losses()
        with self.path.open("rb") as stream:
            for number, segment in enumerate(self._segments):
                if segment.channels is not None and not everything:
                    continue
                found = self._load(stream, segment, None, ignored)
                if segment.channels is None:
                    self._segments[number] = segment._replace(channels=self._count(found))
        self.channels = {number: self._channel(record) for number, record in sorted(self._channels.items())}
        unknown = {channel for s in self._segments for channel in s.channels or ()} - self.channels.keys()
        if unknown:
            self.warnings.append(f"{self.path}: messages on {len(unknown)} channels without definition are ignored")

    def _channel(self, record: records.ChannelRecord) -> Channel:
        schema = self._schemas.get(record.schema_id, records.Schema(0, "", "", b""))
        return Channel(
            record.id, record.topic, long_name(schema.name), record.message_encoding, schema.encoding, schema.data
        )

    def _count(self, found: list[RawMessage]) -> frozenset[int] | None:
        """Add messages to the statistics; returns the channels, or None where nothing was readable."""
        times: dict[int, list[int]] = {}
        for log_time, _, channel, _ in found:
            times.setdefault(channel, []).append(log_time)
        for channel, values in times.items():
            self.count_times(channel, np.array(values, dtype=np.uint64))
        return frozenset(times) if times else None

    def count_times(self, channel: int, times: NDArray[np.uint64]) -> None:
        """Add log times (uint64) of a channel to its statistics."""
        if not len(times):
            return
        ordered = np.sort(times)
        gap = int(np.diff(ordered).max()) if len(ordered) > 1 else 0
        statistics = self.statistics.setdefault(channel, TopicStatistics())
        statistics.add(int(ordered[0]), int(ordered[-1]), len(ordered), gap)


class _Walk:
    """The walk over the heads of a file's records at opening; fills the container."""

    def __init__(self, container: McapContainer, stream: BinaryIO, size: int) -> None:
        self.container = container
        self.stream = stream
        self.size = size
        self.losses = container.losses_at_opening
        self.loose: list[tuple[int, int, int, int]] = []
        self.in_summary = False
        self.chunk: Segment | None = None
        self.index: dict[int, NDArray[np.uint64]] = {}
        self.index_is_whole = True
        self.chunks_of_summary: list[int] | None = None

    def run(self) -> None:
        """From the magic to the footer, or as far as it goes."""
        path = self.container.path
        if self.size == 0:
            raise LogFormatError(f"{path}: is empty")
        if self.stream.read(len(records.MAGIC)) != records.MAGIC:
            raise LogFormatError(f"{path}: is not an MCAP file")
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
        self._close_chunk()
        self._close_loose()
        if not finished:
            self.losses.truncated_files += 1
            self.losses.bytes_lost += max(self.size - at, 0)
            self.losses.note(f"{path}: ends at byte {self.size} without its footer")

    def _content(self, at: int, length: int, limit: int = records.MAX_RECORD_BYTES) -> bytes:
        if length > limit:
            raise Damage(f"a record of {length} bytes")
        self.stream.seek(at + records.PREFIX.size)
        return self.stream.read(length)

    def _record(self, opcode: int, at: int, length: int, head: bytes) -> None:
        container = self.container
        try:
            if opcode == Opcode.MESSAGE:
                self._message(at, length, head)
            elif opcode == Opcode.MESSAGE_INDEX:
                self._message_index(at, length)
            elif opcode == Opcode.CHUNK:
                self._chunk(at, length)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                container._define(opcode, self._content(at, length), at, self.losses)
            elif opcode == Opcode.HEADER:
                container.profile, container.library = records.parse_header(self._content(at, length))
            elif opcode == Opcode.METADATA and len(container.metadata) < MAX_METADATA:
                name, values = records.parse_metadata(self._content(at, length))
                container.metadata[name] = values
        except Damage as error:
            if opcode == Opcode.MESSAGE_INDEX:
                self.index_is_whole = False
                return
            self.losses.damaged_chunks += 1
            self.losses.note(f"{container.path}: byte {at}: {error}")

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
        for channel, times in by_channel.items():
            self.container.count_times(channel, np.array(times, dtype=np.uint64))
        self.container._segments.append(Segment(start, first, last + size - first, None, frozenset(by_channel)))
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
        times = np.frombuffer(content, dtype="<u8", offset=6)[::2] if length > 6 else np.zeros(0, np.uint64)
        self.index[records.NUMBER.unpack_from(content)[0]] = times

    def _close_chunk(self) -> None:
        """The chunk's indexes are complete when something else follows."""
        if self.chunk is not None:
            channels = frozenset(self.index) if self.index and self.index_is_whole else None
            for channel in channels or ():
                self.container.count_times(channel, self.index[channel])
            self.container._segments.append(self.chunk._replace(channels=channels))
        self.chunk = None
        self.index = {}
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
