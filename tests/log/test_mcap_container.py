"""MCAP in spite of damage: what is whole is read, what is not is counted, nothing is lost in silence."""

from __future__ import annotations

import json
import struct
import zlib
from typing import TYPE_CHECKING

import lz4.frame
import pytest
import zstandard
from log_builders import SECOND, START, chunk_data_at, chunks_of, flipped, scan_payloads, write_raw, write_run
from mcap.writer import CompressionType, IndexType
from memory import at_most_bytes
from paths import DATA

from hsloc.errors import LogFormatError
from hsloc.log.mcap.container import McapContainer
from hsloc.log.mcap.records import MAGIC
from hsloc.log.summary import Losses

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

COUNT = 200


def read(path: Path) -> tuple[list[int], Losses]:
    """Log times of all messages, and all losses."""
    container = McapContainer(path)
    losses = container.losses_at_opening.copy()
    return [message[0] for message in container.messages(container.channels, losses)], losses


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    return write_raw(tmp_path / "log.mcap", scan_payloads(COUNT))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"repeat_channels": False, "repeat_schemas": False},
        {"repeat_channels": False, "use_chunking": False, "use_statistics": False},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_schemas": False},
        {"enable_crcs": False},
        {"profile": ""},
        {"chunk_size": 10_000_000},
    ],
    ids=str,
)
def test_every_shape_of_a_whole_file(tmp_path: Path, options: dict[str, object]) -> None:
    path = write_raw(tmp_path / "log.mcap", scan_payloads(COUNT), **options)  # type: ignore[arg-type]
    times, losses = read(path)
    assert times == [START + n * SECOND // 10 for n in range(COUNT)]
    assert losses == Losses()
    (statistics,) = McapContainer(path).statistics.values()
    assert (statistics.count, statistics.first_ns, statistics.last_ns) == (COUNT, times[0], times[-1])
    assert statistics.largest_gap_ns == SECOND // 10


def test_a_file_cut_in_the_middle_of_a_chunk(whole: Path) -> None:
    data = whole.read_bytes()
    chunk = chunks_of(data)[10]
    whole.write_bytes(data[: chunk[0] + chunk[1] // 2])
    times, losses = read(whole)
    assert 0 < len(times) < COUNT
    assert losses.truncated_files == 1
    assert losses.bytes_lost == chunk[1] // 2
    assert losses.data_lost


@pytest.mark.parametrize("cut", [1, 20, 100])
def test_a_file_that_was_never_closed_loses_no_message(whole: Path, cut: int) -> None:
    whole.write_bytes(whole.read_bytes()[:-cut])
    times, losses = read(whole)
    # The closing magic alone may be missing: by then the footer was read.
    assert (len(times), losses.truncated_files) == (COUNT, 0 if cut == 1 else 1)


def test_a_killed_recorder_leaves_chunks_without_index_behind_the_last(whole: Path) -> None:
    data = whole.read_bytes()
    at, length = chunks_of(data)[12]
    whole.write_bytes(data[: at + length])
    times, losses = read(whole)
    per_chunk = COUNT / len(chunks_of(data))
    assert len(times) == pytest.approx(13 * per_chunk, abs=per_chunk)
    assert (losses.truncated_files, losses.damaged_chunks) == (1, 0)


def test_a_cut_between_the_indexes_of_a_chunk_loses_none_of_its_channels(tmp_path: Path) -> None:
    payloads = sorted(scan_payloads(20, "/front") + scan_payloads(20, "/rear"), key=lambda payload: payload[1])
    path = write_raw(tmp_path / "log.mcap", payloads, chunk_size=10_000_000)
    data = path.read_bytes()
    ((at, length),) = chunks_of(data)
    (first_index,) = struct.unpack_from("<Q", data, at + length + 1)
    for cut in range(at + length, at + length + 9 + first_index + 40):
        path.write_bytes(data[:cut])
        times, losses = read(path)
        assert (len(times), losses.truncated_files) == (40, 1), cut


@pytest.mark.parametrize("compression", list(CompressionType))
def test_one_damaged_chunk_is_skipped_and_counted(tmp_path: Path, compression: CompressionType) -> None:
    path = write_raw(tmp_path / "log.mcap", scan_payloads(COUNT), compression=compression)
    data = path.read_bytes()
    chunk = chunks_of(data)[3]
    path.write_bytes(flipped(data, chunk_data_at(data, chunk) + 60))
    times, losses = read(path)
    assert COUNT - 20 < len(times) < COUNT
    assert times == sorted(times)
    assert losses.damaged_chunks == 1
    assert str(chunk_data_at(data, chunk)) in losses.reasons[0]
    assert str(path) in losses.reasons[0]


def test_a_wrong_checksum_alone_is_damage(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "log.mcap", scan_payloads(COUNT))
    data = path.read_bytes()
    path.write_bytes(flipped(data, chunks_of(data)[3][0] + 9 + 24))
    times, losses = read(path)
    assert len(times) < COUNT
    assert losses.damaged_chunks == 1
    assert "checksum" in losses.reasons[0]


def test_unknown_compression_is_named(whole: Path) -> None:
    data = whole.read_bytes().replace(b"zstd", b"zst9")
    whole.write_bytes(data)
    times, losses = read(whole)
    assert times == []
    assert losses.unknown_compression == {"zst9": len(chunks_of(data))}
    assert losses.data_lost


def test_a_damaged_length_costs_one_chunk_if_the_summary_stands(whole: Path) -> None:
    data = whole.read_bytes()
    chunk = chunks_of(data)[5]
    whole.write_bytes(flipped(data, chunk[0] + 1 + 6))
    times, losses = read(whole)
    assert COUNT - 20 < len(times) < COUNT
    assert losses.damaged_chunks == 1
    assert losses.truncated_files == 0
    assert losses.bytes_lost >= chunk[1]
    assert "reading goes on at byte" in losses.reasons[0]


def test_a_channel_may_be_repeated_in_the_summary_without_its_schema(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "log.mcap", scan_payloads(COUNT), repeat_schemas=False)
    (channel,) = McapContainer(path).channels.values()
    assert channel.typename == "sensor_msgs/msg/LaserScan"
    assert channel.schema


def test_a_broken_message_index_costs_nothing(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "log.mcap", scan_payloads(COUNT), chunk_size=100_000)
    data = path.read_bytes()
    at = sum(chunks_of(data)[0])
    assert data[at] == 0x07
    (length,) = struct.unpack_from("<Q", data, at + 1)
    # One entry less than its count: an odd size.
    broken = (
        data[: at + 1] + struct.pack("<Q", length - 8) + data[at + 9 : at + 9 + length - 8] + data[at + 9 + length :]
    )
    path.write_bytes(broken)
    times, _ = read(path)
    assert len(times) == COUNT
    assert McapContainer(path).statistics[1].count == COUNT


def test_out_of_order_and_overlapping_chunks_are_merged_exactly(tmp_path: Path) -> None:
    # All of /b after all of /a, as converters of data sets write; and pairs swapped inside.
    first, second = scan_payloads(COUNT, "/a"), scan_payloads(COUNT, "/b")
    for number in range(0, COUNT, 2):
        first[number : number + 2] = reversed(first[number : number + 2])
    for options in ({}, {"use_chunking": False}, {"index_types": IndexType.NONE}):
        path = write_raw(tmp_path / "log.mcap", first + second, **options)
        times, losses = read(path)
        assert times == sorted(times)
        assert (len(times), losses.late_messages) == (2 * COUNT, 0)


@pytest.mark.parametrize("few", [0, 5])
def test_much_that_overlaps_goes_through_a_heap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, few: int) -> None:
    monkeypatch.setattr("hsloc.log.mcap.container._FEW", few)
    first, second = scan_payloads(COUNT, "/a"), scan_payloads(COUNT, "/b")
    mixed = [message for pair in zip(first, reversed(second), strict=True) for message in pair]
    times, losses = read(write_raw(tmp_path / "log.mcap", mixed))
    assert times == sorted(times)
    assert (len(times), losses.late_messages) == (2 * COUNT, 0)


def test_what_is_held_back_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hsloc.log.mcap.container.MAX_HELD_BYTES", 1000)
    first, second = scan_payloads(COUNT, "/a"), scan_payloads(COUNT, "/b")
    mixed = [message for pair in zip(first, reversed(second), strict=True) for message in pair]
    times, losses = read(write_raw(tmp_path / "log.mcap", mixed))
    assert sorted(times) == sorted([time for _, time, _ in mixed])
    assert losses.late_messages > 0


def test_a_chunk_that_lies_about_its_times_gives_late_messages(whole: Path) -> None:
    data = bytearray(whole.read_bytes())
    struct.pack_into("<Q", data, chunks_of(bytes(data))[2][0] + 9, START + 1000 * SECOND)
    whole.write_bytes(data)
    times, losses = read(whole)
    assert len(times) == COUNT
    assert 0 < losses.late_messages < 20


def test_only_chunks_with_selected_channels_are_unpacked(tmp_path: Path) -> None:
    path = write_run(tmp_path / "log.mcap", scans=400)
    data = path.read_bytes()
    container = McapContainer(path)
    static = next(c.id for c in container.channels.values() if c.topic == "/tf_static")
    # Everything but the first chunk is garbage now, which does not matter to a reader of /tf_static.
    for chunk in chunks_of(data)[1:]:
        data = flipped(data, chunk_data_at(data, chunk) + 20)
    path.write_bytes(data)
    losses = Losses()
    assert len(list(McapContainer(path).messages([static], losses))) == 1
    assert losses == Losses()
    assert McapContainer(path).verify().damaged_chunks == len(chunks_of(data)) - 1


# Files made to hurt


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


HEADER = MAGIC + record(0x01, text("ros2") + text("x"))


def chunk(data: bytes, size: int, compression: str, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 0, size, crc) + text(compression) + struct.pack("<Q", len(data))
    return record(0x06, head + data)


def zstd_bomb(size: int, stated: bool) -> bytes:
    compressor = zstandard.ZstdCompressor(level=3, write_content_size=stated).compressobj(size if stated else -1)
    block = bytes(1 << 20)
    parts = [compressor.compress(block) for _ in range(size >> 20)]
    return b"".join(parts) + compressor.flush()


BIG = 600 << 20


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        # Made when they are needed: every process of pytest collects these.
        (lambda: chunk(zstd_bomb(BIG, stated=True), BIG, "zstd"), "claims"),
        (lambda: chunk(zstd_bomb(BIG, stated=True), 1000, "zstd"), "holds 1001"),
        (lambda: chunk(zstd_bomb(BIG, stated=False), 1000, "zstd"), "holds 1001"),
        (chunk(lz4.frame.compress(bytes(64 << 20)), 1000, "lz4"), "holds 1001"),
        (chunk(b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 40) + b"\0\0\0", 1 << 40, "zstd"), "claims"),
        (chunk(b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 40) + b"\0\0\0", 100, "zstd"), "zstd"),
        (chunk(b"abc", 1 << 62, ""), "claims"),
        (record(0x06, bytes(28) + b"\xff" * 52), "compression claims"),
        (record(0x03, b"\x01\x00" + struct.pack("<I", 1 << 31)), "larger than the record"),
        (record(0x04, struct.pack("<HH", 1, 0) + struct.pack("<I", 4) + b"\xff\xfe\xfd\xfc" + text("")), "UTF-8"),
        (record(0x05, b"short"), "too short"),
    ],
    ids=range(11),
)
def test_bombs_and_absurd_lengths_are_refused_without_work(
    tmp_path: Path, content: bytes | Callable[[], bytes], reason: str
) -> None:
    path = tmp_path / "log.mcap"
    content = content if isinstance(content, bytes) else content()
    path.write_bytes(HEADER + content + record(0x0F, bytes(4)) + record(0x02, bytes(20)) + MAGIC)
    with at_most_bytes(1 << 20):
        container = McapContainer(path)
        losses = container.losses_at_opening.copy()
        assert list(container.messages(range(100), losses)) == []
    assert losses.damaged_chunks == 1
    assert reason in losses.reasons[0]


def test_a_record_length_beyond_the_file_ends_it(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(HEADER + record(0x05, b"", length=1 << 62))
    times, losses = read(path)
    assert (times, losses.truncated_files) == ([], 1)


def test_many_chunks_that_unpack_to_too_much_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hsloc.log.mcap.container.FREE_UNPACKED_BYTES", 10 << 20)
    filler = record(0x80, bytes((1 << 20) - 9))
    data = zstandard.compress(filler)
    path = tmp_path / "log.mcap"
    path.write_bytes(HEADER + chunk(data, 1 << 20, "zstd", zlib.crc32(filler)) * 50)
    container = McapContainer(path)
    losses = Losses()
    assert list(container.messages([1], losses)) == []
    assert losses.damaged_chunks == 40
    assert "times its size" in losses.reasons[0]


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"hello, world\n", bytes(1000)])
def test_what_is_no_mcap_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(LogFormatError, match=r"log\.mcap: is (empty|not an MCAP file)"):
        McapContainer(path)


# The format's own conformance files


@pytest.mark.data
def test_all_conformance_files_hold_what_is_in_their_json() -> None:
    files = sorted((DATA / "mcap-conformance").glob("*/*.mcap"))
    if not files:
        pytest.skip(f"no conformance files in {DATA / 'mcap-conformance'}; set HSLOC_DATA")
    assert len(files) == 416
    for file in files:
        records = [(r["type"], dict(r["fields"])) for r in json.loads(file.with_suffix(".json").read_text())["records"]]
        container = McapContainer(file)
        losses = container.losses_at_opening.copy()
        messages = [(t, c, bytes(d)) for t, _, c, d in container.messages(range(1 << 16), losses)]
        expected = [
            (int(f["log_time"]), int(f["channel_id"]), bytes(map(int, f["data"])))
            for kind, f in records
            if kind == "Message"
        ]
        assert messages == sorted(expected, key=lambda m: m[0]), file.name
        assert losses == Losses(), file.name
        assert sum(s.count for s in container.statistics.values()) == len(expected), file.name
        channels = {int(f["id"]): f for kind, f in records if kind == "Channel"}
        schemas = {f["id"]: f for kind, f in records if kind == "Schema"}
        assert container.channels.keys() == channels.keys(), file.name
        for number, fields in channels.items():
            channel, schema = container.channels[number], schemas.get(fields["schema_id"])
            assert (channel.topic, channel.message_encoding) == (fields["topic"], fields["message_encoding"])
            if schema is not None:
                assert channel.typename == schema["name"]
                assert channel.schema == bytes(map(int, schema["data"]))
                assert channel.schema_encoding == schema["encoding"]
        metadata = {f["name"]: f["metadata"] for kind, f in records if kind == "Metadata"}
        assert container.metadata == metadata, file.name
