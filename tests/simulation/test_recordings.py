"""The fixture recordings are what their README describes, and are made again by its commands."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import re
import shlex
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import pytest
import zstandard
from mcap.reader import make_reader
from paths import RECORDINGS

from hsloc.cli import record as command
from hsloc.log import open_log
from hsloc.model import Odometry, Scan, Truth
from hsloc.simulation.built_in import built_in

if TYPE_CHECKING:
    from pathlib import Path

FOLDER = RECORDINGS
README = (FOLDER / "README.md").read_text()
SUMS = dict(re.findall(r"^([0-9a-f]{64})  (\w+)\.mcap$", README, re.MULTILINE))
SUMS = {name: digest for digest, name in SUMS.items()}
COMMANDS = dict(re.findall(r"^hsloc record recordings/(\w+)\.mcap (.*)$", README, re.MULTILINE))
ROW = re.compile(r"^\| `(\w+)\.mcap` \| ([\w-]+) \| (\d+) \| ([\d.]+) \|", re.MULTILINE)
TABLE = {row[0]: row[1:] for row in ROW.findall(README)}
NAMES = ["office", "corridor_loop", "hall", "kidnapped", "slip", "paper"]


def test_the_readme_lists_every_recording() -> None:
    files = sorted(path.stem for path in FOLDER.glob("*.mcap"))
    assert files == sorted(SUMS) == sorted(COMMANDS) == sorted(TABLE) == sorted(NAMES)


def test_they_are_under_ten_megabytes() -> None:
    assert sum(path.stat().st_size for path in FOLDER.glob("*.mcap")) < 10_000_000


@pytest.mark.parametrize("name", NAMES)
def test_checksums(name: str) -> None:
    assert sha256((FOLDER / f"{name}.mcap").read_bytes()).hexdigest() == SUMS[name]


@pytest.mark.unmeasured
@pytest.mark.parametrize("name", NAMES)
def test_recorded_again_by_its_command(name: str, tmp_path: Path) -> None:
    """The same messages always; the same bytes wherever the same zstd packs them."""
    if os.environ.get("NUMBA_DISABLE_JIT") == "1" and name != "paper":
        pytest.skip("a hundred million rays and walls take minutes without the compiler")
    again = tmp_path / f"{name}.mcap"
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    assert command.run(parser.parse_args([str(again), *shlex.split(COMMANDS[name]), "-q"])) == 0
    assert _contents(again) == _contents(FOLDER / again.name)
    packers = re.search(r"zstd ([\d.]+) through mcap ([\d.]+)\.", README).groups()
    if packers == (".".join(map(str, zstandard.ZSTD_VERSION)), importlib.metadata.version("mcap")):
        assert again.read_bytes() == (FOLDER / again.name).read_bytes()


def _contents(path: Path) -> tuple[Any, ...]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        messages = [
            (channel.topic, schema.name, message.log_time, message.publish_time, message.data)
            for schema, channel, message in reader.iter_messages()
        ]
        metadata = [(record.name, record.metadata) for record in reader.iter_metadata()]
        return messages, metadata, [(a.name, a.data) for a in reader.iter_attachments()]


@pytest.mark.unmeasured
@pytest.mark.parametrize("name", NAMES)
def test_they_hold_what_the_readme_lists(name: str) -> None:
    world, seed, seconds = TABLE[name]
    log = open_log(FOLDER / f"{name}.mcap")
    metadata = log.metadata()["hsloc.scenario"]
    assert (metadata["world"], metadata["seed"]) == (world, seed)
    assert metadata["world_sha256"] == built_in(world).fingerprint()
    events = list(log.events())
    assert (events[-1].stamp_ns - events[0].stamp_ns) / 1e9 == pytest.approx(float(seconds), abs=0.06)
    assert log.map().cells.max() == 100
    _, start = log.initial_pose()  # type: ignore[misc]
    truth = next(event for event in events if isinstance(event, Truth))
    assert start.distance(truth.T_map_base) < 1e-6
    counts = [sum(isinstance(event, kind) for event in events) for kind in (Truth, Odometry, Scan)]
    assert counts[0] == counts[1] > 1000
    assert counts[2] > 500
    scans = [event for event in events if isinstance(event, Scan)]
    assert min(scan.hits().sum() for scan in scans) > 40
