"""The panels of report.png: the map with the trajectory, curves over time, and the table."""

from __future__ import annotations

from math import floor, log10
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.font_manager import FontProperties
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.textpath import TextPath
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator, StrMethodFormatter
from matplotlib.transforms import Affine2D

from hsloc.model import Status
from hsloc.report import style
from hsloc.report.data import Curve, with_gaps
from hsloc.report.map_image import known_runs, line_width, picture_of
from hsloc.report.png_labels import HALO
from hsloc.report.table import MARK_WORDS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid
    from hsloc.report.charts import Chart
    from hsloc.report.data import ReportData
    from hsloc.report.map_image import Extent

    Floats = NDArray[np.float64]
    from hsloc.report.table import Row

_PLACE = np.array(((13.0, 0.0), (-9.0, 8.0), (-5.0, 0.0), (-9.0, -8.0), (13.0, 0.0))) / 13.0
"""An arrow, as vertices of a marker."""
MOST_TO_CHECK = 40
"""Places to check that are drawn: more would hide the map."""
_SIGN_OFFSET = np.array((0.36, 0.45))
"""By which the "!" is left of and below the middle of its triangle (points): its parts then lie on whole pixels."""


def draw_map(
    axes: Axes, data: ReportData, grid: OccupancyGrid | None, points: Floats | None, extent: Extent, pixels: float
) -> None:
    """Fill the panel, which is about `pixels` wide or high, whichever is more."""
    axes.set_facecolor(style.UNKNOWN if grid is not None else style.PAPER)
    if grid is not None:
        _draw_grid(axes, grid, pixels)
    if points is not None and len(points):
        axes.plot(points[:, 0], points[:, 1], ".", color=style.WALL, markersize=2.2, label="map points", zorder=2)
    _draw_paths(axes, data, extent, max(extent.width, extent.height) / pixels)
    _draw_marks(axes, data)
    _draw_places(axes, data)
    _draw_ends(axes, data)
    _draw_scale_bar(axes, extent)
    axes.set_xlim(extent.x0, extent.x1)
    axes.set_ylim(extent.y0, extent.y1)
    axes.set_aspect("equal", adjustable="box")
    axes.tick_params(length=3, labelsize=style.SMALL, color=style.RULE, labelcolor=style.MUTED)
    unit, metres = ("km", 1000.0) if max(extent.width, extent.height) > 5000.0 else ("m", 1.0)
    for axis, name in ((axes.xaxis, "x"), (axes.yaxis, "y")):
        axis.set_label_text(f"{name} [{unit}]", fontsize=style.SMALL, color=style.MUTED)
        axis.labelpad = 2
        axis.set_major_locator(MaxNLocator(9, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / metres:.10g}".replace("-", "−")))
    if grid is None:
        axes.grid(color=style.RULE, linewidth=0.7)
        axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color(style.RULE)


def _draw_grid(axes: Axes, grid: OccupancyGrid, pixels: float) -> None:
    picture = picture_of(grid, pixels)
    if picture is None:
        return
    # Opaque, on a panel of the colour of what is unknown, and as numbers from 0 to 1: matplotlib takes half the time.
    # It cuts off what is behind the point of 255 times the number: this is the level itself or a little more.
    levels = (picture.levels + np.float32(0.25)) / np.float32(255.25)
    levels[..., 3] = 1.0
    image = axes.imshow(
        levels, origin="lower", zorder=1, interpolation="antialiased",
        extent=(0.0, picture.width, 0.0, picture.height), aspect="equal",
    )  # fmt: skip
    pose = picture.T_map_corner
    image.set_transform(Affine2D().rotate(pose.theta).translate(pose.x, pose.y) + axes.transData)


def _draw_paths(axes: Axes, data: ReportData, extent: Extent, pixel: float) -> None:
    """In the order of the legend; zorder gives what covers what. Nothing finer than half a pixel is drawn."""

    def seen(xy: Floats) -> Floats:
        return joined(pieces_of(xy, 0.5 * pixel))

    if data.loops is not None and len(data.loops):
        lines = with_gaps(data.loops.reshape(-1, 2), np.arange(2 * len(data.loops)) % 2 == 0)
        axes.plot(*lines.T, color=style.GREEN, linewidth=1.2, label="loop closed", zorder=4)
    if len(data.path):
        known = seen(with_gaps(np.where(data.localised[:, None], data.path, np.nan), data.jumps))
        axes.plot(
            *known.T,
            color=style.BLUE,
            linewidth=line_width(data, extent),
            label="trajectory",
            zorder=5,
            solid_capstyle="round",
        )
    if data.reference is not None and len(data.reference):
        axes.plot(
            *seen(with_gaps(data.reference, data.reference_jumps)).T,
            color="black",
            linewidth=1.0,
            linestyle=(0, (5, 3)),
            label="reference",
            zorder=6,
        )
    if data.odometry is not None and len(data.odometry):
        axes.plot(
            *seen(data.odometry).T, color=style.VERMILLION, alpha=0.7, linewidth=1.3, linestyle=(0, (1, 1.2)),
            label="odometry alone" if extent.holds(data.odometry) else "odometry alone, goes on outside", zorder=3,
        )  # fmt: skip
    if not data.localised.all():
        guessed = seen(with_gaps(np.where(data.localised[:, None], np.nan, data.path), data.jumps))
        axes.plot(
            *guessed.T, color=style.PURPLE, linewidth=2.0, linestyle=(0, (0.8, 1.2)), label="pose unknown", zorder=4
        )


def _draw_marks(axes: Axes, data: ReportData) -> None:
    if data.scans is None:
        return
    for status, marker, colour, size, zorder in (
        (Status.NO_RETURNS, "v", style.ORANGE, 5.0, 7),
        (Status.REJECTED, "x", style.VERMILLION, 5.0, 8),
        (Status.RELOCALISED, "*", style.ORANGE, 13.0, 9),
    ):
        xy = data.scans.xy[data.scans.where(status)]
        if len(xy):
            axes.plot(
                *xy.T, linestyle="none", marker=marker, color=colour, markersize=size, label=MARK_WORDS[status],
                zorder=zorder, markeredgewidth=1.4 if marker == "x" else 0.7,
                markeredgecolor=colour if marker == "x" else style.INK,
            )  # fmt: skip


def _draw_places(axes: Axes, data: ReportData) -> None:
    """Places between which the run does not decide: an arrow along the heading, and the probability."""
    for each, labels in zip(data.ambiguities, data.place_labels, strict=True):
        for place, label in zip(each.places, labels, strict=True):
            xy = (place.pose.x, place.pose.y)
            arrow = MarkerStyle(_PLACE, transform=Affine2D().rotate(place.pose.theta))
            axes.plot(*xy, marker=arrow, color=style.ORANGE, markersize=15, markeredgecolor=style.INK, zorder=11)
            axes.annotate(
                label, xy, xytext=(0, -22), textcoords="offset points", fontsize=style.TEXT, ha="center",
                fontweight="bold", color=style.INK, path_effects=HALO, zorder=11,
            )  # fmt: skip
    if data.ambiguities:
        axes.plot(
            [], [], linestyle="none", marker=MarkerStyle(_PLACE), color=style.ORANGE, markersize=12,
            markeredgecolor=style.INK, label="place that may be right",
        )  # fmt: skip


def draw_places_to_check(axes: Axes, places: Sequence[tuple[float, float]]) -> None:
    """Where the reasons of the verdict were found (x, y in m), as warning signs; of many some, evenly."""
    shown = np.array(places)[:: len(places) // MOST_TO_CHECK + 1]
    if not len(shown):
        return
    axes.plot(
        *shown.T, linestyle="none", marker="^", color="white", markersize=13, markeredgecolor=style.VERMILLION,
        markeredgewidth=1.6, label="place to check", zorder=10,
    )  # fmt: skip
    # One marker for all: as a text each would be laid out for itself.
    sign = TextPath((0.0, 0.0), "!", size=8.0, prop=FontProperties(family=style.FONT, weight="bold"))
    box, corners = sign.get_extents(), np.asarray(sign.vertices, dtype=np.float64)
    corners = corners - 0.5 * (np.asarray(box.min) + np.asarray(box.max)) - _SIGN_OFFSET
    size = 2.0 * float(np.abs(corners).max())  # matplotlib scales a shape by its largest coordinate
    axes.plot(
        *shown.T, linestyle="none", marker=Path(corners, sign.codes), color=style.VERMILLION, markersize=size,
        markeredgewidth=0.0, zorder=10,
    )  # fmt: skip


def _draw_ends(axes: Axes, data: ReportData) -> None:
    if not len(data.path):
        axes.text(
            0.5, 0.5, "no pose", transform=axes.transAxes, ha="center", va="center", color=style.MUTED, fontsize=14
        )
        return
    order = np.argsort(data.seconds, kind="stable")
    for row, marker, colour in ((order[-1], "s", style.VERMILLION), (order[0], "o", style.GREEN)):
        axes.plot(
            *data.path[row], marker=marker, color=colour, markersize=9, markeredgecolor="white", markeredgewidth=1.5,
            zorder=10,
        )  # fmt: skip


def _draw_scale_bar(axes: Axes, extent: Extent) -> None:
    """A bar of a round length, up to a fifth of the width, in the lower left corner."""
    length = round_length(extent.width / 5.0)
    x, y = extent.x0 + 0.025 * extent.width, extent.y0 + 0.035 * extent.height
    axes.plot(
        (x, x + length), (y, y), color=style.INK, linewidth=3.0, solid_capstyle="butt", zorder=12,
        path_effects=[withStroke(linewidth=6.0, foreground="white")],
    )  # fmt: skip
    axes.annotate(
        format_round_length(length), (x + length / 2.0, y), xytext=(0, 5),
        textcoords="offset points", ha="center", fontsize=style.TEXT, color=style.INK, path_effects=HALO, zorder=12,
    )  # fmt: skip


def round_length(metres: float) -> float:
    """The nearest smaller 1, 2 or 5 times a power of ten."""
    power = 10.0 ** floor(log10(metres))
    return float(next(step * power for step in (5.0, 2.0, 1.0) if step * power <= metres * (1.0 + 1e-12)))


def format_round_length(metres: float) -> str:
    """5 mm, 20 cm, 5 m, 2 km."""
    for limit, factor, unit in ((0.0095, 1e3, "mm"), (0.95, 1e2, "cm"), (950.0, 1.0, "m")):
        if metres < limit:
            return f"{metres * factor:g} {unit}"
    return f"{metres / 1000.0:g} km"


MOST_POINTS = 3000
_GAP_PIXELS = 10.0
"""Between a label of the table and its value."""


def draw_panel(axes: Axes, chart: Chart, data: ReportData, *, with_time: bool) -> None:
    """One curve over time; `with_time` writes the time under it."""
    unit, factor = ("min", 60.0) if data.duration_s > 300.0 else ("s", 1.0)
    curve = chart.curve.thinned(MOST_POINTS)
    curve = Curve(curve.seconds / factor, curve.values)
    end = max(data.duration_s, float(chart.curve.seconds.max(initial=0.0))) / factor
    _draw_line(axes, curve, chart)
    for begin, until in data.lost:
        axes.axvspan(begin / factor, until / factor, facecolor=style.PURPLE, alpha=0.22, linewidth=0, zorder=0)
    title = f"{chart.title} [{chart.unit}]" if chart.unit else chart.title
    # With y given, matplotlib does not look for its place among the ticks, which takes a tenth of the drawing.
    axes.set_title(title, loc="left", fontsize=style.TEXT, color=style.INK, pad=4, y=1.0)
    axes.set_xlim(0.0, end if end > 0.0 else 1.0)
    axes.grid(axis="y", color=style.RULE, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(length=3, labelsize=style.SMALL, color=style.RULE, labelcolor=style.MUTED)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(style.RULE)
    # Where a label is, matplotlib finds by measuring all numbers of the axis once more: not for those that are empty.
    axes.yaxis.set_label_coords(0.0, 0.5)
    if with_time:
        axes.set_xlabel(f"time [{unit}]", fontsize=style.SMALL, color=style.MUTED, labelpad=2)
    else:
        axes.tick_params(labelbottom=False)
        axes.xaxis.set_label_coords(0.5, 0.0)


def _draw_line(axes: Axes, curve: Curve, chart: Chart) -> None:
    if not np.isfinite(curve.values).any():
        return
    middle, top = float(np.nanmedian(curve.values)), float(np.nanmax(curve.values))
    if chart.is_logarithmic:
        axes.set_yscale("log")
        floor = max(float(np.nanpercentile(curve.values, 1.0)), middle / 30.0)
        axes.set_ylim(floor, top * 1.4)
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.plot(curve.seconds, np.maximum(curve.values, floor), color=style.BLUE, linewidth=1.1)
        return
    axes.fill_between(curve.seconds, 0.0, curve.values, color=style.BLUE, alpha=0.13, linewidth=0)
    axes.plot(curve.seconds, curve.values, color=style.BLUE, linewidth=1.1)
    axes.set_ylim(0.0, top * 1.08 if top > 0.0 else 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))


_LETTER = 9.3
"""Mean width of a letter of the table (pixels), or a little more."""


def line_count(rows: Sequence[Row], width: float) -> int:
    """Lines of a table of this width (pixels), or some more: a heading if there are pairs, more for a long value."""
    most = max(int(width / _LETTER), 1)
    paired = any(len(row.values) == 2 for row in rows)
    long = [row.values[0] for row in rows if len(row.values) == 1 and len(row.label + row.values[0]) > most]
    return len(rows) + paired + sum(1 + len(value) // most for value in long)


def draw_table(axes: Axes, rows: list[Row], *, line_height: float, size: float) -> None:
    """The table, from the top down, in type of `size`; `line_height` is a line's part of the panel."""
    axes.set_axis_off()
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.0)
    y = 1.0
    if any(len(row.values) == 2 for row in rows):
        for x, heading in ((0.74, "translation"), (1.0, "rotation")):
            axes.text(x, y, heading, ha="right", va="top", fontsize=min(style.SMALL, size), color=style.MUTED)
        y -= line_height
    rules = []
    for row in rows:
        rules.append(y + 0.18 * line_height)
        label = axes.text(0.0, y, row.label, ha="left", va="top", fontsize=size, color=style.INK)
        begin, end = 0.0, 0.0
        for x, value in zip((0.74, 1.0) if len(row.values) == 2 else (1.0,), row.values, strict=True):
            text = axes.text(x, y, value, ha="right", va="top", fontsize=size, color=style.INK, fontweight="bold")
            if len(row.values) == 1:
                begin, end = label.get_window_extent().x1 + _GAP_PIXELS, text.get_window_extent().x0
            if end < begin:  # a long value has lines of its own
                room = 0.95 * axes.bbox.width / text.get_window_extent().width
                text.remove()
                for piece in _pieces(value, int(room * len(value))):
                    y -= line_height
                    axes.text(x, y, piece, ha="right", va="top", fontsize=size, color=style.INK, fontweight="bold")
        if row.usual and begin < end:
            _draw_usual(axes, row.usual, y, (begin, end - _GAP_PIXELS), size)
        y -= line_height
    ends = np.array([(x, rule) for rule in rules for x in (0.0, 1.0)]).reshape(-1, 2)
    ends = with_gaps(ends, np.arange(len(ends)) % 2 == 0)
    axes.plot(*ends.T, color=style.RULE, linewidth=0.7, clip_on=False)


def _pieces(text: str, most: int) -> list[str]:
    """A text in lines of at most `most` letters, if its parts between commas are not longer."""
    bound = text.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in wrap(bound, max(most, 1), break_long_words=False)]


def _draw_usual(axes: Axes, usual: str, y: float, between: tuple[float, float], size: float) -> None:
    """What is usual, between the label and the value (pixels), if there is room."""
    x = (between[0] - axes.bbox.x0) / axes.bbox.width
    text = axes.text(
        x, y, f"usual: {usual}", ha="left", va="top", fontsize=min(style.SMALL, 0.9 * size), color=style.MUTED
    )
    if text.get_window_extent().x1 > between[1]:
        text.remove()


_BLOCK = 4096
"""Points of a path that are Python's numbers at a time: all of a long run would take ten times their memory."""


def pieces_of(xy: Floats, finest: float) -> list[Floats]:
    """A path (n, 2) in pieces (m, 2) where NaN breaks it, without points closer than `finest` to the last one kept.

    Distances are taken along the axes; the first and the last point of a piece are always kept.
    """
    pieces = []
    for begin, end in known_runs(xy):
        rows = [begin]
        x0, y0 = xy[begin].tolist()
        for at in range(begin + 1, end, _BLOCK):
            until = min(at + _BLOCK, end)
            for row, x, y in zip(range(at, until), *xy[at:until].T.tolist(), strict=True):
                if abs(x - x0) + abs(y - y0) >= finest:
                    rows.append(row)
                    x0, y0 = x, y
        if (xy[end - 1] != (x0, y0)).any():
            rows.append(end - 1)
        pieces.append(xy[rows])
    return pieces


def joined(pieces: list[Floats]) -> Floats:
    """The pieces as one path again, NaN between them."""
    gap = np.full((1, 2), np.nan)
    parts = [part for piece in pieces for part in (piece, gap)]
    return np.concatenate(parts[:-1]) if parts else gap[:0]
