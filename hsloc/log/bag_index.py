"""A new index for a ROS 1 bag without one, or with damage (wiki.ros.org/Bags/Format/2.0).

What is whole of it becomes another bag.
"""

from __future__ import annotations

import bz2
import io
import struct
from typing import IO, TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator, Sized
    from io import BufferedReader
    from pathlib import Path

    Connections = dict[bytes, tuple[bytes, bytes]]
    """Header and data of the record of each connection, by its number."""

_BAG_MAGIC, _BAG_HEADER_BYTES = b"#ROSBAG V2.0\n", 4096
_MOST_HEADER, _MOST_CHUNK = 1 << 20, 1 << 28
"""Largest header and chunk (bytes) that are believed: recorders write chunks of 768 kB."""
_PIECE = 1 << 14
"""Packed bytes that are unpacked at once: where they are damaged none of them are read."""
_MESSAGE, _INDEX_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x07"


_OP_CHUNK = b"\x04\x00\x00\x00op=" + _CHUNK
_SEARCHED = 1 << 16
"""Bytes that are searched at once for the next chunk. Internal: time alone."""
_CHUNK_HEADER = 128
"""Largest header of a chunk: it has the fields op, compression and size."""
_MOST_SEARCHES = 100
"""Number of damaged places behind which the next chunk is searched for. Internal: bounds the time."""


class Reindexed(NamedTuple):
    """Number of chunks of a new bag, and of those of the old one that are not whole; whether that had an index."""

    chunks: int
    damaged: int
    had_index: bool


def reindex(source: Path, target: Path) -> Reindexed:
    """Write a bag of the chunks of another, with a new index.

    Of a chunk that was cut, or cannot be unpacked or read to its end, the records before that are kept.
    """
    connections: Connections = {}
    infos: list[bytes] = []
    damaged = 0
    with source.open("rb") as stream, target.open("wb") as out:
        if stream.read(len(_BAG_MAGIC)) != _BAG_MAGIC:
            return Reindexed(0, 0, False)
        out.write(_BAG_MAGIC + b" " * _BAG_HEADER_BYTES)
        had_index = _note_connections(stream, connections)
        for fields, data in _chunks(stream, connections):
            content = _chunk_content(fields, data)
            entries, whole = _chunk_index(content, connections)
            size = int.from_bytes(fields.get(b"size", b""), "little")
            damaged += whole < size or not fields
            if not whole:
                continue
            record = _bag_header(fields), data
            if len(content) != size:
                head = {b"op": _CHUNK, b"compression": b"none", b"size": whole.to_bytes(4, "little")}
                record = _bag_header(head), content[:whole]
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
    return Reindexed(len(infos), damaged, had_index)


def _note_connections(stream: BufferedReader, connections: Connections) -> bool:
    """The connections that stand behind the last chunk, if the bag says where; whether it does.

    Each has another record where it begins, which a damaged chunk may hold.
    """
    begin = stream.tell()
    head = _bag_record(stream)
    if head is not None:
        begin = stream.tell()
        place = int.from_bytes(_bag_fields(head[0]).get(b"index_pos", b""), "little")
        stream.seek(min(place, stream.seek(0, io.SEEK_END)))
        while (record := _bag_record(stream)) is not None:
            fields = _bag_fields(record[0])
            if fields.get(b"op") != _CONNECTION:
                break
            connections.setdefault(fields.get(b"conn", b""), record)
    stream.seek(begin)
    return bool(connections)


def _chunks(stream: BufferedReader, connections: Connections) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Header and data of each chunk; behind what is damaged, from the next header of one on. Connections are noted.

    What is between and no record gives an empty header.
    """
    for _ in range(_MOST_SEARCHES):
        is_sound = True
        while is_sound:
            begin = stream.tell()
            record = _bag_record(stream, may_be_cut=True)
            fields = {} if record is None else _bag_fields(record[0])
            op = fields.get(b"op")
            if record is not None and op == _CHUNK:
                yield fields, record[1]
            elif record is not None and op == _CONNECTION:
                connections.setdefault(fields.get(b"conn", b""), record)
            # A chunk that goes on to the end may state a size that is wrong.
            is_sound = op is not None and not (op == _CHUNK and not stream.peek(1))
        if op is None and begin < stream.seek(0, io.SEEK_END):
            yield {}, b""
        if not _seek_chunk(stream, begin + 1):
            return


def _bag_record(stream: IO[bytes], may_be_cut: bool = False) -> tuple[bytes, bytes] | None:
    """Header and data of the next record; None where it is not whole, but for the data of a chunk that `may_be_cut`."""
    parts = []
    for most in (_MOST_HEADER, _MOST_CHUNK):
        size = int.from_bytes(stream.read(4), "little")
        parts.append(stream.read(size) if size <= most else b"")
        if len(parts[-1]) < size:
            is_chunk = size <= most and len(parts) == 2 and _bag_fields(parts[0]).get(b"op") == _CHUNK
            if not (may_be_cut and is_chunk):
                return None
    return (parts[0], parts[1]) if parts[0] else None


def _seek_chunk(stream: BufferedReader, begin: int) -> bool:
    """Go to the next chunk whose header is whole, from a place on; whether there is one."""
    while True:
        stream.seek(begin)
        piece = stream.read(_SEARCHED + _CHUNK_HEADER)
        if (found := piece.find(_OP_CHUNK, 0)) < 0:
            if len(piece) <= _CHUNK_HEADER:
                return False
            begin += max(len(piece) - _CHUNK_HEADER, 1)
            continue
        for back in range(4, _CHUNK_HEADER):
            at = begin + found - back
            if at < begin:
                break
            stream.seek(at)
            size = int.from_bytes(stream.read(4), "little")
            header = _bag_fields(stream.read(size)) if back - 4 <= size <= _CHUNK_HEADER else {}
            if header.keys() == {b"op", b"compression", b"size"}:
                stream.seek(at)
                return True
        begin += found + 1


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


def _chunk_content(fields: dict[bytes, bytes], data: bytes) -> bytes:
    """What a chunk holds, unpacked as far as that goes."""
    size = int.from_bytes(fields.get(b"size", b""), "little")
    compression = fields.get(b"compression", b"none")
    if size > _MOST_CHUNK or compression not in (b"none", b"bz2", b"lz4"):
        return b""
    if compression == b"none":
        return data[:size]
    unpacker: Any = bz2.BZ2Decompressor()
    if compression == b"lz4":
        import lz4.frame

        unpacker = lz4.frame.LZ4FrameDecompressor()
    found = bytearray()
    try:
        for at in range(0, len(data), _PIECE):
            if unpacker.eof or len(found) >= size:
                break
            found += unpacker.decompress(data[at : at + _PIECE], size - len(found))
    except (OSError, EOFError, RuntimeError, ValueError):
        pass  # what came before it stands
    return bytes(found)


def _chunk_index(content: bytes, connections: Connections) -> tuple[dict[bytes, list[bytes]], int]:
    """Time (8 bytes) and place (4) of each message of a chunk, by connection, and where the first record that is not
    whole begins; connections are noted.
    """
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
    return found, at
