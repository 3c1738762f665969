"""A copy of an MCAP file far away that has only what hsloc reads: the rest, such as images, stays holes.

The summary at the end says where chunks are and which channels are in them. Of a compressed chunk all is needed or
nothing; in one that is not compressed, each message has its place. What is not fetched reads as zeros, and belongs to
channels whose type hsloc does not read. Everything else is as in the file, so that it is read in the same way.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

from hsloc.log.container import Channel
from hsloc.log.mcap import records
from hsloc.log.mcap.records import Damage, Opcode
from hsloc.log.messages.decoders import is_read
from hsloc.log.messages.definitions import long_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    Fetch = Callable[[Sequence[tuple[int, int]]], Sequence[bytes]]

_TAIL_BYTES = 64 << 10
_MAX_SUMMARY_BYTES = 64 << 20
_FOOTER_BYTES = len(records.MAGIC) + records.PREFIX.size + 20
_HEAD_BYTES = records.PREFIX.size + 128
"""What is fetched of a chunk to parse its head, as `IndexScan` does."""
GAP_BYTES = 64 << 10
"""Bytes that are fetched in vain rather than by another request: 10 ms of a link of 50 Mbit/s, as a request takes."""
_BLOCK_BYTES, _BATCH = 4 << 20, 16
"""Bytes of a request, at most, and requests at a time: what is held in memory."""
_INDEX = struct.Struct("<QQQQI")
_INDEX_ENTRY = struct.Struct("<HQ")
_CRC_AT = records.PREFIX.size + 24


class _Chunk(NamedTuple):
    """Where a chunk's record and the message indexes behind it are, and the channels in it."""

    at: int
    end: int
    index_end: int
    channels: frozenset[int]
    compressed: bool


@dataclass(frozen=True, slots=True)
class _Plan:
    """The chunks in the order of the file, and the channels that are not read."""

    chunks: tuple[_Chunk, ...]
    unread: frozenset[int]


def copy_needed(fetch: Fetch, size: int, target: BinaryIO) -> int | None:
    """Write what is needed of a file of `size` bytes to `target`; the number of bytes that were fetched.

    `fetch` returns the bytes of several ranges (first, one behind the last). None where the file has no summary that
    says enough and is right, or no channel that can be left out: then it is to be fetched whole.
    """
    if size <= _TAIL_BYTES:
        return None
    (tail,) = fetch([(size - _TAIL_BYTES, size)])
    try:
        plan = _plan(fetch, size, tail)
        if plan is None:
            return None
        target.truncate(size)
        copy = _Copy(fetch, target)
        copy.add(_outside_of_messages(plan, size))
        copy.add(_messages(plan, target))
        copy.add(_between_messages(plan, target))
    except (Damage, struct.error):
        return None
    for chunk in plan.chunks:
        if not chunk.compressed and not copy.has(chunk.at, chunk.end):
            # The checksum is of all messages; zero means that there is none.
            target.seek(chunk.at + _CRC_AT)
            target.write(bytes(4))
    return len(tail) + sum(end - first for first, end in copy.there)


class _Copy:
    """What is there of the file; `there` are ranges that do not touch, in their order."""

    def __init__(self, fetch: Fetch, target: BinaryIO) -> None:
        self._fetch, self._target = fetch, target
        self.there: list[tuple[int, int]] = []

    def add(self, spans: Iterable[tuple[int, int]]) -> None:
        """Fetch ranges, except what is there, and near ones together."""
        missing = [part for span in _merged(spans, GAP_BYTES) for part in self._missing(span)]
        batch: list[tuple[int, int]] = []
        for first, end in missing:
            for at in range(first, end, _BLOCK_BYTES):
                batch.append((at, min(at + _BLOCK_BYTES, end)))
                if len(batch) == _BATCH:
                    self._write(batch)
                    batch = []
        if batch:
            self._write(batch)
        self.there = list(_merged([*self.there, *missing], 0))

    def _write(self, batch: Sequence[tuple[int, int]]) -> None:
        for (first, end), content in zip(batch, self._fetch(batch), strict=True):
            if len(content) != end - first:
                raise Damage("the file has become shorter")
            self._target.seek(first)
            self._target.write(content)

    def has(self, first: int, end: int) -> bool:
        """Whether a range is there."""
        return not list(self._missing((first, end)))

    def _missing(self, span: tuple[int, int]) -> Iterator[tuple[int, int]]:
        at, end = span
        for first, last in self.there:
            if last <= at:
                continue
            if first >= end:
                break
            if first > at:
                yield at, first
            at = last
        if at < end:
            yield at, end


def _merged(spans: Iterable[tuple[int, int]], gap: int) -> Iterator[tuple[int, int]]:
    """Ranges in their order, those with at most `gap` bytes between them as one."""
    begin = last = -1
    for first, end in sorted(spans):
        if begin >= 0 and first <= last + gap:
            last = max(last, end)
            continue
        if begin >= 0:
            yield begin, last
        begin, last = first, end
    if begin >= 0:
        yield begin, last


def _plan(fetch: Fetch, size: int, tail: bytes) -> _Plan | None:
    """What the summary says; None where it does not say enough. Raises Damage or struct.error."""
    footer = tail[-_FOOTER_BYTES:]
    if not footer.endswith(records.MAGIC) or footer[0] != Opcode.FOOTER:
        return None
    start = records.parse_footer(footer[records.PREFIX.size :])
    if not 0 < start < size or size - start > _MAX_SUMMARY_BYTES:
        return None
    summary = tail[start - size :] if size - start <= len(tail) else fetch([(start, size)])[0]
    schemas: dict[int, records.Schema] = {0: records.Schema(0, "", "", b"")}
    channels: dict[int, records.ChannelRecord] = {}
    chunks: list[_Chunk] = []
    for opcode, content in _records(summary):
        if opcode == Opcode.SCHEMA:
            schema = records.parse_schema(content)
            schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            record = records.parse_channel(content)
            channels[record.id] = record
        elif opcode == Opcode.CHUNK_INDEX:
            chunks.append(_chunk(content))
    chunks.sort()
    ends = [chunk.index_end for chunk in chunks]
    apart = all(end <= chunk.at for end, chunk in zip(ends, chunks[1:], strict=False))
    known = all(chunk.channels and chunk.channels <= channels.keys() for chunk in chunks)
    defined = all(record.schema_id in schemas for record in channels.values())
    if not (chunks and apart and ends[-1] <= start and known and defined):
        return None
    unread = frozenset(
        record.id for record in channels.values() if not is_read(_channel(record, schemas[record.schema_id]))
    )
    return _Plan(tuple(chunks), unread) if unread else None


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of records one behind the other, up to the footer."""
    at = 0
    while at + records.PREFIX.size <= len(data):
        opcode, length = records.PREFIX.unpack_from(data, at)
        at += records.PREFIX.size
        if opcode == Opcode.FOOTER:
            return
        if at + length > len(data):
            raise Damage("a record is longer than what it is in")
        yield opcode, data[at : at + length]
        at += length


def _chunk(content: bytes) -> _Chunk:
    _, _, at, length, size = _INDEX.unpack_from(content)
    entries = content[_INDEX.size : _INDEX.size + size]
    channels = frozenset(number for number, _ in _INDEX_ENTRY.iter_unpack(entries))
    index_bytes, name_size = struct.unpack_from("<QI", content, _INDEX.size + size)
    if length < records.PREFIX.size or name_size > 64:
        raise Damage("a chunk index that cannot be")
    return _Chunk(at, at + length, at + length + index_bytes, channels, name_size > 0)


def _channel(record: records.ChannelRecord, schema: records.Schema) -> Channel:
    return Channel(record.id, record.topic, long_name(schema.name), record.message_encoding)


def _is_in_part(plan: _Plan, chunk: _Chunk) -> bool:
    """Whether some messages of a chunk are needed, and can be fetched without the others."""
    return not chunk.compressed and bool(chunk.channels & plan.unread)


def _outside_of_messages(plan: _Plan, size: int) -> Iterator[tuple[int, int]]:
    """All but chunks with messages that are not read: of those the heads."""
    at = 0
    for chunk in plan.chunks:
        if chunk.channels <= plan.unread or _is_in_part(plan, chunk):
            yield at, min(chunk.at + _HEAD_BYTES, chunk.end)
            at = chunk.end
    yield at, size


def _messages(plan: _Plan, copy: BinaryIO) -> Iterator[tuple[int, int]]:
    """Messages that are read, and the heads of the others, in chunks of which a part is needed."""
    for chunk in plan.chunks:
        if not chunk.channels <= plan.unread and _is_in_part(plan, chunk):
            for first, end, channel in _places(chunk, copy):
                yield first, end if channel not in plan.unread else min(first + records.MESSAGE.size, end)


def _between_messages(plan: _Plan, copy: BinaryIO) -> Iterator[tuple[int, int]]:
    """What is behind a message that is not read, where the next one does not follow at once: definitions."""
    for chunk in plan.chunks:
        if not chunk.channels <= plan.unread and _is_in_part(plan, chunk):
            for first, end, channel in _places(chunk, copy):
                if channel in plan.unread:
                    copy.seek(first)
                    _, length = records.PREFIX.unpack(copy.read(records.PREFIX.size))
                    behind = first + records.PREFIX.size + length
                    if behind < end:
                        yield behind, end


def _places(chunk: _Chunk, copy: BinaryIO) -> Iterator[tuple[int, int, int]]:
    """(first byte, one behind the last, channel) of the messages of a chunk; what stands before them is channel -1."""
    copy.seek(chunk.at)
    _, length = records.PREFIX.unpack(copy.read(records.PREFIX.size))
    head = records.parse_chunk_head(copy.read(_HEAD_BYTES - records.PREFIX.size), length)
    begin = chunk.at + records.PREFIX.size + head.data_at
    copy.seek(chunk.end)
    found = [(begin, -1)]
    for opcode, content in _records(copy.read(chunk.index_end - chunk.end)):
        if opcode == Opcode.MESSAGE_INDEX:
            (channel,) = records.NUMBER.unpack_from(content)
            found += [(begin + offset, channel) for _, offset in struct.iter_unpack("<QQ", content[6:])]
    found.sort()
    end = begin + head.data_size
    if end > chunk.end or found[-1][0] > end:
        raise Damage("a message index that points out of its chunk")
    for (first, channel), (following, _) in zip(found, [*found[1:], (end, -1)], strict=True):
        yield first, following, channel
