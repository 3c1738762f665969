"""The small panels of report.png: error, or fitness and covariance, over time; and the table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter

from hsloc.model import Status
from hsloc.report import style
from hsloc.report.data import LOG_ABOVE, Curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from hsloc.report.data import ReportData
    from hsloc.report.table import Row

MOST_POINTS = 3000


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One quantity over time: its heading, curve, and the colour of its line."""

    title: str
    curve: Curve
    colour: str = style.BLUE
    is_fitness: bool = False


def time_panels(data: ReportData) -> list[Panel]:
    """With truth: both errors and fitness. Without: fitness and what the estimator itself believes (sigma)."""
    panels = []
    if data.errors is not None:
        metres, degrees = data.errors.translation_m, data.errors.rotation_deg
        panels.append(Panel("translation error [cm]", Curve(metres.seconds, metres.values * 100.0)))
        panels.append(Panel("rotation error [deg]", degrees))
    scans = data.scans
    if scans is not None:
        if data.errors is None:
            panels.append(Panel("position, standard deviation [cm]", Curve(scans.seconds, scans.sigma_m * 100.0)))
            panels.append(Panel("heading, standard deviation [deg]", Curve(scans.seconds, scans.sigma_deg)))
        accepted = np.where(scans.where(Status.REJECTED), np.nan, scans.fitness)
        panels.append(Panel("fitness of the match", Curve(scans.seconds, accepted), style.GREEN, True))
    return [panel for panel in panels if np.isfinite(panel.curve.values).any()]


def draw_panel(axes: Axes, panel: Panel, data: ReportData, *, with_time: bool) -> None:
    """One panel; `with_time` writes the time under it."""
    unit, factor = ("min", 60.0) if data.duration_s > 300.0 else ("s", 1.0)
    lost = () if data.scans is None else data.scans.lost
    curve = _known(panel.curve, lost).thinned(MOST_POINTS)
    curve = Curve(curve.seconds / factor, curve.values)
    end = max(data.duration_s, float(panel.curve.seconds.max(initial=0.0))) / factor
    if panel.is_fitness:
        _draw_fitness(axes, curve, data, factor)
    else:
        _draw_line(axes, curve, panel.colour)
    for begin, until in lost:
        axes.axvspan(
            begin / factor, min(until / factor, end), facecolor=style.PURPLE, alpha=0.22, linewidth=0, zorder=0
        )
    axes.set_title(panel.title, loc="left", fontsize=style.TEXT, color=style.INK, pad=4)
    axes.set_xlim(0.0, end if end > 0.0 else 1.0)
    axes.grid(axis="y", color=style.RULE, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(length=3, labelsize=style.SMALL, color=style.RULE, labelcolor=style.MUTED)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(style.RULE)
    if with_time:
        axes.set_xlabel(f"time [{unit}]", fontsize=style.SMALL, color=style.MUTED, labelpad=2)
    else:
        axes.tick_params(labelbottom=False)


def _known(curve: Curve, lost: tuple[tuple[float, float], ...]) -> Curve:
    """The curve without its NaN, but with one where the pose was lost and nothing known: the line breaks there."""
    known = np.isfinite(curve.values)
    seconds, values = curve.seconds[known], curve.values[known]
    for begin, until in lost:
        if not ((seconds >= begin) & (seconds < until)).any():
            row = int(np.searchsorted(seconds, begin))
            seconds, values = np.insert(seconds, row, begin), np.insert(values, row, np.nan)
    return Curve(seconds, values)


def _draw_line(axes: Axes, curve: Curve, colour: str) -> None:
    middle, top = float(np.nanmedian(curve.values)), float(np.nanmax(curve.values))
    if middle > 0.0 and top > LOG_ABOVE * middle:
        axes.set_yscale("log")
        floor = max(float(np.nanpercentile(curve.values, 1.0)), middle / 30.0)
        axes.set_ylim(floor, top * 1.4)
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.tick_params(which="minor", length=0)
        axes.plot(curve.seconds, np.maximum(curve.values, floor), color=colour, linewidth=1.1)
        return
    axes.fill_between(curve.seconds, 0.0, curve.values, color=colour, alpha=0.13, linewidth=0)
    axes.plot(curve.seconds, curve.values, color=colour, linewidth=1.1)
    axes.set_ylim(0.0, top * 1.08 if top > 0.0 else 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))


def _draw_fitness(axes: Axes, curve: Curve, data: ReportData, factor: float) -> None:
    axes.plot(curve.seconds, curve.values, color=style.GREEN, linewidth=1.0)
    low = float(np.nanmin(curve.values))
    if data.scans is not None:
        refused = data.scans.where(Status.REJECTED) & np.isfinite(data.scans.fitness)
        low = min(low, float(data.scans.fitness[refused].min(initial=1.0)))
        axes.plot(
            data.scans.seconds[refused] / factor, data.scans.fitness[refused], "x", color=style.VERMILLION,
            markersize=5.0, markeredgewidth=1.4,
        )  # fmt: skip
    axes.set_ylim(max(0.0, low - 0.08), 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))


def draw_table(axes: Axes, rows: list[Row], *, line_height: float) -> None:
    """The table, from the top down; `line_height` is a line's part of the panel. What does not fit is left out."""
    axes.set_axis_off()
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.0)
    y = 1.0
    if any(len(row.values) == 2 for row in rows):
        for x, heading in ((0.74, "translation"), (1.0, "rotation")):
            axes.text(x, y, heading, ha="right", va="top", fontsize=style.SMALL, color=style.MUTED)
        y -= line_height
    for row in rows:
        if y < 0.6 * line_height:
            break
        axes.plot((0.0, 1.0), (y + 0.18 * line_height,) * 2, color=style.RULE, linewidth=0.7, clip_on=False)
        axes.text(0.0, y, row.label, ha="left", va="top", fontsize=style.TEXT, color=style.INK)
        for x, value in zip((0.74, 1.0) if len(row.values) == 2 else (1.0,), row.values, strict=True):
            axes.text(x, y, value, ha="right", va="top", fontsize=style.TEXT, color=style.INK, fontweight="bold")
        y -= line_height
