"""What the figures share: head, frames, and the colour of each matcher."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"HIDE": style.BLUE, "HS": style.VERMILLION}


def head(figure: Figure, title: str, line: str) -> None:
    """Title and a line below it, at the upper left."""
    height = float(figure.get_figheight())
    figure.text(0.03, 1.0 - 0.18 / height, title, fontsize=18, fontweight="bold", va="top")
    figure.text(0.03, 1.0 - 0.56 / height, line, fontsize=12, color=style.MUTED, va="top")


def quiet(axes: Axes, *, grid: bool = True) -> None:
    """Thin rules instead of a box."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(length=3)
    axes.set_axisbelow(True)
    if grid:
        axes.grid(color=style.RULE, linewidth=0.7)
