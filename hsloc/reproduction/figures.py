"""Figures 2 to 8 of the course report, from our own results. Colours and type as in report.png."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hsloc.atomic_write import write_atomically
from hsloc.model.pose2 import Pose2, compose_poses, wrap_angle
from hsloc.report import style
from hsloc.reproduction import published
from hsloc.reproduction.convergence import COUNTS, ITERATIONS, REACHED
from hsloc.reproduction.figure_localisation import draw_columns, draw_errors, draw_path
from hsloc.reproduction.figure_style import COLOURS, head, quiet
from hsloc.reproduction.material import SEEN_FROM
from hsloc.reproduction.scan_match import START, scan_seen

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from matplotlib.axes import Axes

    from hsloc.reproduction.convergence import Convergence
    from hsloc.reproduction.mapping import Mapped
    from hsloc.reproduction.run import MaterialResults
    from hsloc.reproduction.scan_match import ScanMatch

DPI = 100
SETTINGS_THAT_STAY = ("backend", "backend_fallback", "interactive", "toolbar", "webagg", "tk.", "savefig.directory")


def draw_figures(results: MaterialResults, folder: Path) -> list[Path]:
    """Draw what the results allow into `folder`, as fig2_<material>.png and so on; returns the files.

    The same results give the same bytes. Raises OutputError.
    """
    jobs: list[tuple[str, tuple[float, float], Callable[[Figure], None]]] = []
    if results.scan_match:
        for number, matcher in ((2, "HS"), (3, "HIDE")):
            jobs.append((f"fig{number}", (16.0, 6.0), lambda f, number=number, matcher=matcher: draw_match(  # type: ignore[misc]
                f, results, number, matcher)))  # fmt: skip
    if results.convergence is not None:
        convergence = results.convergence
        jobs.append(("fig4", (14.0, 6.0), lambda f: draw_convergence(f, convergence)))
    if results.drives:
        jobs.append(("fig5", (16.0, 8.2), lambda f: draw_path(f, results)))
        jobs.append(("fig6", (14.0, 9.0), lambda f: draw_errors(f, results)))
    if results.mapped:
        jobs.append(("fig7", (16.0, 8.2), lambda f: draw_map(f, results)))
        jobs.append(("fig8", (14.0, 9.0), lambda f: draw_map_errors(f, results)))
    return [_save(folder / f"{name}_{results.material.name}.png", size, draw) for name, size, draw in jobs]


def _save(path: Path, size: tuple[float, float], draw: Callable[[Figure], None]) -> Path:
    # A user's matplotlibrc must not change the picture.
    defaults: dict[Any, Any] = {
        key: value for key, value in matplotlib.rcParamsDefault.items() if not key.startswith(SETTINGS_THAT_STAY)
    }
    look: dict[Any, Any] = {
        "font.family": style.FONT, "font.size": style.TEXT, "text.color": style.INK, "axes.labelcolor": style.MUTED,
        "axes.edgecolor": style.RULE, "xtick.color": style.MUTED, "ytick.color": style.MUTED,
        "axes.unicode_minus": True,
        "xtick.labelsize": style.SMALL, "ytick.labelsize": style.SMALL, "axes.labelsize": style.SMALL,
        "legend.frameon": False, "legend.fontsize": style.TEXT,
    }  # fmt: skip
    with warnings.catch_warnings(), matplotlib.rc_context({**defaults, **look}):
        figure = Figure(figsize=size, dpi=DPI, facecolor=style.PAPER)
        FigureCanvasAgg(figure)
        draw(figure)
        # Without the version of matplotlib in the file.
        write_atomically(
            path, lambda stream: figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
        )
    return path


DASHES = {"paper": "-", "paper-literal": (0, (4, 2))}
BANDWIDTHS = {"paper": "27 % to 0.7 % of the window", "paper-literal": "8 to 0.2 (m, rad)"}
TITLES = {
    "improvisations": "an iteration is an improvisation: the count of [P], differential evolution is free",
    "evaluations": "an iteration is a fitness evaluation: the count of [M], all is paid for",
}


def draw_convergence(figure: Figure, convergence: Convergence) -> None:
    """A panel for each way to count; the mean of the seeds, and between which values 80 % of them lie."""
    seeds = len(convergence.curves[0].fitness)
    head(
        figure,
        "Figure 4: the best fitness found so far",
        f"E2, mean of {seeds} seeds; shaded: from the 10th to the 90th percentile; sigma 1 m. "
        "Published: HIDE 0.99 before iteration 100, HS 0.955 after 1000",
    )
    low = min(float(curve.mean[29]) for curve in convergence.curves) - 0.01
    for column, counts in enumerate(COUNTS):
        axes = figure.add_axes((0.055 + column * 0.48, 0.09, 0.445, 0.71))
        _draw_panel(axes, convergence, counts)
        axes.set_ylim(low, 1.0)
        axes.set_title(TITLES[counts], loc="left", fontsize=style.TEXT)
        axes.set_xlabel(f"iteration ({counts})", labelpad=2)
        if column == 0:
            axes.set_ylabel("best fitness")


def _draw_panel(axes: Axes, convergence: Convergence, counts: str) -> None:
    iterations = np.arange(1, ITERATIONS + 1)
    for curve in convergence.curves:
        if curve.counts != counts:
            continue
        colour = COLOURS[curve.matcher]
        below, above = np.percentile(curve.fitness, (10, 90), axis=0)
        axes.fill_between(iterations, below, above, color=colour, alpha=0.10, linewidth=0, zorder=1)
        axes.plot(
            iterations, curve.mean, color=colour, linewidth=2.0, linestyle=DASHES[curve.preset], zorder=3,
            label=f"{curve.matcher}, bandwidth {BANDWIDTHS[curve.preset]}",
        )  # fmt: skip
    axes.axhline(REACHED, color=style.MUTED, linewidth=0.9, linestyle=(0, (1, 2)), zorder=2)
    axes.axhline(convergence.fitness_at_truth, color=style.INK, linewidth=0.9, zorder=2)
    axes.annotate(
        f"at the true pose: {convergence.fitness_at_truth:.3f}", (ITERATIONS, convergence.fitness_at_truth),
        xytext=(-4, 3), textcoords="offset points", ha="right", va="bottom", fontsize=style.SMALL, color=style.INK,
    )  # fmt: skip
    axes.annotate(
        f"{REACHED}", (ITERATIONS, REACHED), xytext=(-4, -3), textcoords="offset points", ha="right", va="top",
        fontsize=style.SMALL, color=style.MUTED,
    )  # fmt: skip
    axes.set_xlim(0, ITERATIONS)
    axes.legend(loc="lower right", fontsize=style.SMALL + 0.5, labelcolor=style.INK, handlelength=2.8)
    quiet(axes)


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
