"""The drawings of report.html as SVG text, coloured by its CSS: charts over time, and the map in metres."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from html import escape
from io import BytesIO
from math import ceil, degrees, floor, log10
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from hsloc.model import Status
from hsloc.report.data import LOG_ABOVE
from hsloc.report.map_image import line_width, picture_of, shown_extent
from hsloc.report.polyline import pieces_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from hsloc.report.data import Curve

    Floats = NDArray[np.float64]
    from hsloc.model import OccupancyGrid
    from hsloc.report.data import ReportData
    from hsloc.report.map_image import Extent

WIDTH, HEIGHT = 460.0, 170.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 8.0, 10.0, 22.0
"""Size of a chart and its margins in CSS pixels, at its natural size."""

MOST_POINTS = 1500


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A curve with its heading. `name` is its key in the page; `marks` are single points, drawn as crosses.

    `spans` (begin, end) are shaded. Over time where `over_time`, else over counts of evaluations.
    """

    name: str
    title: str
    unit: str
    curve: Curve
    colour: str = "blue"
    top: float | None = None
    from_zero: bool = True
    marks: Curve | None = None
    spans: tuple[tuple[float, float], ...] = ()
    over_time: bool = True


def chart_svg(chart: Chart, end: float) -> str:
    """The chart over 0 .. end as an <svg> element."""
    curve = chart.curve.thinned(MOST_POINTS)
    end = end if end > 0.0 else 1.0
    known = curve.values[np.isfinite(curve.values)]
    if chart.marks is not None:
        known = np.concatenate((known, chart.marks.values))
    scale, values = _vertical_scale(known, chart)

    def x(second: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * min(max(second / end, 0.0), 1.0)

    time = " data-time" if chart.over_time else ""
    head = f'<svg class="chart" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{escape(chart.title)}"'
    parts = [f'{head} data-name="{escape(chart.name)}" data-end="{end:.9g}"{time}>']
    for begin, until in chart.spans:
        left, right = x(begin), x(min(until, end))
        parts.append(f'<rect class="lost" x="{left:.1f}" y="{TOP:g}" width="{max(right - left, 1.0):.1f}" ')
        parts.append(f'height="{HEIGHT - TOP - BOTTOM:g}"/>')
    for value in values:
        y = scale(value)
        parts.append(f'<path class="rule" d="M{LEFT:g} {y:.1f}H{WIDTH - RIGHT:g}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 5:g}" y="{y + 3.5:.1f}" text-anchor="end">{number(value)}</text>')
    parts += _time_axis(end, x, chart.over_time)
    parts.append(f'<path class="line {chart.colour}" d="{_line(curve, x, scale)}"/>')
    if chart.marks is not None:
        crosses = "".join(
            f"M{x(second) - 3:.1f} {scale(value) - 3:.1f}l6 6m0-6l-6 6"
            for second, value in zip(chart.marks.seconds.tolist(), chart.marks.values.tolist(), strict=True)
        )
        parts.append(f'<path class="line vermillion" d="{crosses}"/>')
    parts.append(f'<path class="cursor" d="M0 {TOP:g}V{HEIGHT - BOTTOM:g}" visibility="hidden"/></svg>')
    return "".join(parts)


def timeline_html(rows: Sequence[tuple[str, int, str, Floats]], spacing: float, end: float) -> str:
    """One line for each status with a bar wherever scans had it: (label, count, colour, seconds of the scans).

    Scans closer than twice `spacing` make one bar. The strips stretch with the page, the words do not.
    """
    end = end if end > 0.0 else 1.0
    width, high = 1000.0, 12.0

    def x(second: float) -> float:
        return width * min(max(second / end, 0.0), 1.0)

    parts = []
    for label, count, colour, seconds in rows:
        bars = []
        for first, last in runs(seconds, 2.0 * spacing):
            begin, until = x(first), x(last + spacing)
            bars.append(f"M{begin:.2f} 0h{max(until - begin, 0.8):.2f}v{high:g}H{begin:.2f}z")
        parts.append(
            f"<span>{escape(label)}</span><span>{count}</span>"
            f'<svg class="chart strip" viewBox="0 0 {width:g} {high:g}" preserveAspectRatio="none" role="img"'
            f' aria-label="when scans were {escape(label)}" data-time data-left="0" data-right="0"'
            f' data-end="{end:.9g}">'
            f'<path class="bar {colour}" d="{"".join(bars)}"/>'
            f'<path class="cursor" d="M0 0V{high:g}" visibility="hidden"/></svg>'
        )
    unit, factor = _time_unit(end)
    labels = "".join(
        f'<i style="left:{100.0 * value * factor / end:.2f}%">{number(value)}{f" {unit}" if value == 0.0 else ""}</i>'
        for value in ticks(0.0, end / factor, 8)
    )
    return f'<div class="timeline">{"".join(parts)}<div class="times">{labels}</div></div>'


def runs(seconds: Floats, gap: float) -> list[tuple[float, float]]:
    """First and last of each group of sorted seconds that are at most `gap` apart."""
    if len(seconds) == 0:
        return []
    breaks = np.flatnonzero(np.diff(seconds) > gap)
    firsts = seconds[np.concatenate(((0,), breaks + 1))]
    lasts = seconds[np.concatenate((breaks, (len(seconds) - 1,)))]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def ticks(low: float, high: float, count: int) -> list[float]:
    """At most about `count` round numbers within [low, high]."""
    if not high > low:
        return [low]
    rough = (high - low) / count
    power = 10.0 ** floor(log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough * (1.0 - 1e-9))
    return [index * step for index in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)]


def number(value: float) -> str:
    """A tick's number, with a true minus sign; powers of ten from 100 000 on as such."""
    if value >= 1e5 and abs(log10(value) - round(log10(value))) < 1e-9:
        return "10" + str(round(log10(value))).translate(_SUPERSCRIPT)
    return f"{value:.6g}".replace("-", "−")


_SUPERSCRIPT = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def _vertical_scale(known: Floats, chart: Chart) -> tuple[Callable[[float], float], list[float]]:
    """From a value to a height in the chart, and the values of its ticks."""
    room = HEIGHT - TOP - BOTTOM
    high = float(known.max(initial=0.0)) if chart.top is None else chart.top
    middle = float(np.median(known)) if len(known) else 0.0
    if chart.top is None and middle > 0.0 and high > LOG_ABOVE * middle:
        floor_value = max(float(np.percentile(known, 1.0)), middle / 30.0)
        low_log, high_log = log10(floor_value), log10(high * 1.3)
        powers = [10.0**power for power in range(ceil(low_log), floor(high_log) + 1)]
        if len(powers) < 3:
            steps = (step * 10.0**power for power in range(floor(low_log), floor(high_log) + 1) for step in (1, 2, 5))
            powers = [value for value in steps if low_log <= log10(value) <= high_log]

        def logarithmic(value: float) -> float:
            part = (log10(max(value, floor_value)) - low_log) / (high_log - low_log)
            return TOP + room * (1.0 - part)

        return logarithmic, powers
    low = 0.0 if chart.from_zero else max(0.0, float(known.min(initial=high)) - 0.05)
    high = high if high > low else low + 1.0

    def linear(value: float) -> float:
        return TOP + room * (1.0 - min(max((value - low) / (high - low), 0.0), 1.0))

    return linear, ticks(low, high, 4)


def _time_unit(end: float) -> tuple[str, float]:
    """The unit of a time axis, and its seconds."""
    return ("min", 60.0) if end > 300.0 else ("s", 1.0)


def _time_axis(end: float, x: Callable[[float], float], over_time: bool) -> list[str]:
    unit, factor = _time_unit(end) if over_time else ("", 1.0)
    parts = []
    values = ticks(0.0, end / factor, 8)
    for value in values:
        label = number(value) + (f" {unit}" if unit and value == values[-1] else "")
        # The last label must not run out of the picture.
        near_the_edge = value * factor > 0.96 * end
        place = f'x="{x(value * factor):.1f}" text-anchor="{"end" if near_the_edge else "middle"}"'
        parts.append(f'<text class="tick" {place} y="{HEIGHT - BOTTOM + 15:g}">{label}</text>')
    return parts


def _line(curve: Curve, x: Callable[[float], float], scale: Callable[[float], float]) -> str:
    parts = []
    command = "M"
    for second, value in zip(curve.seconds.tolist(), curve.values.tolist(), strict=True):
        if value == value:
            parts.append(f"{command}{x(second):.1f} {scale(value):.1f}")
            command = "L"
        else:
            command = "M"
    return "".join(parts)


MOST_PIXELS = 4000
"""Longest side of the embedded picture."""
FINEST = 3000
"""A path is drawn as finely as this part of the map's larger side; more is not visible, even enlarged."""
MOST_VERTICES, MOST_MARKS = 30_000, 2_000


def map_svg(data: ReportData, grid: OccupancyGrid | None, points: Floats | None) -> tuple[str, Extent]:
    """The <svg> element, and what it shows. Its coordinates are metres from the middle of that, y downwards."""
    extent = shown_extent(data, grid, points)
    middle = np.array(((extent.x0 + extent.x1) / 2.0, (extent.y0 + extent.y1) / 2.0))
    finest = max(extent.width, extent.height) / FINEST
    unit = max(extent.width, extent.height) / 900.0
    box = f"{-extent.width / 2:.6g} {-extent.height / 2:.6g} {extent.width:.6g} {extent.height:.6g}"
    look = f"--u:{unit:.6g};--path:{line_width(data, extent):.2g}px"
    head = '<svg id="map" role="img" aria-label="map and trajectory" tabindex="0"'
    parts = [f'{head} style="{look}" viewBox="{box}" data-x="{middle[0]:.9g}" data-y="{middle[1]:.9g}">']
    if grid is not None:
        parts.append(_layer("map", _image(grid, middle)))
    if points is not None and len(points):
        dots = "".join(f"M{x:.5g} {y:.5g}h0" for x, y in _local(points, middle).tolist())
        parts.append(_layer("points", f'<path class="points" d="{dots}"/>'))
    if data.odometry is not None and len(data.odometry):
        parts.append(_layer("odometry", f'<path class="odometry" d="{_path(data.odometry, middle, finest)}"/>'))
    if len(data.path):
        known = np.where(data.localised[:, None], data.path, np.nan)
        guessed = np.where(data.localised[:, None], np.nan, data.path)
        lines = f'<path class="trajectory" d="{_path(known, middle, finest)}"/>'
        if not data.localised.all():
            lines += f'<path class="guessed" d="{_path(guessed, middle, finest)}"/>'
        parts.append(_layer("trajectory", lines))
    if data.reference is not None and len(data.reference):
        parts.append(_layer("reference", f'<path class="reference" d="{_path(data.reference, middle, finest)}"/>'))
    parts.append(_marks(data, middle))
    parts.append(_axes(extent, middle))
    parts.append('<g id="here" visibility="hidden"><circle class="here" r="7"/></g></svg>')
    return "".join(parts), extent


def _axes(extent: Extent, middle: Floats) -> str:
    """Where the map's frame has its origin, and its axes, if that is in the picture."""
    if not (extent.x0 <= 0.0 <= extent.x1 and extent.y0 <= 0.0 <= extent.y1):
        return ""
    x, y = _local(np.zeros(2), middle).tolist()
    arrows = '<path class="x" d="M0 0h30m-5-3l5 3l-5 3"/><path class="y" d="M0 0v-30m-3 5l3-5l3 5"/>'
    names = '<text x="33" y="4">x</text><text x="-3" y="-34">y</text>'
    return (
        f'<g class="axes" data-layer="axes" transform="translate({x:.6g} {y:.6g})">'
        f"<title>origin of the map</title><g>{arrows}{names}</g></g>"
    )


def _layer(name: str, content: str) -> str:
    return f'<g data-layer="{name}">{content}</g>'


def _local(xy: Floats, middle: Floats) -> Floats:
    """Metres from the middle, y downwards: small numbers, since browsers reckon in 32 bits."""
    result: Floats = (xy - middle) * (1.0, -1.0)
    return result


def _path(xy: Floats, middle: Floats, finest: float) -> str:
    """A path's `d`; NaN breaks the line, and points closer than `finest` to the last one drawn are left out."""
    local = _local(xy, middle)
    while sum(map(len, pieces := pieces_of(local, finest))) > MOST_VERTICES:
        finest *= 2.0
    decimals = max(0, ceil(-np.log10(finest)) + 1)
    return "".join("M" + "L".join(f"{x:.{decimals}f} {y:.{decimals}f}" for x, y in piece.tolist()) for piece in pieces)


def _image(grid: OccupancyGrid, middle: Floats) -> str:
    picture = picture_of(grid, MOST_PIXELS)
    if picture is None:
        return ""
    # Grey and clear, the top row first.
    levels = np.ascontiguousarray(picture.levels[::-1, :, (0, 3)])
    stream = BytesIO()
    Image.fromarray(levels).save(stream, format="PNG", optimize=True)
    pose = picture.T_map_corner
    x, y = _local(np.array((pose.x, pose.y)), middle).tolist()
    return (
        f'<image class="grid" data-cell="{picture.side:.6g}" width="{picture.width:.9g}" height="{picture.height:.9g}" '
        f'transform="translate({x:.9g} {y:.9g}) rotate({-degrees(pose.theta):.9g}) '
        f'translate(0 {-picture.height:.9g})" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{b64encode(stream.getvalue()).decode("ascii")}"/>'
    )


def _marks(data: ReportData, middle: Floats) -> str:
    parts = []
    scans = data.scans
    if scans is not None:
        for status, shape in (
            (Status.NO_RETURNS, '<path class="mark orange" d="M-4-4h8l-4 8z"/>'),
            (Status.REJECTED, '<path class="mark cross" d="M-4-4l8 8m0-8l-8 8"/>'),
            (
                Status.RELOCALISED,
                '<path class="mark orange" d="M0-9l2.6 5.6 6 .7-4.5 4.1 1.2 6L0 3.4l-5.3 3 1.2-6-4.5-4.1 6-.7z"/>',
            ),
        ):
            rows = np.flatnonzero(scans.where(status) & np.isfinite(scans.xy).all(axis=1))
            rows = rows[:: max(1, ceil(len(rows) / MOST_MARKS))]
            marks = []
            for row, (x, y) in zip(rows.tolist(), _local(scans.xy[rows], middle).tolist(), strict=True):
                words = f"{status.replace('_', ' ')} at {scans.seconds[row]:.2f} s"
                reason = f": {scans.reason[row]}" if scans.reason[row] else ""
                title = f"<title>{escape(words + reason)}</title>"
                marks.append(f'<g transform="translate({x:.6g} {y:.6g})">{title}{shape}</g>')
            if marks:
                parts.append(_layer(str(status), "".join(marks)))
    if len(data.path):
        order = np.argsort(data.seconds, kind="stable")
        for row, shape, name in (
            (order[-1], '<rect class="mark end" x="-5" y="-5" width="10" height="10"/>', "end"),
            (order[0], '<circle class="mark start" r="6"/>', "start"),
        ):
            x, y = _local(data.path[row], middle).tolist()
            parts.append(f'<g transform="translate({x:.6g} {y:.6g})"><title>{name}</title>{shape}</g>')
    return "".join(parts)
