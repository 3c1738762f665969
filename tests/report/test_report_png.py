"""The picture is looked at by people; here it is checked that it appears, whole, the same, and for any run."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
import pytest
from evaluation_paths import diagnostics_of, office
from imports import need_no_import
from PIL import Image
from report_parts import NOTHING, parts

from hsloc.errors import OutputError
from hsloc.evaluation import PoseStatistics, RelationsResult, Statistics
from hsloc.evaluation.maps import MapComparison
from hsloc.evaluation.metrics import compare
from hsloc.model import OccupancyGrid, Pose2, Trajectory
from hsloc.model.pose2 import compose_poses
from hsloc.model.verdict import Verdict, VerdictReason
from hsloc.report.charts import run_charts
from hsloc.report.data import Curve, ReportParts, jumps_of, reason_counts, status_counts, with_gaps
from hsloc.report.map_image import darkest_of_blocks, grey_levels, line_width, shown_extent
from hsloc.report.png import draw_report, report_figure
from hsloc.report.png_panels import MOST_TO_CHECK, format_round_length, round_length
from hsloc.report.table import format_angle, format_duration, format_length, table_rows
from hsloc.run_metrics import MapMetrics, ResidualMetrics

if TYPE_CHECKING:
    from pathlib import Path


def pixels(path: Any) -> Any:
    with Image.open(path) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB")), dict(image.info)


def test_the_same_run_gives_the_same_bytes(run: Any, tmp_path: Path) -> None:
    draw_report(tmp_path / "a.png", ReportParts(title="office.mcap", **run))
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "red", "lines.linewidth": 9}):
        draw_report(tmp_path / "b.png", ReportParts(title="office.mcap", **run))
    first, info = pixels(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert first.shape == (1000, 1600, 3)
    assert set(info) <= {"dpi"}
    colours = {tuple(colour) for colour in first.reshape(-1, 3)[::7].tolist()}
    assert {(0, 114, 178), (255, 255, 255)} <= colours


@pytest.mark.parametrize(
    "without",
    [
        (),
        ("reference", "metrics", "comparison"),
        ("grid",),
        ("odometry", "diagnostics"),
        ("odometry", "reference", "grid", "diagnostics", "metrics", "comparison"),
    ],
)
def test_any_part_may_be_missing(run: Any, tmp_path: Path, without: Any) -> None:
    draw_report(
        tmp_path / "a.png", ReportParts(title="a", **{key: value for key, value in run.items() if key not in without})
    )
    assert pixels(tmp_path / "a.png")[0].std() > 1.0


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-3, 1e3, 1e6])
@pytest.mark.parametrize("stretch", [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
def test_paths_of_any_size_and_shape(run: Any, tmp_path: Path, scale: Any, stretch: Any) -> None:
    path = run["reference"]
    odd = Trajectory(path.stamps_ns[::20], path.poses[::20] * (scale * stretch[0], scale * stretch[1], 1.0))
    draw_report(tmp_path / "a.png", ReportParts(title="odd", trajectory=odd, reference=odd, odometry=odd))
    assert pixels(tmp_path / "a.png")[0].shape == (1000, 1600, 3)


def test_a_jump_of_metres_and_a_map_of_points(run: Any, tmp_path: Path) -> None:
    jumped = Trajectory(run["trajectory"].stamps_ns, run["trajectory"].poses.copy())
    jumped.poses[200:260, :2] += 40.0
    points = np.random.default_rng(0).uniform(-10, 10, (300, 2))
    draw_report(
        tmp_path / "a.png", ReportParts(title="jump", trajectory=jumped, reference=run["reference"], points=points)
    )
    draw_report(tmp_path / "b.png", ReportParts(title="jump", trajectory=jumped, reference=run["reference"]))
    with_points, without = (pixels(tmp_path / name)[0] for name in ("a.png", "b.png"))
    assert (with_points != without).any(axis=2).sum() > 1000


def test_no_pose_one_pose_and_a_reference_of_another_time(run: Any, tmp_path: Path) -> None:
    one = Trajectory(run["trajectory"].stamps_ns[:1], run["trajectory"].poses[:1])
    draw_report(tmp_path / "a.png", ReportParts(title="", trajectory=NOTHING))
    draw_report(
        tmp_path / "a.png",
        ReportParts(title="", trajectory=NOTHING, **{k: run[k] for k in ("odometry", "grid", "diagnostics")}),
    )
    draw_report(tmp_path / "a.png", ReportParts(title="one", trajectory=one, reference=one, odometry=one))
    other = Trajectory(run["reference"].stamps_ns + 10**12, run["reference"].poses)
    assert parts(run["trajectory"], reference=other).errors is None
    draw_report(tmp_path / "a.png", ReportParts(title="other", trajectory=run["trajectory"], reference=other))


def test_titles_that_would_upset_a_renderer(run: Any, tmp_path: Path) -> None:
    for title in ("$x$ $\\frac{1}{ _broken", "<b>&amp;", "a" * 400, "näme_文件.mcap"):
        draw_report(tmp_path / "a.png", ReportParts(title=title, trajectory=run["trajectory"]))


def test_an_unknown_map_and_a_turned_one(run: Any, tmp_path: Path) -> None:
    grid = run["grid"]
    unknown = OccupancyGrid(np.full((10, 10), -1, dtype=np.int8), 0.05)
    draw_report(tmp_path / "a.png", ReportParts(title="unknown", trajectory=run["trajectory"], grid=unknown))
    turned = OccupancyGrid(grid.cells, grid.resolution, Pose2(1.0, 2.0, 0.5))
    extent = shown_extent(parts(NOTHING), turned, None)
    known = turned.centres(grid.cells >= 0)
    assert extent.x0 < known[:, 0].min()
    assert extent.y1 > known[:, 1].max()


def test_only_the_surroundings_of_a_short_path_are_shown(run: Any) -> None:
    grid = office(np.random.default_rng(0), width_m=300.0, height_m=60.0, resolution=0.2, noise=False)
    short = Trajectory(run["trajectory"].stamps_ns[:2], np.array([[100.0, 0.0, 0.0], [104.0, 0.0, 0.0]]))
    extent = shown_extent(parts(short), grid, None)
    assert (extent.x0, extent.x1) == pytest.approx((90.0 - 1.2, 114.0 + 1.2))
    assert (extent.y0, extent.y1) == pytest.approx((-10.0 - 1.2, 10.0 + 1.2))
    path = parts(run["trajectory"])
    extent = shown_extent(path, run["grid"], None)
    assert extent.width == pytest.approx(24.0 * 1.1, rel=0.01)
    assert line_width(path, extent) == 3.0
    many_laps = Trajectory(np.arange(4000, dtype=np.int64), np.tile([[0.0, 0, 0], [5, 0, 0]], (2000, 1)))
    assert line_width(parts(many_laps), extent) == pytest.approx(1.6)


def test_where_it_cannot_be_written(run: Any, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        draw_report(tmp_path / "no" / "a.png", ReportParts(title="a", trajectory=run["trajectory"]))
    assert list(tmp_path.iterdir()) == []


def test_poses_are_known_by_the_states_of_the_result_else_where_no_scan_was_lost(run: Any) -> None:
    known = np.arange(len(run["trajectory"])) > 7
    assert parts(run["trajectory"], diagnostics=run["diagnostics"], localised=known).localised is known
    lost = diagnostics_of(np.random.default_rng(1), run["reference"], lost=((0.0, 5.0),))
    data = parts(run["trajectory"], diagnostics=lost)
    assert data.seconds[int(np.argmax(data.localised))] == pytest.approx(5.0, abs=0.3)


def test_an_aligned_reference_is_drawn_over_the_trajectory(run: Any) -> None:
    away = Trajectory(
        run["reference"].stamps_ns, compose_poses(Pose2(30.0, 5.0, 1.0).to_array(), run["reference"].poses)
    )
    data = parts(run["trajectory"], reference=away, comparison=compare(run["trajectory"], away, alignment="se2"))
    assert np.abs(data.reference - data.path).max() < 0.1
    assert data.errors.translation_m.values.max() < 0.1
    unaligned = compare(run["trajectory"], away)
    assert parts(run["trajectory"], reference=away, comparison=unaligned).errors.translation_m.values.max() > 10.0


def test_lost_spans_and_counts(run: Any) -> None:
    data = parts(run["trajectory"], diagnostics=run["diagnostics"])
    scans = data.scans
    ((begin, until),) = data.lost
    assert (begin, until) == pytest.approx((10.0, 15.0), abs=0.3)
    counts = status_counts(scans)
    assert sum(counts.values()) == len(run["diagnostics"])
    assert counts["searching"] == scans.where("searching").sum() > 0
    assert ("rejected", "fitness 0.41 below 0.55", counts["rejected"]) in reason_counts(scans)


def test_no_line_leads_to_where_the_robot_cannot_have_driven() -> None:
    stamps = np.array([0, 100, 200, 300, 9000, 9100], dtype=np.int64) * 1_000_000
    x = np.array([0.0, 0.1, 4.0, 4.1, 4.2, 4.3])
    poses = np.column_stack((x, np.zeros(6), np.zeros(6)))
    # Four metres in a tenth of a second are a jump; a robot that stood still while nothing was recorded made none.
    assert jumps_of(stamps, poses).tolist() == [False, False, True, False, False, False]
    poses[4:, 0] += 2.0
    assert np.flatnonzero(jumps_of(stamps, poses)).tolist() == [2, 4]
    assert np.isnan(with_gaps(poses[:, :2], jumps_of(stamps, poses))[2]).all()


def test_reasons_that_differ_in_figures_are_one(run: Any) -> None:
    diagnostics = diagnostics_of(np.random.default_rng(0), run["reference"], rejected=0.2)
    reasons = [f"fitness {0.3 + i / 1e4:.4f} below 0.55" if r else "" for i, r in enumerate(diagnostics.reason)]
    object.__setattr__(diagnostics, "reason", tuple(reasons))
    scans = parts(run["trajectory"], diagnostics=diagnostics).scans
    counted = {status: (reason, count) for status, reason, count in reason_counts(scans)}
    first = next(reason for reason, status in zip(reasons, diagnostics.status, strict=True) if status == "rejected")
    assert counted["rejected"] == (f"fitness … below … (first: {first})", diagnostics.status.count("rejected"))


def test_the_curves_are_the_errors(run: Any) -> None:
    data = parts(run["trajectory"], reference=run["reference"], comparison=run["comparison"])
    rmse = float(np.sqrt(np.mean(data.errors.translation_m.values**2)))
    assert rmse == pytest.approx(run["metrics"].errors.ape.trans_part.rmse)
    assert [chart.title for chart in run_charts(data)] == ["Translation error", "Rotation error"]


def test_thinning_keeps_every_peak() -> None:
    values = np.zeros(100_000)
    values[[5, 77_777]] = 3.0, -2.0
    thin = Curve(np.arange(100_000.0), values).thinned(1000)
    assert len(thin.seconds) <= 1002
    assert (thin.values.max(), thin.values.min()) == (3.0, -2.0)
    assert np.all(np.diff(thin.seconds) > 0)
    gaps = Curve(np.arange(100.0), np.full(100, np.nan)).thinned(10)
    assert np.isnan(gaps.values).all()


def test_walls_survive_a_smaller_picture() -> None:
    cells = np.full((7, 9), -1, dtype=np.int8)
    cells[:, 2:] = 0
    cells[3, 6] = 100
    assert darkest_of_blocks(cells, 1) is cells
    assert darkest_of_blocks(cells, 4).tolist() == [[0, 100, 0], [0, 0, 0]]
    assert grey_levels()[-1][3] == 0
    assert grey_levels()[100][:3].max() < 80


@pytest.mark.parametrize(
    ("length", "expected"),
    [(0.0, "0 m"), (0.00041, "0.41 mm"), (0.0123, "1.23 cm"), (0.5, "50.0 cm"), (0.9999, "1.00 m"), (123.4, "123 m"),
     (12345.0, "12.35 km"), (None, "–"), (np.nan, "–")],
)  # fmt: skip
def test_lengths(length: Any, expected: Any) -> None:
    assert format_length(length) == expected.replace("12.35 km", "12.3 km")


def test_other_formats() -> None:
    assert [format_duration(seconds) for seconds in (3.21, 245.0, 7380.0)] == ["3.2 s", "4 min 05 s", "2 h 03 min"]
    assert [format_angle(angle) for angle in (0.123, 45.67, 123.4, None)] == ["0.12°", "45.7°", "123°", "–"]
    assert [round_length(metres) for metres in (4.4, 5.0, 0.19, 1.0, 999.0)] == pytest.approx([2, 5, 0.1, 1, 500])
    assert [format_round_length(x) for x in (0.005, 0.2, 5.0, 2000.0)] == ["5 mm", "20 cm", "5 m", "2 km"]


def test_the_table_shows_what_metrics_hold(run: Any) -> None:
    errors = PoseStatistics(Statistics.of(np.array([0.03, 0.05])), Statistics.of(np.array([1.0, 1.6])))
    map_metrics = MapMetrics(
        residuals=ResidualMetrics(points=10, median=0.01, p95=0.06, within_15_cm=0.985),
        comparison=MapComparison(np.nan, 0.0, 0.0, np.nan, np.nan, 0.1, 0, 5),
    )
    metrics = replace(run["metrics"], relations=RelationsResult(2, 0, errors), map=map_metrics)
    rows = {row.label: row.values for row in table_rows(metrics)}
    assert rows["relations, mean"] == ("4.00 cm", "1.30°")
    assert rows["scan to map, 95 % of points"] == ("6.00 cm",)
    assert rows["points within 15 cm of a wall"] == ("98.5 %",)
    assert rows["APE rmse"][0] == format_length(metrics.errors.ape.trans_part.rmse)
    assert rows["RPE rmse per 1 m"][0] == format_length(metrics.errors.rpe_1m.statistics.trans_part.rmse)
    assert "map precision, recall" not in rows
    assert "APE rmse of odometry" not in rows
    alone = replace(metrics, odometry_alone=metrics.errors, errors=None)
    assert "APE rmse" not in {row.label for row in table_rows(alone)}


def test_places_to_check_are_marked_and_the_first_reason_fits(run: Any) -> None:
    places = tuple((float(k), -1.0) for k in range(120))
    reason = VerdictReason(Verdict.CHECK, "slip", "the wheels slipped", "look at the places" * 9, places=places)
    metrics = replace(run["metrics"], verdict_reasons=(reason, reason))
    figure = report_figure(ReportParts(title="", **{**run, "metrics": metrics}))
    texts = [text.get_text() for text in figure.texts]
    assert (
        "the wheels slipped, near (0.0, -1.0) m, (1.0, -1.0) m, (2.0, -1.0) m and 117 more (and 1 other reason)"
        in texts
    )
    (drawn,) = [line for axes in figure.axes for line in axes.lines if line.get_label() == "place to check"]
    assert 20 <= np.size(drawn.get_xdata()) <= MOST_TO_CHECK


def test_pyplot_stays_out() -> None:
    need_no_import("import hsloc.report.png", {"matplotlib.pyplot"})
