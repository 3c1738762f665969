"""Fig. 4 of [P]: the best fitness against the iteration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.report import style
from hsloc.reproduction.convergence import COUNTS, ITERATIONS, REACHED
from hsloc.reproduction.figure_style import COLOURS, head, quiet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hsloc.reproduction.convergence import Convergence

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
