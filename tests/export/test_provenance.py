"""The line "run it again with": pasted into a shell it gives the same files."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.analysis.analyse import analyse
from hsloc.cli.arguments import run_request
from hsloc.cli.main import build_parser, main
from hsloc.evaluation import write_tum
from hsloc.export.provenance import command
from hsloc.export.results_folder import report_parts
from hsloc.log import ReadOptions, open_log
from hsloc.maps import save_map
from hsloc.model import OccupancyGrid, Trajectory, Truth
from hsloc.options import OPTIONS
from hsloc.replay.run import run
from hsloc.report.view import view_of
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from hsloc.options import Option


def paste(folder: Path, out: str) -> None:
    """Run the line of a results folder again, into another one."""
    line = (folder / "config.yaml").read_text().splitlines()[0].partition("run it again with: ")[2]
    program = Path(folder.parent / "hsloc")
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m hsloc.cli.main "$@"\n')
    program.chmod(0o755)
    path = f"{folder.parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(["bash", "-c", f"{line} -q --out {out}"], check=True, env=os.environ | {"PATH": path})


def same(first: Path, second: Path) -> None:
    names = {path.name for path in first.iterdir()}
    assert names == {path.name for path in second.iterdir()}
    for name in sorted(names - {"timings.json"}):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def reference(path: Path, log: Path) -> None:
    truth = [event for event in open_log(log, ReadOptions()).events() if isinstance(event, Truth)]
    write_tum(path, Trajectory.from_pairs((event.stamp_ns, event.T_map_base) for event in truth))


def test_the_line_gives_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Alignment, relations, reference, folders, a configuration file, --set, names with blanks (B5)."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my logs").mkdir()
    log = Path("my logs") / "an office's log.mcap"
    shutil.copy(RECORDINGS / "office.mcap", log)
    reference(Path("my logs/truth.tum"), log)
    Path("mine.yaml").write_text("hide: {budget: 150, restarts: 3}\nmatcher: hs\nlocaliser: {window_min: 0.2}\n")
    stamps = np.loadtxt("my logs/truth.tum", usecols=0)
    Path("my logs/two.relations").write_text(f"{stamps[150]:.6f} {stamps[200]:.6f} 0.1 0 0 0 0 0\n")
    start = ",".join(repr(value) for value in start_of(log))
    argv = ["replay", str(log), "-q", "--out", "first", "--duration", "6", "--start", "1", "--seed", "7",
            "--alignment", "se2", "--reference", "my logs/truth.tum", "--relations", "my logs/two.relations",
            "--config", "mine.yaml", "--set", "matcher.budget=90", "--initial-pose", start,
            "--set", "localiser.window_sigmas=2.5"]  # fmt: skip
    assert main(argv) == 0
    Path("mine.yaml").unlink()
    paste(tmp_path / "first", "second")
    same(tmp_path / "first", tmp_path / "second")
    text = Path("first/config.yaml").read_text()
    assert "--relations=" in text.splitlines()[0]
    assert "--alignment=se2" in text.splitlines()[0]


def start_of(log: Path) -> tuple[float, float, float]:
    """The start that the log states."""
    stated = open_log(log, ReadOptions()).initial_pose()
    assert stated is not None
    pose = stated[1]
    return pose.x, pose.y, pose.theta


def test_the_line_of_a_mapping_run_and_of_another_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    slip = str(RECORDINGS / "slip.mcap")
    for number, words in enumerate(
        (["--mode", "slam", "--no-odom", "--end", "4"], ["--preset", "paper", "--matcher", "hs", "--end", "4"])
    ):
        assert main(["replay", slip, "-q", "--out", f"first{number}", *words]) == 0
        paste(tmp_path / f"first{number}", f"second{number}")
        same(tmp_path / f"first{number}", tmp_path / f"second{number}")


def test_names_that_are_no_text_are_quoted_for_bash() -> None:
    line = command(RunRequest(logs=(Path(os.fsdecode(b"logs/B\xfc'ro\n.mcap")),)))
    assert "\n" not in line
    printed = subprocess.run(["bash", "-c", f"printf %s {line.split(' ', 2)[2]}"], capture_output=True, check=True)
    assert printed.stdout == b"logs/B\xfc'ro\n.mcap"


def test_limits_are_no_part_of_the_files(tmp_path: Path) -> None:
    log = (RECORDINGS / "slip.mcap",)
    assert command(RunRequest(logs=log, max_ape=0.1)) == command(RunRequest(logs=log))


def test_a_server_writes_no_folder(tmp_path: Path) -> None:
    request = RunRequest.from_values(
        ["/srv/job/input/run.mcap"],
        {"map": "/srv/job/map/floor.yaml", "relations": "/srv/job/relations/r.txt", "bare_names": True},
    )
    assert command(request) == "hsloc replay run.mcap --map=floor.yaml --relations=r.txt"


def test_a_map_is_repeated_by_the_command_that_builds_maps() -> None:
    arguments = build_parser().parse(["map", "run.clf", "--no-odom", "--seed", "3"])
    line = command(run_request(arguments))
    assert line == "hsloc map run.clf --no-odom --seed=3"
    assert run_request(build_parser().parse(shlex.split(line)[1:])) == run_request(arguments)


EXAMPLES: dict[str, Any] = {
    "mode": "slam", "map": "maps/a floor.yaml", "resume": "results/first", "no_odometry": True,
    "initial_pose": [-1.5, 2.0, 0.25], "unknown_start": True, "alignment": "origin", "reference": "/vicon",
    "relations": "some.relations", "scan_topic": "/front,/rear", "laser_pose": [-0.1, 0.0, -3.0], "deskew": True,
    "start_s": -2.5, "end_s": 60.125, "preset": "paper", "matcher": "icp", "mapper": "point", "seed": 77,
    "set": ["hide.budget=400", "localiser.fuse=true"], "stamps": "log", "slice": "-0.2,0.5",
    "scan_fix": "range_max=12", "time_offset": "/odom=-0.25", "wheels": "0.033,0.16",
    "assert_loop": "12.5,140,3,9", "forbid_loop": "30,81",
}  # fmt: skip


@pytest.mark.parametrize("option", [option for option in OPTIONS if option.place != "check"], ids=lambda o: o.name)
def test_every_option_survives_the_line(option: Option) -> None:
    """Request, line, command line, request: nothing that decides the files is lost."""
    if option.name in ("config", "duration_s"):  # written as --set and --end
        return
    value = EXAMPLES.get(option.name, True if option.kind == "switch" else "/some/topic")
    request = RunRequest.from_values(["my logs/run.mcap"], {option.name: value})
    words = shlex.split(command(request))
    assert words[2] == "my logs/run.mcap"
    written_as = (option.flag, "--set=") if option.place == "config" else option.flag
    assert (words[1] == "map" and option.name == "mode") or any(word.startswith(written_as) for word in words)
    arguments = build_parser().parse(words[1:])
    assert run_request(arguments) == request


def in_view(log: Path, **options: Any) -> tuple[str, int]:
    """Group and seed of a short run."""
    result = run(RunRequest.from_values([log], {"end_s": 1.0, **options}))
    found = view_of(report_parts(result, analyse(result))).values["run"]
    return found["group"], found["seed"]


def test_runs_are_one_group_wherever_their_files_are_and_not_with_another_map(tmp_path: Path) -> None:
    grid = open_log(RECORDINGS / "office.mcap", ReadOptions()).map()
    assert grid is not None
    wider = OccupancyGrid(grid.cells, 1.01 * grid.resolution, grid.origin)
    for name, each in (("a", grid), ("it's", grid), ("wider", wider)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "office.mcap").symlink_to(RECORDINGS / "office.mcap")
        save_map(each, tmp_path / name / "floor")
    first, seed = in_view(tmp_path / "a" / "office.mcap", map=tmp_path / "a" / "floor.yaml", seed=3)
    assert seed == 3
    there = {"map": tmp_path / "it's" / "floor.yaml", "bare_names": True}
    assert in_view(tmp_path / "it's" / "office.mcap", **there) == (first, 0)
    assert in_view(tmp_path / "a" / "office.mcap", map=tmp_path / "wider" / "floor.yaml")[0] != first
    assert in_view(tmp_path / "a" / "office.mcap", **there, alignment="se2")[0] != first


def test_a_name_that_only_bash_reads_has_a_report(tmp_path: Path) -> None:
    log = tmp_path / os.fsdecode(b"B\xfc'ro.mcap")
    log.symlink_to(RECORDINGS / "office.mcap")
    assert len(in_view(log)[0]) == 16
