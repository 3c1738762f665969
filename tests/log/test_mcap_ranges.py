"""Copies of MCAP files that lack what hsloc does not read: less is fetched, and what is read is the same."""

from __future__ import annotations

import random
from collections import Counter
from io import BytesIO
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from hsloc.errors import LogError
from hsloc.log.mcap.container import McapContainer
from hsloc.log.mcap.ranges import copy_needed
from hsloc.log.messages.decoders import is_read
from hsloc.log.summary import Losses
from hsloc.sweep.remote import RemoteFile, RemoteLog, remote_logs

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

IMAGE_BYTES, IMAGES = 200_000, 30


def recording(compression: CompressionType, *, mixed: bool, chunked: bool = True, images: int = IMAGES) -> bytes:
    """Scans and images: in turn (`mixed`), or the images in the middle; a topic of the middle is defined there."""
    rng, stream, now = random.Random(1), BytesIO(), 0
    writer = Writer(stream, chunk_size=512 << 10, compression=compression, use_chunking=chunked)
    writer.start("ros2", "a test")
    types = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/Image", "nav_msgs/msg/Odometry")
    scan, image, odometry = (writer.register_schema(name, "ros2msg", b"byte[] data\n") for name in types)
    scans, late = writer.register_channel("/scan", "cdr", scan), 0
    pictures = writer.register_channel("/camera", "cdr", image) if images else 0

    def add(channel: int, size: int) -> None:
        nonlocal now
        now += 1_000_000
        writer.add_message(channel, now, rng.randbytes(size), now)

    for k in range(IMAGES):
        add(scans, 2_000)
        for _ in range(0 if not images else 1 if mixed else images if k == IMAGES // 2 else 0):
            add(pictures, IMAGE_BYTES)
        late = late or writer.register_channel("/odom", "cdr", odometry)
        add(late, 700)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def copied(content: bytes, target: Path) -> int | None:
    """How many bytes were fetched for a copy of a file."""

    def fetch(ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        return [content[first:end] for first, end in ranges]

    with target.open("w+b") as file:
        return copy_needed(fetch, len(content), file)


def read_in_spite(path: Path) -> tuple[set[tuple[int, int, int, bytes]], int]:
    """All messages of topics that are read, and how many chunks are damaged."""
    container, losses = McapContainer(path), Losses()
    wanted = [number for number, channel in container.channels.items() if is_read(channel)]
    found = {(*message[:3], bytes(message[3])) for message in container.messages(wanted, losses)}
    return found, losses.damaged_chunks + container.losses_at_opening.damaged_chunks


def read(path: Path) -> set[tuple[int, int, int, bytes]]:
    """All messages of topics that are read; none is lost."""
    found, damaged = read_in_spite(path)
    assert damaged == 0
    return found


@pytest.mark.parametrize(
    ("compression", "mixed"),
    [(CompressionType.NONE, True), (CompressionType.NONE, False), (CompressionType.ZSTD, False)],
)
def test_images_are_left_out_and_all_else_is_the_same(
    tmp_path: Path, compression: CompressionType, mixed: bool
) -> None:
    content = recording(compression, mixed=mixed)
    (tmp_path / "whole.mcap").write_bytes(content)
    fetched = copied(content, tmp_path / "copy.mcap")
    assert fetched is not None
    assert fetched < (0.05 if mixed else 0.2) * len(content)
    found = read(tmp_path / "copy.mcap")
    assert len(found) == 2 * IMAGES
    assert found == read(tmp_path / "whole.mcap")
    whole, copy = McapContainer(tmp_path / "whole.mcap"), McapContainer(tmp_path / "copy.mcap")
    assert copy.statistics == whole.statistics  # images are counted, too
    assert copy.channels == whole.channels


@pytest.mark.parametrize(
    "content",
    [
        b"\x89MCAP0\r\n" + bytes(100_000),
        recording(CompressionType.NONE, mixed=True)[:-1],
        recording(CompressionType.NONE, mixed=True, chunked=False),
        recording(CompressionType.NONE, mixed=True, images=0) + bytes(1),
    ],
    ids=["no footer", "cut off", "no chunks", "bytes behind"],
)
def test_what_has_no_index_is_fetched_whole(tmp_path: Path, content: bytes) -> None:
    assert copied(content, tmp_path / "copy.mcap") is None


def test_a_file_whose_topics_are_all_read_is_fetched_whole(tmp_path: Path) -> None:
    content = recording(CompressionType.NONE, mixed=True, images=0)
    assert len(content) > 64 << 10
    assert copied(content, tmp_path / "copy.mcap") is None


def test_a_wrong_index_never_makes_a_message(tmp_path: Path) -> None:
    """A bit of the summary, or of a chunk's index, is wrong: fewer messages are found and that is counted, or all."""
    content, rng = recording(CompressionType.NONE, mixed=True), random.Random(3)
    (tmp_path / "whole.mcap").write_bytes(content)
    expected = read(tmp_path / "whole.mcap")
    summary = make_reader(BytesIO(content)).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    ends = [each.chunk_start_offset + each.chunk_length for each in summary.chunk_indexes]
    last = summary.chunk_indexes[-1]
    places = [*range(ends[-1] + last.message_index_length, len(content))]
    for end, each in zip(ends, summary.chunk_indexes, strict=True):
        places += range(end, end + each.message_index_length)
    outcomes = Counter[str]()
    for at in rng.sample(places, 120):
        wrong = bytearray(content)
        wrong[at] ^= 1 << rng.randrange(8)
        if copied(bytes(wrong), tmp_path / "copy.mcap") is None:
            outcomes["whole"] += 1
            continue
        (tmp_path / "wrong.mcap").write_bytes(wrong)
        (of_copy, lost), (of_whole, _) = (read_in_spite(tmp_path / f"{name}.mcap") for name in ("copy", "wrong"))
        assert of_copy <= expected, at
        assert of_copy == of_whole or lost > 0, at
        outcomes["all" if of_copy == expected else "fewer"] += 1
    assert outcomes["whole"] > 0
    assert outcomes["all"] > 0


def test_a_log_at_a_url_is_fetched_in_parts_and_refused_if_it_changes(tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    content = recording(CompressionType.NONE, mixed=True)
    (tmp_path / "run.mcap").write_bytes(content)
    (log,) = remote_logs(f"file://{tmp_path}/run.mcap")
    path = log.fetch()
    assert path.stat().st_size == len(content)
    assert path.stat().st_blocks * 512 < 0.5 * len(content)  # holes
    assert read(path) == read(tmp_path / "run.mcap")
    fsspec.filesystem("memory").pipe("/bucket/run.mcap", content)
    assert read(remote_logs("memory://bucket/run.mcap")[0].fetch()) == read(tmp_path / "run.mcap")
    file = log.files[0]
    with pytest.raises(LogError, match="it changed while it was read"):
        RemoteLog(log.url, (RemoteFile(file.url, file.path, file.size, "an older one"),)).fetch()
