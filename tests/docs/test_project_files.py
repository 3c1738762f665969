"""The files beside the code: one version, hooks without a network, a citation, a site that lists every page."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from typing import Any

import pytest
from paths import ROOT
from ruamel.yaml import YAML
from waiting import LIMIT_S

from hsloc.version import __version__

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def read_yaml(name: str) -> Any:
    return YAML(typ="safe").load((ROOT / name).read_text(encoding="utf-8"))


def test_the_version_is_in_one_place() -> None:
    assert PYPROJECT["project"]["dynamic"] == ["version"]
    assert PYPROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "hsloc.version.__version__"}
    done = subprocess.run(
        [sys.executable, "-m", "hsloc.cli.main", "--version"],
        capture_output=True,
        text=True,
        check=True,
        timeout=LIMIT_S,
    )
    assert done.stdout == f"hsloc {__version__}\n"


def test_the_changelog_begins_with_what_comes_next() -> None:
    first = re.search(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert first is not None
    assert first[1].startswith(("Unreleased", __version__))


def test_the_hooks_of_pre_commit_are_those_of_make_lint() -> None:
    repositories = read_yaml(".pre-commit-config.yaml")["repos"]
    assert {repository["repo"] for repository in repositories} == {"local"}, "others need a network"
    entries = " ".join(hook["entry"] for hook in repositories[0]["hooks"])
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    tools = re.findall(r"^\t\$\(BIN\)/(ruff \w+|mypy|lint-imports)", makefile, re.MULTILINE)
    assert len(tools) == 4
    assert [tool for tool in tools if f".venv/bin/{tool}" not in entries] == []


def test_the_citation_has_what_the_format_requires() -> None:
    citation = read_yaml("CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["license"] == PYPROJECT["project"]["license"]
    assert all({"type", "title", "authors"} <= set(reference) for reference in citation["references"])


@pytest.mark.parametrize("folder", ["docs", "examples", "recordings"])
def test_every_page_is_in_the_navigation_of_the_site(folder: str) -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / folder).glob("*.md"))]
    assert pages
    assert [page for page in pages if page not in text] == []


def test_the_lock_pins_what_the_extras_ask_for() -> None:
    pinned = set(re.findall(r"^([a-z0-9-]+)==", (ROOT / "requirements.lock").read_text(encoding="utf-8"), re.MULTILINE))
    extras = PYPROJECT["project"]["optional-dependencies"]
    expected = [*PYPROJECT["project"]["dependencies"], *extras["serve"], *extras["dev"], *extras["docs"]]
    names = {re.split(r"[\[>=<]", each)[0].lower().replace("_", "-").replace(".", "-") for each in expected} - {"hsloc"}
    assert names - pinned == set()


def test_no_file_of_code_is_longer_than_400_lines() -> None:
    files = [path for folder in ("hsloc", "service", "tests", "benchmarks") for path in (ROOT / folder).rglob("*")]
    code = [path for path in files if path.suffix in (".py", ".js", ".css", ".html") and path.is_file()]
    assert len(code) > 500
    assert [path for path in code if path.read_bytes().count(b"\n") > 400] == []
