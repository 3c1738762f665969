"""Poses to compare with, in all the ways in which a user can name them."""

from __future__ import annotations

import json
from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.cli.main import main
from hsloc.errors import ConfigError, EvaluationError, TopicError
from hsloc.log import LogWriter, ReadOptions
from hsloc.model import Pose2, Trajectory
from hsloc.replay.references import read_reference
from hsloc.request import RunRequest
from hsloc.trajectory_io.reader import read_tum
from hsloc.trajectory_io.tum import write_tum

if TYPE_CHECKING:
    from pathlib import Path

HALL = RECORDINGS / "hall.mcap"
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    return read_reference(f"{HALL}:/ground_truth")


@pytest.fixture
def moving(tmp_path: Path) -> Path:
    """A robot that drives 1 m/s along the odometry frame, which a localiser places; its stamps are a second ahead."""
    path = tmp_path / "moving.mcap"
    with LogWriter(path) as log:
        log.transforms(START, [("base_link", "tip", Pose2(0.5, 0.0, 0.0))], static=True)
        for number in range(20):
            stamp = START + number * SECOND // 10
            log.transforms(
                stamp + SECOND, [("map", "odom", Pose2(0.0, float(number // 10), pi / 2))], log_time_ns=stamp
            )
            log.transforms(stamp, [("odom", "base_link", Pose2(number / 10.0, 0.0, 0.0))])
    return path


def replay(tmp_path: Path, capsys: pytest.CaptureFixture[str], *options: Path | str, code: int = 0) -> Any:
    out = str(tmp_path / "out")
    assert main(["replay", str(HALL), "--end", "6", *map(str, options), "--out", out, "--overwrite", "--json"]) == code
    captured = capsys.readouterr()
    return json.loads(captured.out) if code == 0 else captured.err


def test_a_reference_is_the_truth_of_a_log_or_any_topic(truth: Trajectory) -> None:
    assert len(truth) > 1000
    named = read_reference(str(HALL))
    assert np.array_equal(named.poses, truth.poses)
    assert np.array_equal(read_reference("/ground_truth", [HALL]).poses, truth.poses)
    odometry = read_reference(f"{HALL}:/odom")
    assert len(odometry) == len(truth)
    assert not np.allclose(odometry.poses, truth.poses)
    np.testing.assert_allclose(read_reference(f"{HALL}:/tf:odom.base_link").poses, odometry.poses, atol=1e-9)


def test_transforms_between_two_frames(moving: Path) -> None:
    found = read_reference(f"{moving}:/tf:map.tip")
    assert found.stamps_ns.tolist() == [START + number * SECOND // 10 for number in range(20)]
    # The tip is half a metre ahead; the odometry frame looks along y of the map, and is a metre further on later.
    expected = [(0.0, number // 10 + number / 10.0 + 0.5, pi / 2) for number in range(20)]
    np.testing.assert_allclose(found.poses, expected, atol=1e-9)
    reverse = read_reference(f"{moving}:/tf:tip.map")
    assert [round(value, 9) for value in reverse.poses[0]] == [-0.5, 0.0, round(-pi / 2, 9)]


@pytest.mark.parametrize(
    ("name", "error", "match"),
    [
        ("none.tum", EvaluationError, r"none\.tum: no such file; a reference is a TUM or CSV file, a LOG, LOG:TOPIC"),
        ("/vicon", EvaluationError, "a topic needs a log: LOG:/vicon"),
        ("{log}:/vicon", TopicError, "no topic /vicon to take as truth; --truth-topic may be /ground_truth"),
        ("{log}:/tf:map", EvaluationError, "transforms are named /tf:PARENT.CHILD"),
        ("{log}:/tf:map.base_link", EvaluationError, "no transforms lead from map to base_link; name a topic, as in"),
    ],
)
def test_what_cannot_be_found_is_reported_with_what_can(name: str, error: type[Any], match: str) -> None:
    with pytest.raises(error, match=match) as caught:
        read_reference(name.format(log=HALL))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["tum", "csv", "log", "topic"])
def test_replay_compares_with_any_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], truth: Trajectory, kind: str
) -> None:
    write_tum(tmp_path / "truth.tum", truth)
    rows = "".join(f"{stamp / 1e9:.9f},{x!r},{y!r},{theta!r}\n" for stamp, (x, y, theta) in
                   zip(truth.stamps_ns.tolist(), truth.poses.tolist(), strict=True))  # fmt: skip
    (tmp_path / "truth.csv").write_text(f'"t","x","y","theta"\n{rows}')
    named: Any = {"tum": tmp_path / "truth.tum", "csv": tmp_path / "truth.csv", "log": HALL, "topic": "/ground_truth"}[
        kind
    ]
    expected = replay(tmp_path, capsys)
    found = replay(tmp_path, capsys, "--reference", named)
    assert found["matched"] == expected["matched"]
    assert found["association"] == "nearest"
    assert found["ape"]["trans_part"]["rmse"] == pytest.approx(expected["ape"]["trans_part"]["rmse"], abs=1e-6)
    assert "--reference=" in (tmp_path / "out" / "config.yaml").read_text().splitlines()[0]


def test_a_sparse_reference_between_the_beats_is_met_by_interpolation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], truth: Trajectory
) -> None:
    """At 1 Hz, 11 ms from the estimate's stamps: no pose of it is within 10 ms."""
    stamps = np.arange(truth.stamps_ns[0], truth.stamps_ns[0] + 6 * SECOND, SECOND) + 11_000_000
    write_tum(tmp_path / "sparse.tum", Trajectory(stamps, truth.interpolated(stamps)))
    found = replay(tmp_path, capsys, "--reference", tmp_path / "sparse.tum")
    assert (found["association"], found["matched"]) == ("interpolation", len(stamps))
    assert found["ape"]["trans_part"]["rmse"] < 0.02


def test_a_reference_of_another_time_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], truth: Trajectory
) -> None:
    write_tum(tmp_path / "late.tum", Trajectory(truth.stamps_ns + 3600 * SECOND, truth.poses))
    found = replay(tmp_path, capsys, "--reference", tmp_path / "late.tum")
    assert "overlap by 0.000 s" in found["evaluation_error"]
    assert "nearest gap is 3594" in found["evaluation_error"]
    assert "ape" not in found


def test_a_reference_that_is_missing_costs_no_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no such file" in replay(tmp_path, capsys, "--reference", "none.tum", code=1)
    with pytest.raises(ConfigError, match="leave out one of them"):
        RunRequest(logs=(HALL,), reference="x.tum", read=ReadOptions(truth_topic="/ground_truth"))


def test_eval_takes_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str], truth: Trajectory) -> None:
    write_tum(tmp_path / "truth.tum", truth)
    assert main(["eval", str(HALL), str(tmp_path / "truth.tum"), f"{HALL}:/odom", "--json"]) == 0
    same, odometry = json.loads(capsys.readouterr().out)["estimates"]
    assert same["ape"]["trans_part"]["max"] < 1e-9
    assert odometry["ape"]["trans_part"]["max"] > 0.1


def test_the_head_of_a_csv_gives_the_order_of_its_quaternions(tmp_path: Path) -> None:
    path = tmp_path / "euroc.csv"
    path.write_text("t,x,y,z,qw,qx,qy,qz\n1,2,3,0,0,0,0,1\n")
    assert abs(read_tum(path).poses[0, 2]) == pytest.approx(np.pi)
    path.write_text("t,x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,0,1\n")
    assert read_tum(path).poses.tolist() == [[2.0, 3.0, 0.0]]


@pytest.mark.parametrize("text", ["/typo.tum", "/no/such/run.mcap", ""])
def test_a_file_that_is_not_there_is_not_taken_for_a_topic(text: str) -> None:
    with pytest.raises(EvaluationError, match="no such file; a reference is"):
        read_reference(text, [HALL])
