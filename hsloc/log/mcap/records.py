"""MCAP records, parsed with a limit on everything a file may claim.

The library's readers stop at the first damage, and trust sizes that a file states; see
https://mcap.dev/spec for the layout. Every function raises `Damage` and nothing else.
"""

from __future__ import annotations

import zlib
from enum import IntEnum
from struct import Struct
from struct import error as StructError
from typing import NamedTuple

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"

MAX_CHUNK_BYTES = 256 << 20
"""Largest chunk, compressed or not, that is taken into memory. Recorders write 1 to 16 MB."""
MAX_RECORD_BYTES = 1 << 20
"""Largest header, schema, channel or metadata record."""


class Opcode(IntEnum):
    """Kinds of records."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    METADATA = 0x0C
    DATA_END = 0x0F


class Damage(Exception):
    """A record that cannot be read. Internal: the container counts it."""


class UnknownCompression(Damage):
    """A chunk compressed in a way that is not in the specification."""


PREFIX = Struct("<BQ")
"""Opcode and length of what follows."""
MESSAGE = Struct("<BQHIQQ")
"""Prefix, channel, sequence, log time, publish time: what stands before a message's payload."""
MESSAGE_HEAD = Struct("<BQH4xQ8x")
"""The same without sequence and publish time."""
MESSAGE_FIELDS = MESSAGE.size - PREFIX.size
_CHUNK = Struct("<QQQII")
NUMBER = Struct("<H")
"""The number that schemas, channels and message indexes start with."""
_U32 = Struct("<I")
_U64 = Struct("<Q")


class ChunkHead(NamedTuple):
    """What a chunk says about itself; `data_at` and `data_size` are relative to the record's content."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_at: int
    data_size: int


class Schema(NamedTuple):
    """A schema record."""

    id: int
    name: str
    encoding: str
    data: bytes


class ChannelRecord(NamedTuple):
    """A channel record."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


class _Cursor:
    """Reads fields one after the other; `Damage` where they do not fit."""

    def __init__(self, data: bytes | memoryview) -> None:
        self.data = data
        self.at = 0

    def number(self, layout: Struct) -> int:
        try:
            (value,) = layout.unpack_from(self.data, self.at)
        except StructError as error:
            raise Damage("record too short") from error
        self.at += layout.size
        return int(value)

    def raw(self, length: int) -> bytes:
        end = self.at + length
        if end > len(self.data):
            raise Damage("a length inside a record is larger than the record")
        value = bytes(self.data[self.at : end])
        self.at = end
        return value

    def text(self) -> str:
        try:
            return self.raw(self.number(_U32)).decode()
        except UnicodeDecodeError as error:
            raise Damage("a name is not UTF-8") from error

    def strings(self) -> dict[str, str]:
        end = self.number(_U32) + self.at
        values = {}
        while self.at < end:
            key = self.text()
            values[key] = self.text()
        return values


def parse_header(content: bytes) -> tuple[str, str]:
    """(profile, library)."""
    cursor = _Cursor(content)
    return cursor.text(), cursor.text()


def parse_schema(content: bytes | memoryview) -> Schema:
    """A schema record's content."""
    cursor = _Cursor(content)
    number, name, encoding = cursor.number(NUMBER), cursor.text(), cursor.text()
    return Schema(number, name, encoding, cursor.raw(cursor.number(_U32)))


def parse_channel(content: bytes | memoryview) -> ChannelRecord:
    """A channel record's content."""
    cursor = _Cursor(content)
    number, schema = cursor.number(NUMBER), cursor.number(NUMBER)
    return ChannelRecord(number, schema, cursor.text(), cursor.text(), cursor.strings())


def parse_metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """(name, values)."""
    cursor = _Cursor(content)
    return cursor.text(), cursor.strings()


def parse_chunk_head(content: bytes, record_length: int) -> ChunkHead:
    """The head of a chunk from the first bytes of its content."""
    try:
        start, end, size, crc, name_size = _CHUNK.unpack_from(content)
    except StructError as error:
        raise Damage("chunk record too short") from error
    cursor = _Cursor(content)
    cursor.at = _CHUNK.size
    if name_size > 64:
        raise Damage(f"the name of a compression claims {name_size} bytes")
    try:
        compression = cursor.raw(name_size).decode()
    except UnicodeDecodeError as error:
        raise Damage("the name of a compression is not UTF-8") from error
    data_size = cursor.number(_U64)
    if cursor.at + data_size > record_length:
        raise Damage("chunk data are larger than their record")
    return ChunkHead(start, end, size, crc, compression, cursor.at, data_size)


def parse_footer(content: bytes) -> int:
    """Where the summary starts; 0 for none."""
    return _Cursor(content).number(_U64)


def decompress(head: ChunkHead, data: bytes) -> bytes:
    """The records of a chunk, never more than it claims and never more than MAX_CHUNK_BYTES; CRC checked."""
    if head.size > MAX_CHUNK_BYTES:
        raise Damage(f"chunk claims {head.size} bytes, at most {MAX_CHUNK_BYTES} are read")
    if head.compression == "zstd":
        records = _unzstd(data, head.size)
    elif head.compression == "lz4":
        records = _unlz4(data, head.size)
    elif head.compression == "":
        records = data
    else:
        raise UnknownCompression(head.compression)
    if len(records) != head.size:
        raise Damage(f"chunk holds {len(records)} bytes, claims {head.size}")
    if head.crc and zlib.crc32(records) != head.crc:
        raise Damage("chunk checksum does not match")
    return records


_MAX_WINDOW = 1 << 27
"""Maximum window of zstd (bytes). Internal: guards the memory against a hostile file."""


def _unzstd(data: bytes, size: int) -> bytes:
    try:
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
        stated = zstandard.frame_content_size(data)
        # The library allocates what the *frame* states, so that has to be believed first.
        if stated == size:
            records = decompressor.decompress(data, max_output_size=max(size, 1))
            if len(records) == size:
                return records
        with decompressor.stream_reader(data, read_across_frames=True) as stream:
            return stream.read(size + 1)
    except (zstandard.ZstdError, MemoryError, ValueError) as error:
        raise Damage(f"zstd: {error}") from error


def _unlz4(data: bytes, size: int) -> bytes:
    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (RuntimeError, EOFError, MemoryError, ValueError) as error:
        raise Damage(f"lz4: {error}") from error
