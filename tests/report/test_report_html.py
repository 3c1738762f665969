"""The page is looked at by people; here: that it is whole, closed to the network, and shows text as text."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from evaluation_paths import diagnostics_of
from PIL import Image

from hsloc.errors import OutputError
from hsloc.model import OccupancyGrid, Pose2, Trajectory
from hsloc.model.verdict import Verdict, VerdictReason
from hsloc.report.data import Provenance, ReportParts, prepare
from hsloc.report.html import time_charts, write_report_html
from hsloc.report.svg import MOST_MARKS, Chart, chart_svg, map_svg, runs, ticks
from hsloc.warnings import RunWarning

if TYPE_CHECKING:
    from pathlib import Path

NASTY = "<script>alert('x')</script> & \"quoted\" {{data}} {{nothing}} ]]> <b>"
VOID = {"meta", "input", "br", "link"}


class Page(HTMLParser):
    """Elements, their text and attributes; fails where tags do not close each other."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, Any]]] = []
        self.text: list[tuple[str, str]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[Any]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append((self.open[-1] if self.open else "", data))

    def all(self, tag: str) -> list[Any]:
        return [attributes for name, attributes in self.elements if name == tag]

    def within(self, tag: str) -> str:
        return "".join(data for name, data in self.text if name == tag)


def parts(trajectory: Trajectory, **others: Any) -> Any:
    return prepare(ReportParts(title="", trajectory=trajectory, **others))


def write(tmp_path: Path, **arguments: Any) -> tuple[str, Page]:
    write_report_html(tmp_path / "report.html", ReportParts(**{"title": "office.mcap", **arguments}))
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    return text, Page(text)


def test_it_is_whole_the_same_and_loads_nothing(run: dict[str, Any], tmp_path: Path) -> None:
    text, page = write(tmp_path, **run)
    assert write(tmp_path, **run)[0] == text
    own = re.sub(r"base64,[^\"]+", "", text)
    assert not re.search(r"https?:|[\"'(]//|@import|url\(|fetch|XMLHttpRequest", own)
    for tag, attributes in page.elements:
        for name in ("src", "href"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, name)
    assert "default-src 'none'" in text
    names = {attributes.get("data-name") for attributes in page.all("svg")}
    assert names >= {"error_cm", "error_deg", "fitness", "sigma_cm", "sigma_deg", "evaluations"}
    layers = {attributes.get("data-layer") for attributes in page.all("g")}
    assert layers >= {"map", "trajectory", "reference", "odometry", "rejected", "relocalised"}
    assert {attributes["data-toggle"] for attributes in page.all("input")} <= layers
    assert f"{run['metrics'].errors.ape.trans_part.rmse:.4f}" in page.within("td")


def nasty_metrics(run: Any) -> Any:
    metrics = run["metrics"]
    warning, reason = RunWarning(NASTY, NASTY, NASTY), VerdictReason(Verdict.CHECK, NASTY, NASTY + "!", NASTY)
    return replace(
        metrics,
        verdict=Verdict.CHECK,
        verdict_reasons=(reason,),
        run=replace(metrics.run, map=NASTY, matcher=NASTY),
        log=replace(metrics.log, reference=NASTY, lasers=(replace(metrics.log.lasers[0], topic=NASTY),)),
        scans=replace(metrics.scans, by_status={NASTY: 1}),
        losses=replace(metrics.losses, notes=(NASTY,)),
        warnings=(warning,),
        evaluation_error=NASTY,
    )


def test_text_is_text(run: dict[str, Any], tmp_path: Path) -> None:
    diagnostics = diagnostics_of(np.random.default_rng(1), run["reference"], rejected=0.5)
    reasons = tuple(NASTY if reason else "" for reason in diagnostics.reason)
    object.__setattr__(diagnostics, "reason", reasons)
    provenance = Provenance(NASTY, NASTY, {NASTY: NASTY}, {NASTY: NASTY})
    arguments = {**run, "diagnostics": diagnostics, "metrics": nasty_metrics(run)}
    text, page = write(tmp_path, **{**arguments, "title": NASTY}, provenance=provenance, convergence={
        NASTY: (np.arange(5.0), np.linspace(0.5, 0.9, 5))
    })  # fmt: skip
    assert "<script>alert" not in text
    assert len(page.all("script")) == 2
    assert page.within("h1") == NASTY
    assert page.within("title").startswith(NASTY)
    assert page.within("pre").count("alert('x')") >= 3
    assert NASTY in page.within("code")
    assert page.all("b") == []


def test_the_script_finds_its_data(run: dict[str, Any], tmp_path: Path) -> None:
    text, page = write(tmp_path, **run)
    (source,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, flags=re.S)
    data = json.loads(source)
    outputs = {attributes["data-for"] for attributes in page.all("output")}
    assert outputs == set(data["charts"])
    curve = data["charts"]["error_cm"]
    assert len(curve["t"]) == len(curve["v"])
    assert np.sqrt(np.mean(np.square(curve["v"]))) / 100 == pytest.approx(
        run["metrics"].errors.ape.trans_part.rmse, rel=0.2
    )
    assert data["path"]["x"][0] == pytest.approx(run["trajectory"].poses[0, 0], abs=1e-5)


@pytest.mark.parametrize(
    "kept", [(), ("grid",), ("diagnostics",), ("reference",), ("odometry", "metrics"), ("reference", "comparison")]
)
def test_any_part_may_be_missing(run: Any, tmp_path: Path, kept: Any) -> None:
    write(tmp_path, trajectory=run["trajectory"], **{name: run[name] for name in kept})
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)))
    write(tmp_path, trajectory=nothing, **{name: run[name] for name in kept})
    still = Trajectory(run["trajectory"].stamps_ns, run["trajectory"].poses * 0.0)
    write(tmp_path, trajectory=still, **{name: run[name] for name in kept})


def test_a_map_of_points(run: dict[str, Any], tmp_path: Path) -> None:
    _, page = write(tmp_path, trajectory=run["trajectory"], points=np.array([[1.0, 2.0], [3.0, 4.0]]))
    (dots,) = [attributes["d"] for attributes in page.all("path") if attributes.get("class") == "points"]
    assert dots.count("h0") == 2
    assert "points" in {attributes["data-toggle"] for attributes in page.all("input")}


def test_why_scans_were_not_used(run: dict[str, Any], tmp_path: Path) -> None:
    _, page = write(tmp_path, **run)
    count = sum(status == "rejected" for status in run["diagnostics"].status)
    assert "fitness 0.41 below 0.55" in page.within("td")
    titles = [data for name, data in page.text if name == "title"]
    assert sum("fitness 0.41" in title for title in titles) == count
    used = diagnostics_of(np.random.default_rng(2), run["reference"], rejected=0.0)
    object.__setattr__(used, "reason", ("",) * len(used))
    _, page = write(tmp_path, trajectory=run["trajectory"], diagnostics=used)
    assert "Every scan was used." in page.within("p")


def test_the_embedded_map_is_the_map() -> None:
    cells = np.full((6, 8), -1, dtype=np.int8)
    cells[1:5, 2:7] = 0
    cells[1, 3] = 100
    svg, _ = map_svg(
        parts(Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)))),
        OccupancyGrid(cells, 0.5, Pose2(10.0, 20.0, 0.0)),
        None,
    )
    (source,) = re.findall(r"base64,([^\"]+)", svg)
    with Image.open(io.BytesIO(base64.b64decode(source))) as image:
        levels = np.asarray(image.convert("RGBA"))
    assert levels.shape == (4, 5, 4)
    assert levels[..., 3].min() == 255
    dark = np.argwhere(levels[..., 0] < 100)
    assert dark.tolist() == [[3, 1]]
    # The lower left corner of the known part lies at (11, 20.5), the middle of the picture at (12.25, 21.5).
    assert 'width="2.5" height="2"' in svg
    assert "translate(-1.25 1)" in svg


def test_a_path_is_drawn_true_and_thin() -> None:
    rng = np.random.default_rng(0)
    n = 200_000
    poses = np.column_stack((np.cumsum(rng.normal(0, 0.01, (n, 2)), axis=0) + 5e5, np.zeros(n)))
    path = Trajectory(np.arange(n, dtype=np.int64) * 10**7, poses)
    svg, extent = map_svg(parts(path), None, None)
    assert len(svg) < 800_000
    (d,) = re.findall(r'class="trajectory" d="M([^"]*)"', svg)
    drawn = np.array([[float(number) for number in point.split()] for point in d.split("L")])
    middle = np.array(((extent.x0 + extent.x1) / 2, (extent.y0 + extent.y1) / 2))
    back = drawn * (1, -1) + middle
    assert back[0] == pytest.approx(poses[0, :2], abs=0.02)
    assert back[-1] == pytest.approx(poses[-1, :2], abs=0.02)
    # Nothing of the true path is far from what is drawn.
    from scipy.spatial import cKDTree

    assert cKDTree(back).query(poses[::50, :2])[0].max() < 0.1


def test_many_marks_are_thinned(run: dict[str, Any]) -> None:
    n = 3 * MOST_MARKS
    rng = np.random.default_rng(0)
    path = Trajectory(np.arange(n, dtype=np.int64) * 10**8, np.cumsum(rng.normal(0, 1, (n, 3)), axis=0))
    diagnostics = diagnostics_of(rng, path, every=1, rejected=1.0)
    svg, _ = map_svg(parts(path, diagnostics=diagnostics), None, None)
    assert svg.count("rejected at") <= MOST_MARKS


def test_where_it_cannot_be_written(run: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_report_html(tmp_path / "no" / "report.html", ReportParts(title="a", trajectory=run["trajectory"]))


def test_charts_by_hand() -> None:
    assert ticks(0.0, 2.3, 4) == pytest.approx([0, 1, 2])
    assert ticks(0.0, 139.0, 8) == pytest.approx([0, 20, 40, 60, 80, 100, 120])
    assert ticks(3.0, 3.0, 4) == [3.0]
    assert runs(np.array([0.0, 0.1, 0.2, 1.0]), 0.15) == [(0.0, 0.2), (1.0, 1.0)]
    assert runs(np.array([]), 1.0) == []


def test_a_chart_breaks_where_the_pose_was_lost(run: Any) -> None:
    data = parts(run["trajectory"], diagnostics=run["diagnostics"])
    (fitness,) = [chart for chart in time_charts(data) if chart.name == "fitness"]
    svg = chart_svg(fitness, 30.0)
    (d,) = re.findall(r'class="line green" d="([^"]*)"', svg)
    assert d.count("M") == 2
    assert svg.count('class="lost"') == 1


def test_a_wide_range_is_drawn_on_powers_of_ten(run: Any) -> None:
    data = parts(run["trajectory"], reference=run["reference"], comparison=run["comparison"])
    (chart,) = [chart for chart in time_charts(data) if chart.name == "error_cm"]
    chart.curve.values[10] = 5000.0
    labels = re.findall(r'text-anchor="end">([\d.]+)<', chart_svg(Chart("a", "a", "cm", chart.curve), 30.0))
    assert {"1", "10", "100", "1000"} <= set(labels)
