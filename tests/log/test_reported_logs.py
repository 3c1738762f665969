"""Kinds of logs from public reports that were misread or refused: files and encodings."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import shutil
import sqlite3
import tarfile
import zipfile
from typing import TYPE_CHECKING, Any

import log_formats
import lz4.frame
import numpy as np
import pytest
import zstandard
from log_builders import describe, scan_payloads, write_raw

from hsloc.errors import LogError, LogFormatError, TopicError
from hsloc.log import ReadOptions, open_log
from hsloc.log.messages import definitions

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def expected(plain: Path) -> list[tuple[str, int, float]]:
    return events_of(plain)


@pytest.fixture(scope="module")
def bag(plain: Path) -> Path:
    return log_formats.bag1(plain, plain.with_name("run.bag"))


def events_of(path: Path | list[Path], **options: Any) -> list[tuple[str, int, float]]:
    log = open_log(path, ReadOptions(**options))
    found = [describe(event) for event in log.events()]
    assert not log.losses.data_lost, log.losses.lines()
    return found


# Files.


@pytest.mark.parametrize(
    "name", ["x.bag.active", "X.BAG", "x.bag.1", "noext", "x.db3", "run #3.mcap", "a%20?b.txt", "\udcfc.db3"]
)
@pytest.mark.parametrize("which", ["bag", "db3", "plain"])
def test_the_kind_of_a_file_is_what_it_holds(
    request: pytest.FixtureRequest, tmp_path: Path, expected: list[Any], which: str, name: str
) -> None:
    target = tmp_path / "folder #1 %41" / name
    target.parent.mkdir()
    shutil.copy(request.getfixturevalue(which), target)
    assert events_of(target) == expected
    assert open_log(target).summary.paths == (target,)


def _zip(source: Path, target: Path) -> None:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(source, f"bag/{source.name}")
        archive.writestr("bag/metadata.yaml", "rosbag2_bagfile_information: {}")


def _tar(source: Path, target: Path) -> None:
    with tarfile.open(target, "w:gz") as archive:
        archive.add(source, f"bag/{source.name}")


def _with(*compress: Callable[[bytes], bytes]) -> Callable[[Path, Path], None]:
    def pack(source: Path, target: Path) -> None:
        data = source.read_bytes()
        for each in compress:
            data = each(data)
        target.write_bytes(data)

    return pack


_SKIPPED = b"\x50\x2a\x4d\x18\x04\0\0\0size"
"""A frame that decompressors skip: pzstd begins with one, and goes on with several that count."""
_gzip, _zstd = _with(gzip.compress), _with(zstandard.compress)


@pytest.mark.parametrize(
    ("pack", "ending"),
    [
        *((_gzip, ".gz"), (_zstd, ".zstd"), (_zstd, ""), (_zip, ".zip"), (_tar, ".tgz")),
        *((_with(bz2.compress), ".bz2"), (_with(lzma.compress), ".xz"), (_with(lz4.frame.compress), ".lz4")),
        (_with(gzip.compress, gzip.compress), ".gz.gz"),
        (_with(lambda data: _SKIPPED + zstandard.compress(data[:99]) + zstandard.compress(data[99:])), ".zst"),
    ],
)
@pytest.mark.parametrize("which", ["bag", "db3", "plain"])
def test_packed_logs_are_unpacked(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    expected: list[Any],
    which: str,
    pack: Callable[[Path, Path], None],
    ending: str,
) -> None:
    source: Path = request.getfixturevalue(which)
    target = tmp_path / f"{source.name}{ending}"
    pack(source, target)
    log = open_log(target)
    assert [describe(event) for event in log.events()] == expected
    assert log.summary.paths == (target,)
    assert len(log.sha256()) == 64


def test_a_folder_of_packed_files_is_a_recording(tmp_path: Path, db3: Path, expected: list[Any]) -> None:
    _zstd(db3, tmp_path / "bag_0.db3.zstd")
    assert events_of(tmp_path) == expected
    shutil.copy(db3, tmp_path / "bag_0.db3")
    assert events_of(tmp_path) == expected, "a part that is there packed and unpacked is one part"


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("x.7z", b"7z\xbc\xaf\x27\x1c\0", "packed by 7z, which is not read; unpack it first"),
        ("x.db3-wal", b"\x37\x7f\x06\x82\0", "name the database, x.db3"),
        ("x.db3", b"", "is empty; its write-ahead log beside it"),
    ],
)
def test_files_that_are_no_logs_are_reported_as_what_they_are(
    tmp_path: Path, name: str, data: bytes, reason: str
) -> None:
    (tmp_path / "x.db3-wal").write_bytes(b"")
    (tmp_path / name).write_bytes(data)
    with pytest.raises(LogFormatError, match=reason):
        open_log(tmp_path / name)


def test_a_folder_is_searched_by_content_packed_or_not(tmp_path: Path, plain: Path, expected: list[Any]) -> None:
    (tmp_path / "recording.xz").write_bytes(lzma.compress(plain.read_bytes()))
    assert events_of(tmp_path) == expected
    (tmp_path / "recording.xz").unlink()
    (tmp_path / "live.db3-wal").write_bytes(b"\x37\x7f\x06\x82\0")
    with pytest.raises(LogFormatError, match="copy both"):
        open_log(tmp_path)


def test_damaged_packing_is_one_line(tmp_path: Path, plain: Path) -> None:
    packed = ((_gzip, "a.mcap.gz"), (_zstd, "a.mcap.zst"), (_zip, "a.zip"), (_with(bz2.compress), "a.bz2"))
    for pack, name in (*packed, (_with(lzma.compress), "a.xz"), (_with(lz4.frame.compress), "a.lz4")):
        pack(plain, tmp_path / name)
        data = bytearray((tmp_path / name).read_bytes())
        noise = np.random.default_rng(0).bytes(len(data) // 2 - 300)
        for damaged in (data[: len(data) // 2], data[:300] + noise + data[-len(data) // 2 :]):
            (tmp_path / name).write_bytes(damaged)
            try:
                log = open_log(tmp_path / name, ReadOptions(require_scan=False, require_odometry=False))
                lines = [reason for reason in log.losses.reasons if "as far as it goes" in reason]
            except (LogFormatError, LogError) as error:
                lines = [str(error)]
            assert len(lines) == 1
            assert f"{name}: " in lines[0]
            assert "\n" not in lines[0]
    (tmp_path / "deep.gz").write_bytes(gzip.compress(gzip.compress(gzip.compress(gzip.compress(plain.read_bytes())))))
    with pytest.raises(LogFormatError, match="packed more than 3 times"):
        open_log(tmp_path / "deep.gz")


def test_messages_compressed_one_by_one_are_read(tmp_path: Path, plain: Path, expected: list[Any]) -> None:
    (named,) = log_formats.bag2(plain, tmp_path / "bag", "MESSAGE").glob("*.db3*")
    assert events_of(tmp_path / "bag") == expected
    assert events_of(named) == expected
    items = [
        (s, c, t, (zstandard.compress, lz4.frame.compress, gzip.compress)[n % 3](data))
        for n, (s, c, t, data) in enumerate(log_formats.messages(plain))
    ]
    assert events_of(log_formats.write(tmp_path / "messages.mcap", items)) == expected


def test_the_write_ahead_log_of_a_database_is_read_and_nothing_beside_it_changes(
    tmp_path: Path, db3: Path, expected: list[Any]
) -> None:
    live = tmp_path / "live.db3"
    with sqlite3.connect(db3) as source, sqlite3.connect(live) as target:
        source.backup(target)
        target.execute("PRAGMA journal_mode = WAL")
        target.execute("PRAGMA wal_autocheckpoint = 0")
        rows = target.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
        target.execute("DELETE FROM messages WHERE id > ?", (len(rows) // 2,))
        target.commit()
        target.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        target.executemany(
            "INSERT INTO messages (id, topic_id, timestamp, data) VALUES (?, ?, ?, ?)", rows[len(rows) // 2 :]
        )
        target.commit()
        copied = tmp_path / "copied"
        copied.mkdir()
        for name in ("live.db3", "live.db3-wal"):
            shutil.copy(tmp_path / name, copied / name)
    before = {path.name: path.read_bytes() for path in copied.iterdir()}
    assert events_of(copied / "live.db3") == expected
    assert events_of(copied) == expected
    assert {path.name: path.read_bytes() for path in copied.iterdir()} == before
    # Cut within its last frame, within the head of a frame, and to less than its own head.
    whole = (copied / "live.db3-wal").read_bytes()
    page = int.from_bytes(whole[8:12], "big")
    for cut in (whole[:-1], whole[: 32 + 3 * (24 + page)], whole[: 32 + 3 * (24 + page) + 7], whole[:20]):
        (copied / "live.db3-wal").write_bytes(cut)
        log = open_log(copied / "live.db3")
        assert 0 < len(list(log.events())) < len(expected)
        assert log.losses.truncated_files == 1
        assert "ends within a transaction" in log.losses.reasons[0]
    # Frames of before the log was begun anew are in the database, and no loss.
    stale = bytes(each ^ 0xFF for each in whole[16:24])
    for keep in (2, len(whole) // (24 + page)):
        at = 32 + keep * (24 + page)
        old = whole[at : at + 8] + stale + whole[at + 16 :] if at < len(whole) else b""
        (copied / "live.db3-wal").write_bytes(whole[:at] + old)
        assert open_log(copied / "live.db3").losses.data_lost == (keep == 2)


def test_a_transaction_that_was_cut_off_is_rolled_back(tmp_path: Path, db3: Path, expected: list[Any]) -> None:
    live, copied = tmp_path / "live.db3", tmp_path / "copied.db3"
    shutil.copy(db3, live)
    connection = sqlite3.connect(live, isolation_level=None)
    connection.execute("PRAGMA cache_size = 1")
    connection.execute("BEGIN")
    connection.execute("UPDATE messages SET timestamp = 7, data = zeroblob(3000)")
    shutil.copy(live, copied)
    shutil.copy(f"{live}-journal", f"{copied}-journal")
    connection.close()
    assert copied.read_bytes() != db3.read_bytes()
    log = open_log(copied)
    assert [describe(event) for event in log.events()] == expected
    assert "rolled back by the journal" in log.losses.reasons[0]


# Encodings.


@pytest.mark.parametrize(
    "text",
    ["sensor_msgs/msg/LaserScan", "LaserScan", "main", "# nothing", "MSG: LaserScan", "not available }{", "\0"],
)
def test_an_incomplete_definition_of_a_standard_type_is_replaced_and_named(tmp_path: Path, text: str) -> None:
    full = definitions.definition_text(definitions.LASER_SCAN)
    schema = (definitions.LASER_SCAN, "ros2msg", (full.partition("=" * 80)[0] if text == "main" else text).encode())
    log = open_log(write_raw(tmp_path / "a.mcap", scan_payloads(5), schema=schema), ReadOptions(require_odometry=False))
    assert len(list(log.events())) == 5
    assert any("/scan" in str(warning) and "incomplete" in str(warning) for warning in log.summary.warnings)


@pytest.mark.parametrize(
    "name",
    [
        "sensor_msgs::msg::dds_::LaserScan_",
        "sensor_msgs/msg/dds_/LaserScan_",
        "sensor_msgs::msg::LaserScan",
        "sensor_msgs.msg.LaserScan",
        "LaserScan",
    ],
)
@pytest.mark.parametrize(("form", "encoding"), [("ros2msg", "cdr"), ("ros2idl", "CDR"), ("anything", "xcdr2")])
def test_types_and_encodings_are_known_by_any_usual_name(tmp_path: Path, name: str, form: str, encoding: str) -> None:
    text = definitions.definition_text(definitions.LASER_SCAN).encode()
    path = write_raw(tmp_path / "a.mcap", scan_payloads(5), schema=(name, form, text), encoding=encoding)
    assert len(list(open_log(path, ReadOptions(require_odometry=False)).events())) == 5


def test_the_number_of_a_header_of_ros_1_may_be_in_the_definition_alone(tmp_path: Path) -> None:
    text = definitions.definition_text(definitions.LASER_SCAN)
    text = text.replace("MSG: std_msgs/Header\n", "MSG: std_msgs/Header\nuint32 seq\n")
    path = write_raw(tmp_path / "a.mcap", scan_payloads(5), schema=(definitions.LASER_SCAN, "ros2msg", text.encode()))
    assert len(list(open_log(path, ReadOptions(require_odometry=False)).events())) == 5


def test_an_encoding_that_is_not_read_is_named(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.mcap", scan_payloads(5), encoding="cbor")
    with pytest.raises(TopicError, match=r"encoded as cbor.*convert them as cdr"):
        open_log(path)


def test_a_definition_that_contradicts_the_standard_one_is_not_replaced(tmp_path: Path) -> None:
    schema = (definitions.LASER_SCAN, "ros2msg", b"std_msgs/Header header\nfloat32 other\n")
    with pytest.raises(LogFormatError, match="cannot be used"):
        open_log(write_raw(tmp_path / "a.mcap", scan_payloads(5), schema=schema), ReadOptions(require_odometry=False))


@pytest.mark.parametrize("layout", [4, 8])
def test_xcdr2_is_read_whether_it_is_laid_out_so_or_only_labelled(
    tmp_path: Path, plain: Path, expected: list[Any], layout: int
) -> None:
    items = []
    for schema, channel, log_time, data in log_formats.messages(plain):
        payload = _aligned_to_four(schema.name, data) if layout == 4 else data
        items.append((schema, channel, log_time, b"\x00\x07\x00\x00" + payload[4:]))
    assert events_of(log_formats.write(tmp_path / "xcdr2.mcap", items)) == expected


def _aligned_to_four(typename: str, data: bytes) -> bytes:
    """The message with its doubles aligned to four bytes: the padding before the first double is left out."""
    if typename == definitions.LASER_SCAN:
        return data
    tail = {definitions.ODOMETRY: 680, definitions.TF_MESSAGE: 56}[typename]
    head = data[:-tail]
    return head[:-4] + data[-tail:] if head.endswith(b"\0" * 4) and _padded(head) else data


def _padded(head: bytes) -> bool:
    """Whether four of the zeros that end a head are padding: the string before ends with one zero."""
    return len(head.rstrip(b"\0")) + 1 <= len(head) - 4


@pytest.mark.parametrize(("identifier", "name"), [(b"\x00\x03", "PL_CDR"), (b"\x00\x09", "delimited XCDR2")])
def test_encodings_that_are_not_read_are_named(tmp_path: Path, identifier: bytes, name: str) -> None:
    messages = [(topic, time, identifier + data[2:]) for topic, time, data in scan_payloads(5)]
    log = open_log(write_raw(tmp_path / "a.mcap", messages), ReadOptions(require_odometry=False, require_scan=False))
    assert list(log.events()) == []
    assert name in " ".join(log.losses.reasons)


def _camel(value: Any) -> Any:
    """With names as JavaScript has them, times in nanoseconds, and arrays of numbers as objects."""
    if isinstance(value, list):
        numbers = value and isinstance(value[0], float)
        return {str(k): item for k, item in enumerate(value)} if numbers else [_camel(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"sec", "nanosec"}:
        return value["sec"] * SECOND + value["nanosec"]
    first = {key: key.partition("_") for key in value}
    return {head + rest.title().replace("_", ""): _camel(value[key]) for key, (head, _, rest) in first.items()}


@pytest.mark.parametrize(
    "written",
    [
        lambda message: json.dumps(message).encode(),
        lambda message: json.dumps(_camel(message)).encode() + b"\0",
        lambda message: json.dumps({"topic": "/x", "type": "y", "msg": message}).encode(),
    ],
)
@pytest.mark.parametrize("encoding", ["json", "application/json", "cdr"])
def test_ros_messages_as_json_are_read(
    tmp_path: Path, plain: Path, expected: list[Any], written: Callable[[Any], bytes], encoding: str
) -> None:
    items = []
    for schema, channel, log_time, data in log_formats.messages(plain):
        message = log_formats.ROS2.deserialize_cdr(data, schema.name)
        schema.encoding, schema.data, channel.message_encoding = "jsonschema", b"", encoding
        items.append((schema, channel, log_time, written(_plain(message))))
    assert events_of(log_formats.write(tmp_path / "json.mcap", items)) == expected


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [None if not np.isfinite(item) else float(item) for item in value]
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    return value


# Transforms.
