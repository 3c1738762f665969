"""The guides are correct: every command and every example in them is run, and every link leads somewhere."""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
from paths import ROOT
from waiting import LIMIT_S

from hsloc.cli.main import COMMANDS, build_parser, main
from hsloc.config import Config, to_dict

GUIDES = sorted((ROOT / "docs").glob("*.md"))
OF_OTHER_TOOLS = {
    "coming-from.md": {
        "--align", "--align_origin", "--all_pairs", "--correct_scale", "--delta_unit", "--save_results", "--t_max_diff",
    },
}  # fmt: skip
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_EXIT = re.compile(r"#.*exit code (\d)")


def blocks(path: Path, language: str) -> list[str]:
    return [text for kind, text in _BLOCK.findall(path.read_text(encoding="utf-8")) if kind == language]


def commands(path: Path) -> list[str]:
    lines = [line for block in blocks(path, "sh") for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.strip() and not line.startswith("#")]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recordings: Path) -> Path:
    (tmp_path / "recordings").symlink_to(recordings, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_line(line: str, capsys: pytest.CaptureFixture[str]) -> int:
    """A line of a shell; commands of ours in this process, as starting it again takes most of the time."""
    words = shlex.split(line, comments=True)
    if words[0] != "hsloc":
        return subprocess.run(["bash", "-c", line], check=False, timeout=LIMIT_S).returncode
    target = None
    if ">" in words:
        target = Path(words[words.index(">") + 1])
        words = words[: words.index(">")]
    capsys.readouterr()
    status = main(words[1:])
    if target is not None:
        target.write_text(capsys.readouterr().out)
    return status


@pytest.mark.unmeasured
@pytest.mark.parametrize("path", [path for path in GUIDES if commands(path)], ids=lambda path: path.name)
def test_every_command_of_a_guide_works_as_described(
    path: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for line in commands(path):
        expected = _EXIT.search(line)
        status = run_line(line, capsys)
        printed = capsys.readouterr()
        assert status == (int(expected.group(1)) if expected else 0), f"{line}\n{printed.err}"
        assert "Traceback" not in printed.err


@pytest.mark.unmeasured
@pytest.mark.parametrize("path", [path for path in GUIDES if blocks(path, "python")], ids=lambda path: path.name)
def test_the_examples_run_from_top_to_bottom(path: Path, here: Path) -> None:
    names: dict[str, object] = {"__name__": "example"}
    for number, block in enumerate(blocks(path, "python")):
        exec(compile(block, f"{path.name}, example {number + 1}", "exec"), names)


@pytest.mark.parametrize("path", [ROOT / "README.md", *GUIDES], ids=lambda path: path.name)
def test_every_command_that_is_named_exists(path: Path) -> None:
    """Also those that are too long to run: the parser must take them."""
    for line in commands(path):
        words = shlex.split(line, comments=True)
        if words[0] == "hsloc":
            build_parser().parse_args(words[1 : words.index(">") if ">" in words else None])
    inline = re.findall(r"`([^`]+)`", path.read_text(encoding="utf-8"))
    flags = set(re.findall(r"--[a-z][a-z0-9_-]+", " ".join(inline)))
    known = {text for parser in parsers() for action in parser._actions for text in action.option_strings}
    assert flags - known - OF_OTHER_TOOLS.get(path.name, set()) - {"--version"} == set()


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.name)
def test_every_parameter_that_is_named_exists(path: Path) -> None:
    parameters = to_dict(Config())
    for name in re.findall(r"`([a-z_]+(?:\.[a-z_0-9]+)+)`", path.read_text(encoding="utf-8")):
        first, *rest = name.split(".")
        part: Any = parameters.get(first)
        if isinstance(part, dict):
            for key in rest:
                assert key in part, f"{name}: {key} is no parameter; known: {', '.join(part)}"
                part = part[key]


def parsers() -> list[argparse.ArgumentParser]:
    actions = build_parser()._actions
    (subparsers,) = (action for action in actions if isinstance(action, argparse._SubParsersAction))
    return list(subparsers.choices.values())


@pytest.mark.parametrize("path", [ROOT / "README.md", *GUIDES], ids=lambda path: path.name)
def test_every_link_leads_somewhere(path: Path) -> None:
    for link in re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8")):
        if not link.startswith(("http:", "https:")):
            assert (path.parent / link).exists(), link


def test_every_guide_is_in_the_list() -> None:
    text = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    assert [path.name for path in GUIDES if path.name != "README.md" and f"({path.name})" not in text] == []


def test_the_help_of_every_command_fits_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    for name in COMMANDS:
        with pytest.raises(SystemExit) as ended:
            main([name, "--help"])
        assert ended.value.code == 0
        assert capsys.readouterr().out.startswith("usage: hsloc ")
