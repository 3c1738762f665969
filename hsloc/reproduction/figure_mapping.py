"""Fig. 7 and 8 of [P]: the map of points that was drawn on the way, and the error over the time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.model.pose2 import compose_poses
from hsloc.report import style
from hsloc.reproduction import published
from hsloc.reproduction.figure_localisation import draw_columns
from hsloc.reproduction.figure_style import COLOURS, head, quiet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hsloc.reproduction.mapping import Mapped
    from hsloc.reproduction.run import MaterialResults

SHOWN = (("HIDE", "default"), ("HS", "paper-literal"))


def draw_map(figure: Figure, results: MaterialResults) -> None:
    """Points and paths, of our best on the left and of the report's settings on the right."""
    drives = {(d.matcher, d.preset): d for d in results.mapped if d.seed == 0}
    head(
        figure,
        "Figure 7: SLAM along the waypoints",
        f"E4 on {results.material.title}, seed 0; every point within 60 m is seen, through walls; nothing is known but "
        "the start",
    )
    world = results.material.world.points
    assert world is not None
    low, high = world.min(axis=0) - 12.0, world.max(axis=0) + 12.0
    for column, key in enumerate(SHOWN):
        axes = figure.add_axes((0.045 + 0.49 * column, 0.06, 0.455, 0.74))
        axes.plot(*world.T, "s", color=style.RULE, markersize=5.5, label="true points", zorder=2)
        _draw(axes, drives[key])
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlabel("x [m]", labelpad=1)
        axes.set_ylabel("y [m]", labelpad=1)
        drive = drives[key]
        axes.set_title(
            f"{key[0]}, {key[1]}: {drive.points} points, {100 * drive.complete:.0f} % of the true ones covered",
            loc="left", fontsize=style.TEXT,
        )  # fmt: skip
        axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.05), ncols=5, columnspacing=1.1, handlelength=1.4)
        quiet(axes)


def _draw(axes: Axes, drive: Mapped) -> None:
    path, points = drive.path, drive.map_points
    assert path is not None
    assert points is not None
    odometry = compose_poses(path.truth.poses[0], path.odometry.poses)
    axes.plot(*odometry[:, :2].T, color=style.PURPLE, linewidth=1.2, linestyle=(0, (1, 1.2)), zorder=3,
              label="odometry alone")  # fmt: skip
    axes.plot(*path.truth.poses[:, :2].T, color="black", linewidth=3.8, alpha=0.28, zorder=4, label="true path",
              solid_capstyle="butt")  # fmt: skip
    axes.plot(*path.estimate.poses[:, :2].T, color=COLOURS[drive.matcher], linewidth=1.5, zorder=5, label="estimate")
    axes.plot(*points.T, ".", color=style.INK, markersize=3.5, label="map", zorder=6)


def draw_map_errors(figure: Figure, results: MaterialResults) -> None:
    """x, y and theta below each other, a column for each of two presets, HIDE and HS in each."""
    head(
        figure,
        "Figure 8: the errors of SLAM over the time",
        f"E4 on {results.material.title}, seed 0; each column has its own scale; theta is wrapped",
    )
    drives = {(d.matcher, d.preset): d for d in results.mapped if d.seed == 0}
    draw_columns(figure, drives, {"HS": published.E4_RMSE}, metres=True)
