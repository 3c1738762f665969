"""report.png: where the robot went, how large the errors are, and how certain the result is, in one picture."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hsloc.atomic_write import write_atomically
from hsloc.report import style
from hsloc.report.data import prepare
from hsloc.report.map_image import Extent, shown_extent
from hsloc.report.png_panels import Panel, draw_map, draw_panel, draw_table, time_panels
from hsloc.report.table import Row, summary, table_rows

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from hsloc.evaluation import Comparison
    from hsloc.model import OccupancyGrid, ScanDiagnostics, Trajectory
    from hsloc.report.data import ReportData
    from hsloc.run_metrics import RunMetrics

WIDTH, HEIGHT, DPI = 16.0, 10.0, 100
"""The picture is 1600 x 1000 pixels."""

LEFT, LEFT_OF_AXES, RIGHT, BOTTOM, TOP = 0.015, 0.05, 0.985, 0.06, 0.9
"""Edges as parts of the picture: of text, of axes (their numbers are left of them), and of all below the head."""

LINE = 0.031
"""Height of a line of the table, as a part of the picture's."""

WIDE = 2.1
"""From this ratio of width to height on, the map takes the whole width, and the rest is below it."""

SETTINGS_THAT_STAY = ("backend", "backend_fallback", "interactive", "toolbar", "webagg", "tk.", "savefig.directory")


def draw_report(
    path: str | Path,
    *,
    title: str,
    trajectory: Trajectory,
    odometry: Trajectory | None = None,
    reference: Trajectory | None = None,
    grid: OccupancyGrid | None = None,
    diagnostics: ScanDiagnostics | None = None,
    metrics: RunMetrics | None = None,
    comparison: Comparison | None = None,
    localised: NDArray[np.bool_] | None = None,
    points: NDArray[np.float64] | None = None,
) -> None:
    """Draw the report of a run as a PNG of 1600 x 1000 pixels: the same run gives the same bytes.

    `comparison` of trajectory and reference gives the error curves, `localised` (n,) marks the known poses.
    `points`, shape (n, 2) in metres, are drawn as a map of points. All poses are in the map frame, but for the
    reference, which `comparison` aligns. Raises `OutputError` where `path` cannot be written.
    """
    data = prepare(trajectory, odometry, reference, diagnostics, comparison, localised)
    # A user's matplotlibrc must not change the picture.
    defaults = {
        key: value for key, value in matplotlib.rcParamsDefault.items() if not key.startswith(SETTINGS_THAT_STAY)
    }
    with (
        warnings.catch_warnings(),
        matplotlib.rc_context({**defaults, "font.family": style.FONT, "axes.unicode_minus": True}),
    ):
        # A letter that the font lacks becomes a box in the picture: the user need not be warned.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure = _figure(title, data, grid, points, metrics)
        # Without the version of matplotlib in the file.
        write_atomically(
            Path(path), lambda stream: figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
        )


def _figure(
    title: str,
    data: ReportData,
    grid: OccupancyGrid | None,
    points: NDArray[np.float64] | None,
    metrics: RunMetrics | None,
) -> Figure:
    figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DPI, facecolor=style.PAPER)
    FigureCanvasAgg(figure)
    rows = [] if metrics is None else table_rows(metrics)
    extent, panels = shown_extent(data, grid, points), time_panels(data)
    left, bottom, width, height = _place(figure, extent, panels, rows, data)
    axes = figure.add_axes((left, bottom, width, height))
    shown = extent.widened(width * WIDTH / (height * HEIGHT))
    draw_map(axes, data, grid, points, shown, max(width * WIDTH, height * HEIGHT) * DPI)
    _draw_head(figure, axes, title, [] if metrics is None else summary(metrics))
    return figure


def _draw_head(figure: Figure, axes: Axes, title: str, facts: list[str]) -> None:
    """Title, and below it the facts on the left and the legend on the right, as much of them as there is room."""
    # A dollar sign in a file's name is no formula.
    heading = figure.text(LEFT, 0.982, "", fontsize=20, fontweight="bold", color=style.INK, va="top", parse_math=False)
    line = figure.text(LEFT, 0.937, "", fontsize=12, color=style.MUTED, va="top")
    handles, labels = axes.get_legend_handles_labels()
    legend = figure.legend(
        handles, labels, loc="upper right", bbox_to_anchor=(RIGHT, 0.94), ncols=max(len(labels), 1), frameon=False,
        fontsize=style.TEXT, labelcolor=style.INK, handlelength=2.2, columnspacing=1.3, handletextpad=0.6,
        borderaxespad=0.0, borderpad=0.0,
    )  # fmt: skip
    taken = legend.get_window_extent().width / (WIDTH * DPI)
    for most in range(len(title), 0, -1):
        heading.set_text(title if most == len(title) else f"{title[: most // 2]}…{title[-(most - most // 2) :]}")
        if heading.get_window_extent().width / (WIDTH * DPI) <= RIGHT - LEFT:
            break
    for count in range(len(facts), -1, -1):
        line.set_text("  ·  ".join(facts[:count]))
        if line.get_window_extent().width / (WIDTH * DPI) <= RIGHT - LEFT - taken - 0.02:
            break


Box = tuple[float, float, float, float]


def _place(figure: Figure, extent: Extent, panels: list[Panel], rows: list[Row], data: ReportData) -> Box:
    """Draw panels and table beside the map or below it; returns the box that is left for the map."""
    if not panels and not rows:
        return LEFT_OF_AXES, BOTTOM, RIGHT - LEFT_OF_AXES, TOP - BOTTOM
    if extent.aspect > WIDE:
        height = min(max((RIGHT - LEFT_OF_AXES) * WIDTH / extent.aspect / HEIGHT, 0.3), 0.48)
        below = TOP - height - 0.1
        split = LEFT_OF_AXES + 0.6 * (RIGHT - LEFT_OF_AXES) if panels else LEFT_OF_AXES - 0.055
        _draw_panels(figure, panels, data, (LEFT_OF_AXES, BOTTOM, split - LEFT_OF_AXES, below - BOTTOM))
        _draw_rows(figure, rows, (split + 0.055, BOTTOM, RIGHT - split - 0.055, below - BOTTOM))
        return LEFT_OF_AXES, TOP - height, RIGHT - LEFT_OF_AXES, height
    width = min(max((TOP - BOTTOM) * HEIGHT * extent.aspect / WIDTH, 0.36), 0.64)
    column = LEFT_OF_AXES + width + 0.055
    table = min(LINE * (len(rows) + 2), 0.5) if rows else 0.0
    above = TOP - BOTTOM - table - (0.065 if rows else 0.0)
    _draw_panels(figure, panels, data, (column, TOP - above, RIGHT - column, above))
    _draw_rows(figure, rows, (column, BOTTOM - 0.02 if panels else TOP - table, RIGHT - column, table))
    return LEFT_OF_AXES, BOTTOM, width, TOP - BOTTOM


def _draw_panels(figure: Figure, panels: list[Panel], data: ReportData, box: Box) -> None:
    """The panels one below the other; their headings are within the box, the time of the last below it."""
    left, bottom, width, height = box
    heading = 0.036
    each = height / max(len(panels), 1)
    for index, panel in enumerate(panels):
        y = bottom + height - (index + 1) * each
        axes = figure.add_axes((left, y, width, each - heading))
        draw_panel(axes, panel, data, with_time=index == len(panels) - 1)


def _draw_rows(figure: Figure, rows: list[Row], box: Box) -> None:
    if rows:
        draw_table(figure.add_axes(box), rows, line_height=LINE / box[3])
