"""The report's figures 2 to 8, drawn from our own results. Colours and type as in report.png."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hsloc.atomic_write import write_atomically
from hsloc.report import style
from hsloc.reproduction.figure_convergence import draw_convergence
from hsloc.reproduction.figure_localisation import draw_errors, draw_path
from hsloc.reproduction.figure_mapping import draw_map, draw_map_errors
from hsloc.reproduction.figure_match import draw_match

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hsloc.reproduction.run import MaterialResults

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
