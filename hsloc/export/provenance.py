"""What it takes to run a replay again: command, configuration, versions, checksums."""

from __future__ import annotations

import platform
import shlex
from hashlib import file_digest
from importlib import metadata
from typing import TYPE_CHECKING

from hsloc.config import dump
from hsloc.replay.map_sources import map_files
from hsloc.report.html import Provenance
from hsloc.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.model.pose2 import Pose2
    from hsloc.replay.run import Result
    from hsloc.request import RunRequest

_PACKAGES = ("numpy", "scipy", "numba", "mcap", "rosbags")


def provenance(result: Result) -> Provenance:
    """For the report."""
    versions = {"hsloc": __version__, "Python": platform.python_version()}
    versions |= {name: metadata.version(name) for name in _PACKAGES}
    hashes = {" ".join(result.spec.names()): result.input_sha256}
    if result.spec.map_path is not None:
        hashes |= {path.name: _sha256(path) for path in map_files(result.spec.map_path)}
    return Provenance(command(result.spec), dump(result.spec.config), versions, hashes)


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


def command(spec: RunRequest) -> str:
    """The command line that repeats the run, with the config.yaml of its results."""
    words = ["hsloc", "replay", *spec.names()]
    read = spec.read
    flags: tuple[tuple[str, object], ...] = (
        ("--mode", None if spec.mode == "auto" else spec.mode),
        ("--map", None if spec.map_path is None else spec.map_path.name),
        ("--resume", None if spec.resume is None else spec.resume.name),
        ("--initial-pose", _pose(spec.initial_pose)),
        ("--scan-topic", read.scan_topic),
        ("--odom-topic", read.odom_topic),
        ("--truth-topic", read.truth_topic),
        ("--reference", spec.reference),
        ("--base-frame", read.base_frame),
        ("--laser-pose", _pose(read.laser_pose)),
        ("--start", read.start_s),
        ("--end", read.end_s),
    )
    words += [f"{flag}={value}" for flag, value in flags if value is not None]
    if spec.unknown_start:
        words.append("--unknown-start")
    if read.deskew:
        words.append("--deskew")
    if spec.no_odometry:
        words.append("--no-odom")
    return shlex.join([*words, "--config=config.yaml", f"--seed={spec.seed}"])


def config_text(result: Result) -> str:
    """The effective configuration; what else is needed to repeat the run stands above it."""
    lines = [
        f"# hsloc {__version__}; run it again with: {command(result.spec)}",
        f"# preset: {result.spec.preset}",
        f"# input sha256: {result.input_sha256}",
    ]
    return "\n".join(lines) + "\n" + dump(result.spec.config)


def _pose(pose: Pose2 | None) -> str | None:
    return None if pose is None else f"{pose.x!r},{pose.y!r},{pose.theta!r}"
