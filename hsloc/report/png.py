"""Pictures by matplotlib: report.png of a run, and the plots of `hsloc eval`.

The plots show trajectories with the reference, the error on the map, and errors over time.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from hsloc.atomic_write import write_atomically
from hsloc.errors import OutputError, not_written
from hsloc.report import style
from hsloc.report.changes import draw_changes
from hsloc.report.charts import Chart, run_charts
from hsloc.report.data import prepare, since
from hsloc.report.map_image import Extent, shown_extent
from hsloc.report.png_labels import label_ends
from hsloc.report.png_panels import draw_map, draw_panel, draw_places_to_check, draw_table, line_count
from hsloc.report.summary import VERDICT_WORDS, ResultSummary, count, short_warnings
from hsloc.report.table import reason_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.text import Text
    from numpy.typing import NDArray

    from hsloc.evaluation import Comparison
    from hsloc.model.verdict import VerdictReason
    from hsloc.report.data import ReportData, ReportParts
    from hsloc.report.table import Row

WIDTH, HEIGHT, DPI = 16.0, 10.0, 100
"""The picture is 1600 x 1000 pixels."""

LEFT, LEFT_OF_AXES, RIGHT, BOTTOM, TOP = 0.015, 0.05, 0.985, 0.06, 0.88
"""Edges as parts of the picture: of text, of axes (their numbers are left of them), and of all below the head."""

HEAD, TEXT_LINE = 0.909, 0.023
"""Where the third line of the head is, and the height of one of its small lines, as parts of the picture's."""

MOST_WARNINGS = 3
"""Warnings that are shown; the last line says how many others there are."""

LINE, USUAL_LINE, LEAST_LINE = 0.031, 0.024, 0.0165
"""Height of a line of the table, as a part of the picture's: where there is room, where the type has its usual size,
and as low as it may be, with smaller type."""

LEAST_SCALE = 0.8
"""The map may be drawn this much smaller, so that odometry which leaves it is in the picture; if not, it is cut."""

MOST_PANELS, LEAST_PANEL = 3, 0.075
"""Curves that are shown at most, the most important first, and the height that each needs with its heading."""

WIDE = 2.1
"""From this ratio of width to height on, the map takes the whole width, and the rest is below it."""

SETTINGS_THAT_STAY = ("backend", "backend_fallback", "interactive", "toolbar", "webagg", "tk.", "savefig.directory")

Box = tuple[float, float, float, float]
_PLOT: dict[str, Any] = {"figsize": (13.0, 6.5), "layout": "constrained"}
_INKS = (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE, style.ORANGE)
FORMATS: dict[str, dict[str, str | None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
"""Kinds of picture, without the time, so that the same errors give the same bytes."""


def draw_report(path: str | Path, parts: ReportParts, data: ReportData | None = None) -> None:
    """Draw the report of a run as a PNG of 1600 x 1000 pixels: the same run gives the same bytes.

    `data` is what `prepare(parts)` gave, where it is known already. Raises `OutputError` where the file cannot be
    written.
    """
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
        canvas = report_figure(parts, data).canvas
        assert isinstance(canvas, FigureCanvasAgg)  # that on which texts were measured already
        canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    # None of them is clear. Level 3 of zlib: 3 % more bytes than at 6 in two thirds of the time.
    image = Image.fromarray(pixels).convert("RGB")
    write_atomically(Path(path), lambda stream: image.save(stream, format="PNG", dpi=(DPI, DPI), compress_level=3))


def report_figure(parts: ReportParts, data: ReportData | None = None) -> Figure:
    """The picture before it is drawn; `data` is what `prepare(parts)` gave, where it is known already."""
    figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DPI, facecolor=style.PAPER)
    FigureCanvasAgg(figure)
    data = prepare(parts) if data is None else data
    summary = None if parts.metrics is None else ResultSummary.of(parts.metrics)
    rows = [] if summary is None else list(summary.figures)
    warned = [] if parts.metrics is None else _warning_lines(short_warnings(parts.metrics))
    reasons = () if parts.metrics is None else parts.metrics.verdict_reasons
    head = HEAD - (0.027 if reasons else 0.0)
    top = min(head - TEXT_LINE * len(warned) - 0.012, TOP)
    extent, panels = _with_odometry(shown_extent(data, parts.grid, parts.points), data), run_charts(data)[:MOST_PANELS]
    left, bottom, width, height = _place(figure, (extent, top), panels, rows, data)
    axes = figure.add_axes((left, bottom, width, height))
    shown = extent.widened(width * WIDTH / (height * HEIGHT))
    draw_map(axes, data, parts.grid, parts.points, shown, max(width * WIDTH, height * HEIGHT) * DPI)
    draw_changes(axes, parts.map_changes)
    draw_places_to_check(axes, [place for reason in reasons for place in reason.places])
    label_ends(axes, data)
    _draw_head(figure, axes, parts.title, summary, reasons)
    for k, text in enumerate(warned):
        line = figure.text(
            LEFT, head - k * TEXT_LINE, "", fontsize=style.SMALL, color=style.MUTED, va="top", parse_math=False
        )
        _fit(line, [text, *(f"{text[:most]}…" for most in range(len(text) - 1, 0, -1))], RIGHT - LEFT)
    return figure


def _warning_lines(texts: Sequence[str]) -> list[str]:
    """What stands below the reasons; a job and report.html have all of it, with remedies."""
    shown = texts if len(texts) <= MOST_WARNINGS else texts[: MOST_WARNINGS - 1]
    lines = [text if text.startswith("log: ") else f"warning {text}" for text in shown]
    others = len(texts) - len(shown)
    return [*lines, f"and {count(others, 'other warning')}: see report.html"] if others else lines


def _with_odometry(extent: Extent, data: ReportData) -> Extent:
    """With all of the odometry, if what else is shown does not become too small."""

    def scale(shown: Extent) -> float:
        """Parts of the picture's width a metre, at most."""
        below = min((RIGHT - LEFT_OF_AXES) / shown.width, 0.48 * HEIGHT / WIDTH / shown.height)
        return max(below, min(0.64 / shown.width, (TOP - BOTTOM) * HEIGHT / WIDTH / shown.height))

    whole = extent if data.odometry is None else extent.around(data.odometry)
    return whole if scale(whole) >= LEAST_SCALE * scale(extent) else extent


def _draw_head(
    figure: Figure, axes: Axes, title: str, summary: ResultSummary | None, reasons: Sequence[VerdictReason]
) -> None:
    """Title and legend, the verdict with the headline and the facts, and the first reason, as much as there is room."""
    wide = WIDTH * DPI
    handles, labels = axes.get_legend_handles_labels()
    legend = figure.legend(
        handles, labels, loc="upper right", bbox_to_anchor=(RIGHT, 0.976), ncols=max(len(labels), 1), frameon=False,
        fontsize=style.TEXT, labelcolor=style.INK, handlelength=2.2, columnspacing=1.3, handletextpad=0.6,
        borderaxespad=0.0, borderpad=0.0,
    )  # fmt: skip
    taken = legend.get_window_extent().width / wide
    # A dollar sign in a file's name is no formula.
    heading = figure.text(LEFT, 0.985, "", fontsize=20, fontweight="bold", color=style.INK, va="top", parse_math=False)
    _fit(heading, [_shortened(title, most) for most in range(len(title), 0, -1)], RIGHT - LEFT - taken - 0.02)
    if summary is None:
        return
    badge = figure.text(
        LEFT + 0.004, 0.9385, summary.verdict.upper(), fontsize=12, fontweight="bold", color="white", va="top",
        bbox={"boxstyle": "round,pad=0.25", "facecolor": style.VERDICT[summary.verdict], "linewidth": 0},
    )  # fmt: skip
    start = LEFT + 0.02 + badge.get_window_extent().width / wide
    line = figure.text(start, 0.9385, "", fontsize=12.5, color=style.INK, va="top", parse_math=False)
    texts = [summary.headline, VERDICT_WORDS[summary.verdict], *summary.facts[1:]]
    _fit(line, ["  ·  ".join(texts[:count]) for count in range(len(texts), 0, -1)], RIGHT - start)
    if summary.reasons:
        others = len(summary.reasons) - 1
        more = f" (and {count(others, 'other reason')})" if others else ""
        line = figure.text(LEFT, HEAD, "", fontsize=11, color=style.INK, va="top", parse_math=False)
        # What there is no room for is in report.html: the remedy first, then places, then times.
        first, text = replace(reasons[0], remedy=""), reasons[0].text
        whole = [summary.reasons[0], reason_text(first), reason_text(replace(first, places=())), text]
        cuts = [*whole, *(f"{text[:most]}…" for most in range(len(text), 0, -1))]
        _fit(line, [f"{each}{more}" for each in cuts], RIGHT - LEFT)


def _shortened(text: str, most: int) -> str:
    return text if most >= len(text) else f"{text[: most // 2]}…{text[-(most - most // 2) :]}"


def _fit(line: Text, texts: list[str], width: float) -> None:
    """Show the first of the texts that is at most `width` (a part of the picture) wide, else the last."""
    low, high = 0, len(texts) - 1  # Each is shorter than the one before.
    middle = 0  # Most lines have room: to measure a text takes as long as to draw it.
    while low < high:
        line.set_text(texts[middle])
        if line.get_window_extent().width / (WIDTH * DPI) <= width:
            high = middle
        else:
            low = middle + 1
        middle = (low + high) // 2
    if texts:
        line.set_text(texts[low])


def _place(figure: Figure, shown: tuple[Extent, float], panels: list[Chart], rows: list[Row], data: ReportData) -> Box:
    """Draw panels and table beside the map or below it; returns the box that is left for the map.

    `shown` is what the map shows, and the upper edge of all.
    """
    extent, top = shown
    if not panels and not rows:
        return LEFT_OF_AXES, BOTTOM, RIGHT - LEFT_OF_AXES, top - BOTTOM
    if extent.aspect > WIDE:
        split = LEFT_OF_AXES + 0.6 * (RIGHT - LEFT_OF_AXES) if panels else LEFT_OF_AXES - 0.055
        lines = line_count(rows, (RIGHT - split - 0.055) * WIDTH * DPI)
        # The table begins above the panels and ends below them, which have headings and times.
        room = top - 0.065 - 0.02 - min(USUAL_LINE * lines, 0.45)
        height = min(max((RIGHT - LEFT_OF_AXES) * WIDTH / extent.aspect / HEIGHT, 0.3), 0.48, max(room, 0.3))
        below = top - height - 0.065
        _draw_panels(figure, panels, data, (LEFT_OF_AXES, BOTTOM, split - LEFT_OF_AXES, below - BOTTOM))
        _draw_rows(figure, rows, (split + 0.055, 0.02, RIGHT - split - 0.055, below - 0.02))
        return LEFT_OF_AXES, top - height, RIGHT - LEFT_OF_AXES, height
    width = min(max((top - BOTTOM) * HEIGHT * extent.aspect / WIDTH, 0.36), 0.64)
    column = LEFT_OF_AXES + width + 0.055
    lines = line_count(rows, (RIGHT - column) * WIDTH * DPI)
    table = min(LINE * lines + 0.01, 0.55) if rows else 0.0
    above = top - 0.02 - table - 0.085 if rows else top - BOTTOM
    _draw_panels(figure, panels, data, (column, top - above, RIGHT - column, above))
    _draw_rows(figure, rows, (column, 0.02 if panels else top - table, RIGHT - column, table))
    return LEFT_OF_AXES, BOTTOM, width, top - BOTTOM


def _draw_panels(figure: Figure, panels: list[Chart], data: ReportData, box: Box) -> None:
    """The panels one below the other; their headings are within the box, the time of the last below it."""
    left, bottom, width, height = box
    heading = 0.036
    panels = panels[: max(int(height / LEAST_PANEL), 1)]
    each = height / max(len(panels), 1)
    for index, panel in enumerate(panels):
        y = bottom + height - (index + 1) * each
        axes = figure.add_axes((left, y, width, each - heading))
        draw_panel(axes, panel, data, with_time=index == len(panels) - 1)


def _draw_rows(figure: Figure, rows: list[Row], box: Box) -> None:
    if rows:
        line = min(LINE, max(box[3] / line_count(rows, box[2] * WIDTH * DPI), LEAST_LINE))
        size = style.TEXT * min(line / USUAL_LINE, 1.0)
        draw_table(figure.add_axes(box), rows, line_height=line / box[3], size=size)


def draw_comparisons(comparisons: Mapping[str, Comparison], figure: Figure | None = None) -> Figure:
    """The figure: paths with the reference on the left, translation and rotation errors over time on the right.

    A single estimate is coloured by its error, as evo does.
    """
    figure = Figure(**_PLOT) if figure is None else figure
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    paths, translation = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    rotation = figure.add_subplot(grid[1, 1], sharex=translation)
    first = min(int(each.pairs.stamps_ns.min()) for each in comparisons.values())
    for k, (name, each) in enumerate(comparisons.items()):
        order = np.argsort(each.pairs.stamps_ns, kind="stable")
        seconds = since(each.pairs.stamps_ns[order], first)
        error, turn = each.errors.trans_part[order], each.errors.angle_deg[order]
        reference, moved = each.pairs.reference[order], each.aligned[order, :2]
        ink = _INKS[k % len(_INKS)]
        paths.plot(*reference[:, :2].T, "--", color=style.MUTED, linewidth=1.0, label="reference" if k == 0 else None)
        if len(comparisons) == 1 and len(moved) > 1:
            _by_error(figure, paths, moved, error)
        else:
            paths.plot(*moved.T, color=ink, linewidth=1.6, label=name)
        translation.plot(seconds, error * 100.0, color=ink, linewidth=1.1, label=name)
        rotation.plot(seconds, turn, color=ink, linewidth=1.1)
    paths.set_aspect("equal", adjustable="datalim")
    alignment = next(iter(comparisons.values())).alignment
    paths.set(xlabel="x [m]", ylabel="y [m]", title=f"Path (alignment {alignment})")
    translation.set(ylabel="translation error [cm]", title="Absolute pose error")
    rotation.set(ylabel="rotation error [deg]", xlabel="time [s]")
    for axes in (translation, rotation):
        axes.set_ylim(bottom=0.0)
    for axes in (paths, translation, rotation):
        axes.grid(color=style.RULE, linewidth=0.6)
        axes.set_axisbelow(True)
    paths.legend(loc="best", fontsize=style.SMALL)
    if len(comparisons) > 1:
        translation.legend(loc="best", fontsize=style.SMALL)
    return figure


def _by_error(figure: Figure, axes: Axes, path: NDArray[np.float64], error: NDArray[np.float64]) -> None:
    pieces = np.stack((path[:-1], path[1:]), axis=1)
    lines = LineCollection(list(pieces), cmap="viridis", linewidths=2.0)
    lines.set_array(100.0 * error[1:])
    axes.add_collection(lines)
    axes.autoscale_view()
    figure.colorbar(lines, ax=axes, label="translation error [cm]", shrink=0.7)


def save_plot(path: Path, comparisons: Mapping[str, Comparison]) -> None:
    """Write the figure as PNG, SVG or PDF, by the name's ending. Raises OutputError."""
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise OutputError(f"{path}: unknown kind of picture; name a file that ends in {', '.join(FORMATS)}")
    try:
        with matplotlib.rc_context({"svg.hashsalt": "hsloc"}):  # else ids of an SVG differ from one time to the next
            draw_comparisons(comparisons).savefig(path, dpi=140, metadata=FORMATS[kind])
    except OSError as error:
        raise OutputError(not_written(path, error)) from error


def show_plot(comparisons: Mapping[str, Comparison]) -> None:
    """Open the figure in a window, and wait until it is closed. Raises OutputError where there is none to open."""
    from matplotlib import pyplot

    if matplotlib.get_backend().lower() == "agg":
        raise OutputError("--plot: there is no display, or no toolkit for windows (tkinter); use --save-plot FILE.png")
    draw_comparisons(comparisons, pyplot.figure(**_PLOT))
    pyplot.show()
