"""Options of a run on the command lines: one table, offered by every command; values, hints, help."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import TYPE_CHECKING
from zipfile import ZipFile

import pytest
from paths import RECORDINGS

from hsloc.cli.main import COMMANDS, build_parser, main
from hsloc.cli.submit import packed, request_of
from hsloc.errors import LogError, MapError
from hsloc.options import BY_NAME, OPTIONS, offered

if TYPE_CHECKING:
    import argparse
    from pathlib import Path

SLIP = str(RECORDINGS / "slip.mcap")


def flags(command: str) -> dict[str, argparse.Action]:
    """The long flags of a command."""
    actions = build_parser().commands[command]._actions
    return {flag: action for action in actions for flag in action.option_strings}


@pytest.mark.parametrize("interface", ["replay", "map", "sweep", "submit"])
def test_every_command_has_the_flags_of_the_table(interface: str) -> None:
    found = flags(interface)
    for option in offered(interface):  # type: ignore[arg-type]
        assert option.flag in found
        assert found[option.flag].dest == option.name
    others = {option.flag for option in OPTIONS} - {option.flag for option in offered(interface)}  # type: ignore[arg-type]
    assert not others & set(found)


def test_the_help_of_every_option_is_a_sentence() -> None:
    for option in OPTIONS:
        for text in (option.help, option.http or option.help):
            assert text[0].isupper(), text
            assert text.endswith("."), text


def test_submit_sends_the_options(tmp_path: Path) -> None:
    """--duration, --reference, hs and --set were accepted and ignored, or not accepted (B3)."""
    (tmp_path / "truth.tum").write_text("0 0 0 0 0 0 0 1\n")
    given = {
        "start_s": 2.0,
        "duration_s": 3.0,
        "matcher": "hs",
        "reference": str(tmp_path / "truth.tum"),
        "initial_pose": (-1.0, 2.0, 0.0),
        "set": ["matcher.budget=400", "localiser.fuse=false"],
        "scan_topic": ["/front", "/rear"],
        "max_ape": 0.1,
    }
    assert request_of(given, lambda path: f"id of {path.name}") == {
        "read": {"start_s": 2.0, "end_s": 5.0, "scan_topic": "/front,/rear"},
        "matcher": "hs",
        "reference": "id of truth.tum",
        "initial_pose": [-1.0, 2.0, 0.0],
        "config": {"harmony_search": {"budget": 400}, "localiser": {"fuse": False}},
        "max_ape": 0.1,
    }
    yaml = "image: %s\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    (tmp_path / "map.yaml").write_text(yaml % "walls.png")
    (tmp_path / "plan.yaml").write_text(yaml % "plan.pgm")
    # A folder of results has its map.yaml, an image its YAML beside it.
    given = {"map": tmp_path, "align_to": tmp_path / "plan.pgm"}
    assert request_of(given, lambda path: f"id of {path.name}") == {
        "map": {"yaml": "id of map.yaml", "image": "id of walls.png"},
        "align_to": {"yaml": "id of plan.yaml", "image": "id of plan.pgm"},
    }
    with pytest.raises(MapError, match=r"a service takes a map as YAML and image"):
        request_of({"map": tmp_path / "map.npz"}, str)
    given = {"start_s": 2.0, "reference": "/vicon"}
    assert request_of(given, str) == {"read": {"start_s": 2.0, "truth_topic": "/vicon"}}


def test_submit_packs_logs_of_several_files(tmp_path: Path) -> None:
    recording, target = tmp_path / "recording", tmp_path / "archives"
    recording.mkdir()
    target.mkdir()
    for name in ("run_0.db3", "run_0.db3-wal", "metadata.yaml"):
        (recording / name).write_bytes(name.encode())
    assert packed(recording / "metadata.yaml", target) == recording / "metadata.yaml"
    for log, names in (
        (recording, ["metadata.yaml", "run_0.db3", "run_0.db3-wal"]),
        (recording / "run_0.db3", ["run_0.db3", "run_0.db3-wal"]),
    ):
        with ZipFile(packed(log, target)) as archive:
            assert archive.namelist() == names
    with pytest.raises(LogError, match=r"cannot be packed .*TMPDIR"):
        packed(recording, tmp_path / "missing")


def test_submit_has_no_bar_with_no_progress() -> None:
    assert build_parser().parse(["submit", "run.mcap", "--no-progress"]).no_progress


@pytest.mark.parametrize("flag", ["--initial-pose", "--laser-pose"])
@pytest.mark.parametrize("text", ["-1,2,0", "-1.5,-2,-3e-1", "-.5,0,0", "-1 2 0"])
def test_a_pose_may_begin_with_a_minus(flag: str, text: str) -> None:
    arguments = build_parser().parse(["replay", SLIP, flag, text])
    assert getattr(arguments, flag[2:].replace("-", "_"))[0] < 0.0


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["repaly"], "hsloc: error: argument COMMAND: invalid choice 'repaly'; did you mean replay?"),
        (
            ["replay", "run.mcap", "--intial-pose", "1,2,0"],
            "hsloc replay: error: unrecognized arguments: --intial-pose 1,2,0; did you mean --initial-pose?",
        ),
        (["replay", "run.mcap", "--bogus"], "hsloc replay: error: unrecognized arguments: --bogus"),
        (
            ["replay", "run.mcap", "--output"],
            "hsloc replay: error: unrecognized arguments: --output; did you mean --out?",
        ),
        (
            ["check", "run.mcap", "--quite"],
            "hsloc check: error: unrecognized arguments: --quite; did you mean --quiet?",
        ),
        (
            ["replay", "run.mcap", "--matcher", "hid"],
            "hsloc replay: error: argument --matcher: invalid choice 'hid'; did you mean hide?",
        ),
        (
            ["replay", "run.mcap", "--min-localised", "95"],
            "hsloc replay: error: argument --min-localised: '95' must be from 0 to 1",
        ),
    ],
)
def test_a_mistake_is_one_line_with_a_hint(argv: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert stop.value.code == 2
    assert capsys.readouterr() == ("", f"{line} (see {line.partition(':')[0]} --help)\n")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("hide.budgt=3", "--set hide.budgt=3: there is no parameter hide.budgt; did you mean hide.budget?"),
        ("localiser=3", "--set localiser=3: there is no parameter localiser; did you mean localiser."),
        ("hide.budget=many", "--set: hide.budget is 'many'; it must be of type int"),
        ("hide.budget", "--set hide.budget: is not KEY=VALUE, such as hide.budget=400"),
        ("localiser.lost_after=3", "since version 0.2 it is called max_consecutive_rejections"),
    ],
)
def test_a_wrong_parameter_is_named_with_the_nearest(text: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--set", text]) == 1
    error = capsys.readouterr().err
    assert error.startswith("hsloc: error: ")
    assert line in error
    assert error.count("\n") == 1


def test_matcher_in_a_key_is_the_one_that_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--json", "--matcher", "hs", "--set", "matcher.budget=77", "--set", "hide.budget=88"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["matcher"], found["harmony_search"]["budget"], found["hide"]["budget"]) == ("harmony_search", 77, 88)
    (tmp_path / "mine.yaml").write_text("matcher: hs\n")
    assert main(["config", "--json", "--config", str(tmp_path / "mine.yaml")]) == 0
    assert json.loads(capsys.readouterr().out)["matcher"] == "harmony_search"
    assert main(["config", "--json", "--set", "matcher=icp", "--set", "matcher.iterations=3"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["matcher"], found["icp"]["iterations"]) == ("icp", 3)


def test_bare_hsloc_shows_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    printed = capsys.readouterr()
    assert "replay" in printed.out
    assert printed.err == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_shows_examples_that_it_accepts(command: str) -> None:
    parser = build_parser()
    text = parser.commands[command].format_help()
    examples = [line.strip() for line in text.partition("examples:")[2].splitlines() if line.startswith("  hsloc ")]
    assert examples or command == "completion"
    for line in examples:
        words = line.partition("   ")[0].partition(" ||")[0].partition(" >")[0].split()[1:]
        arguments = parser.parse(words)
        assert arguments.command == command


def test_the_table_of_options_imports_the_standard_library_alone() -> None:
    code = (
        "import sys; before = set(sys.modules); import hsloc.options; "
        "found = {name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names);"
        "sys.exit(f'imported {found}' if found - {'hsloc'} else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_names_and_flags_are_unique() -> None:
    assert len(BY_NAME) == len(OPTIONS) == len({option.flag for option in OPTIONS})
