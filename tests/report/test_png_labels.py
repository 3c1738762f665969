"""Labels, warnings and the table of report.png by the extents that matplotlib gives them: nothing lies on anything."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from evaluation_paths import office
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox
from sample_metrics import mapped, sample_metrics

from hsloc.model import ScanDiagnostics, Trajectory
from hsloc.model.verdict import Verdict, VerdictReason
from hsloc.report.data import ReportParts
from hsloc.report.png import MOST_WARNINGS, report_figure
from hsloc.report.png_labels import place_labels
from hsloc.report.table import table_rows
from hsloc.warnings import RunWarning

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

OFFICE = office(np.random.default_rng(0), noise=False)


def along(*corners: tuple[float, float]) -> Trajectory:
    """A path of poses that are 0.1 m apart."""
    pieces = [np.linspace(a, b, round(10.0 * np.hypot(*np.subtract(b, a)))) for a, b in pairwise(corners)]
    xy = np.concatenate(pieces)
    return Trajectory(np.arange(len(xy), dtype=np.int64) * 10**8, np.column_stack((xy, np.zeros(len(xy)))))


def found_at(path: Trajectory, *rows: int) -> ScanDiagnostics:
    """A scan at each pose; at some the pose was found by a search."""
    scans = len(path)
    return ScanDiagnostics(
        stamps_ns=path.stamps_ns,
        status=tuple("relocalised" if k in rows else "matched" for k in range(scans)),
        fitness=np.full(scans, 0.9),
        sigma=np.full((scans, 3), 0.01),
        evaluations=np.zeros(scans, dtype=np.int64),
        reason=("",) * scans,
        covariance=np.zeros((scans, 3, 3)),
    )


def figure_of(trajectory: Trajectory, **others: Any) -> Figure:
    return report_figure(ReportParts(title="run.mcap", trajectory=trajectory, grid=OFFICE, **others))


def named(axes: Axes, name: str) -> Text:
    (found,) = [text for text in axes.texts if text.get_text() == name]
    return found


def crossed(axes: Axes, box: Bbox) -> list[str]:
    """Labels of the lines that go through a box."""
    lines = [line for line in axes.lines if line.get_linestyle() != "None"]
    inside = [line.get_path().transformed(line.get_transform()).intersects_bbox(box, filled=False) for line in lines]
    return [str(line.get_label()) for line, is_inside in zip(lines, inside, strict=True) if is_inside]


def marks(axes: Axes, label: str) -> list[Bbox]:
    """The boxes of marks, half as large as they are."""
    (line,) = [line for line in axes.lines if line.get_label() == label]
    half = 0.25 * line.get_markersize() * 100.0 / 72.0
    return [Bbox((xy - half, xy + half)) for xy in axes.transData.transform(np.column_stack(line.get_data()))]


@pytest.mark.parametrize(
    "corners",
    [
        ((-5.0, -2.0), (-5.0, 2.0), (5.0, 2.0)),
        ((-5.0, -2.0), (5.0, 2.0), (5.0, 1.0), (-5.0, -1.0)),  # the end is beside the start
        ((-5.0, 0.0), (5.0, 0.0), (-4.4, 0.05)),
        ((11.8, 3.0), (0.0, 3.0), (0.0, -3.0), (11.8, -3.0)),  # both at the edge of the panel
    ],
)
def test_start_and_end_are_named_off_the_path_the_marks_and_each_other(
    corners: tuple[tuple[float, float], ...],
) -> None:
    path = along(*corners)
    figure = figure_of(path, diagnostics=found_at(path, 12, len(path) - 14))
    (axes,) = [each for each in figure.axes if each.get_xlabel().startswith("x [")]
    labels = [named(axes, "start"), named(axes, "end")]
    boxes = [label.get_window_extent() for label in labels]
    assert not boxes[0].overlaps(boxes[1])
    for label, box in zip(labels, boxes, strict=True):
        assert crossed(axes, box) == []
        assert box.count_overlaps(marks(axes, "pose found by search")) == 0
        assert axes.bbox.x0 <= box.x0 < box.x1 <= axes.bbox.x1
        assert axes.bbox.y0 <= box.y0 < box.y1 <= axes.bbox.y1
        assert any(isinstance(effect, withStroke) for effect in label.get_path_effects())


def test_a_mark_that_lies_on_the_start_does_not_hide_it() -> None:
    path = along((-5.0, -2.0), (5.0, 2.0))
    figure = figure_of(path, diagnostics=found_at(path, 0))
    (axes,) = [each for each in figure.axes if each.get_xlabel().startswith("x [")]
    (star,) = [line for line in axes.lines if line.get_label() == "pose found by search"]
    ends = [line for line in axes.lines if line.get_marker() in ("o", "s")]
    assert len(ends) == 2
    assert all(end.get_zorder() > star.get_zorder() for end in ends)


def test_one_label_where_the_robot_came_back_to_the_start() -> None:
    (axes,) = [each for each in figure_of(along((0, 0), (5, 0), (5, 3), (0, 0))).axes if each.get_xlabel() == "x [m]"]
    assert {text.get_text() for text in axes.texts} >= {"start, end"}
    assert not {"start", "end"} & {text.get_text() for text in axes.texts}


def test_labels_that_have_no_room_nearby_get_a_line_to_their_mark() -> None:
    (axes,) = [each for each in figure_of(along((-6.0, -3.0), (6.0, 3.0))).axes if each.get_xlabel() == "x [m]"]
    before = len(axes.texts)
    crowd = np.array([(x, y) for x in np.arange(-1.5, 1.51, 0.25) for y in np.arange(-1.0, 1.01, 0.25)])
    axes.plot(*crowd.T, "s", markersize=7)
    (label,) = place_labels(axes, (("here", np.zeros(2)),))
    assert len(axes.texts) == before + 2
    middle = np.asarray(axes.transData.transform((0.0, 0.0)))
    box = label.get_window_extent()
    assert np.hypot(*(np.clip(middle, box.min, box.max) - middle)) > 20.0


WARNINGS = tuple(RunWarning(f"code_{k}", f"something was found {k} " + "and more " * 40, "do this") for k in range(5))


@pytest.mark.parametrize("number", [0, 1, MOST_WARNINGS, 5])
@pytest.mark.parametrize("reasons", [(), (VerdictReason(Verdict.CHECK, "slip", "the wheels slipped"),)])
def test_warnings_stand_below_the_verdict(number: int, reasons: tuple[VerdictReason, ...]) -> None:
    metrics = sample_metrics(warnings=WARNINGS[:number], verdict_reasons=reasons)
    figure = figure_of(along((-5.0, -2.0), (5.0, 2.0)), metrics=metrics)
    shown = [text for text in figure.texts if text.get_text().startswith("warning code_")]
    assert [text.get_text().split(":")[0] for text in shown] == [
        f"warning code_{k}" for k in range(number if number <= MOST_WARNINGS else MOST_WARNINGS - 1)
    ]
    others = [text for text in figure.texts if "other warnings: see report.html" in text.get_text()]
    assert [text.get_text().split()[1] for text in others] == (["3"] if number == 5 else [])
    boxes = [text.get_window_extent() for text in figure.texts if text.get_text()]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    assert all(box.x1 < 1600 for box in boxes)
    assert min(box.y0 for box in boxes) > max(axes.bbox.y1 for axes in figure.axes)


@pytest.mark.parametrize("width", [11.0, 5.0], ids=["wide", "high"])
@pytest.mark.parametrize("with_errors", [False, True])
def test_the_whole_table_is_in_the_picture(run: dict[str, Any], width: float, with_errors: bool) -> None:
    built = mapped(run["metrics"])
    metrics = replace(built, warnings=WARNINGS) if with_errors else replace(built, errors=None)
    path = along((-5.0, 0.0), (5.0, 0.2)) if width > 10.0 else along((0.0, -5.0), (0.2, 5.0))
    grid = office(np.random.default_rng(0), width_m=24.0 if width > 10.0 else 9.0, height_m=9.0, noise=False)
    figure = report_figure(ReportParts(title="", trajectory=path, grid=grid, metrics=metrics))
    (table,) = [axes for axes in figure.axes if not axes.axison]
    shown = {text.get_text() for text in table.texts}
    rows = {row.label: row for row in table_rows(metrics)}
    assert set(rows) <= shown
    assert rows["wall thickness"].values[0] in shown
    assert "usual: 9 to 21 cm, 2 to 4 cells" in shown
    boxes = [text.get_window_extent() for text in table.texts]
    assert min(box.y0 for box in boxes) >= 0.0
    assert max(box.x1 for box in boxes) <= 1600.0
    # A line's box has room for letters with tails: half of it is the letters.
    letters = [Bbox(((box.x0, box.y0 + 0.25 * box.height), (box.x1, box.y1 - 0.25 * box.height))) for box in boxes]
    assert not any(a.overlaps(b) for a, b in combinations(letters, 2))


@pytest.mark.parametrize(("away", "name"), [(1.5, "odometry alone"), (60.0, "odometry alone, goes on outside")])
def test_odometry_that_leaves_the_map_is_shown_or_said_to_go_on(away: float, name: str) -> None:
    path = along((-5.0, -2.0), (5.0, 2.0))
    top = 0.5 * OFFICE.resolution * OFFICE.cells.shape[0]
    odometry = along((-5.0, -2.0), (-5.0, top + away))
    (axes,) = [each for each in figure_of(path, odometry=odometry).axes if each.get_xlabel() == "x [m]"]
    assert [str(line.get_label()) for line in axes.lines].count(name) == 1
    assert bool(axes.get_ylim()[1] > top + away) is (name == "odometry alone")
