"""report.html and compare.html: a run, or several side by side, in one file that needs no network.

The comparison is made from what the runs' report.html show; `comparison_rows` is its table for the terminal.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.atomic_write import write_text_atomically
from hsloc.errors import EvaluationError
from hsloc.evaluation.metrics import format_json
from hsloc.report.data import prepare, reason_counts
from hsloc.report.seeds import figure_names, is_number, seed_groups, seed_rows
from hsloc.report.summary import REASONS_HEADING, VERDICT_WORDS, WARNINGS_HEADING, ResultSummary
from hsloc.report.table import DASH, STATUS_WORDS, error_statistics
from hsloc.report.view import data_url, view_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from hsloc.evaluation.error_metrics import ErrorMetrics
    from hsloc.report.data import Provenance, ReportData, ReportParts
    from hsloc.report.view import ReportView
    from hsloc.run_metrics import LaserMetrics, RunMetrics

STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse", "count")
VIEWER_SCRIPTS = ("input.js", "charts.js", "layers.js", "export.js", "view.js")
"""Files of hsloc/report/viewer, in the order in which they are needed."""

_DATA = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.DOTALL)
_OF_THE_FIRST = (
    "map",
    "scans",
    "points",
    "loops",
    "graph",
    "ellipses",
    "marks",
    "ambiguities",
    "events",
    "status",
    "odometry",
    "reference",
)
"""Parts of a view that are drawn of the first run alone."""


def write_report_html(
    path: str | Path, parts: ReportParts, view: ReportView | None = None, data: ReportData | None = None
) -> None:
    """Write the report of a run as one self-contained HTML file: the same run gives the same bytes.

    `view` is what `view_of(parts)` gave and `data` what `prepare(parts)` did, where they are known already. All text
    is escaped. Raises `OutputError` where the file cannot be written.
    """
    data, metrics = prepare(parts) if data is None else data, parts.metrics
    summary = None if metrics is None else ResultSummary.of(metrics)
    view = view_of(parts, data) if view is None else view
    values = view.values if view.map_png is None else view.with_picture(data_url(view.map_png))
    fragments = {
        "title": escape(parts.title),
        "head": "" if summary is None else _head(summary),
        "figures": "" if summary is None else _figures(summary),
        "read": "" if metrics is None else _what_was_read(metrics),
        "scans": _scans(data),
        "statistics": "" if metrics is None else _statistics(metrics),
        "provenance": _provenance(parts.provenance),
        "metrics": "" if metrics is None else escape(format_json(metrics.to_json())),
    }
    write_page(Path(path), "report", fragments, values)


def write_page(path: Path, name: str, fragments: Mapping[str, str], data: Mapping[str, object], *more: str) -> None:
    """Write templates/<name>.html, filled, with `data` and the scripts that draw it, as one file that loads nothing."""
    scripts = [*(f"viewer/{each}" for each in (*VIEWER_SCRIPTS, *more)), f"templates/{name}.js"]
    body = _fill(_resource(f"templates/{name}.html"), fragments)
    write_text_atomically(path, page_text(fragments["title"], body, data, "".join(map(_resource, scripts))))


def page_text(title: str, body: str, data: Mapping[str, object] | None = None, script: str = "") -> str:
    """A page in the style of the reports; `title` and `body` are escaped already."""
    style = _resource("viewer/view.css") + _resource("templates/report.css")
    page = {"title": title, "style": style, "body": body, "data": _script_json(data or {}), "script": script}
    return _fill(_resource("templates/page.html"), page)


def _head(summary: ResultSummary) -> str:
    """Verdict, headline, facts, the figures that matter most, and the reasons for the verdict."""
    key_figures = "".join(
        f'<div class="key-figure"><dt>{escape(row.label)}</dt><dd>{escape(" / ".join(row.values))}</dd>'
        f'<dd class="muted">{escape(row.explanation)}</dd></div>'
        for row in summary.key_figures
    )
    reasons = _texts(REASONS_HEADING, summary.reasons, "reasons")
    warnings = _texts(WARNINGS_HEADING, summary.warnings, "others")
    return (
        f'<p class="headline"><strong class="verdict {summary.verdict}">{summary.verdict}</strong> '
        f"<span>{escape(summary.headline)}</span></p>"
        f'<p class="muted">{escape(VERDICT_WORDS[summary.verdict])}</p><ul class="facts">{_items(summary.facts)}</ul>'
        f'<dl class="key-figures">{key_figures}</dl><section class="warnings">{reasons}{warnings}</section>'
    )


def _texts(heading: tuple[str, str], texts: Sequence[str], kind: str) -> str:
    """A list below its heading, which says what is in it; nothing where there is no text."""
    name, what = map(escape, heading)
    head = f'<h2>{name} <small class="muted">{what}</small></h2>'
    return f'{head}<ul class="{kind}">{_items(texts)}</ul>' if texts else ""


def _figures(summary: ResultSummary) -> str:
    rows = []
    paired = False
    for row in summary.figures:
        if len(row.values) == 2 and not paired:
            paired = True
            rows.append('<tr><td></td><th scope="col">translation</th><th scope="col">rotation</th></tr>')
        cells = "".join(f"<td>{escape(value)}</td>" for value in row.values)
        if len(row.values) == 1:
            usual = f' <small class="muted">usual: {escape(row.usual)}</small>' if row.usual else ""
            cells = f'<td colspan="2">{escape(row.values[0])}{usual}</td>'
        rows.append(f'<tr title="{escape(row.explanation)}"><th scope="row">{escape(row.label)}</th>{cells}</tr>')
    explained = "".join(f"<dt>{escape(row.label)}</dt><dd>{escape(row.explanation)}</dd>" for row in summary.figures)
    return (
        f'<table class="figures">{"".join(rows)}</table>'
        f"<details><summary>What the figures mean</summary><dl>{explained}</dl></details>"
    )


def _scans(data: ReportData) -> str:
    """Why scans were not used."""
    scans = data.scans
    if scans is None:
        return ""
    table = "".join(
        f'<tr><th scope="row">{escape(STATUS_WORDS.get(status, status))}</th>'
        f'<td class="words">{escape(reason) or "no reason given"}</td><td>{count}</td></tr>'
        for status, reason, count in reason_counts(scans)
    )
    why = (
        f'<table><tr><th scope="col" class="words">status</th><th scope="col" class="words">why</th>'
        f'<th scope="col">scans</th></tr>{table}</table>'
        if table
        else "<p>Every scan was used.</p>"
    )
    return f"<section><h2>Scans that were not used</h2>{why}</section>"


def _statistics(metrics: RunMetrics) -> str:
    rows = [
        f'<tr><th scope="row">{escape(label)} [{unit}]</th>'
        + "".join(f"<td>{_cell(getattr(values, name))}</td>" for name in STATISTICS)
        + "</tr>"
        for label, unit, values in error_statistics(metrics)
    ]
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{name}</th>' for name in STATISTICS)
    about = "" if metrics.errors is None else _pairing(metrics.errors)
    return (
        f'<section><h2>Errors</h2><p class="muted">{escape(about)}</p>'
        f'<div class="scroll"><table><tr><td></td>{head}</tr>{"".join(rows)}</table></div></section>'
    )


def _pairing(errors: ErrorMetrics) -> str:
    return (
        f"alignment {errors.alignment}, association {errors.association} within {errors.t_max_diff:g} s, "
        f"{errors.matched} pairs; without a partner: {errors.unmatched_reference} poses of the reference, "
        f"{errors.unmatched_estimate} of the estimate"
    )


def _cell(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4f}" if value == value else DASH


def _what_was_read(metrics: RunMetrics) -> str:
    rows = [("scans", _laser(laser)) for laser in metrics.log.lasers]
    rows += [("odometry", metrics.log.odometry or "none"), ("reference", metrics.log.reference or "none")]
    run = metrics.run
    rows.append(("algorithm", f"{run.matcher or 'graph mapper'}, preset {run.preset}, seed {run.seed}"))
    table = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="words">{escape(value)}</td></tr>' for name, value in rows
    )
    return f'<section><h2>What was read</h2><div class="scroll"><table>{table}</table></div></section>'


def _items(lines: Iterable[str]) -> str:
    return "".join(f"<li>{escape(line)}</li>" for line in lines)


def _laser(laser: LaserMetrics) -> str:
    where = f"x {laser.x:z.3f} m, y {laser.y:z.3f} m, yaw {degrees(laser.yaw):z.1f}°"
    upside_down = ", upside down" if laser.upside_down else ""
    source = "assumed" if laser.extrinsics == "identity" else f"from {laser.extrinsics}"
    return f"{laser.topic}, laser at {where}{upside_down} ({source})"


def _provenance(provenance: Provenance) -> str:
    parts = []
    if provenance.command:
        parts.append(f'<h3>Command</h3><pre tabindex="0">{escape(provenance.command)}</pre>')
    for heading, entries in (("Versions", provenance.versions), ("SHA-256 of the input", provenance.hashes)):
        if entries:
            rows = "".join(
                f'<tr><th scope="row">{escape(name)}</th><td class="words"><code>{escape(value)}</code></td></tr>'
                for name, value in entries.items()
            )
            parts.append(f'<h3>{heading}</h3><div class="scroll"><table>{rows}</table></div>')
    if provenance.config:
        parts.append(f'<h3>Configuration</h3><pre tabindex="0">{escape(provenance.config)}</pre>')
    return f"<section><h2>To repeat this run</h2>{''.join(parts)}</section>" if parts else ""


def _script_json(values: Mapping[str, object]) -> str:
    """JSON that cannot end the <script> element around it."""
    text = json.dumps(values, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _resource(name: str) -> str:
    """The text of a file beside this module."""
    return files("hsloc.report").joinpath(*name.split("/")).read_text(encoding="utf-8")


def _fill(template: str, fragments: Mapping[str, str]) -> str:
    """Put each fragment in the place of its {{name}}, in one pass: what a fragment holds is never a place."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: fragments[found[1]], template)


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
    for name in figure_names([run.figures for run in runs]):
        first = runs[0].figures.get(name)
        cells = [_figure_cell(run.figures.get(name), first if k else None) for k, run in enumerate(runs)]
        rows.append((name, *cells))
    return rows


def _figure_cell(figure: dict[str, Any] | None, first: dict[str, Any] | None) -> str:
    if figure is None:
        return "–"
    text = " / ".join(figure["values"])
    changed = "" if first is None else change(first, figure)
    return f"{text} ({changed})" if changed else text


def change(first: Mapping[str, Any], figure: Mapping[str, Any]) -> str:
    """How a figure differs from that of the first run, for each of its values; empty where none does by 0.05 %.

    Shares differ by percentage points (pp), other numbers in per cent, from the tenfold on by a factor. Values that are
    not one number, such as counts of several kinds, have no change. compare.js does the same.
    """
    numbers, values = figure.get("numbers", ()), figure["values"]
    if len(numbers) != len(values) or len(first.get("numbers", ())) != len(values):
        return ""
    parts = [_change(*each) for each in zip(first["numbers"], numbers, values, strict=True)]
    return " / ".join(part or "0 %" for part in parts) if any(parts) else ""


def _change(first: float | None, number: float | None, text: str) -> str:
    if first is None or number is None or first == number or not is_number(text):
        return ""
    if "%" in text:
        points = 100.0 * (number - first)
        return "" if abs(points) < 0.05 else f"{points:+.1f} pp"
    if first == 0.0:
        return ""
    factor = number / first
    if factor >= 10.0 or 0.0 < factor <= 0.1:
        return f"× {factor:.0f}" if factor > 1.0 else f"× {factor:.1g}"
    percent = 100.0 * (factor - 1.0)
    return "" if abs(percent) < 0.05 else f"{percent:+.{1 if abs(percent) < 10.0 else 0}f} %"


def write_comparison(path: Path, runs: Sequence[ComparedRun]) -> None:
    """Write the comparison as one HTML file that loads nothing. Raises OutputError where it cannot be written."""
    shown = [{"name": run.name, "data": _thinned(run.view) if k else run.view} for k, run in enumerate(runs)]
    title = escape(f"Comparison of {', '.join(run.name for run in runs)}")
    write_page(path, "compare", {"title": title}, {"runs": shown, "seeds": over_seeds(runs)}, "compare.js")


def over_seeds(runs: Sequence[ComparedRun]) -> dict[str, Any] | None:
    """Names of groups of runs that differ in their seed alone, and rows of their figures; None without such a group."""
    groups = seed_groups([(run.name, run.view) for run in runs])
    if all(len(group.views) < 2 for group in groups):
        return None
    return {"names": [group.name for group in groups], "rows": [list(row) for row in seed_rows(groups)]}


def _thinned(view: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in view.items() if key not in _OF_THE_FIRST}
