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
from report_parts import NOTHING, parts, view_in

from hsloc.analysis.scan_statistics import Coverage, ScanOverlay
from hsloc.errors import OutputError
from hsloc.model import OccupancyGrid, Pose2, Trajectory
from hsloc.model.estimate import Ambiguity, LikelyPlace
from hsloc.model.verdict import Verdict, VerdictReason
from hsloc.report.charts import run_charts
from hsloc.report.data import MOST_AMBIGUITIES, Provenance, ReportParts
from hsloc.report.html import write_report_html
from hsloc.report.png import report_figure
from hsloc.report.view import MOST_EDGES, MOST_MARKS, MOST_POSES, graph_view, runs, view_of
from hsloc.slam.pose_graph import Edges, PoseGraph
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


def write(tmp_path: Path, **arguments: Any) -> tuple[str, Page]:
    write_report_html(tmp_path / "report.html", ReportParts(**{"title": "office.mcap", **arguments}))
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    return text, Page(text)


def test_it_is_whole_the_same_and_loads_nothing(run: dict[str, Any], tmp_path: Path) -> None:
    text, page = write(tmp_path, **run)
    assert write(tmp_path, **run)[0] == text
    own = re.sub(r"base64,[^\"]+", "", text)
    assert not re.search(r"https?:|[\"'(]//[^ ]|@import|url\(|fetch\(|XMLHttpRequest", own)
    for tag, attributes in page.elements:
        for name in ("src", "href"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, name)
    assert "default-src 'none'" in text
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


def test_the_view_holds_what_the_run_holds(run: dict[str, Any], tmp_path: Path) -> None:
    view = view_in(write(tmp_path, **run)[0])
    charts = {chart["name"]: chart for chart in view["charts"]}
    assert set(charts) == {"error_cm", "error_deg", "sigma_cm", "sigma_deg", "fitness"}
    curve = charts["error_cm"]
    assert len(curve["t"]) == len(curve["v"])
    assert np.sqrt(np.mean(np.square([v for v in curve["v"] if v is not None]))) / 100 == pytest.approx(
        run["metrics"].errors.ape.trans_part.rmse, rel=0.2
    )
    assert max(v for v in curve["v"] if v is not None) / 100 == pytest.approx(
        run["metrics"].errors.ape.trans_part.max, rel=1e-4
    )
    # The line breaks where the pose was lost; refused matches are marks.
    assert charts["fitness"]["v"].count(None) == 1
    refused = sum(status == "rejected" for status in run["diagnostics"].status)
    assert len(charts["fitness"]["marks"]["t"]) == refused > 0
    path = view["trajectory"]
    assert path["x"][0] == pytest.approx(run["trajectory"].poses[0, 0], abs=1e-3)
    assert path["states"] == ["localised", "lost"]
    assert max(error for error in path["error"] if error is not None) <= run["metrics"].errors.ape.trans_part.max + 1e-4
    assert [mark["status"] for mark in view["marks"]] == ["rejected", "relocalised"]
    assert len(view["marks"][0]["t"]) == refused
    kinds = {event["kind"] for event in view["events"]}
    assert kinds == {"loss", "rejected"}
    assert sum(row["count"] for row in view["status"]) == len(run["diagnostics"])
    assert view["summary"]["figures"][0]["name"] == "APE rmse"


@pytest.mark.parametrize(
    "kept", [(), ("grid",), ("diagnostics",), ("reference",), ("odometry", "metrics"), ("reference", "comparison")]
)
def test_any_part_may_be_missing(run: Any, tmp_path: Path, kept: Any) -> None:
    write(tmp_path, trajectory=run["trajectory"], **{name: run[name] for name in kept})
    write(tmp_path, trajectory=NOTHING, **{name: run[name] for name in kept})
    still = Trajectory(run["trajectory"].stamps_ns, run["trajectory"].poses * 0.0)
    write(tmp_path, trajectory=still, **{name: run[name] for name in kept})


def test_a_map_of_points(run: dict[str, Any], tmp_path: Path) -> None:
    text, _ = write(tmp_path, trajectory=run["trajectory"], points=np.array([[1.0, 2.0], [3.0, 4.0]]))
    assert view_in(text)["points"] == {"x": [1.0, 3.0], "y": [2.0, 4.0]}


def test_why_scans_were_not_used(run: dict[str, Any], tmp_path: Path) -> None:
    _, page = write(tmp_path, **run)
    count = sum(status == "rejected" for status in run["diagnostics"].status)
    assert "fitness 0.41 below 0.55" in page.within("td")
    assert str(count) in page.within("td")
    used = diagnostics_of(np.random.default_rng(2), run["reference"], rejected=0.0)
    object.__setattr__(used, "reason", ("",) * len(used))
    _, page = write(tmp_path, trajectory=run["trajectory"], diagnostics=used)
    assert "Every scan was used." in page.within("p")


def test_the_embedded_map_is_the_map(tmp_path: Path) -> None:
    cells = np.full((6, 8), -1, dtype=np.int8)
    cells[1:5, 2:7] = 0
    cells[1, 3] = 100
    grid = OccupancyGrid(cells, 0.5, Pose2(10.0, 20.0, 0.0))
    text, _ = write(tmp_path, trajectory=NOTHING, grid=grid)
    frame = view_in(text)["map"]
    # The lower left corner of the known part lies at (11, 20.5).
    assert (frame["side"], frame["width"], frame["height"], frame["corner"]) == (0.5, 5, 4, [11.0, 20.5, 0.0])
    with Image.open(io.BytesIO(base64.b64decode(frame["image"].partition("base64,")[2]))) as image:
        levels = np.asarray(image.convert("RGBA"))
    assert levels.shape == (4, 5, 4)
    assert levels[..., 3].min() == 255
    assert np.argwhere(levels[..., 0] < 100).tolist() == [[3, 1]]


def test_a_long_path_is_drawn_true_and_thin() -> None:
    rng = np.random.default_rng(0)
    n = 200_000
    poses = np.column_stack((np.cumsum(rng.normal(0, 0.01, (n, 2)), axis=0) + 5e5, np.zeros(n)))
    poses[123_456:, 0] += 5.0
    path = Trajectory(np.arange(n, dtype=np.int64) * 10**7, poses)
    diagnostics = diagnostics_of(rng, path, every=30, rejected=1.0)
    shown = ReportParts(title="", trajectory=path, diagnostics=diagnostics)
    view, _ = view_of(shown)
    trajectory = view["trajectory"]
    assert len(trajectory["x"]) <= MOST_POSES + 3
    assert (trajectory["x"][-1], trajectory["y"][-1]) == pytest.approx(tuple(poses[-1, :2]), abs=1e-3)
    (jump,) = trajectory["breaks"]  # with both of its sides
    assert trajectory["t"][jump - 1 : jump + 1] == [1234.55, 1234.56]
    assert len(view["marks"][0]["t"]) <= MOST_MARKS
    assert len(json.dumps(view)) < 800_000


def test_scans_lie_where_they_were_taken(run: dict[str, Any]) -> None:
    path = run["trajectory"]
    cloud = np.array([[1.0, 0.0], [0.0, 2.0], [400.0, -400.0]])
    overlay = ScanOverlay(
        stamps_ns=path.stamps_ns[[40, 0]],
        poses=path.poses[[40, 0]],
        far=np.array([0.02, np.nan]),
        rows=np.array([0]),
        points=(cloud,),
        distances=(np.array([0.0, 0.07, 9.0]),),
    )
    view, _ = view_of(ReportParts(title="", trajectory=path, diagnostics=run["diagnostics"], overlay=overlay))
    scans = view["scans"]
    assert (scans["t"], scans["count"], scans["far"]) == ([2.0], [3], [0.02])
    assert (scans["x"][0], scans["y"][0]) == pytest.approx(tuple(path.poses[40, :2]), abs=1e-3)
    points = np.frombuffer(base64.b64decode(scans["points"]), dtype="<i2").reshape(-1, 2)
    assert points.tolist() == [[100, 0], [0, 200], [32767, -32767]]  # farther than any lidar sees
    assert list(base64.b64decode(scans["distances"])) == [0, 7, 255]
    assert scans["status"][0]
    (far,) = [chart for chart in view["charts"] if chart["name"] == "far_cm"]
    assert (far["t"], far["v"]) == ([2.0, 10.0], [2.0, None])  # the line breaks where the pose was lost


@pytest.mark.parametrize("known", [True, False])
def test_a_pose_that_is_known_during_a_search_was_found_later(run: dict[str, Any], known: bool) -> None:
    path, diagnostics = run["trajectory"], run["diagnostics"]
    row = diagnostics.status.index("searching")
    stamps = diagnostics.stamps_ns[[row]]
    cloud, near = np.array([[1.0, 0.0]]), np.array([0.0])
    overlay = ScanOverlay(
        stamps_ns=stamps, poses=path.poses[:1], far=near, rows=np.array([0]), points=(cloud,), distances=(near,)
    )
    localised = np.full(len(path), known)
    view, _ = view_of(
        ReportParts(title="", trajectory=path, diagnostics=diagnostics, overlay=overlay, localised=localised)
    )
    (status,) = view["scans"]["status"]
    assert status.startswith("during the pose search")
    assert ("placed once it had ended" in status) is known


def test_coverage_holds_counts_of_any_size(run: dict[str, Any], tmp_path: Path) -> None:
    counts = np.array([[0, 1, 7], [1000, 60_000, 0]], dtype=np.int32)
    shown = {**run, "coverage": Coverage(counts, 0.25, Pose2(-1.0, 2.0, 0.5))}
    coverage = view_in(write(tmp_path, **shown)[0])["coverage"]
    assert (coverage["side"], coverage["width"], coverage["height"], coverage["most"]) == (0.25, 3, 2, 60_000)
    assert coverage["corner"] == [-1.0, 2.0, 0.5]
    levels = np.frombuffer(base64.b64decode(coverage["levels"]), dtype=np.uint8).reshape(2, 3)
    np.testing.assert_allclose(2.0 ** (levels[::-1] / 16) - 1.0, counts, rtol=0.05)  # the top row first
    nothing = replace(shown["coverage"], counts=np.zeros_like(counts))
    assert view_of(ReportParts(title="", **run, coverage=nothing)).values["coverage"] is None


def test_places_between_which_a_run_does_not_decide_are_drawn(run: dict[str, Any], tmp_path: Path) -> None:
    stamps = run["trajectory"].stamps_ns
    places = (LikelyPlace(Pose2(1.0, 2.0, 0.5), 0.75), LikelyPlace(Pose2(99.0, 2.0, 0.5), 0.25))
    stretches = [Ambiguity(int(stamps[k]), int(stamps[3 * k]), int(stamps[2 * k]), places) for k in range(10)]
    shown = ReportParts(title="", **run, ambiguities=tuple(stretches))
    view, _ = view_of(shown)
    found = view["ambiguities"]
    assert len(found) == MOST_AMBIGUITIES
    assert (found[-1]["begin"], found[-1]["end"], found[-1]["at"]) == (0.45, 1.35, 0.9)  # the longest, at 20 Hz
    assert (found[0]["x"], found[0]["theta"], found[0]["p"]) == ([1.0, 99.0], [0.5, 0.5], [0.75, 0.25])
    assert found[-1]["labels"] == ["75 % at 1 s", "25 % at 1 s"]
    assert view["extent"][2] > 99.0  # all of them are in the picture
    (event, *_) = [each for each in view["events"] if each["kind"] == "ambiguous"]
    assert event["text"].endswith("x 1.0 m, y 2.0 m (75 %), x 99.0 m, y 2.0 m (25 %)")
    axes = report_figure(shown).axes[-1]
    assert "place that may be right" in axes.get_legend_handles_labels()[1]
    assert {text.get_text() for text in axes.texts} >= {label for each in found for label in each["labels"]}


def test_places_of_the_reasons_of_a_verdict_are_marked(run: dict[str, Any]) -> None:
    reasons = (
        VerdictReason(Verdict.CHECK, "slip", "a slip", places=((1.0, 2.0), (3.0, 4.0))),
        VerdictReason(Verdict.CHECK, "x", "all"),
    )
    view, _ = view_of(ReportParts(title="", **run | {"metrics": replace(run["metrics"], verdict_reasons=reasons)}))
    mark = view["marks"][-1]
    assert (mark["status"], mark["x"], mark["y"]) == ("to_check", [1.0, 3.0], [2.0, 4.0])
    assert mark["reason"] == ["a slip", "a slip"]


def test_without_a_pose_times_begin_with_the_first_scan(run: dict[str, Any]) -> None:
    diagnostics = run["diagnostics"]
    overlay = ScanOverlay(
        stamps_ns=diagnostics.stamps_ns[[0, 20]],
        poses=np.zeros((2, 3)),
        far=np.zeros(2),
        rows=np.array([0, 1]),
        points=(np.ones((1, 2)),) * 2,
        distances=(np.zeros(1),) * 2,
    )
    view, _ = view_of(ReportParts(title="", trajectory=NOTHING, diagnostics=diagnostics, overlay=overlay))
    assert view["scans"]["t"] == pytest.approx((diagnostics.stamps_ns[[0, 20]] - diagnostics.stamps_ns[0]) / 1e9)
    assert view["status"][0]["runs"][0][0] == 0.0


def test_a_view_is_drawn_once_and_stays_as_it_is(run: dict[str, Any], tmp_path: Path) -> None:
    shown = ReportParts(title="office.mcap", **run)
    view = view_of(shown)
    write_report_html(tmp_path / "given.html", shown, view)
    assert "image" not in view.values["map"]
    assert (tmp_path / "given.html").read_text(encoding="utf-8") == write(tmp_path, **run)[0]


def test_where_it_cannot_be_written(run: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_report_html(tmp_path / "no" / "report.html", ReportParts(title="a", trajectory=run["trajectory"]))


def test_of_many_edges_the_longest_are_drawn() -> None:
    n = MOST_EDGES + 3
    poses = np.column_stack((np.arange(n) ** 1.01, np.zeros(n), np.zeros(n)))
    chain = np.stack((np.arange(n - 1), np.arange(1, n)), axis=1)
    edges = Edges(chain, np.zeros((n - 1, 3)), np.zeros((n - 1, 3, 3)), np.zeros(n - 1))
    found = graph_view(PoseGraph(np.arange(n), poses, edges))
    assert found is not None
    assert (len(found["edges"]), found["total"], found["x"][0]) == (MOST_EDGES, n - 1, 2.014)  # the first two are gone
    assert found["edges"][0] == [0, 1]
    assert graph_view(PoseGraph(np.arange(n), poses, Edges.none())) is None


def test_runs_and_logarithms_by_hand(run: Any) -> None:
    assert runs(np.array([0.0, 0.1, 0.2, 1.0]), 0.15) == [(0.0, 0.2), (1.0, 1.0)]
    assert runs(np.array([]), 1.0) == []
    data = parts(run["trajectory"], reference=run["reference"], comparison=run["comparison"])
    (chart,) = [chart for chart in run_charts(data) if chart.name == "error_cm"]
    assert not chart.is_logarithmic
    chart.curve.values[10] = 5000.0
    assert chart.is_logarithmic
