"""`hsloc check --profile`: what a recording does not keep, and files that are no profile."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from log_builders import write_run

from hsloc.cli.main import main
from hsloc.errors import ConfigError
from hsloc.log import read_profile

if TYPE_CHECKING:
    from pathlib import Path

KEPT = """
topics:
  /scan: {type: sensor_msgs/LaserScan, rate: 5, max_gap: 0.5, frame: laser}
  odom: {rate: [15, 25], child_frame: base_link}
  /camera: {required: false}
  /nothing:
    required: false
transforms: [base_link -> laser]
max_offset: 0.1
duration: [1, 10]
"""


def test_a_recording_that_keeps_its_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile = tmp_path / "fleet.yaml"
    profile.write_text(KEPT)
    assert main(["check", str(write_run(tmp_path / "run.mcap")), "--profile", str(profile)]) == 0
    assert capsys.readouterr().out.endswith("profile: kept\n")


def test_what_is_not_kept_is_a_line_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, profile = write_run(tmp_path / "run.mcap"), tmp_path / "fleet.yaml"
    profile.write_text("""
topics:
  /scan: {type: sensor_msgs/PointCloud2, rate: [50, 60], max_gap: 0.01, frame: front}
  /odom: {child_frame: base}
  /imu:
transforms: [map -> laser]
duration: 3600
""")
    assert main(["check", str(log), "--profile", str(profile), "--json"]) == 4
    found = json.loads(capsys.readouterr().out)["profile"]
    for part in (
        "/scan: type is sensor_msgs/msg/LaserScan, not sensor_msgs/msg/PointCloud2",
        "/scan: rate is 10.00 Hz, not 50 to 60 Hz",
        "/scan: the largest gap is 0.100 s, not at most 0.01 s",
        "/scan: frame is laser, not front",
        "/odom: child frame is base_link, not base",
        "/imu: is not in the recording, or has no message",
        "transform map -> laser: is not in the recording",
        "not at least 3600 s",
    ):
        assert any(part in line for line in found), (part, found)
    assert len(found) == 8


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("topic: {}", "no key 'topic'"),
        ("topics: [1]", "table by topic"),
        ("topics: {/scan: 3}", "must be a table of type"),
        ("topics: {/scan: {rte: 3}}", "no key 'rte'"),
        ("topics: {/scan: {rate: [3, 1]}}", "least"),
        ("topics: {/scan: {rate: []}}", "least"),
        ("topics: {/scan: {max_gap: -1}}", "0 or more"),
        ("topics: {/scan: {frame: 3}}", "must be a text"),
        ("topics: {/scan: {required: 3}}", "true or false"),
        ("transforms: [odom]", "parent -> child"),
        ("[]", "is not a profile"),
    ],
)
def test_files_that_are_no_profile(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=expected):
        read_profile(path)
