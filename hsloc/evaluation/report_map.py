"""The large panel of report.png: the map, and where the robot went on it."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, log10
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import Affine2D

from hsloc.evaluation import report_style as style
from hsloc.model import Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from hsloc.evaluation.report_data import ReportData
    from hsloc.model import OccupancyGrid

    Floats = NDArray[np.float64]

MARGIN = 0.05
"""Free room around what is shown, as a part of the larger side."""
LEAST_SIZE = 0.5
"""Metres: a robot that stood still gets some ground to stand on."""

HALO = [withStroke(linewidth=3.0, foreground="white")]


@dataclass(frozen=True, slots=True)
class Extent:
    """The rectangle of the map frame that the panel shows, metres."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        """Along x."""
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        """Along y."""
        return self.y1 - self.y0

    @property
    def aspect(self) -> float:
        """Width by height."""
        return self.width / self.height

    def widened(self, aspect: float) -> Extent:
        """The smallest rectangle around this one, with the same middle, that has another aspect."""
        wider, higher = max(self.width, self.height * aspect), max(self.height, self.width / aspect)
        x, y = (self.x0 + self.x1) / 2.0, (self.y0 + self.y1) / 2.0
        return Extent(x - wider / 2.0, y - higher / 2.0, x + wider / 2.0, y + higher / 2.0)


def shown_extent(data: ReportData, grid: OccupancyGrid | None, points: Floats | None) -> Extent:
    """All of the known map, the trajectory and the reference. Odometry may leave the picture: it drifts."""
    corners = [data.path]
    if data.reference is not None:
        corners.append(data.reference)
    if points is not None:
        corners.append(points)
    if grid is not None:
        corners.append(_known_corners(grid))
    every = np.concatenate(corners)
    every = every[np.isfinite(every).all(axis=1)]
    if len(every) == 0:
        return Extent(-1.0, -1.0, 1.0, 1.0)
    low, high = every.min(axis=0), every.max(axis=0)
    size = float((high - low).max())
    size = max(size, LEAST_SIZE)
    middle, half = (low + high) / 2.0, np.maximum(high - low, 0.08 * size) / 2.0 + MARGIN * size
    return Extent(*(middle - half).tolist(), *(middle + half).tolist())


def draw_map(
    axes: Axes, data: ReportData, grid: OccupancyGrid | None, points: Floats | None, extent: Extent, pixels: float
) -> None:
    """Fill the panel, which is about `pixels` wide or high, whichever is more."""
    axes.set_facecolor(style.UNKNOWN if grid is not None else style.PAPER)
    if grid is not None:
        _draw_grid(axes, grid, pixels)
    if points is not None and len(points):
        axes.plot(points[:, 0], points[:, 1], ".", color=style.WALL, markersize=2.2, label="map points", zorder=2)
    _draw_paths(axes, data)
    _draw_marks(axes, data)
    _draw_ends(axes, data, extent)
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


def _known_corners(grid: OccupancyGrid) -> Floats:
    """Corners in the map frame of the rectangle that holds all known cells, shape (4, 2); or of no cell, (0, 2)."""
    known = grid.cells >= 0
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if len(rows) == 0:
        return np.zeros((0, 2))
    y0, y1, x0, x1 = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=np.float64) * grid.resolution
    return grid.origin @ corners


def _draw_grid(axes: Axes, grid: OccupancyGrid, pixels: float) -> None:
    known = grid.cells >= 0
    if not known.any():
        return
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    row, column = int(rows[0]), int(columns[0])
    cells = grid.cells[row : rows[-1] + 1, column : columns[-1] + 1]
    factor = max(1, ceil(max(cells.shape) / pixels))
    cells = darkest_of_blocks(cells, factor)
    side = factor * grid.resolution
    height, width = cells.shape
    image = axes.imshow(
        grey_levels()[np.clip(cells, -1, 100)], origin="lower", zorder=1, interpolation="antialiased",
        extent=(0.0, width * side, 0.0, height * side), aspect="equal",
    )  # fmt: skip
    pose = grid.origin
    corner = Affine2D().translate(column * grid.resolution, row * grid.resolution)
    image.set_transform(corner.rotate(pose.theta).translate(pose.x, pose.y) + axes.transData)


def darkest_of_blocks(cells: NDArray[np.int8], factor: int) -> NDArray[np.int8]:
    """The map made smaller: each block of factor x factor cells becomes its most occupied one.

    A mean would let walls that are one cell thick fade away.
    """
    if factor == 1:
        return cells
    height, width = (-(-side // factor) * factor for side in cells.shape)
    padded = np.full((height, width), -1, dtype=np.int8)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    blocks = padded.reshape(height // factor, factor, width // factor, factor)
    result: NDArray[np.int8] = blocks.max(axis=(1, 3))
    return result


def grey_levels() -> NDArray[np.uint8]:
    """RGBA of the values 0 (free) .. 100 (wall), and clear as the last row, which -1 (unknown) finds: (102, 4)."""
    free, wall = (np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) for colour in (style.FREE, style.WALL))
    part = np.linspace(0.0, 1.0, 101)[:, None]
    levels = np.zeros((102, 4), dtype=np.uint8)
    levels[:101, :3] = np.round(free * (1.0 - part) + wall * part)
    levels[:101, 3] = 255
    # Clear, but of the colour of the ground: a scaled picture mixes the colours of neighbours.
    levels[101, :3] = [int(style.UNKNOWN[i : i + 2], 16) for i in (1, 3, 5)]
    return levels


def _draw_paths(axes: Axes, data: ReportData) -> None:
    """In the order of the legend; what lies over what is said by zorder."""
    if len(data.path):
        known = np.where(data.believed[:, None], data.path, np.nan)
        axes.plot(*known.T, color=style.BLUE, linewidth=3.0, label="trajectory", zorder=5, solid_capstyle="round")
    if data.reference is not None and len(data.reference):
        axes.plot(*data.reference.T, color="black", linewidth=1.0, linestyle=(0, (5, 3)), label="reference", zorder=6)
    if data.odometry is not None and len(data.odometry):
        axes.plot(
            *data.odometry.T, color=style.VERMILLION, alpha=0.7, linewidth=1.3, linestyle=(0, (1, 1.2)),
            label="odometry alone", zorder=3,
        )  # fmt: skip
    if not data.believed.all():
        guessed = np.where(data.believed[:, None], np.nan, data.path)
        axes.plot(
            *guessed.T, color=style.PURPLE, linewidth=2.0, linestyle=(0, (0.8, 1.2)), label="pose unknown", zorder=4
        )


def _draw_marks(axes: Axes, data: ReportData) -> None:
    if data.scans is None:
        return
    for statuses, label, marker, colour, size, zorder in (
        ((Status.NO_RETURNS,), "scan without returns", "v", style.ORANGE, 5.0, 7),
        ((Status.REJECTED,), "scan rejected", "x", style.VERMILLION, 5.0, 8),
        ((Status.RELOCALISED,), "pose found", "*", style.ORANGE, 13.0, 9),
    ):
        xy = data.scans.xy[data.scans.where(*statuses)]
        if len(xy):
            axes.plot(
                *xy.T, linestyle="none", marker=marker, color=colour, markersize=size, label=label, zorder=zorder,
                markeredgewidth=1.4 if marker == "x" else 0.7,
                markeredgecolor=colour if marker == "x" else style.INK,
            )  # fmt: skip


def _draw_ends(axes: Axes, data: ReportData, extent: Extent) -> None:
    if not len(data.path):
        axes.text(
            0.5, 0.5, "no pose", transform=axes.transAxes, ha="center", va="center", color=style.MUTED, fontsize=14
        )
        return
    order = np.argsort(data.seconds, kind="stable")
    start, end = data.path[order[0]], data.path[order[-1]]
    together = np.hypot(*(end - start)) < 0.04 * max(extent.width, extent.height)
    for xy, marker, colour, label in (
        (end, "s", style.VERMILLION, "" if together else "end"),
        (start, "o", style.GREEN, "start, end" if together else "start"),
    ):
        axes.plot(
            *xy, marker=marker, color=colour, markersize=9, markeredgecolor="white", markeredgewidth=1.5, zorder=10
        )
        near_the_edge = xy[0] > extent.x1 - 0.1 * extent.width
        axes.annotate(
            label, xy, xytext=(-8 if near_the_edge else 8, 8), textcoords="offset points", fontsize=style.TEXT,
            fontweight="bold", color=style.INK, path_effects=HALO, zorder=11, ha="right" if near_the_edge else "left",
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
