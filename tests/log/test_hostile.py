"""Any bytes: an error of ours or a log, in bounded time."""

from __future__ import annotations

import os
import struct
import time
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_builders import scan_payloads, write_raw, write_run
from log_formats import foxglove_mcap, ros1_mcap
from mcap.writer import CompressionType

from hsloc.errors import HslocError
from hsloc.log.checks.checker import check_log
from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions

if TYPE_CHECKING:
    from pathlib import Path

ALL = ReadOptions(require_scan=False, require_odometry=False)
LIMIT_S = 100.0
"""Processor time of a file [s], which takes 0.02 s: what is without bounds passes it."""
EXAMPLES = int(os.environ.get("HSLOC_MUTATIONS", "400"))
"""HSLOC_MUTATIONS=10000 pytest tests/log/test_hostile.py -k mutated: for the long run."""


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """Files of every shape to start from."""
    folder = tmp_path_factory.mktemp("seeds")
    files = [write_run(folder / "run.mcap", scans=6, truth=True)]
    for number, options in enumerate(
        [
            {"compression": CompressionType.NONE},
            {"compression": CompressionType.LZ4},
            {"use_chunking": False},
            {"repeat_channels": False, "repeat_schemas": False},
        ]
    ):
        payloads = scan_payloads(6)
        files.append(write_raw(folder / f"{number}.mcap", payloads, **options))  # type: ignore[arg-type]
    files += [foxglove_mcap(files[0], folder / f"{encoding}.mcap", encoding) for encoding in ("json", "protobuf")]
    files.append(ros1_mcap(files[0], folder / "ros1.mcap"))
    return [file.read_bytes() for file in files]


def read_all(path: Path) -> int:
    """Every method of a log; only errors of ours may come out."""
    begin = time.process_time()
    count = 0
    try:
        log = open_log(path, ALL)
        count = sum(1 for _ in log.events())
        check_log(log)
        log.map()
        log.initial_pose()
        log.verify()
        assert isinstance(log.losses.lines(), list)
    except HslocError as error:
        assert "\n" not in str(error)  # noqa: PT017
    assert time.process_time() - begin < LIMIT_S
    return count


LENGTHS = (0, 1, 9, 1 << 16, 1 << 31, (1 << 32) - 1, 1 << 62, (1 << 64) - 1)
MUTATIONS = st.one_of(
    st.tuples(st.just("byte"), st.integers(0, 255)),
    st.tuples(st.just("length"), st.sampled_from(LENGTHS)),
    st.tuples(st.just("delete"), st.integers(1, 64)),
    st.tuples(st.just("insert"), st.binary(min_size=1, max_size=64)),
    st.tuples(st.just("copy"), st.integers(0, 1 << 20)),
)
"""What is done at a place of a file. Places are drawn without regard to the file and taken modulo its length."""


def mutate(content: bytearray, place: int, kind: str, value: Any) -> None:
    """The first eight bytes say what the file is: they stay."""
    at = 8 + place % (len(content) - 8)
    if kind == "byte":
        content[at] = value
    elif kind == "length":
        content[at : at + 8] = struct.pack("<Q", value)
    elif kind == "delete":
        del content[at : at + value]
    elif kind == "insert":
        content[at:at] = value
    else:
        source = value % len(content)
        content[at:at] = content[source : source + 200]


@pytest.mark.unmeasured
@settings(max_examples=EXAMPLES)
@given(
    seed=st.integers(0, 7),
    mutations=st.lists(st.tuples(st.integers(0, 1 << 20), MUTATIONS), min_size=1, max_size=6),
)
def test_mutated_bytes(
    tmp_path_factory: pytest.TempPathFactory,
    seeds: list[bytes],
    seed: int,
    mutations: list[tuple[int, tuple[str, Any]]],
) -> None:
    content = bytearray(seeds[seed])
    for place, (kind, value) in mutations:
        mutate(content, place, kind, value)
    path = tmp_path_factory.mktemp("mutated") / "log.mcap"
    path.write_bytes(content)
    read_all(path)


@settings(max_examples=100)
@given(body=st.binary(max_size=400), seed=st.integers(0, 7))
def test_random_records_behind_a_good_start(
    tmp_path_factory: pytest.TempPathFactory, seeds: list[bytes], body: bytes, seed: int
) -> None:
    path = tmp_path_factory.mktemp("random") / "log.mcap"
    path.write_bytes(seeds[seed][:60] + body)
    read_all(path)


@pytest.mark.unmeasured
def test_every_truncation_is_a_log_with_losses_or_an_error(tmp_path: Path, seeds: list[bytes]) -> None:
    path = tmp_path / "log.mcap"
    for content in seeds:
        counts = []
        for size in range(0, len(content), max(len(content) // 30, 1)):
            path.write_bytes(content[:size])
            counts.append(read_all(path))
        # More of the file is never fewer events.
        assert counts == sorted(counts)
        path.write_bytes(content)
        assert read_all(path) >= counts[-1] > 0


def test_a_file_of_empty_records_is_walked_through(tmp_path: Path, seeds: list[bytes]) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(seeds[0][:8] + struct.pack("<BQ", 0x90, 0) * 200_000)
    assert read_all(path) == 0
