"""report.html: a run in one file that needs no network, for the screen and for paper."""

from __future__ import annotations

import json
import re
from html import escape
from importlib.resources import files
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.atomic_write import write_text_atomically
from hsloc.evaluation.metrics import format_json
from hsloc.model import Status
from hsloc.report.data import Curve, prepare, reason_counts, status_counts
from hsloc.report.summary import ResultSummary
from hsloc.report.svg import Chart, chart_svg, map_svg, timeline_html
from hsloc.report.table import DASH, STATUS_WORDS, error_statistics

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from hsloc.evaluation.error_metrics import ErrorMetrics
    from hsloc.model import OccupancyGrid
    from hsloc.report.data import Provenance, ReportData, ReportParts
    from hsloc.run_metrics import LaserMetrics, RunMetrics

    Floats = NDArray[np.float64]

STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse", "count")
STATUS_COLOURS: dict[str, str] = {
    Status.MATCHED: "green",
    Status.PREDICTED: "sky",
    Status.REJECTED: "vermillion",
    Status.NO_RETURNS: "orange",
    Status.SEARCHING: "purple",
    Status.RELOCALISED: "blue",
}


def write_report_html(path: str | Path, parts: ReportParts) -> None:
    """Write the report of a run as one self-contained HTML file: the same run gives the same bytes.

    All text is escaped. Raises `OutputError` where it cannot be written.
    """
    data, metrics = prepare(parts), parts.metrics
    summary = None if metrics is None else ResultSummary.of(metrics)
    drawing, extent = map_svg(data, parts.grid, parts.points)
    charts, end = time_charts(data, is_built=metrics is not None and metrics.run.mode == "slam"), _end(data)
    fragments = {
        "title": escape(parts.title),
        "head": "" if summary is None else _head(summary),
        "map": drawing,
        "aspect": f"{min(max(extent.aspect, 0.7), 3.0):.4g}",
        "legend": _legend(data, parts.grid, parts.points),
        "figures": "" if summary is None else _figures(summary),
        "charts": "".join(_figure(chart, end) for chart in charts) + _convergence(parts.convergence),
        "read": "" if metrics is None else _what_was_read(metrics),
        "scans": _scans(data, end),
        "statistics": "" if metrics is None else _statistics(metrics),
        "provenance": _provenance(parts.provenance),
        "metrics": "" if metrics is None else escape(format_json(metrics.to_json())),
        "data": _script_json(_page_data(data, charts)),
        "style": _template("report.css"),
        "script": _template("report.js"),
    }
    write_text_atomically(Path(path), _fill(_template("report.html"), fragments))


def time_charts(data: ReportData, is_built: bool = False) -> list[Chart]:
    """All that is known over time: errors where there is truth, fitness, standard deviations, effort.

    The standard deviations of a map that was built (`is_built`) are relative to its first pose.
    """
    of = ", relative to the first pose" if is_built else ""
    charts = []
    lost = () if data.scans is None else data.scans.lost
    if data.errors is not None:
        metres, angle = data.errors.translation_m, data.errors.rotation_deg
        centimetres = Curve(metres.seconds, metres.values * 100.0)
        charts.append(Chart("error_cm", "Translation error", "cm", centimetres, spans=lost))
        charts.append(Chart("error_deg", "Rotation error", "deg", angle, spans=lost))
    scans = data.scans
    if scans is not None:
        refused = scans.where(Status.REJECTED) & np.isfinite(scans.fitness)
        fitness = Curve(scans.seconds, np.where(refused, np.nan, scans.fitness))
        marks = Curve(scans.seconds[refused], scans.fitness[refused])
        charts.append(Chart("fitness", "Fitness of the match", "", fitness, "green", 1.0, False, marks, lost))
        sigma = Curve(scans.seconds, scans.sigma_m * 100.0)
        charts.append(Chart("sigma_cm", f"Position, standard deviation{of}", "cm", sigma, "blue", spans=lost))
        sigma = Curve(scans.seconds, scans.sigma_deg)
        charts.append(Chart("sigma_deg", f"Heading, standard deviation{of}", "deg", sigma, "blue", spans=lost))
        spent = Curve(scans.seconds, np.where(scans.evaluations > 0, scans.evaluations, np.nan))
        charts.append(Chart("evaluations", "Fitness evaluations of the search", "", spent, "purple", spans=lost))
    return [_without_gaps(chart) for chart in charts if np.isfinite(chart.curve.values).any()]


def _without_gaps(chart: Chart) -> Chart:
    """Without the NaN of scans that were not matched; where the pose was lost the line still breaks."""
    curve = chart.curve
    inside = np.zeros(len(curve.seconds), dtype=bool)
    for begin, until in chart.spans:
        inside |= (curve.seconds >= begin) & (curve.seconds < until)
    keep = np.isfinite(curve.values) | inside
    kept = Curve(curve.seconds[keep], curve.values[keep])
    return Chart(
        chart.name, chart.title, chart.unit, kept, chart.colour, chart.top, chart.from_zero, chart.marks, chart.spans
    )


def _end(data: ReportData) -> float:
    scans = 0.0 if data.scans is None else float(data.scans.seconds.max(initial=0.0))
    return max(data.duration_s, scans)


def _figure(chart: Chart, end: float) -> str:
    unit = f' <span class="muted">{escape(chart.unit)}</span>' if chart.unit else ""
    return (
        f"<figure><figcaption>{escape(chart.title)}{unit}"
        f'<output data-for="{escape(chart.name)}"></output></figcaption>{chart_svg(chart, end)}</figure>'
    )


def _convergence(convergence: Mapping[str, tuple[Floats, Floats]]) -> str:
    parts = []
    for index, (name, (evaluations, fitness)) in enumerate(convergence.items()):
        curve = Curve(np.asarray(evaluations, dtype=np.float64), np.asarray(fitness, dtype=np.float64))
        if len(curve.seconds):
            title, unit = f"Convergence: {name}", "median best fitness over evaluations"
            chart = Chart(f"convergence{index}", title, unit, curve, "green", 1.0, False, over_time=False)
            parts.append(_figure(chart, float(curve.seconds.max())))
    return "".join(parts)


def _legend(data: ReportData, grid: OccupancyGrid | None, points: Floats | None) -> str:
    entries = [
        ("map", "map", grid is not None),
        ("points", "map points", points is not None and len(points) > 0),
        ("trajectory", "trajectory", len(data.path) > 0),
        ("reference", "reference", data.reference is not None and len(data.reference) > 0),
        ("odometry", "odometry alone", data.odometry is not None and len(data.odometry) > 0),
    ]
    if data.scans is not None:
        for status, label in (
            (Status.REJECTED, "scan rejected"),
            (Status.NO_RETURNS, "scan without returns"),
            (Status.RELOCALISED, "pose found"),
        ):
            entries.append((str(status), label, bool(data.scans.where(status).any())))
    return (
        "".join(
            f'<label><input type="checkbox" checked data-toggle="{name}"><i class="key {name}"></i>{label}</label>'
            for name, label, there in entries
            if there
        )
        + (
            '<span><i class="key start"></i>start</span><span><i class="key end"></i>end</span>'
            if len(data.path)
            else ""
        )
        + ('<span><i class="key guessed"></i>pose unknown</span>' if not data.localised.all() else "")
    )


def _head(summary: ResultSummary) -> str:
    """Verdict, headline, facts, the figures that matter most, and what speaks against the result."""
    key_figures = "".join(
        f'<div class="key-figure"><dt>{escape(row.label)}</dt><dd>{escape(" / ".join(row.values))}</dd>'
        f'<dd class="muted">{escape(row.explanation)}</dd></div>'
        for row in summary.key_figures
    )
    reasons = f'<h2>Look at this</h2><ul class="reasons">{_items(summary.reasons)}</ul>' if summary.reasons else ""
    warnings = f"<h2>Warnings</h2><ul>{_items(summary.warnings)}</ul>" if summary.warnings else ""
    return (
        f'<p class="headline"><strong class="verdict {summary.verdict}">{summary.verdict}</strong> '
        f"<span>{escape(summary.headline)}</span></p>"
        f'<p class="muted">{escape(summary.verdict_text)}</p><ul class="facts">{_items(summary.facts)}</ul>'
        f'<dl class="key-figures">{key_figures}</dl><section class="warnings">{reasons}{warnings}</section>'
    )


def _figures(summary: ResultSummary) -> str:
    rows = []
    paired = False
    for row in summary.figures:
        if len(row.values) == 2 and not paired:
            paired = True
            rows.append('<tr><td></td><th scope="col">translation</th><th scope="col">rotation</th></tr>')
        cells = "".join(f"<td>{escape(value)}</td>" for value in row.values)
        if len(row.values) == 1:
            cells = f'<td colspan="2">{escape(row.values[0])}</td>'
        rows.append(f'<tr title="{escape(row.explanation)}"><th scope="row">{escape(row.label)}</th>{cells}</tr>')
    explained = "".join(f"<dt>{escape(row.label)}</dt><dd>{escape(row.explanation)}</dd>" for row in summary.figures)
    return (
        f'<table class="figures">{"".join(rows)}</table>'
        f"<details><summary>What the figures mean</summary><dl>{explained}</dl></details>"
    )


def _scans(data: ReportData, end: float) -> str:
    scans = data.scans
    if scans is None:
        return ""
    counts = status_counts(scans)
    spacing = float(np.median(np.diff(scans.seconds))) if len(scans.seconds) > 1 else 1.0
    rows = [
        (STATUS_WORDS.get(name, name), count, STATUS_COLOURS.get(name, "blue"), scans.seconds[scans.where(name)])
        for name, count in counts.items()
    ]
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
    return f"<section><h2>Scans</h2>{timeline_html(rows, spacing, end)}{why}</section>"


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
    where = f"x {laser.x:.3f} m, y {laser.y:.3f} m, yaw {degrees(laser.yaw):.1f}°"
    upside_down = ", upside down" if laser.upside_down else ""
    source = "assumed" if laser.extrinsics == "identity" else f"from {laser.extrinsics}"
    return f"{laser.topic}, laser at {where}{upside_down} ({source})"


def _provenance(provenance: Provenance) -> str:
    parts = []
    if provenance.command:
        parts.append(f"<h3>Command</h3><pre>{escape(provenance.command)}</pre>")
    for heading, entries in (("Versions", provenance.versions), ("SHA-256 of the input", provenance.hashes)):
        if entries:
            rows = "".join(
                f'<tr><th scope="row">{escape(name)}</th><td class="words"><code>{escape(value)}</code></td></tr>'
                for name, value in entries.items()
            )
            parts.append(f'<h3>{heading}</h3><div class="scroll"><table>{rows}</table></div>')
    if provenance.config:
        parts.append(f"<h3>Configuration</h3><pre>{escape(provenance.config)}</pre>")
    return f"<section><h2>To repeat this run</h2>{''.join(parts)}</section>" if parts else ""


def _page_data(data: ReportData, charts: list[Chart]) -> dict[str, object]:
    """What the script reads under the pointer: the curves, and where the robot was."""
    order = np.argsort(data.seconds, kind="stable")
    order = order[:: max(1, len(order) // 3000)]
    thin = {chart.name: chart.curve.thinned(1500) for chart in charts}
    return {
        "charts": {
            chart.name: {
                "t": _short(thin[chart.name].seconds), "v": _short(thin[chart.name].values), "unit": chart.unit
            }
            for chart in charts
        },
        "path": {"t": _short(data.seconds[order]), "x": _short(data.path[order, 0]), "y": _short(data.path[order, 1])},
    }  # fmt: skip


def _short(values: Floats) -> list[float | None]:
    """Seven figures are enough to read."""
    return [float(f"{value:.7g}") if value == value else None for value in values.tolist()]


def _script_json(values: dict[str, object]) -> str:
    """JSON that cannot end the <script> element around it."""
    text = json.dumps(values, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _template(name: str) -> str:
    return (files("hsloc.report") / "templates" / name).read_text(encoding="utf-8")


def _fill(template: str, fragments: Mapping[str, str]) -> str:
    """Put each fragment in the place of its {{name}}, in one pass: what a fragment holds is never a place."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: fragments[found[1]], template)
