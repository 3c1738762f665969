"""Damaged and odd logs, through the commands: what is recovered, how the loss is named, and the exit code.

Each is made from the first seconds of a fixture recording, in many small chunks. The rows are the cases in which other
readers of MCAP stop with a trace, or lose messages without a word.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import shutil
import sqlite3
from typing import TYPE_CHECKING, Any

import log_formats as formats
import pytest
from log_builders import chunk_data_at, chunks_of, flipped
from mcap.writer import CompressionType, IndexType
from paths import RECORDINGS

from hsloc.cli.main import main

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SCANS = 60


def small(path: Path, source: Path, **options: Any) -> Path:
    """The messages of `source` in chunks of about three scans."""
    return formats.write(path, formats.messages(source), source, **({"chunk_size": 8192} | options))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("damaged")
    return small(folder / "whole.mcap", formats.cut(RECORDINGS / "office.mcap", folder / "cut.mcap", 6.0))


@pytest.fixture(scope="module")
def uncompressed(source: Path) -> Path:
    return small(source.with_name("uncompressed.mcap"), source, compression=CompressionType.NONE)


def middle(data: bytes) -> tuple[int, int]:
    """A chunk that is not the map's."""
    chunks = chunks_of(data)
    return chunks[len(chunks) // 2]


def renamed(data: bytes, chunks: list[tuple[int, int]]) -> bytes:
    """Chunks whose compression has an unknown name."""
    changed = bytearray(data)
    for at, _ in chunks:
        changed[at + 9 + 28 : at + 9 + 36] = b"\x04\x00\x00\x00qbit"
    return bytes(changed)


def bad_crc(data: bytes) -> bytes:
    """A chunk whose checksum alone is wrong."""
    at, _ = middle(data)
    return flipped(data, at + 9 + 24)


DAMAGES: dict[str, tuple[Callable[[bytes], bytes], int, str]] = {
    "cut in a chunk": (lambda d: d[: middle(d)[0] + 100], 25, "1 file ends too early"),
    "cut behind a chunk": (lambda d: d[: sum(middle(d))], 25, "1 file ends too early"),
    "killed recorder": (lambda d: d[: sum(chunks_of(d)[-1])], SCANS, "1 file ends too early"),
    "last 20 bytes missing": (lambda d: d[:-20], SCANS, "1 file ends too early"),
    "wrong checksum": (bad_crc, SCANS - 8, "1 damaged chunk was skipped"),
    "flipped byte, zstd": (
        lambda d: flipped(d, chunk_data_at(d, middle(d)) + 40), SCANS - 8, "1 damaged chunk was skipped",
    ),
    "absurd length": (
        lambda d: d[: middle(d)[0] + 1] + b"\xff" * 8 + d[middle(d)[0] + 9 :], SCANS - 8, "1 damaged chunk was skipped",
    ),
    "unknown compression, one chunk": (
        lambda d: renamed(d, [middle(d)]), SCANS - 8, "chunks in unknown compression 'qbit'",
    ),
}  # fmt: skip
"""What is done to the bytes, how many scans must be recovered at least, and how the loss must be named."""


def run(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str, str]:
    code = main([str(word) for word in argv])
    return code, *capsys.readouterr()


def counts(capsys: pytest.CaptureFixture[str], path: Path) -> tuple[int, dict[str, Any]]:
    code, out, _ = run(capsys, "info", path, "--json")
    return code, json.loads(out)


@pytest.mark.parametrize("name", DAMAGES)
def test_of_a_damaged_log_what_is_whole_is_used_and_the_loss_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path, name: str
) -> None:
    damage, at_least, words = DAMAGES[name]
    path = tmp_path / "run.mcap"
    path.write_bytes(damage(source.read_bytes()))
    code, report = counts(capsys, path)
    assert code == 3
    assert report["data_lost"]
    assert words in " ".join(report["losses"])
    assert at_least <= report["events"]["scan"] <= SCANS
    assert any(str(path) in reason for reason in report["reasons"])
    code, out, err = run(capsys, "replay", path, "--json", "--out", tmp_path / "out")
    assert code == 3
    metrics = json.loads(out)
    assert metrics["scans"]["total"] == report["events"]["scan"]
    assert metrics["losses"]["data_lost"]
    assert words in err
    assert f"hsloc: log: {path}: " in err
    if name.startswith("cut "):
        # The start is at the end of the file. Without it the scans give the right pose, less precisely.
        assert metrics["ape"]["trans_part"]["rmse"] < 0.05
        start = f"2.6,8.1,{math.pi / 2}"
        given = ("--out", tmp_path / "given", "--initial-pose", start)
        code, out, err = run(capsys, "replay", path, "--json", "-q", *given)
        assert code == 3
        assert words in err  # Quiet, but not about a loss.
        assert "warning" not in err
        metrics = json.loads(out)
    assert metrics["ape"]["trans_part"]["rmse"] < 0.02


def test_a_flipped_byte_without_compression_is_found_by_the_checksum(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], uncompressed: Path
) -> None:
    data = uncompressed.read_bytes()
    at, size = middle(data)
    path = tmp_path / "run.mcap"
    path.write_bytes(flipped(data, at + size // 2))
    code, report = counts(capsys, path)
    assert code == 3
    assert SCANS - 8 <= report["events"]["scan"] < SCANS
    assert "1 damaged chunk was skipped" in report["losses"]


def test_a_log_all_of_whose_chunks_are_unreadable_is_an_error_with_its_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path
) -> None:
    data = source.read_bytes()
    path = tmp_path / "run.mcap"
    path.write_bytes(renamed(data, chunks_of(data)))
    code, report = counts(capsys, path)
    assert code == 3
    assert "scan" not in report["events"]
    assert "unknown compression 'qbit'" in " ".join(report["losses"])
    code, out, err = run(capsys, "replay", path, "--out", tmp_path / "out")
    assert (code, out) == (1, "")
    assert "qbit" in err


WHOLE: dict[str, dict[str, Any]] = {
    "no index": {"index_types": IndexType.NONE},
    "no chunks": {"use_chunking": False},
    "no statistics, no offsets": {"use_statistics": False, "use_summary_offsets": False},
    "no checksums": {"enable_crcs": False},
    "LZ4": {"compression": CompressionType.LZ4},
    "empty profile": {"profile": ""},
}


@pytest.mark.parametrize("name", WHOLE)
def test_odd_but_whole_logs_lose_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path, name: str
) -> None:
    code, report = counts(capsys, small(tmp_path / "run.mcap", source, **WHOLE[name]))
    assert (code, report["events"]["scan"], report["losses"]) == (0, SCANS, [])


def test_messages_out_of_order_without_chunks_come_in_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path
) -> None:
    everything = list(formats.messages(source))
    mixed = [everything[n ^ 1] if (n ^ 1) < len(everything) else everything[n] for n in range(len(everything))]
    path = formats.write(tmp_path / "run.mcap", mixed, source, use_chunking=False)
    trajectories = []
    for log in (path, source):
        assert run(capsys, "replay", log, "-q", "--out", tmp_path / log.stem)[0] == 0
        trajectories.append((tmp_path / log.stem / "trajectory.tum").read_bytes())
    assert trajectories[0] == trajectories[1]


def test_strangers_in_the_file_do_no_harm(tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path) -> None:
    everything = list(formats.messages(source))
    schema, channel, log_time, _ = everything[-1]
    for name, form, encoding, definition in (
        ("foxglove.Log", "protobuf", "protobuf", b"\xff((("),
        ("Thing", "jsonschema", "json", b"{"),
        ("my_msgs/msg/Odd", "ros2idl", "cdr", b"module {"),
        ("Flat", "flatbuffer", "flatbuffer", b"\0\1"),
    ):
        stranger = type(schema)(data=definition, encoding=form, id=90, name=name)
        other = type(channel)(id=90, message_encoding=encoding, metadata={}, schema_id=90, topic="/other")
        path = formats.write(tmp_path / "run.mcap", [*everything, (stranger, other, log_time, b"\xff\xfe")], source)
        code, report = counts(capsys, path)
        assert (code, report["events"]["scan"], report["losses"]) == (0, SCANS, []), name


@pytest.mark.parametrize("content", [b"", b"\0" * 4000, b"garbage " * 100, b"\x89PNG\r\n\x1a\n" + b"\0" * 99])
@pytest.mark.parametrize("command", ["info", "check", "replay"])
def test_what_is_no_log_is_one_line_and_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, command: str
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    code, out, err = run(capsys, command, path)
    assert (code, out) == (1, "")
    assert err.startswith(f"hsloc: error: {path}: ")
    assert err.count("\n") == 1


def test_a_log_that_ends_behind_its_first_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    code, report = counts(capsys, path)
    assert (code, report["events"], report["topics"]) == (3, {}, [])
    code, _, err = run(capsys, "replay", path)
    assert code == 1
    assert "the log holds no messages" in err


def test_of_a_log_that_is_cut_off_in_its_first_chunk_is_said_that(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(source.read_bytes()[:300])
    for command in ("replay", "map"):
        code, out, err = run(capsys, command, path)
        assert (code, out) == (1, "")
        assert "1 file ends too early" in err
        assert "copy the file again" in err
        assert err.count("\n") == 1


@pytest.mark.parametrize("kept", [300, 5000])
def test_the_check_of_a_log_without_a_whole_chunk_names_the_loss_and_nothing_that_cannot_help(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kept: int
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(source.read_bytes()[:kept])
    code, out, _ = run(capsys, "check", path)
    assert code == 1
    assert f"bytes were lost; 1 file ends too early (cut off, or never closed) ({path}: ends at byte {kept}" in out
    assert "remedy: copy the file again, if the copy was cut off; else record again: no scan" in out
    assert "no scans (sensor_msgs/msg/LaserScan) in what is left of the log" in out
    assert not re.search("convert|--odom-topic|--no-odom", out)


def test_the_check_of_a_log_that_is_cut_later_offers_a_new_copy_and_what_is_whole(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    data = source.read_bytes()
    path.write_bytes(data[: middle(data)[0] + 100])
    code, out, _ = run(capsys, "check", path)
    assert code == 3
    assert (
        "remedy: copy the file again, if the copy was cut off; else what is whole is used, and `hsloc convert`" in out
    )
    assert "in what is left of the log" not in out


@pytest.fixture(scope="module")
def bag(source: Path) -> Path:
    return formats.bag2(source, source.with_name("bag"))


def copied(bag: Path, target: Path) -> Path:
    shutil.copytree(bag, target)
    return target


def test_the_metadata_of_a_bag_stands_for_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bag: Path
) -> None:
    code, report = counts(capsys, bag / "metadata.yaml")
    assert (code, report["events"]["scan"]) == (0, SCANS)


@pytest.mark.parametrize("text", ["RIHS01_" + "0" * 64, ""])
def test_a_wrong_type_hash_in_the_metadata_does_not_matter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bag: Path, text: str
) -> None:
    folder = copied(bag, tmp_path / "bag")
    metadata = folder / "metadata.yaml"
    metadata.write_text(re.sub(r"RIHS01_[0-9a-f]{64}", text, metadata.read_text()))
    code, report = counts(capsys, folder)
    assert (code, report["events"]["scan"]) == (0, SCANS)


@pytest.mark.parametrize("damage", ["missing", "rubbish", "cut"])
def test_a_folder_whose_metadata_is_of_no_use_is_read_by_its_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bag: Path, damage: str
) -> None:
    metadata = copied(bag, tmp_path / "bag") / "metadata.yaml"
    if damage == "missing":
        metadata.unlink()
    else:
        metadata.write_text("{" if damage == "rubbish" else metadata.read_text()[:200])
    code, report = counts(capsys, tmp_path / "bag")
    assert (code, report["events"]["scan"]) == (0, SCANS)


def test_a_database_from_before_definitions_is_read_by_the_names_of_its_types(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bag: Path
) -> None:
    folder = copied(bag, tmp_path / "bag")
    (path,) = folder.glob("*.db3")
    with contextlib.closing(sqlite3.connect(path)) as base, base:
        for line in ("DROP TABLE message_definitions", "DROP TABLE schema", "DROP TABLE metadata"):
            base.execute(line)
        base.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
    code, report = counts(capsys, path)
    assert (code, report["events"]["scan"]) == (0, SCANS)


def test_a_database_that_is_cut_is_read_as_far_as_it_is_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bag: Path
) -> None:
    folder = copied(bag, tmp_path / "bag")
    (path,) = folder.glob("*.db3")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    code, out, err = run(capsys, "info", folder, "--json")
    assert code in (1, 3)
    assert "cannot be read as a ROS 2 bag" in out + err
    missing = len(data) - len(data) * 2 // 3
    assert f"{missing} of its {len(data)} bytes are missing" in out + err
    assert "copy the file again, if the copy was cut off" in out + err


def test_payloads_that_are_cut_are_counted_one_by_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path
) -> None:
    seen = 0

    def items() -> Any:
        nonlocal seen
        for schema, channel, log_time, data in formats.messages(source):
            seen += channel.topic == "/scan"
            yield schema, channel, log_time, data[:200] if channel.topic == "/scan" and seen % 10 == 5 else data

    code, report = counts(capsys, formats.write(tmp_path / "run.mcap", items(), source))
    assert (code, report["events"]["scan"]) == (3, SCANS - SCANS // 10)
    assert "6 messages could not be decoded: /scan" in report["losses"]


def test_a_folder_of_parts_one_of_them_damaged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path
) -> None:
    folder = formats.split(source, tmp_path / "parts", 3)
    part = folder / "run_1.mcap"
    part.write_bytes(part.read_bytes()[:-300])
    code, report = counts(capsys, folder)
    assert code == 3
    assert any("run_1.mcap" in reason for reason in report["reasons"])
    assert report["events"]["scan"] > SCANS // 2
