"""MCAP files, read in spite of damage.

Opening makes a directory of the file (see `hsloc.log.mcap.index_scan`). Reading loads one segment after the other in
the order of their start times and merges what overlaps.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left
from itertools import chain
from operator import itemgetter
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from hsloc.errors import LogError, LogFormatError, not_read
from hsloc.log.container import Channel, RawMessage, out_of_line
from hsloc.log.mcap import records
from hsloc.log.mcap.index_scan import IndexScan, Segment
from hsloc.log.mcap.records import ChunkHead, Damage, Opcode, UnknownCompression
from hsloc.log.messages.definitions import long_name
from hsloc.log.summary import Losses
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

MAX_HELD_BYTES = 256 << 20
"""Payload held back for the sake of order, at most."""
MAX_TOTAL_RATIO = 100
"""Bytes a file may unpack to, as a multiple of its own size ..."""
FREE_UNPACKED_BYTES = 4 << 30
"""... but in any case as many as this: maps of unknown cells pack 1 : 8000."""
_FEW = 4096
"""Messages held back up to which they are sorted again with each segment (a sorted list is a heap as well)."""


class McapContainer:
    """One MCAP file. Raises LogFormatError where the file cannot be opened, or is no MCAP at all.

    `shown` is the name for messages to people, where the file is a copy of another.
    """

    format = "mcap"

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        self.path = shown or path
        self._file = path
        self.warnings: list[RunWarning] = []
        self._unpacked = 0
        try:
            self._size = path.stat().st_size
            with path.open("rb") as stream:
                self._directory = IndexScan(self.path, stream, self._size).run()
            self._read_what_the_index_does_not_tell()
        except OSError as error:
            raise LogFormatError(not_read(self.path, error)) from error
        self.profile = self._directory.profile
        self.statistics = self._directory.statistics
        self.warnings += self._directory.clock.warnings(self.path, self.statistics.values())
        self.metadata = self._directory.metadata
        self.losses_at_opening = self._directory.losses
        self.channels = {number: self._channel(record) for number, record in sorted(self._directory.channels.items())}
        unknown = self._indexed() - self.channels.keys()
        if unknown:
            text = f"{self.path}: messages on {len(unknown)} channels without definition are ignored"
            self.warnings.append(RunWarning(WarningCode.CHANNELS_UNDEFINED, text))

    def messages(self, wanted: Collection[int], losses: Losses) -> Iterator[RawMessage]:
        """As `Container.messages`."""
        return chain.from_iterable(self.runs(wanted, losses))

    def runs(self, wanted: Collection[int], losses: Losses) -> Iterator[list[RawMessage]]:
        """As `Container.runs`: segments are merged exactly, unless more than 256 MB would be held back."""
        chosen = frozenset(wanted)
        segments = [s for s in self._directory.segments if s.channels is None or s.channels & chosen]
        heap: list[RawMessage] = []
        held = 0
        last = 0
        self._unpacked = 0
        try:
            with self._file.open("rb") as stream:
                for index, segment in enumerate(segments):
                    horizon = segments[index + 1].start_ns if index + 1 < len(segments) else 1 << 64
                    found = self._load(stream, segment, chosen, losses)
                    if len(heap) < _FEW:
                        found = sorted(heap + found) if heap else found
                        split = bisect_left(found, horizon, key=itemgetter(0))
                        if split:
                            losses.late_messages += bisect_left(found, last, hi=split, key=itemgetter(0))
                            last = max(last, found[split - 1][0])
                        yield found[:split]
                        # Copies, so that not the whole chunk stays in memory for a few messages.
                        heap = [(*message[:3], bytes(message[3])) for message in found[split:]]
                        held = sum(len(message[3]) for message in heap)
                    else:
                        for message in found:
                            heapq.heappush(heap, (*message[:3], bytes(message[3])))
                            held += len(message[3])
                    ready: list[RawMessage] = []
                    while heap and (heap[0][0] < horizon or held > MAX_HELD_BYTES):
                        message = heapq.heappop(heap)
                        held -= len(message[3])
                        losses.late_messages += message[0] < last
                        last = max(last, message[0])
                        ready.append(message)
                    if ready:
                        yield ready
        except OSError as error:
            raise LogError(not_read(self.path, error)) from error

    def verify(self) -> Losses:
        """Read every segment and count what is damaged."""
        losses = self.losses_at_opening.copy()
        for _ in self.runs(self.channels, losses):
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
        unpack = records.MESSAGE_HEAD.unpack_from
        view = memoryview(data)
        # Unique and in the order of the file, as an uncompressed chunk may be larger than its place in it.
        base = segment.at << 32
        at, end = 0, len(data)
        head_size, prefix_size = records.MESSAGE.size, records.PREFIX.size
        last_head = end - head_size
        while end - at >= prefix_size:
            if at <= last_head:
                opcode, length, channel, log_time = unpack(data, at)
            else:
                opcode, length = records.PREFIX.unpack_from(data, at)
            following = at + prefix_size + length
            if following > end:
                break
            if opcode == 5:
                if length < records.MESSAGE_FIELDS:
                    break
                if wanted is None or channel in wanted:
                    append((log_time, base + at, channel, view[at + head_size : following]))
            elif opcode == 0:
                break
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and not self._directory.knows(opcode, data, at):
                self._directory.define(opcode, view[at + prefix_size : following], segment.at, losses)
            at = following
        low, high = self._directory.plausible_ns
        if found and not (low <= min(found)[0] and max(found)[0] <= high):
            found = _with_plausible_times(found, low, high, segment.start_ns, losses)
        if found and self._directory.clock.has_single_errors:
            found = _with_times_in_line(found, losses)
        if at < end:
            losses.damaged_chunks += 1
            losses.bytes_lost += end - at
            losses.note(f"{self.path}: chunk at byte {segment.at}: its last {end - at} bytes are no records")
        return found

    def _read_what_the_index_does_not_tell(self) -> None:
        """Read the segments whose channels are unknown, and all of them if a channel is not defined."""
        directory = self._directory
        # Either may stand in the chunks alone, even where the summary repeats the other.
        schemas = {record.schema_id for record in directory.channels.values()} - {0}
        everything = not (self._indexed() <= directory.channels.keys() and schemas <= directory.schemas.keys())
        # What is damaged is counted when it is read for its own sake.
        ignored = Losses()
        with self._file.open("rb") as stream:
            for number, segment in enumerate(directory.segments):
                if segment.channels is not None and not everything:
                    continue
                found = self._load(stream, segment, None, ignored)
                if segment.channels is None:
                    directory.segments[number] = segment._replace(channels=self._count(found))

    def _indexed(self) -> set[int]:
        """Channels that are known to have messages."""
        return {channel for segment in self._directory.segments for channel in segment.channels or ()}

    def _channel(self, record: records.ChannelRecord) -> Channel:
        schema = self._directory.schemas.get(record.schema_id, records.Schema(0, "", "", b""))
        return Channel(
            record.id, record.topic, long_name(schema.name), record.message_encoding, schema.encoding, schema.data
        )

    def _count(self, found: list[RawMessage]) -> frozenset[int] | None:
        """Add messages to the statistics; returns the channels, or None where nothing was readable."""
        times: dict[int, list[int]] = {}
        for log_time, _, channel, _ in found:
            times.setdefault(channel, []).append(log_time)
        for channel, values in times.items():
            self._directory.count_times(channel, np.array(values, dtype=np.uint64))
        return frozenset(times) if times else None


def _with_plausible_times(
    found: list[RawMessage], low: int, high: int, start_ns: int, losses: Losses
) -> list[RawMessage]:
    """Messages in the order of the file, those with impossible log times at the time of the one before."""
    last = next((message[0] for message in found if low <= message[0] <= high), start_ns)
    repaired = []
    for message in found:
        if low <= message[0] <= high:
            last = message[0]
        else:
            losses.log_times_repaired += 1
            message = (last, *message[1:])
        repaired.append(message)
    return repaired


def _with_times_in_line(found: list[RawMessage], losses: Losses) -> list[RawMessage]:
    """Messages in the order of the file; log times that those of their channel contradict give way to ones before."""
    channels = np.array([message[2] for message in found])
    times = np.array([message[0] for message in found], dtype=np.uint64).astype(np.int64)
    wrong = np.zeros(len(found), dtype=np.bool_)
    for channel in np.unique(channels):
        rows = np.flatnonzero(channels == channel)
        wrong[rows] = out_of_line(times[rows])
    for row in np.flatnonzero(wrong).tolist():  # never the first one
        losses.log_times_repaired += 1
        found[row] = (found[row - 1][0], *found[row][1:])
    return found
