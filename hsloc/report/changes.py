"""What changed since the given map was made, in words for the page, and drawn on the map of report.png."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.report import style
from hsloc.report.data import since
from hsloc.report.rounding import columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from hsloc.analysis.map_changes import SeenChanges

    Floats = NDArray[np.float64]

CHANGE_WORDS = {"appeared": "not on the map", "vanished": "on the map, but gone"}
_MOST_CELLS = 4000
"""Cells of each kind that are drawn: of more every k-th."""


def change_marks(changes: SeenChanges | None, start_ns: int, most: int) -> list[dict[str, Any]]:
    """For each kind that there is the largest of its things, at most `most`, and when a scan showed each first."""
    if changes is None:
        return []
    found = []
    for kind, words in CHANGE_WORDS.items():
        rows = [k for k, each in enumerate(changes.changes) if each.kind == kind][:most]
        if not rows:
            continue
        things, spans = [changes.changes[k] for k in rows], since(changes.spans_ns[rows], start_ns)
        x, y = np.array([each.x for each in things]), np.array([each.y for each in things])
        texts = [
            f"{each.size:.1f} m, {words}; shown by scans from {begin:.1f} to {end:.1f} s"
            for each, (begin, end) in zip(things, spans.tolist(), strict=True)
        ]
        found.append({"status": kind, "label": words, **columns(t=spans[:, 0], x=x, y=y), "reason": texts})
    return found


def draw_changes(axes: Axes, changes: SeenChanges | None) -> None:
    """The cells of the changes: green what is not on the map, red what is gone."""
    if changes is None:
        return
    layer = changes.layer
    for kind, cells, colour in (
        ("appeared", layer.occupied(), style.GREEN),
        ("vanished", layer.free(), style.VERMILLION),
    ):
        if not cells.any():
            continue
        xy = layer.centres(cells)
        xy = xy[:: -(-len(xy) // _MOST_CELLS)]
        axes.plot(*xy.T, "s", color=colour, markersize=2.6, markeredgewidth=0.0, zorder=3)
        axes.plot([], [], "s", color=colour, markersize=7, label=CHANGE_WORDS[kind])  # large enough for the legend
