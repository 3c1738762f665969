"""The map of report.html: an SVG in metres, with the grid as an embedded picture."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from math import ceil, degrees
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from hsloc.model import Status
from hsloc.report.map_image import line_width, picture_of, shown_extent
from hsloc.report.polyline import pieces_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid
    from hsloc.report.data import ReportData
    from hsloc.report.map_image import Extent

    Floats = NDArray[np.float64]

MOST_PIXELS = 4000
"""Longest side of the embedded picture."""
FINEST = 3000
"""A path is drawn as finely as this part of the map's larger side; nobody sees more, even enlarged."""
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
        believed = np.where(data.believed[:, None], data.path, np.nan)
        guessed = np.where(data.believed[:, None], np.nan, data.path)
        lines = f'<path class="trajectory" d="{_path(believed, middle, finest)}"/>'
        if not data.believed.all():
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
    """A path's `d`; NaN breaks the line, and points nearer than `finest` to the last one drawn are left out."""
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
