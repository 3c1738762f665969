"""A figure has one name, value and unit: on the terminal, in metrics.json, reports, page, and comparison."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from report_parts import view_in
from sample_metrics import mapped

from hsloc.cli.main import main
from hsloc.cli.output import print_job, summary_lines
from hsloc.evaluation.metrics import format_json
from hsloc.model.verdict import Verdict, VerdictReason
from hsloc.report.data import ReportParts
from hsloc.report.html import comparison_rows, read_runs, write_report_html
from hsloc.report.seeds import Spread, seed_groups, spread_text
from hsloc.report.summary import REASONS_HEADING, WARNINGS_HEADING, ResultSummary
from hsloc.run_metrics import RunTimings
from hsloc.warnings import RunWarning
from hsloc_service.execution.worker import summarise

if TYPE_CHECKING:
    from pathlib import Path

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3, "°": 1.0, "%": 1e-2, "": 1.0}


def in_table(text: str) -> dict[str, tuple[str, ...]]:
    """By name, the cells of the figures in a report; what is usual stands in small letters behind the value."""
    (table,) = re.findall(r'<table class="figures">(.*?)</table>', text, flags=re.S)
    rows = re.findall(r'<tr title="[^"]*"><th scope="row">(.*?)</th>(.*?)</tr>', table)
    cell = re.compile(r"<td[^>]*>(.*?)(?: <small .*?)?</td>")
    return {unescape(name): tuple(map(unescape, cell.findall(cells))) for name, cells in rows}


def on_lines(lines: list[str], names: dict[str, Any]) -> dict[str, str]:
    """By name, what a terminal shows behind it."""
    found = {}
    for line in lines:
        for name in sorted(names, key=len, reverse=True):
            if line.startswith(f"{name}  "):
                found[name] = " ".join(line.removeprefix(name).partition("  (usual: ")[0].split())
                break
    return found


def test_the_same_figure_is_the_same_everywhere(
    run: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = run["metrics"]
    timings = RunTimings(seconds={"replay": 1.0}, times_real_time=None, evaluations_per_second=None)
    figures = {row.label: row for row in ResultSummary.of(metrics).figures}
    shown = {name: row.values for name, row in figures.items()}
    assert len(shown) >= 7
    # metrics.json: a figure's numbers are where it refers to, and its text is them in its unit
    written = json.loads(format_json(metrics.to_json()))
    for row in figures.values():
        for k, (source, number) in enumerate(zip(row.sources, row.numbers, strict=True)):
            place: Any = written
            for key in source.split("/"):
                place = place[key]
            assert place == number, source
            text = row.values[k] if len(row.values) == len(row.sources) else ""
            parts = re.fullmatch(r"([-\d.]+) ?(mm|cm|m|km|°|%|)(?: of the poses)?", text)
            if parts and number is not None:
                last_digit = 10.0 ** -len(parts[1].partition(".")[2])
                assert float(parts[1]) == pytest.approx(number / UNITS[parts[2]], abs=0.51 * last_digit), row.label
    # terminal: of a replay, and of a job of the service
    words = {name: " ".join(" ".join(values).split()) for name, values in shown.items()}
    assert on_lines(summary_lines(metrics, timings, tmp_path), shown) == words
    job = summarise(metrics, timings)
    print_job(job)
    assert on_lines(capsys.readouterr().out.splitlines(), shown) == words
    # page: the job's row, and the view that it draws; report.html
    assert {each["name"]: tuple(each["values"]) for each in job["figures"]} == shown
    (tmp_path / "a").mkdir()
    write_report_html(tmp_path / "a" / "report.html", ReportParts(title="office.mcap", **run))
    text = (tmp_path / "a" / "report.html").read_text()
    assert in_table(text) == shown
    view = view_in(text)["summary"]
    assert {each["name"]: tuple(each["values"]) for each in view["figures"]} == shown
    assert [each["numbers"] for each in view["figures"]] == [list(row.numbers) for row in figures.values()]
    # comparison, with itself
    runs = read_runs([tmp_path / "a", tmp_path / "a"])
    rows = {name: cells for name, *cells in comparison_rows(runs)}
    assert {name: rows[name] for name in shown} == {name: [" / ".join(values)] * 2 for name, values in shown.items()}
    assert rows["verdict"] == [metrics.verdict, view["verdict"]]


def test_what_is_usual_stands_beside_the_value_and_in_its_explanation(
    run: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = mapped(run["metrics"])
    timings = RunTimings(seconds={"replay": 1.0}, times_real_time=None, evaluations_per_second=None)
    rows = {row.label: row for row in ResultSummary.of(metrics).figures}
    usual = {label: row.usual for label, row in rows.items() if row.usual}
    assert {"wall thickness", "wall points other scans see through", "points within 15 cm of a wall"} <= set(usual)
    for label, text in usual.items():
        assert set(re.findall(r"\d+", text)) <= set(re.findall(r"\d+", rows[label].explanation)), label
    print_job(summarise(metrics, timings))
    terminals = [summary_lines(metrics, timings, tmp_path), capsys.readouterr().out.splitlines()]
    write_report_html(tmp_path / "report.html", ReportParts(title="office.mcap", **{**run, "metrics": metrics}))
    report = unescape((tmp_path / "report.html").read_text())
    for lines in terminals:
        assert any(line.split("  ")[0] == "wall thickness" and "20.9 cm  (usual: 9 to 21 cm" in line for line in lines)
    assert '>20.9 cm <small class="muted">usual: 9 to 21 cm, 2 to 4 cells</small>' in report


def test_headings_say_how_reasons_and_warnings_differ_in_report_and_page(run: dict[str, Any], tmp_path: Path) -> None:
    reason = VerdictReason(Verdict.CHECK, "slip", "the wheels slipped")
    metrics = replace(run["metrics"], verdict_reasons=(reason,), warnings=(RunWarning("clock_set", "a clock was set"),))
    write_report_html(tmp_path / "report.html", ReportParts(title="office.mcap", **{**run, "metrics": metrics}))
    report = unescape((tmp_path / "report.html").read_text())
    page = (files("hsloc_service") / "web" / "result.js").read_text()
    for (name, what), text in ((REASONS_HEADING, "the wheels slipped"), (WARNINGS_HEADING, "a clock was set")):
        assert re.search(f'<h2>{name} <small class="muted">{re.escape(what)}</small></h2><ul[^>]*><li>{text}', report)
        assert re.search(f'"{name}".*"{re.escape(what)}"', page)


def test_over_seeds_runs_are_one_column(
    run: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics, names = run["metrics"], []
    for seed, verdict in enumerate((Verdict.GOOD, Verdict.CHECK, Verdict.GOOD)):
        changed = replace(metrics, verdict=verdict, run=replace(metrics.run, seed=seed))
        names.append(tmp_path / f"office-seed{seed}")
        names[-1].mkdir()
        write_report_html(names[-1] / "report.html", ReportParts(title="office.mcap", **{**run, "metrics": changed}))
    assert main(["compare", *map(str, names), "--out", str(tmp_path / "c.html")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split("|")[-2].strip() == "office: 3 seeds" for line in lines if line.startswith("|"))
    (verdicts,) = [line for line in lines if "2 good, 1 check" in line]
    assert verdicts.startswith("| verdict")
    (ape,) = [line for line in lines if line.startswith("| APE rmse ") and "±" in line]
    assert re.search(r"([\d.]+) ± 0\.0+ (c?m) \[\1, \1\] / ([\d.]+) ± 0\.0+° \[\3, \3\]", ape)
    assert view_in((tmp_path / "c.html").read_text())["seeds"]["names"] == ["office: 3 seeds"]


def test_the_interval_of_a_mean_has_its_nominal_coverage() -> None:
    rng, n, runs = np.random.default_rng(7), 10, 120
    held = 0
    for _ in range(runs):
        spread = Spread.of(rng.lognormal(0.0, 0.3, n).tolist())
        held += spread.low <= np.exp(0.5 * 0.3**2) <= spread.high
    assert 0.88 <= held / runs <= 0.99  # 0.95 within three standard deviations of 120 draws
    assert spread_text(Spread(3, 0.0123, 0.002, 0.0104, 0.0141), "9.9 mm") == "1.23 ± 0.20 cm [1.04, 1.41]"
    assert spread_text(Spread(3, 0.00911, 2e-5, 0.00909, 0.00913), "9.1 mm") == "0.911 ± 0.002 cm [0.909, 0.913]"
    assert spread_text(Spread.of([0.5]), "50.0 %") == "50.0 %"
    views = [(f"a, seed {k % 2}", {"run": {"seed": k % 2, "group": k // 2}, "summary": None}) for k in range(4)]
    assert [group.name for group in seed_groups(views)] == ["a: 2 seeds (runs 1, 2)", "a: 2 seeds (runs 3, 4)"]
