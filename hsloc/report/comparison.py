"""Results side by side: compare.html, made from what their report.html shows, and a table for the terminal."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

from hsloc.errors import EvaluationError
from hsloc.report.html import write_page

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_DATA = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.DOTALL)
_OF_THE_FIRST = ("map", "scans", "points", "loops", "ellipses", "marks", "events", "status", "odometry", "reference")
"""Parts of a view that are drawn of the first run alone."""


@dataclass(frozen=True, slots=True, eq=False)
class ComparedRun:
    """A result to compare: its name, and the view in its report (see hsloc.report.view)."""

    name: str
    view: dict[str, Any]

    @property
    def figures(self) -> dict[str, dict[str, Any]]:
        """By name: {name, values, numbers, explanation}."""
        summary = self.view["summary"] or {}
        return {each["name"]: each for each in summary.get("figures", ())}


def read_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """From folders of results, or reports; named by their folders, by their paths where two folders share a name.

    Raises EvaluationError for what holds no report that can be compared.
    """
    views = [_view(path / "report.html" if path.is_dir() else path) for path in paths]
    names = [path.name if path.is_dir() or path.name != "report.html" else path.parent.name for path in paths]
    unique = names if len(set(names)) == len(names) else [str(path) for path in paths]
    return [ComparedRun(name or str(path), view) for name, path, view in zip(unique, paths, views, strict=True)]


def _view(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "it is no text"
        raise EvaluationError(f"{path}: cannot be read: {reason}; give the folder of a run's results") from error
    found = _DATA.search(text)
    try:
        view = json.loads(found[1]) if found is not None else None
    except ValueError:
        view = None
    if not isinstance(view, dict) or "extent" not in view or "trajectory" not in view:
        raise EvaluationError(f"{path}: is no report of this version of hsloc; run the replay again")
    return view


def comparison_rows(runs: Sequence[ComparedRun]) -> list[tuple[str, ...]]:
    """A line for the verdict and for each figure of any run: its name, then each run's values and change."""
    verdicts = tuple(str((run.view["summary"] or {}).get("verdict", "")) for run in runs)
    rows = [("verdict", *verdicts)]
    for name in dict.fromkeys(name for run in runs for name in run.figures):
        first = runs[0].figures.get(name)
        cells = [_cell(run.figures.get(name), first if k else None) for k, run in enumerate(runs)]
        rows.append((name, *cells))
    return rows


def _cell(figure: dict[str, Any] | None, first: dict[str, Any] | None) -> str:
    if figure is None:
        return "–"
    text = " / ".join(figure["values"])
    return text if first is None else text + change(first.get("numbers", ()), figure.get("numbers", ()))


def change(first: Sequence[float | None], numbers: Sequence[float | None]) -> str:
    """The change of the first number in per cent, in brackets; empty where there is hardly one, or from zero."""
    if not first or not numbers or first[0] is None or numbers[0] is None or first[0] in (0.0, numbers[0]):
        return ""
    percent = 100.0 * (numbers[0] - first[0]) / abs(first[0])
    if abs(percent) < 0.05:
        return ""
    return f" ({percent:+.1f} %)" if abs(percent) < 10.0 else f" ({percent:+.0f} %)"


def write_comparison(path: Path, runs: Sequence[ComparedRun]) -> None:
    """Write the comparison as one HTML file that loads nothing. Raises OutputError where it cannot be written."""
    shown = [{"name": run.name, "data": _thinned(run.view) if k else run.view} for k, run in enumerate(runs)]
    title = escape(f"Comparison of {', '.join(run.name for run in runs)}")
    write_page(path, "compare", {"title": title}, {"runs": shown}, "compare.js")


def _thinned(view: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in view.items() if key not in _OF_THE_FIRST}
