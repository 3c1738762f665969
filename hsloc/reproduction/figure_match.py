"""Fig. 2 and 3 of [P]: the scan on its map before the match and after it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, wrap_angle
from hsloc.report import style
from hsloc.reproduction.figure_style import COLOURS, head, quiet
from hsloc.reproduction.material import SEEN_FROM
from hsloc.reproduction.scan_match import START, scan_seen

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hsloc.reproduction.run import MaterialResults
    from hsloc.reproduction.scan_match import ScanMatch


def draw_match(figure: Figure, results: MaterialResults, number: int, matcher: str) -> None:
    """Three panels: at the start, after the match as in [P], after the match with our defaults.

    The matches are those of the seed whose error is the median.
    """
    scan = results.material.scan
    rows = {row.variant.preset: row for row in results.scan_match if row.variant.matcher == matcher}
    head(
        figure,
        f"Figure {number}: {matcher} on {results.material.title}",
        f"E1, the seed of the median error of {len(rows['default'].poses)}; "
        "the start is the centre of the box; arrows: the robot",
    )
    panels = (
        ("before the match", START),
        ("after, preset paper-literal", _typical(rows["paper-literal"])),
        ("after, preset default", _typical(rows["default"])),
    )
    low, high = scan.min(axis=0), scan.max(axis=0)
    margin = 0.12 * float((high - low).max())
    for column, (title, pose) in enumerate(panels):
        axes = figure.add_axes((0.04 + column * 0.325, 0.08, 0.3, 0.735))
        axes.plot(*scan.T, ".", color=style.WALL, markersize=4.5, label="map", zorder=2)
        moved = pose @ scan_seen(scan)
        axes.plot(
            *moved.T, "o", color=COLOURS[matcher], markersize=4.5, markerfacecolor="none", markeredgewidth=0.9,
            label="scan", zorder=3,
        )  # fmt: skip
        _arrow(axes, pose, COLOURS[matcher])
        _arrow(axes, SEEN_FROM, style.WALL)
        axes.set_title(f"{title}: {_error(pose)}", loc="left", fontsize=style.TEXT + 1)
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - margin, high[1] + margin)
        axes.set_xlabel("x [m]", labelpad=1)
        if column == 0:
            axes.set_ylabel("y [m]", labelpad=1)
        quiet(axes)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", bbox_to_anchor=(0.98, 0.99), ncols=2, handletextpad=0.2)


def _typical(row: ScanMatch) -> Pose2:
    return Pose2.from_array(row.poses[row.typical])


def _error(pose: Pose2) -> str:
    metres = pose.distance(SEEN_FROM)
    degrees = abs(np.degrees(wrap_angle(pose.theta - SEEN_FROM.theta)))
    length = f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.2f} mm"
    return f"{length}, {degrees:.{1 if degrees >= 0.1 else 3}f} deg off"


def _arrow(axes: Axes, pose: Pose2, colour: str) -> None:
    """Where the robot stands and looks."""
    tip = pose @ Pose2(0.35, 0.0, 0.0)
    look = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 0}
    axes.annotate("", (tip.x, tip.y), (pose.x, pose.y), arrowprops=look, zorder=4)
