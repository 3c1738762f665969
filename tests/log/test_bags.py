"""ROS bags hold the same as the MCAP they were made from, and raise nothing but our errors when they are broken."""

from __future__ import annotations

import gzip
import shutil
from typing import TYPE_CHECKING

import log_formats
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_builders import describe, write_run
from mcap.records import Channel
from rosbags.rosbag2 import StoragePlugin

from hsloc.errors import HslocError, LogFormatError
from hsloc.log.reader import open_log
from hsloc.log.summary import Losses, ReadOptions

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def mcap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("bags") / "run.mcap")


@pytest.fixture(scope="module")
def bag1(mcap: Path) -> Path:
    return log_formats.bag1(mcap, mcap.with_name("run.bag"))


@pytest.fixture(scope="module")
def bag2(mcap: Path) -> Path:
    return log_formats.bag2(mcap, mcap.with_name("bag2"))


@pytest.mark.parametrize("which", ["bag1", "bag2", "bare"])
def test_a_bag_gives_the_same_events_as_its_mcap(request: pytest.FixtureRequest, mcap: Path, which: str) -> None:
    path: Path = request.getfixturevalue("bag2" if which == "bare" else which)
    if which == "bare":
        (path,) = path.glob("*.db3")
    log, converted = open_log(path), open_log(mcap)
    assert [describe(event) for event in log.events()] == [describe(event) for event in converted.events()]
    assert log.losses == Losses()
    assert log.verify() == Losses()
    assert log.summary.extrinsics == "/tf_static"
    assert log.summary.laser_frame == "laser"
    assert log.summary.T_base_laser == converted.summary.T_base_laser
    assert (log.summary.start_ns, log.summary.end_ns) == (converted.summary.start_ns, converted.summary.end_ns)
    assert [(t.topic, t.typename, t.count) for t in log.summary.topics] == [
        (t.topic, t.typename, t.count) for t in converted.summary.topics
    ]
    assert len(log.sha256()) == 64


def test_the_folder_of_a_bag_without_metadata_is_read_file_by_file(tmp_path: Path, bag2: Path, mcap: Path) -> None:
    shutil.copytree(bag2, tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    expected = [describe(event) for event in open_log(mcap).events()]
    assert [describe(event) for event in open_log(tmp_path / "bag").events()] == expected


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_a_compressed_bag_is_read_by_its_metadata(
    tmp_path: Path, mcap: Path, mode: str, storage: StoragePlugin
) -> None:
    log = open_log(log_formats.bag2(mcap, tmp_path / "bag", mode, storage))
    assert [describe(event) for event in log.events()] == [describe(event) for event in open_log(mcap).events()]
    assert log.losses == Losses()


def test_bag_and_mcap_together(tmp_path: Path, bag1: Path, mcap: Path) -> None:
    later = write_run(tmp_path / "later.mcap", first=40)
    together = [describe(event) for event in open_log([bag1, later]).events()]
    assert together == [describe(event) for path in (mcap, later) for event in open_log(path).events()]


def test_a_cut_bag_is_one_line(tmp_path: Path, bag1: Path) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes(bag1.read_bytes()[:3000])
    with pytest.raises(LogFormatError, match=r"cut\.bag: cannot be read as a ROS 1 bag") as caught:
        open_log(path)
    assert "\n" not in str(caught.value)


def test_a_bag_without_its_index_is_read_as_far_as_it_goes(tmp_path: Path, mcap: Path) -> None:
    whole = log_formats.bag1(mcap, tmp_path / "whole.bag", chunk_bytes=2000)
    expected = list(map(describe, open_log(whole).events()))
    path = tmp_path / "cut.bag"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    log = open_log(path)
    found = list(map(describe, log.events()))
    assert 0.4 * len(expected) < len(found) < len(expected)
    assert found == expected[: len(found)]
    assert log.losses.truncated_files == 1
    assert "chunks are read as far as they go" in " ".join(log.losses.reasons)


@pytest.mark.parametrize(("compression", "in_header"), [("", True), ("", False), ("BZ2", False)])
def test_a_damaged_chunk_of_a_bag_is_lost_alone(tmp_path: Path, mcap: Path, compression: str, in_header: bool) -> None:
    path = log_formats.bag1(mcap, tmp_path / "whole.bag", chunk_bytes=2000, compression=compression)
    expected = list(map(describe, open_log(path).events()))
    data = bytearray(path.read_bytes())
    chunk = data.index(b"op=\x05", len(data) // 2)
    begin = chunk - (8 if in_header else -80)
    data[begin : begin + 60] = b"\x55" * 60
    path.write_bytes(data)
    log = open_log(path)
    found = list(map(describe, log.events()))
    assert len(expected) - 20 < len(found) < len(expected)
    assert set(found) < set(expected)
    assert found[-1] == expected[-1]
    assert log.losses.damaged_chunks == 1
    assert log.losses.truncated_files == 0


@pytest.mark.parametrize(("compression", "least"), [("", 0.45), ("LZ4", 0.2)])
def test_the_whole_records_of_a_chunk_that_was_cut_are_read(tmp_path: Path, compression: str, least: float) -> None:
    mcap = write_run(tmp_path / "run.mcap", scans=200)
    whole = log_formats.bag1(mcap, tmp_path / "whole.bag", compression=compression)
    expected = list(map(describe, open_log(whole).events()))
    path = tmp_path / "cut.bag"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])  # in the middle of its only chunk
    log = open_log(path)
    found = list(map(describe, log.events()))
    assert least * len(expected) < len(found) < len(expected)
    assert found == expected[: len(found)]
    assert log.losses.data_lost


@pytest.mark.parametrize("packed", ["run.mcap.gz", "run.mcap.zst"])
def test_a_packed_log_that_was_cut_is_read_as_far_as_it_goes(tmp_path: Path, mcap: Path, packed: str) -> None:
    # Noise on another topic, the last fifth of which is cut off.
    items, noise = list(log_formats.messages(mcap)), np.random.default_rng(0).bytes(500_000)
    channel = Channel(id=9, topic="/noise", message_encoding="raw", metadata={}, schema_id=0)
    items.append((items[0][0], channel, items[-1][2] + 1, noise))
    content = log_formats.write(tmp_path / "mixed.mcap", items, chunk_size=1000).read_bytes()
    path = tmp_path / packed
    data = gzip.compress(content) if packed.endswith("gz") else zstandard.compress(content)
    path.write_bytes(data[: len(data) * 4 // 5])
    log = open_log(path)
    assert list(map(describe, log.events())) == list(map(describe, open_log(mcap).events()))
    assert log.losses.truncated_files == 1
    assert any("as far as it goes" in reason for reason in log.losses.reasons)


@pytest.mark.unmeasured
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_bags_raise_nothing_but_our_errors(
    tmp_path_factory: pytest.TempPathFactory, bag1: Path, bag2: Path, data: st.DataObject
) -> None:
    source = data.draw(st.sampled_from([bag1, next(bag2.glob("*.db3"))]))
    content = bytearray(source.read_bytes())
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(20, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / source.name
    path.write_bytes(content)
    message = ""
    try:
        log = open_log(path, ReadOptions(require_scan=False, require_odometry=False))
        count = sum(1 for _ in log.events())
    except HslocError as error:
        message, count = str(error), 0
    assert count <= 130
    assert "\n" not in message
