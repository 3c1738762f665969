"""Results side by side: a table on the terminal, and one page that needs no network."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from report_parts import view_in

from hsloc.cli.main import main
from hsloc.evaluation.error_metrics import ErrorMetrics
from hsloc.evaluation.metrics import compare
from hsloc.model import Trajectory
from hsloc.report.data import ReportParts
from hsloc.report.html import change, read_runs, write_report_html
from hsloc.report.summary import ResultSummary

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def results(run: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders a and b, of which the path of b is a centimetre off."""
    folder = tmp_path_factory.mktemp("results")
    moved = Trajectory(run["trajectory"].stamps_ns, run["trajectory"].poses + np.array((0.01, 0.0, 0.0)))
    worse = compare(moved, run["reference"])
    metrics = replace(run["metrics"], errors=ErrorMetrics.of(worse.evaluation()))
    changed = {"trajectory": moved, "comparison": worse, "metrics": metrics}
    for name, arguments in (("a", run), ("b", {**run, **changed})):
        (folder / name).mkdir()
        write_report_html(folder / name / "report.html", ReportParts(title="office.mcap", **arguments))
    return folder


def test_the_table_has_the_figures_of_the_reports_and_their_changes(
    results: Path, run: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", str(results / "a"), str(results / "b" / "report.html")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [cell.strip() for cell in lines[0].split("|")[1:-1]] == ["", "a", "b"]
    (ape,) = [line for line in lines if line.startswith("| APE rmse ")]
    _, first, second = (cell.strip() for cell in ape.split("|")[1:-1])
    own = {row.label: row for row in ResultSummary.of(run["metrics"]).figures}
    assert first == " / ".join(own["APE rmse"].values)
    assert re.fullmatch(r"[\d.]+ cm / [\d.]+° \(\+[\d.]+ % / [-+]?[\d.]+ %\)", second)


def test_the_page_is_whole_and_loads_nothing(results: Path, tmp_path: Path) -> None:
    arguments = ["compare", str(results / "a"), str(results / "b"), "--out", str(tmp_path / "c.html"), "--json"]
    assert main(arguments) == 0
    first = (tmp_path / "c.html").read_bytes()
    assert main(arguments) == 1  # not overwritten unasked
    assert main([*arguments, "--overwrite"]) == 0
    assert (tmp_path / "c.html").read_bytes() == first
    text = first.decode()
    assert not re.search(r"https?:|[\"'(]//[^ ]|@import|url\(|fetch\(", re.sub(r"base64,[^\"]+", "", text))
    one, two = view_in(text)["runs"]
    assert one["data"]["map"]["image"].startswith("data:image/png")
    assert "map" not in two["data"]
    assert two["data"]["trajectory"]["x"][0] == pytest.approx(one["data"]["trajectory"]["x"][0] + 0.01, abs=2e-3)


def test_what_is_no_report_is_named(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "report.html").write_text("<p>an old one")
    for path, words in ((tmp_path, "no report of this version"), (tmp_path / "none", "cannot be read")):
        assert main(["compare", str(results / "a"), str(path)]) == 1
        message = capsys.readouterr().err
        assert words in message
        assert str(path) in message
    assert [each.name for each in read_runs([results / "a", results / "a"])] == [str(results / "a")] * 2


def test_changes() -> None:
    def changed(first: list[float | None], numbers: list[float | None], *values: str) -> str:
        return change({"numbers": first}, {"numbers": numbers, "values": values})

    assert changed([2.0], [3.0], "3.00 m") == "+50 %"
    assert changed([2.0], [1.99], "1.99 m") == "-0.5 %"
    assert changed([0.02, 0.1], [1.0, 0.1], "1.00 m", "0.10°") == "× 50 / 0 %"
    assert changed([1.0], [0.981], "98.1 % of the poses") == "-1.9 pp"
    same: list[tuple[list[float | None], list[float | None]]] = [([2.0], [2.0]), ([0.0], [1.0]), ([None], [1.0])]
    assert [changed(a, b, "1.00 m") for a, b in same] == [""] * 3
    assert changed([504.0], [60.0], "60 held by the motion gate") == ""
    assert changed([2.0, 1.0], [3.0, 1.0], "3 of 1") == ""
