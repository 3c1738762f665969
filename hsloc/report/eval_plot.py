"""Plots of `hsloc eval`: trajectories with the reference, the error on the map, and errors over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import rc_context
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from hsloc.errors import OutputError
from hsloc.report import style
from hsloc.report.data import since

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from hsloc.evaluation import Comparison

FORMATS = (".png", ".svg", ".pdf")
_INKS = (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE, style.ORANGE)


def draw_comparisons(comparisons: Mapping[str, Comparison], figure: Figure | None = None) -> Figure:
    """The figure: paths with the reference on the left, translation and rotation errors over time on the right.

    A single estimate is coloured by its error, as evo does.
    """
    figure = Figure(figsize=(13.0, 6.5), layout="constrained") if figure is None else figure
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
    if path.suffix.lower() not in FORMATS:
        raise OutputError(f"{path}: unknown kind of picture; name a file that ends in {', '.join(FORMATS)}")
    try:
        with rc_context({"svg.hashsalt": "hsloc"}):  # else ids of an SVG differ from one time to the next
            draw_comparisons(comparisons).savefig(path, dpi=140, metadata=_METADATA[path.suffix.lower()])
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}; choose another file") from error


_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
"""Without the time, so that the same errors give the same bytes."""


def show_plot(comparisons: Mapping[str, Comparison]) -> None:
    """Open the figure in a window, and wait until it is closed. Raises OutputError where there is none to open."""
    import matplotlib
    from matplotlib import pyplot

    if matplotlib.get_backend().lower() == "agg":
        raise OutputError("--plot: there is no display, or no toolkit for windows (tkinter); use --save-plot FILE.png")
    draw_comparisons(comparisons, pyplot.figure(figsize=(13.0, 6.5), layout="constrained"))
    pyplot.show()
