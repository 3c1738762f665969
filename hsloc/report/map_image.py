"""Which part of the world a report shows, the map as a picture of grey levels, and the small picture of a table."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Pose2
from hsloc.report import style
from hsloc.report.data import prepare, with_gaps

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.model import OccupancyGrid
    from hsloc.report.data import ReportData, ReportParts

    Floats = NDArray[np.float64]

MARGIN = 0.05
"""Free room around what is shown, as a part of the larger side."""

LEAST_SIZE = 0.5
"""Smallest side of what is shown, in metres, for a robot that did not move."""

THUMBNAIL_FILE = "thumbnail.png"
THUMBNAIL = (120, 80)
"""Width and height [pixels] of the small picture of a result."""
_FINER = 2
"""Pixels that it is drawn with for one of it, in each direction, so that lines are smooth."""

SURROUNDINGS = 10.0
"""Metres of map that are shown around the path at least, if the map has them; more around a longer path."""


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

    def holds(self, xy: Floats) -> bool:
        """Whether all points (n, 2) that are known lie within."""
        inside = (self.x0 <= xy[:, 0]) & (xy[:, 0] <= self.x1) & (self.y0 <= xy[:, 1]) & (xy[:, 1] <= self.y1)
        return bool((inside | ~np.isfinite(xy).all(axis=1)).all())

    def around(self, xy: Floats) -> Extent:
        """The smallest rectangle that holds this one and points (n, 2), with a margin around these."""
        known = _finite(xy)
        if not len(known):
            return self
        room = 0.5 * MARGIN * max(self.width, self.height)
        low, high = known.min(axis=0) - room, known.max(axis=0) + room
        corners = (min(self.x0, low[0]), min(self.y0, low[1]), max(self.x1, high[0]), max(self.y1, high[1]))
        return Extent(*(float(value) for value in corners))

    def widened(self, aspect: float) -> Extent:
        """The smallest rectangle around this one, with the same middle, that has another aspect."""
        wider, higher = max(self.width, self.height * aspect), max(self.height, self.width / aspect)
        x, y = (self.x0 + self.x1) / 2.0, (self.y0 + self.y1) / 2.0
        return Extent(x - wider / 2.0, y - higher / 2.0, x + wider / 2.0, y + higher / 2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """The known part of a map (height, width) from 0 (free) to 100 (wall), -1 unknown, row 0 at the bottom.

    `T_map_corner` is the pose of its lower left corner, `side` the side of a pixel in metres.
    """

    values: NDArray[np.int8]
    T_map_corner: Pose2
    side: float

    @property
    def levels(self) -> NDArray[np.uint8]:
        """RGBA (height, width, 4); unknown is clear."""
        return grey_levels()[self.values]

    @property
    def width(self) -> float:
        """In metres."""
        return float(self.values.shape[1] * self.side)

    @property
    def height(self) -> float:
        """In metres."""
        return float(self.values.shape[0] * self.side)


def picture_of(grid: OccupancyGrid, most_pixels: float) -> Picture | None:
    """The map as a picture whose sides have at most `most_pixels`; None where nothing is known."""
    bounds = _known_bounds(grid)
    if bounds is None:
        return None
    row, column, last_row, last_column = bounds
    cells = grid.cells[row : last_row + 1, column : last_column + 1]
    factor = max(1, ceil(max(cells.shape) / most_pixels))
    corner = grid.origin @ (np.array((column, row)) * grid.resolution)
    return Picture(
        np.clip(darkest_of_blocks(cells, factor), -1, 100),
        Pose2(float(corner[0]), float(corner[1]), grid.origin.theta),
        factor * grid.resolution,
    )


def shown_extent(data: ReportData, grid: OccupancyGrid | None, points: Floats | None) -> Extent:
    """All of the trajectory, the reference and the places that may be right, and the known map around them.

    Odometry may lie outside of it. Of a map that is far larger than the path only what lies within `SURROUNDINGS` of
    the path is shown.
    """
    reference = np.zeros((0, 2)) if data.reference is None else data.reference
    paths = _finite(np.concatenate((data.path, reference, data.places)))
    ground = _finite(
        np.concatenate(
            (np.zeros((0, 2)) if points is None else points, np.zeros((0, 2)) if grid is None else _known_corners(grid))
        )
    )
    if len(paths) and len(ground):
        low, high = paths.min(axis=0), paths.max(axis=0)
        around = max(float((high - low).max()), SURROUNDINGS)
        ground = np.clip(ground, low - around, high + around)
    every = np.concatenate((paths, ground))
    if len(every) == 0:
        return Extent(-1.0, -1.0, 1.0, 1.0)
    low, high = every.min(axis=0), every.max(axis=0)
    size = max(float((high - low).max()), LEAST_SIZE)
    middle, half = (low + high) / 2.0, np.maximum(high - low, 0.08 * size) / 2.0 + MARGIN * size
    return Extent(*(middle - half).tolist(), *(middle + half).tolist())


def draw_thumbnail(path: Path, parts: ReportParts, data: ReportData | None = None) -> None:
    """Write a picture of map and trajectory that is small enough for a table of results; known poses are blue.

    `data` is what `prepare(parts)` gave, where it is known already.
    """
    from PIL import Image, ImageDraw

    data, grid = prepare(parts) if data is None else data, parts.grid
    width, height = (_FINER * side for side in THUMBNAIL)
    extent = shown_extent(data, grid, parts.points).widened(width / height)
    pixel = extent.width / width
    ground = style.PAPER if grid is None else style.UNKNOWN
    image = Image.new("RGB", (width, height), ground)
    if grid is not None and (picture := picture_of(grid, max(grid.cells.shape) * grid.resolution / pixel)) is not None:
        x = extent.x0 + (np.arange(width) + 0.5) * pixel
        y = extent.y1 - (np.arange(height) + 0.5) * pixel
        at = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        column, row = np.floor((picture.T_map_corner.inverse() @ at) / picture.side).astype(np.int64).T
        rows, columns = picture.values.shape
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        colours = np.zeros((width * height, 4), dtype=np.uint8)
        colours[inside] = grey_levels()[picture.values[row[inside], column[inside]]]
        levels = Image.fromarray(colours.reshape(height, width, 4))
        image.paste(levels, mask=levels.getchannel("A"))
    draw = ImageDraw.Draw(image)
    for rows_of, colour in ((~data.localised, style.PURPLE), (data.localised, style.BLUE)):
        line = with_gaps(np.where(rows_of[:, None], data.path, np.nan), data.jumps)
        line = np.round((line - (extent.x0, extent.y1)) * (1.0 / pixel, -1.0 / pixel), 1)
        for begin, end in known_runs(line):
            shown = line[begin:end]
            every = np.append(np.any(np.diff(shown, axis=0) != 0.0, axis=1), True)
            draw.line(shown[every].reshape(-1).tolist(), fill=colour, width=2 * _FINER - 1)
            draw.circle(shown[0].tolist(), 2 * _FINER - 1, fill=colour)  # also of a robot that stood still
    image.reduce(_FINER).save(path, optimize=True)


def known_runs(line: Floats) -> list[list[int]]:
    """First row of each run of known points of a path (n, 2), and the row after its last; NaN is between runs."""
    known = np.concatenate(([False], np.isfinite(line).all(axis=1), [False]))
    runs: list[list[int]] = np.flatnonzero(known[1:] != known[:-1]).reshape(-1, 2).tolist()
    return runs


def line_width(data: ReportData, extent: Extent) -> float:
    """Width of the trajectory in pixels: a path that goes to and fro for long must not bury the map."""
    laps = data.length_m / max(extent.width, extent.height)
    return float(np.clip(3.0 * np.sqrt(5.0 / max(laps, 1e-9)), 1.6, 3.0))


def _finite(xy: Floats) -> Floats:
    return xy[np.isfinite(xy).all(axis=1)]


def _known_bounds(grid: OccupancyGrid) -> tuple[int, int, int, int] | None:
    """First row and column, last row and column of the rectangle that holds all known cells."""
    known = grid.cells >= 0
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if len(rows) == 0:
        return None
    return int(rows[0]), int(columns[0]), int(rows[-1]), int(columns[-1])


def _known_corners(grid: OccupancyGrid) -> Floats:
    """Corners in the map frame of that rectangle, shape (4, 2); or of no cell, (0, 2)."""
    bounds = _known_bounds(grid)
    if bounds is None:
        return np.zeros((0, 2))
    y0, x0, y1, x1 = bounds
    corners = np.array([(x0, y0), (x1 + 1, y0), (x1 + 1, y1 + 1), (x0, y1 + 1)], dtype=np.float64)
    return grid.origin @ (corners * grid.resolution)


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
