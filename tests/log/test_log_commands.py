"""`hsloc info` and `hsloc convert` as a user runs them, with the user's mistakes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from log_builders import START, chunk_data_at, chunks_of, flipped, make_scan, write_run

from hsloc.cli.main import main
from hsloc.log.writer import LogWriter
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from pathlib import Path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def test_info_lists_what_is_there_and_what_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "info", write_run(tmp_path / "run.mcap", truth=True))
    assert (code, err) == (0, "")
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert "start: 2023-11-14T22:13:20.000000000Z" in lines
    assert "/odom nav_msgs/msg/Odometry 80 20.00 Hz 0.050 s" in lines
    assert "scans: /scan" in lines
    assert "truth: /ground_truth" in lines
    assert "frames: odom -> base_link -> laser" in lines
    assert "laser: x 0.200 m, y 0.000 m, yaw 0.5000 rad (/tf_static)" in lines
    assert "events: 80 odometry, 40 scan, 40 truth" in lines
    assert "no warnings" in lines


def test_info_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.metadata("hsloc.initial_pose", {"x": "1", "y": "2", "theta": "0.5"})
        log.odometry(START, Pose2())
        log.scan(make_scan(START))
        log.occupancy_grid(OccupancyGrid(make_scan(0).ranges.astype("i1").reshape(2, 4), 0.05), START)
    code, out, _ = run(capsys, "info", path, "--json")
    assert code == 0
    report = json.loads(out)
    assert report["map"] == {"height": 2, "width": 4, "resolution": 0.05}
    assert report["initial_pose"] == {"stamp_ns": START, "x": 1.0, "y": 2.0, "yaw": 0.5}
    assert report["events"] == {"odometry": 1, "scan": 1}
    assert report["scan_topic"] == "/scan"
    assert report["data_lost"] is False
    assert "--laser-pose" in report["warnings"][0]["remedy"]


def test_info_of_a_damaged_log_names_the_damage_once_and_ends_with_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_run(tmp_path / "run.mcap", scans=200)
    data = path.read_bytes()
    path.write_bytes(flipped(data, chunk_data_at(data, chunks_of(data)[9]) + 30)[:-50])
    code, out, _ = run(capsys, "info", path)
    assert code == 3
    assert "1 damaged chunk was skipped" in out
    assert "1 file ends too early" in out
    assert "exit code 3" in out
    code, out, _ = run(capsys, "info", path, "--json", "--quick")
    assert code == 3  # the cut is seen without reading on
    assert json.loads(out)["events"] == {}


def test_info_helps_where_other_commands_refuse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.scan(make_scan(36_000_000_000), topic="/front")
        log.scan(make_scan(36_000_000_000), topic="/rear")
    code, out, _ = run(capsys, "info", path)
    assert code == 0
    assert "choose with --scan-topic /front" in out
    assert "no odometry topic" in out
    assert "start:     36.000000000 s" in out


@pytest.mark.parametrize("command", [("info",), ("convert",)])
def test_mistakes_are_one_line_and_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str]
) -> None:
    (tmp_path / "notes.txt").write_text("hello\n")
    target = [tmp_path / "out.mcap"] if command == ("convert",) else []
    for name in ("missing.mcap", "notes.txt"):
        code, out, err = run(capsys, *command, tmp_path / name, *target)
        assert (code, out) == (1, "")
        assert err.startswith(f"hsloc: error: {tmp_path / name}: ")
        assert err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt"]


def carmen(path: Path) -> Path:
    path.write_text("ODOM 1 2 0 0 0 0 5.5 h 1\nFLASER 2 1 2 0 0 0 1 2 0 5.5 h 1\nODOM 2 2 0 0 0 0 5.4 h 1\n")
    return path


def test_convert_reports_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = carmen(tmp_path / "log.clf"), tmp_path / "log.mcap"
    code, out, err = run(capsys, "convert", source, target, "--laser-pose=-0.1,0,1.5")
    assert (code, err) == (0, "hsloc: warning: 1 stamp runs backwards; the order of the log was kept: ODOM\n")
    assert "1 scans, 2 odometry messages, from CARMEN" in out
    assert "x -0.100 m, y 0.000 m, yaw 1.5000 rad" in out
    assert "stamps that run backwards: 1" in out
    code, out, _ = run(capsys, "convert", source, target, "--force", "--json")
    assert code == 0
    report = json.loads(out)
    assert (report["scans"], report["odometry"], report["stamps_backwards"], report["data_lost"]) == (1, 2, 1, False)


def test_convert_overwrites_only_with_the_flag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = carmen(tmp_path / "log.clf"), tmp_path / "log.mcap"
    target.write_bytes(b"precious")
    code, _, err = run(capsys, "convert", source, target)
    assert code == 1
    assert "exists; give --force" in err
    assert target.read_bytes() == b"precious"
    assert run(capsys, "convert", source, target, "--force", "-q")[:2] == (0, "")
    assert target.read_bytes().startswith(b"\x89MCAP")
    code, _, err = run(capsys, "convert", target, target, "--force")
    assert code == 1
    assert "is the input itself" in err


def test_convert_of_a_damaged_log_ends_with_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_run(tmp_path / "run.mcap", scans=200)
    path.write_bytes(path.read_bytes()[:20_000])
    code, _, err = run(capsys, "convert", path, tmp_path / "out.mcap", "-q")
    assert code == 3
    assert "file ends too early" in err
    assert (tmp_path / "out.mcap").exists()


def test_convert_into_a_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "convert", carmen(tmp_path / "log.clf"), tmp_path / "no" / "out.mcap")
    assert code == 1
    assert "cannot be written" in err


def test_a_pose_that_is_none_is_wrong_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "convert", "in", "out", "--laser-pose", "1,2")
    assert code == 2
    assert "'1,2' is not x,y,yaw" in err
