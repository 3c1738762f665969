"""RunMetrics: one value for all readers; the same figure has the same name and value wherever it is shown."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema_rs
import numpy as np
import pytest
from sample_metrics import sample_metrics

from hsloc.cli.main import main
from hsloc.errors import HslocError
from hsloc.evaluation.metrics import compare
from hsloc.model import Trajectory
from hsloc.model.verdict import Verdict, VerdictReason, verdict_of
from hsloc.report.data import ReportParts
from hsloc.report.png import report_figure
from hsloc.report.summary import ResultSummary
from hsloc.report.table import (
    error_statistics,
    format_angle,
    format_length,
    format_share,
    reason_text,
    reason_texts,
    table_rows,
)
from hsloc.run_metrics import LocalisedMetrics, RunMetrics, RunTimings, schema
from hsloc.warnings import RunWarning, WarningCode
from hsloc_service.execution.worker import summarise

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[2]
KIDNAPPED = ROOT / "recordings" / "kidnapped.mcap"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """(folder, what the terminal shows) of a robot that is kidnapped after 30 s."""
    import contextlib
    import io

    folder, terminal = tmp_path_factory.mktemp("run") / "out", io.StringIO()
    with contextlib.redirect_stdout(terminal):
        assert main(["replay", str(KIDNAPPED), "--start", "20", "--end", "36", "--out", str(folder)]) == 0
    return folder, terminal.getvalue()


@pytest.fixture(scope="module")
def metrics(run: Any) -> Any:
    return RunMetrics.read(run[0] / "metrics.json")


def words(text: str) -> str:
    """Without tags, and with single spaces."""
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", text)).split())


def test_the_published_schema_is_that_of_the_classes() -> None:
    path = ROOT / "docs" / "schemas" / "run-metrics.json"
    made = json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"
    assert path.read_text(encoding="utf-8") == made, "run: python -m hsloc.run_metrics docs/schemas"
    assert jsonschema_rs.meta.is_valid(schema())


def test_every_number_of_the_schema_has_a_unit_or_is_a_count() -> None:
    def numbers(part: Any, name: Any) -> Iterator[Any]:
        for key, value in part.get("properties", {}).items():
            if "number" in value.get("type", ()):
                yield f"{name}.{key}", value["description"]

    found = schema()
    unitless = [
        key
        for name, part in (("RunMetrics", found), *found["$defs"].items())
        for key, text in numbers(part, name)
        if not re.search(r"\[.+\]|from 0 to 1|null without a match", text)
    ]
    statistics = ("rmse", "mean", "median", "std", "min", "max", "sse")  # in the unit of what they are of
    assert set(unitless) == {*(f"Statistics.{name}" for name in statistics), "RelativeError.delta"}


def test_a_run_fits_the_schema_and_reads_back(run: Any, metrics: Any) -> None:
    written = json.loads((run[0] / "metrics.json").read_text())
    jsonschema_rs.validate(schema(), written)
    assert metrics.to_json() == written
    assert metrics.verdict == "check"
    assert (metrics.errors, metrics.localised_only, metrics.odometry_alone) != (None, None, None)
    times = json.loads((run[0] / "timings.json").read_text())
    assert RunTimings.from_json(times).to_json() == times
    assert {"open", "replay", "analyse", "run_mcap", "reports"} <= times["seconds"].keys()
    assert min(times["seconds"].values()) > 0.0


def test_what_cannot_be_measured_is_null_and_reads_back_as_nan() -> None:
    path = Trajectory(np.arange(3, dtype=np.int64), np.zeros((3, 3)))
    values = json.loads(json.dumps(sample_metrics(compare(path, path)).to_json(), allow_nan=False))
    jsonschema_rs.validate(schema(), values)
    assert values["rpe_1m"]["trans_part"]["rmse"] is None
    assert np.isnan(RunMetrics.from_json(values).errors.rpe_1m.statistics.trans_part.rmse)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema_version": "2.0"}, "schema version is '2.0', not 1.2; run the replay again"),
        ({"schema_version": None}, "an earlier one"),
        ({"scans": {"total": 3}}, r"RunMetrics\.scans\.used is missing"),
        ({"fitness": {"median": "high", "p05": None}}, r"RunMetrics\.fitness\.median is 'high'"),
        ({"verdict": "splendid"}, r"RunMetrics\.verdict is 'splendid'"),
        ({"log": 3}, r"RunMetrics\.log is 3; it must be an object"),
    ],
)
def test_other_content_is_refused_by_name(tmp_path: Path, change: Any, message: Any) -> None:
    path = tmp_path / "metrics.json"
    path.write_text(json.dumps(sample_metrics().to_json() | change))
    with pytest.raises(HslocError, match=message) as caught:
        RunMetrics.read(path)
    assert str(path) in str(caught.value)


def test_keys_of_a_later_version_are_ignored() -> None:
    later = sample_metrics().to_json() | {"schema_version": "1.9", "brand_new": {"x": 1}}
    assert RunMetrics.from_json(later) == replace(sample_metrics(), schema_version="1.9")


def test_every_code_is_documented() -> None:
    text = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8")
    assert [code for code in WarningCode if f"| `{code}` |" not in text] == []


def test_the_worst_reason_is_the_verdict() -> None:
    reasons = [VerdictReason(Verdict(each), "x", "x") for each in ("check", "failed", "check")]
    assert verdict_of(reasons) == Verdict.FAILED
    assert verdict_of(reasons[:1]) == Verdict.CHECK
    assert verdict_of([]) == Verdict.GOOD


def forms_of(number: float) -> set[str]:
    """A number of metrics.json as the figures may show it."""
    shares = {format_share(number)} if 0.0 <= number <= 1.0 else set()
    zero = {"less than a cell"} if number == 0.0 else set()
    angles = {format_angle(number), format_angle(np.degrees(number))}
    return {format_length(number), *angles, str(number), f"{number:.3f}", *shares, *zero}


def test_every_figure_is_the_same_in_metrics_on_the_terminal_in_the_reports_and_on_the_page(
    run: Any, metrics: Any
) -> None:
    folder, terminal = run
    report, shown = words((folder / "report.html").read_text()), words(terminal)
    written = json.loads((folder / "metrics.json").read_text())
    summary = summarise(metrics, RunTimings(seconds={"replay": 1.0}, times_real_time=None, evaluations_per_second=None))
    on_page = {each["name"]: each["values"] for each in summary["figures"]}
    parts = ReportParts(title="a", trajectory=Trajectory(np.zeros(0, np.int64), np.zeros((0, 3))), metrics=metrics)
    picture = report_figure(parts)
    # A long value is in lines that follow each other.
    in_picture = " | ".join(" ".join(text.get_text() for text in axes.texts) for axes in picture.axes)
    result = ResultSummary.of(metrics)
    names = {row.label for row in result.figures}
    assert {"APE rmse", "APE rmse where localised", "APE rmse of odometry", "localised"} <= names
    assert [row.label for row in result.key_figures] == [
        "localised", "APE rmse where localised", "points within 15 cm of a wall"
    ]  # fmt: skip
    for row in result.figures:
        line = " ".join([row.label, *row.values])
        assert line in shown
        assert line in report
        assert html.escape(row.explanation) in (folder / "report.html").read_text()
        assert on_page[row.label] == list(row.values)
        assert line in in_picture
        assert row.sources
        for pointer in row.sources:
            number = written
            for key in pointer.split("/"):
                number = number[key]
            assert any(form in " ".join(row.values) for form in forms_of(number)), (row.label, pointer)
    for text in (result.verdict_text, result.headline, *result.reasons):
        assert text in shown
        assert text in report
    in_head = {text.get_text() for text in picture.texts}
    assert {"CHECK"} <= in_head
    assert any(text.startswith(result.headline) for text in in_head)
    assert (summary["headline"], summary["verdict_text"]) == (result.headline, result.verdict_text)
    assert summary["metrics"]["verdict"] == metrics.verdict
    (reason,) = metrics.verdict_reasons
    assert summary["verdict_reasons"][0]["line"] == reason_text(reason)
    for label, unit, values in error_statistics(metrics):
        assert f"{label} [{unit}] {values.rmse:.4f} {values.mean:.4f}" in report


def test_the_headline_of_what_was_found() -> None:
    lost = VerdictReason(Verdict.CHECK, "poses_lost", "x", times=((1.0, 2.0), (5.0, 7.5)))
    scans = replace(sample_metrics().scans, by_status={"relocalised": 2})
    metrics = sample_metrics(
        verdict_reasons=(lost,), verdict=Verdict.CHECK, localised=LocalisedMetrics(share_of_poses=0.9999), scans=scans
    )
    assert ResultSummary.of(metrics).headline == (
        "Localised on the map of the log: > 99.9 % of the poses are known; "
        "the pose was lost 2 times, for 3.5 s in all, and found again."
    )
    nowhere = replace(metrics, localised=LocalisedMetrics(share_of_poses=0.0), verdict=Verdict.FAILED)
    assert ResultSummary.of(nowhere).headline == "Not localised on the map of the log: every pose is a guess."
    assert ResultSummary.of(nowhere).verdict_text == "failed: the result is not usable"
    built = replace(metrics, run=replace(metrics.run, mode="slam", map="built"))
    assert ResultSummary.of(built).headline == "Built a map from 0 scans."


def test_the_error_of_a_kidnapped_robot_is_shown_where_it_is_localised_too(run: Any, metrics: Any) -> None:
    """Not 1.5 m alone, when all that is wrong is a second that the robot itself calls a guess."""
    whole, known = metrics.errors.ape.trans_part.rmse, metrics.localised_only.ape.trans_part.rmse
    assert known < 0.05 < 1.0 < whole
    assert f"APE rmse where localised {100 * known:.2f} cm" in words(run[1])


def test_counts_of_scans_add_up(run: Any, metrics: Any) -> None:
    scans = metrics.scans
    assert sum(scans.by_status.values()) == sum(scans.by_reason.values()) == scans.total
    matched, others = (row.values[0] for row in table_rows(metrics) if row.label.startswith("scans"))
    assert matched == f"{scans.used} of {scans.total}"
    assert "skipped (robot had hardly moved)" in others
    assert scans.used + sum(int(n) for n in re.findall(r"(\d+) [a-z]", others)) == scans.total


def test_the_reasons_name_places_and_times(metrics: Any) -> None:
    (reason,) = metrics.verdict_reasons
    assert reason.code == "poses_lost"
    ((begin, end),) = reason.times
    assert 9.0 < begin < end < 13.0
    assert len(reason.places) == 1
    assert reason_text(replace(reason, remedy="look")) == (
        f"{reason.text}, from {begin:.1f} to {end:.1f} s, "
        f"near ({reason.places[0][0]:.1f}, {reason.places[0][1]:.1f}) m; look"
    )
    many = replace(reason, times=((0.0, 1.0),) * 5, places=(), remedy="")
    assert reason_text(many).endswith(", from 0.0 to 1.0 s, 0.0 to 1.0 s, 0.0 to 1.0 s and 2 more")
    assert reason_text(replace(many, times=(), places=((-0.01, 2.0),))).endswith(", near (0.0, 2.0) m")
    several = [replace(many, text=text, times=(), remedy=remedy) for text, remedy in zip("abc", "xxy", strict=True)]
    assert reason_texts(several) == ["a", "b; x", "c; y"]  # a shared remedy once
    assert reason_texts([]) == []


def test_a_job_keeps_all_warnings_of_the_run() -> None:
    """Those of the analysis too, which concern the result more than those of the log."""
    warnings = (
        RunWarning(WarningCode.CLOCKS_APART, "stamps differ"),
        RunWarning(WarningCode.SCANS_WITHOUT_PLACE, "x" * 600, "check the map"),
    )
    metrics = sample_metrics(warnings=warnings)
    summary = summarise(metrics, RunTimings(seconds={"replay": 1.0}, times_real_time=None, evaluations_per_second=None))
    assert [each["code"] for each in summary["warnings"]] == ["clocks_apart", "scans_without_place"]
    assert summary["warnings"][1] == {"code": "scans_without_place", "text": "x" * 500, "remedy": "check the map"}
