"""The examples run, and what they print is right."""

from __future__ import annotations

import re
import runpy
import sys
from typing import TYPE_CHECKING

import nbformat
import pytest
from nbclient import NotebookClient
from paths import RECORDINGS, ROOT
from waiting import LIMIT_S

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.unmeasured

EXAMPLES = ROOT / "examples"
OFFICE = str(RECORDINGS / "office.mcap")


def run_example(name: str, *arguments: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found is not None, f"{pattern} is not in {text}"
    return float(found[1])


def test_localise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--end", "12", "--out", str(tmp_path / "out"))
    printed = run_example("localise.py", OFFICE, *options, monkeypatch=monkeypatch, capsys=capsys)
    assert number(r"over ([\d.]+) s", printed) == pytest.approx(12.0, abs=0.1)
    assert number(r"([\d.]+) % localised", printed) > 90.0
    assert number(r"APE rmse: ([\d.]+) cm", printed) < 2.0
    assert (tmp_path / "out" / "report.html").exists()


def test_build_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--split", "20", "--end", "30", "--out", str(tmp_path / "map"))
    printed = run_example("build_map.py", OFFICE, *options, monkeypatch=monkeypatch, capsys=capsys)
    assert (tmp_path / "map" / "map.yaml").exists()
    assert number(r"([\d.]+) % of the rest", printed) > 90.0
    assert number(r"APE rmse: ([\d.]+) cm", printed) < 5.0


def test_own_matcher(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run_example("own_matcher.py", OFFICE, "--scans", "5", monkeypatch=monkeypatch, capsys=capsys)
    grid_search = number(r"grid search +median error +([\d.]+) cm", printed)
    hide = number(r"HIDE +median error +([\d.]+) cm", printed)
    assert hide < grid_search < 4.0, "the grid's spacing is 5 cm"


@pytest.mark.filterwarnings("default")  # of Jupyter's own packages
def test_the_notebook_runs_from_top_to_bottom() -> None:
    notebook = nbformat.read(EXAMPLES / "compare_matchers.ipynb", as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "commit it without outputs"
    NotebookClient(notebook, timeout=LIMIT_S, resources={"metadata": {"path": str(EXAMPLES)}}).execute()
    pictures = [
        output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 2


def test_every_example_is_in_the_list() -> None:
    text = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    files = [path.name for pattern in ("*.py", "*.ipynb") for path in EXAMPLES.glob(pattern)]
    assert [name for name in files if f"({name})" not in text] == []
