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
from processes import has_open, heeding_rights
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
        ([OFFICE.replace("office", "away")], "away.mcap: no such file or folder; check the path"),
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


_MAP = "image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n"


@pytest.mark.parametrize("command", ["replay", "map", "check", "info"])
@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("plan.png", b"\x89PNG\r\n\x1a\n" + bytes(99), "is an image, not a log; name the recording, and give a map by"),
        ("plan.pgm", b"P5\n4 4\n255\n" + bytes(16), "is an image, not a log"),
        ("plain.pgm", b"P2\n# by hand\n2 1\n255\n0 254\n", "is an image, not a log"),
        ("photo.jpg", b"\xff\xd8\xff\xe0" + bytes(99), "is an image, not a log"),
        ("map.yaml", _MAP.encode(), "is the YAML of a map, not a log; name the recording, and give the map with --map"),
        ("notes.txt", b"dear diary\n", "name the recording: a .mcap, .db3 or .bag file"),
        ("empty.mcap", b"", "is empty (0 bytes); copy it again, or record again"),
    ],
)
def test_what_is_no_log_is_called_what_it_is_with_a_remedy(
    here: Path, capsys: pytest.CaptureFixture[str], command: str, name: str, content: bytes, expected: str
) -> None:
    (here / name).write_bytes(content)
    assert expected in fails(capsys, command, name)


def test_of_a_folder_whose_logs_lie_further_down_one_is_named(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ("day/b", "day/a/deep", "day/c"):
        (here / folder).mkdir(parents=True)
    (here / "day" / "c" / "notes.txt").write_text("none")
    assert "name a log file" in fails(capsys, "check", "day")
    (here / "day" / "b" / "run.mcap").write_bytes(Path(OFFICE).read_bytes())
    assert "name the folder of one recording, such as day/b" in fails(capsys, "check", "day")
    (here / "day" / "a" / "deep" / "run.db3.zst").write_bytes(b"x")
    assert "such as day/a/deep (2 folders have some)" in fails(capsys, "replay", "day")


@pytest.mark.parametrize("command", ["replay", "check"])
def test_what_may_not_be_read_is_said_with_a_remedy(
    here: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    for name in ("closed/run.mcap", "closed.mcap"):
        (here / name).parent.mkdir(exist_ok=True)
        (here / name).write_bytes(Path(OFFICE).read_bytes())
    (here / "closed.mcap").chmod(0)
    (here / "closed").chmod(0)
    for name in ("closed.mcap", "closed", "closed/run.mcap"):
        line = fails_by_rights(capsys, command, name)
        assert line == (
            f"hsloc: error: {name}: cannot be read (Permission denied); "
            "check its rights, and those of the folders above it"
        )
    line = fails_by_rights(capsys, "replay", OFFICE, "--map", "closed/map.yaml", "--out", "out")
    assert "closed/map.yaml" in line
    assert "check its rights" in line
    (here / "closed").chmod(0o700)


@pytest.mark.parametrize(
    "argv",
    [
        ["replay", OFFICE, "--end", "1", "--out"],
        ["map", OFFICE, "--end", "1", "--out"],
        ["merge", "a", "b", "--out"],
        ["compare", "a", "b", "--out"],
        ["calibrate", OFFICE, "--end", "1", "--out"],
        ["sweep", OFFICE, "--out"],
        ["reproduce", "E1", "--own", "--out"],
        ["convert", OFFICE],
        ["record", "--world", "hall"],
    ],
)
def test_an_output_that_may_not_be_written_is_no_input(
    here: Path, capsys: pytest.CaptureFixture[str], argv: list[str]
) -> None:
    (here / "closed").mkdir(mode=0)
    for target in ("closed/out", "closed/below/out"):
        line = fails_by_rights(capsys, *argv, target)
        assert line.startswith(f"hsloc: error: {target}: cannot be written (Permission denied); ")
        assert line.endswith(("choose another --out", "or name another one"))
    (here / "closed").chmod(0o500)
    if argv[0] in ("replay", "calibrate"):
        assert "is not a folder that may be written to); choose another --out" in fails_by_rights(
            capsys, *argv, "closed/out"
        )


def fails_by_rights(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """As `fails`, where the rights of files are heeded."""
    return heeding_rights(lambda: fails(capsys, *argv))


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


def test_a_service_that_is_not_installed_names_how_it_is_in_a_clone_and_elsewhere(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "hsloc_service.main", raising=False)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    line = fails(capsys, "serve")
    assert "uvicorn, which the service needs, is not installed: pip install '.[serve]' in a clone of hsloc" in line
    assert "pip install 'hsloc[serve]' elsewhere" in line


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
