"""Fig. 5 and 6 of [P]: the path that was driven, and the error over the time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import ConnectionPatch, Rectangle

from hsloc.model.pose2 import compose_poses, wrap_angles
from hsloc.report import style
from hsloc.reproduction import published
from hsloc.reproduction.figure_style import COLOURS, head, quiet

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from hsloc.reproduction.localisation import Drive
    from hsloc.reproduction.mapping import Mapped
    from hsloc.reproduction.run import MaterialResults

    F64 = NDArray[np.float64]

ZOOM = 2.4
"""Width and height of what is magnified, metres."""
PRESETS = ("default", "paper-literal")


def draw_path(figure: Figure, results: MaterialResults) -> None:
    """The whole drive on the left; on the right a piece of it, where the errors can be seen."""
    drives = {(d.matcher, d.preset): d for d in results.drives if d.seed == 0}
    hide, harmony = drives["HIDE", "default"].path, drives["HS", "paper-literal"].path
    assert hide is not None
    assert harmony is not None
    points = results.material.world.points
    assert points is not None
    head(
        figure,
        "Figure 5: localisation along the waypoints",
        f"E3 on {results.material.title}, seed 0; every point within 50 m is seen, through walls",
    )
    odometry = compose_poses(hide.truth.poses[0], hide.odometry.poses)
    whole = figure.add_axes((0.045, 0.07, 0.5, 0.78))
    part = figure.add_axes((0.6, 0.07, 0.385, 0.7))
    whole.plot(*points.T, ".", color=style.WALL, markersize=4.0, label="map points", zorder=2)
    for axes, width in ((whole, 1.6), (part, 2.2)):
        axes.plot(*odometry[:, :2].T, color=style.PURPLE, linewidth=1.4, linestyle=(0, (1, 1.2)), zorder=3,
                  label="odometry alone")  # fmt: skip
        axes.plot(*hide.truth.poses[:, :2].T, color="black", linewidth=width + 2.2, alpha=0.28, zorder=4, label="truth",
                  solid_capstyle="butt")  # fmt: skip
        axes.plot(*harmony.estimate.poses[:, :2].T, color=COLOURS["HS"], linewidth=width * 0.8, zorder=5,
                  label="HS, paper-literal")  # fmt: skip
        axes.plot(*hide.estimate.poses[:, :2].T, color=COLOURS["HIDE"], linewidth=width, zorder=6,
                  label="HIDE, default")  # fmt: skip
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlabel("x [m]", labelpad=1)
        axes.set_ylabel("y [m]", labelpad=1)
        quiet(axes)
    waypoints = results.material.world.waypoints
    whole.plot(*waypoints.T, "D", color=style.ORANGE, markersize=6.5, markeredgecolor=style.INK, markeredgewidth=0.8,
               label="waypoints", zorder=7)  # fmt: skip
    _frame(whole, points, hide.truth.poses[:, :2])
    centre = _worst_place(harmony.truth.poses, harmony.estimate.poses)
    part.set_xlim(centre[0] - ZOOM / 2, centre[0] + ZOOM / 2)
    part.set_ylim(centre[1] - ZOOM / 2, centre[1] + ZOOM / 2)
    title = "magnified: where HS is farthest off (the frame is drawn larger than it is)"
    part.set_title(title, loc="left", fontsize=style.TEXT)
    _connect(figure, whole, part, centre)
    handles, labels = whole.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", bbox_to_anchor=(0.985, 0.925), ncols=3, columnspacing=1.4)


def _frame(axes: Axes, points: F64, path: F64) -> None:
    both = np.vstack((points, path))
    low, high = both.min(axis=0) - 4.0, both.max(axis=0) + 4.0
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def _worst_place(truth: F64, estimate: F64) -> F64:
    place: F64 = truth[int(np.argmax(np.hypot(*(estimate - truth)[:, :2].T))), :2]
    return place


def _connect(figure: Figure, whole: Axes, part: Axes, centre: F64) -> None:
    side = 3.0 * ZOOM  # the true size would be a dot
    corner = centre - side / 2
    whole.add_patch(
        Rectangle((corner[0], corner[1]), side, side, fill=False, edgecolor=style.INK, linewidth=1.2, zorder=8)
    )
    line = ConnectionPatch(
        xyA=(corner[0] + side, corner[1] + side / 2), coordsA=whole.transData, xyB=(0.0, 1.0), coordsB=part.transAxes,
        color=style.MUTED, linewidth=0.9, zorder=1,
    )  # fmt: skip
    figure.add_artist(line)


def draw_errors(figure: Figure, results: MaterialResults) -> None:
    """x, y and theta below each other, a column for each of two presets, HIDE and HS in each."""
    head(
        figure,
        "Figure 6: the errors over the time",
        f"E3 on {results.material.title}, seed 0; the same scale in both columns; theta is wrapped",
    )
    drives = {(d.matcher, d.preset): d for d in results.drives if d.seed == 0}
    draw_columns(figure, drives, published.E3_RMSE)


def draw_columns(
    figure: Figure,
    drives: Mapping[tuple[str, str], Drive | Mapped],
    printed: Mapping[str, tuple[float, float, float]],
    *,
    metres: bool = False,
) -> None:
    """A column for each of `PRESETS`, with x, y and theta below each other; `printed` RMSE are put beside ours.

    In centimetres and with one scale for both columns, or in `metres` and each column with its own.
    """
    length = (1.0, "m", 3) if metres else (100.0, "cm", 2)
    rows = (("x", *length), ("y", *length), ("theta", 180 / np.pi, "deg", 2))
    for row, (name, factor, unit, digits) in enumerate(rows):
        top = max(
            float(np.abs(_errors(drives[matcher, preset])[1][:, row]).max())
            for matcher in COLOURS
            for preset in PRESETS
        )
        for column, preset in enumerate(PRESETS):
            if metres:
                top = max(float(np.abs(_errors(drives[matcher, preset])[1][:, row]).max()) for matcher in COLOURS)
            axes = figure.add_axes((0.06 + 0.48 * column, 0.63 - 0.283 * row, 0.45, 0.205))
            for matcher in ("HS", "HIDE"):
                seconds, errors = _errors(drives[matcher, preset])
                rmse = drives[matcher, preset].rmse[row]
                axes.plot(
                    seconds, errors[:, row] * factor, color=COLOURS[matcher], linewidth=0.9,
                    label=f"{matcher}: RMSE {rmse * factor:.{digits}f} {unit}"
                    + (f" (published {printed[matcher][row] * factor:.{digits}f})" if matcher in printed else ""),
                )  # fmt: skip
            axes.axhline(0.0, color=style.INK, linewidth=0.7)
            axes.set_ylim(-1.05 * top * factor, 1.05 * top * factor)
            axes.set_xlim(0.0, seconds[-1])
            axes.set_title(f"{name} [{unit}]", loc="left", fontsize=style.TEXT, pad=4)
            if row == 0:
                axes.text(0.0, 1.25, f"preset {preset}", transform=axes.transAxes, fontsize=13, fontweight="bold")
            axes.legend(loc="lower right", bbox_to_anchor=(1.01, 0.98), ncols=2, fontsize=style.SMALL - 0.5,
                        handlelength=1.2, columnspacing=1.0, borderpad=0.1)  # fmt: skip
            quiet(axes)
            if row == 2:
                axes.set_xlabel("time [s]", labelpad=1)


def _errors(drive: Drive | Mapped) -> tuple[F64, F64]:
    """Seconds (n,) and estimate minus truth (n, 3)."""
    path = drive.path
    assert path is not None
    errors = path.estimate.poses - path.truth.interpolated(path.estimate.stamps_ns)
    errors[:, 2] = wrap_angles(errors[:, 2])
    return (path.estimate.stamps_ns - path.truth.stamps_ns[0]) * 1e-9, errors
