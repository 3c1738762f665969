"""What users get wrong: one clear line on stderr, exit code 1 or 2, and nothing half-written left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from imports import need_no_import
from paths import RECORDINGS
from processes import has_open
from waiting import LIMIT_S, until

from hsloc.cli.main import main

OFFICE = str(RECORDINGS / "office.mcap")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fails(capsys: pytest.CaptureFixture[str], *argv: str, code: int = 1) -> str:
    """Run a command that must fail; its one line on stderr."""
    try:
        status: object = main(argv)
    except SystemExit as stop:
        status = stop.code
    printed = capsys.readouterr()
    assert status == code
    assert printed.out == ""
    lines = printed.err.strip().splitlines()
    if code == 1:
        assert len(lines) == 1, lines
        assert lines[0].startswith("hsloc: error: ")
    assert "Traceback" not in printed.err
    return lines[-1]


def empty(folder: Path) -> bool:
    return not [path for path in folder.rglob("*") if path.is_file() and path.suffix not in (".yaml", ".txt", ".mcap")]


def test_whoever_reads_the_output_may_have_enough_of_it() -> None:
    command = [sys.executable, "-u", "-m", "hsloc.cli.main", "config"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        assert running.stderr.read() == ""
    assert running.returncode == 1


@pytest.mark.parametrize("argv", [["info", OFFICE, "--json"], ["config"], ["record", "--list"], ["completion", "bash"]])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_disk_behind_stdout_is_one_line(argv: list[str], unbuffered: str) -> None:
    command = [sys.executable, "-m", "hsloc.cli.main", *argv]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": unbuffered}
        )
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "hsloc: error: standard output: cannot be written (No space left on device); check the free space"
    ]


def test_a_name_that_the_terminal_cannot_show_is_escaped(here: Path) -> None:
    (here / "Büro.mcap").write_bytes(Path(OFFICE).read_bytes())
    command = [sys.executable, "-m", "hsloc.cli.main", "info", "--quick", "Büro.mcap"]
    done = subprocess.run(command, capture_output=True, env=os.environ | {"PYTHONIOENCODING": "ascii"}, check=True)
    assert rb"B\xfcro.mcap" in done.stdout


def test_a_name_that_is_no_text_is_read_and_reported(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = os.fsdecode(b"B\xfcro.mcap")
    (here / name).write_bytes(Path(OFFICE).read_bytes())
    assert main(["replay", name, "--end", "2", "--out", "out", "-q"]) == 0
    assert capsys.readouterr().err == ""
    assert r"B\xfcro.mcap" in (here / "out" / "config.yaml").read_text()
    assert r"B\xfcro.mcap" in (here / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["nowhere.mcap"], "nowhere.mcap: no such file or folder; check the path"),
        ([OFFICE.replace("office", "ofice")], f"no such file or folder; did you mean {OFFICE}?"),
        ([OFFICE, "--map", "nowhere.yaml"], "nowhere.yaml"),
        ([OFFICE, "--scan-topic", "/lidar"], "/lidar"),
        ([OFFICE, "--odom-topic", "/wheels"], "/wheels"),
        ([OFFICE, "--config", "nowhere.yaml"], "nowhere.yaml: no such configuration; check the path"),
        ([OFFICE, "--start", "5000"], "no scan between --start and --end"),
    ],
)
def test_what_is_not_there_is_named(
    here: Path, capsys: pytest.CaptureFixture[str], argv: list[str], expected: str
) -> None:
    line = fails(capsys, "replay", *argv, "--out", "out")
    assert expected in line
    assert empty(here)


def test_not_a_log(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "notes.txt").write_text("dear diary\n")
    assert "notes.txt: is not an MCAP, a ROS bag or a CARMEN log" in fails(capsys, "replay", "notes.txt")
    (here / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\0" * 30)
    assert "broken.mcap" in fails(capsys, "replay", "broken.mcap")
    (here / "empty.mcap").write_bytes(b"")
    assert "empty.mcap" in fails(capsys, "replay", "empty.mcap")
    assert empty(here)


def write_log(path: Path, scans: tuple[Any, ...] = ("/scan",), odometry: bool = True, grid: bool = False) -> None:
    import numpy as np

    from hsloc.log import LogWriter
    from hsloc.model import Pose2, Scan

    with LogWriter(path) as writer:
        for k in range(5):
            stamp = 10**9 + k * 10**8
            if odometry:
                writer.odometry(stamp, Pose2(0.1 * k, 0.0, 0.0))
            for topic in scans:
                writer.scan(Scan(stamp, np.ones(10, dtype=np.float32), 0.0, 0.1, 0.1, 10.0), topic=topic)


def test_topics_missing_or_ambiguous_are_reported_with_their_remedy(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(here / "two.mcap", scans=("/front", "/rear"))
    line = fails(capsys, "replay", "two.mcap")
    assert "/front" in line
    assert "/rear" in line
    assert "--scan-topic" in line
    write_log(here / "none.mcap", scans=())
    assert "scan" in fails(capsys, "replay", "none.mcap")
    write_log(here / "still.mcap", odometry=False)
    assert "odometry" in fails(capsys, "replay", "still.mcap")
    assert empty(here)


def test_localising_without_a_map_is_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(here / "bare.mcap")
    assert "--map" in fails(capsys, "replay", "bare.mcap", "--mode", "localise", "--out", "out")
    line = fails(capsys, "replay", OFFICE, "--mapper", "point", "--mode", "slam", "--no-odom", "--out", "out")
    assert "--no-odom" in line
    assert empty(here)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("localizer: {}\n", "unknown key 'localizer'"),
        ("localiser: {update_min_x: 1}\n", "unknown key 'update_min_x'"),
        ("hide: {budget: many}\n", "config.hide.budget is 'many'; it must be of type int"),
        ("hide: {budget: -1}\n", "budget is -1"),
        ("matcher: magic\n", "matcher is 'magic'"),
        ("hide: [1, 2]\n", "config.hide is [1, 2]"),
        ("{unclosed\n", "is not YAML"),
        ("- 1\n", "holds no keys"),
        ("a: &a [1, 1]\nb: [*a, *a]\n", "alias"),
        ("#" * 70_000, "more than 64 kB"),
        ("likelihood_field: {sigma: .nan}\n", "sigma is nan"),
    ],
)
def test_a_wrong_configuration_is_refused_by_name(
    here: Path, capsys: pytest.CaptureFixture[str], text: str, expected: str
) -> None:
    (here / "wrong.yaml").write_text(text)
    line = fails(capsys, "replay", OFFICE, "--config", "wrong.yaml")
    assert "wrong.yaml" in line
    assert expected in line
    assert empty(here)


def test_a_map_that_cannot_be_read(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\noccupied_thresh: 0.65\nfree_thresh: 0.196\nnegate: 0\n"
    )
    assert "map.pgm" in fails(capsys, "replay", OFFICE, "--map", "map.yaml")
    (here / "map.pgm").write_bytes(b"P5\n4 4\n255\nabc")
    assert "map.pgm" in fails(capsys, "replay", OFFICE, "--map", "map.yaml")


def test_a_folder_that_is_full_of_something_else_is_left_alone(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "out").mkdir()
    (here / "out" / "thesis.tex").write_text("do not lose me")
    assert "out: exists already" in fails(capsys, "replay", OFFICE, "--out", "out")
    assert (here / "out" / "thesis.tex").read_text() == "do not lose me"


def test_a_folder_under_a_file_cannot_be_written(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "file.txt").write_text("")
    assert "cannot be written" in fails(capsys, "replay", OFFICE, "--out", "file.txt/out")


@pytest.mark.parametrize(
    "argv",
    [
        ["replay"],
        ["replay", OFFICE, "--seed", "-1"],
        ["replay", OFFICE, "--initial-pose", "1,2"],
        ["replay", OFFICE, "--initial-pose", "1,2,nan"],
        ["replay", OFFICE, "--matcher", "magic"],
        ["replay", OFFICE, "--no-such-flag"],
        ["fly"],
    ],
)
def test_wrong_use_ends_with_2(here: Path, capsys: pytest.CaptureFixture[str], argv: list[str]) -> None:
    fails(capsys, *argv, code=2)
    assert empty(here)


def test_interrupted_runs_leave_nothing_behind(here: Path) -> None:
    command = [sys.executable, "-m", "hsloc.cli.main", "replay", OFFICE, "--out", "out"]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
        # Whoever runs the tests in the background has interrupts ignored, which children inherit.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    until(lambda: has_open(process.pid, Path(OFFICE)) or process.poll() is not None, "the log is read")
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=LIMIT_S)
    assert process.returncode in (130, -signal.SIGINT)  # a shell reports 130 for both
    assert b"Traceback" not in stderr
    assert stderr.decode().strip().endswith("hsloc: interrupted")
    assert list(here.iterdir()) == []


def test_help_imports_nothing_heavy() -> None:
    heavy = {"numpy", "numba", "scipy", "matplotlib", "rosbags", "mcap", "ruamel"}
    need_no_import("from hsloc.cli.main import build_parser; build_parser().format_help()", heavy)
