"""Labels of the map in report.png: each beside its mark, off the lines, the other marks and the other labels.

A place is judged as matplotlib judges the corners for a legend (`loc="best"`): by the lines that cross its box, and by
the points and boxes that lie in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox

from hsloc.report import style

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from matplotlib.text import Text
    from numpy.typing import NDArray

    from hsloc.report.data import ReportData

    Floats = NDArray[np.float64]

HALO = [withStroke(linewidth=3.0, foreground="white")]
_TOGETHER = 12.0
"""Distance (pixels) up to which the first and the last pose have one label: their marks lie on each other."""
_DISTANCES = (9.0, 16.0, 26.0, 40.0, 58.0, 80.0)
"""From a mark to the nearest edge of its label (pixels), as far as none of them is free."""
_DIRECTIONS = ((1, 1), (-1, 1), (1, -1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
_ROOM = 2.0
"""Pixels around a label that are to be free: its halo."""
_ON_LABEL, _OUTSIDE, _ON_MARK, _ON_LINE, _AWAY = 1000.0, 1000.0, 30.0, 10.0, 0.1
"""What a place costs for each label or mark that it covers, outside of the panel, for each line through it by the
points that this is wide, and for each pixel of distance."""
_LEADER = 20.0
"""Distance (pixels) from which on a line leads from the label to its mark."""


def label_ends(axes: Axes, data: ReportData) -> None:
    """Name the first and the last pose; all else is drawn already, and the axes have their limits."""
    if not len(data.path):
        return
    axes.apply_aspect()
    order = np.argsort(data.seconds, kind="stable")
    ends = data.path[[order[0], order[-1]]]
    start, end = np.asarray(axes.transData.transform(ends), dtype=np.float64)
    if np.hypot(*(end - start)) <= _TOGETHER:
        place_labels(axes, (("start, end", ends[0]),))
    else:
        place_labels(axes, (("start", ends[0]), ("end", ends[1])))


def place_labels(axes: Axes, labels: Sequence[tuple[str, Floats]]) -> list[Text]:
    """Write texts beside points of the map (x, y in m), each where it covers least of what is there and before it."""
    marks = [box for line in axes.lines for box in _marks(line)]
    drawn = [line for line in axes.lines if line.get_linestyle() != "None" and len(np.asarray(line.get_xdata()))]
    there = _There(
        axes.bbox,
        [(_path(line), line.get_linewidth()) for line in drawn],
        marks,
        [text.get_window_extent() for text in axes.texts if text.get_text()],
    )
    made: list[Text] = []
    for text, point in labels:
        xy = (float(point[0]), float(point[1]))
        label = axes.annotate(
            text, xy, xytext=(0.0, 0.0), textcoords="offset pixels", fontsize=style.TEXT, fontweight="bold",
            color=style.INK, path_effects=HALO, zorder=14, ha="center", va="center",
        )  # fmt: skip
        at = np.asarray(axes.transData.transform(xy), dtype=np.float64)
        offset, box, distance = there.best(at, np.asarray(label.get_window_extent().size))
        label.set_position((float(offset[0]), float(offset[1])))
        there.labels.append(box)
        if distance >= _LEADER:
            axes.annotate(
                "", xy, xytext=(float(offset[0]), float(offset[1])), textcoords="offset pixels", zorder=13,
                arrowprops={"arrowstyle": "-", "color": style.INK, "linewidth": 0.9, "shrinkA": 0.0, "shrinkB": 4.0,
                            "path_effects": HALO},
            )  # fmt: skip
        made.append(label)
    return made


@dataclass(frozen=True, slots=True, eq=False)
class _There:
    """What a label is not to cover, in pixels: the panel that it lies in, lines with their widths, marks, labels."""

    panel: Bbox
    lines: list[tuple[Path, float]]
    marks: list[Bbox]
    labels: list[Bbox]

    def best(self, at: Floats, size: Floats) -> tuple[Floats, Bbox, float]:
        """The offset of the middle of a label from its mark, its box, and how far the two are apart."""
        found: list[tuple[float, Floats, Bbox, float]] = []
        for distance, direction in product(_DISTANCES, _DIRECTIONS):
            # Diagonally the corner is as far away as the edge is along an axis.
            offset = np.array(direction) * (distance / np.hypot(*direction) + 0.5 * size)
            low = at + offset - 0.5 * size
            box = Bbox((low, low + size))
            cost = self._cost(box.padded(_ROOM), Path((at, at + offset)) if distance >= _LEADER else None)
            found.append((cost + _AWAY * distance, offset, box, distance))
            if not cost:
                break
        return min(found, key=lambda each: each[0])[1:]

    def _cost(self, box: Bbox, leader: Path | None) -> float:
        cost = _ON_LABEL * box.count_overlaps(self.labels) + _ON_MARK * box.count_overlaps(self.marks)
        cost += _ON_LINE * sum(width * path.intersects_bbox(box, filled=False) for path, width in self.lines)
        if leader is not None:
            x, y = np.asarray(leader.vertices, dtype=np.float64)[0].tolist()
            crossed = [each for each in self.marks if not each.contains(x, y)]
            cost += _ON_MARK * sum(leader.intersects_bbox(each) for each in (*crossed, *self.labels))
        is_within = self.panel.x0 <= box.x0 and box.x1 <= self.panel.x1
        is_within = is_within and self.panel.y0 <= box.y0 and box.y1 <= self.panel.y1
        return float(cost if is_within else cost + _OUTSIDE)


def _path(line: Line2D) -> Path:
    """In pixels."""
    return line.get_path().transformed(line.get_transform())


def _marks(line: Line2D) -> list[Bbox]:
    """The boxes of its marks, in pixels."""
    marker: object = line.get_marker()  # a name, or the vertices of an own one
    if isinstance(marker, str) and marker == "None":
        return []
    at = np.asarray(_path(line).vertices, dtype=np.float64).reshape(-1, 2)
    figure = line.get_figure()
    half = 0.5 * line.get_markersize() * (figure.dpi if figure is not None else 72.0) / 72.0
    return [Bbox((xy - half, xy + half)) for xy in at[np.isfinite(at).all(axis=1)]]
