"""The figures of a run under one name and in one unit: for the terminal, report.png, report.html and the web page."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from math import degrees, isfinite
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Status

if TYPE_CHECKING:
    from hsloc.evaluation import PoseStatistics, Statistics
    from hsloc.model.verdict import VerdictReason
    from hsloc.run_metrics import MapMetrics, RunMetrics, ScanCounts

DASH = "–"
_YEAR_2000_NS, _YEAR_2100_NS = 946_684_800e9, 4_102_444_800e9
STATUS_WORDS: dict[str, str] = {
    Status.MATCHED: "matched",
    Status.RELOCALISED: "relocalised",
    Status.PREDICTED: "held by the motion gate",
    Status.REJECTED: "rejected",
    Status.NO_RETURNS: "without returns",
    Status.SEARCHING: "searching",
}
"""What a scan's status is called."""
_LISTED = 3
"""Times and places of a reason that are listed in words."""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table: a label and one value, or two (translation and rotation)."""

    label: str
    values: tuple[str, ...]


def table_rows(metrics: RunMetrics) -> list[Row]:
    """The most important figures: those with two columns first, then those with one."""
    return [*_error_rows(metrics), *_single_rows(metrics)]


def summary(metrics: RunMetrics) -> list[str]:
    """The facts under the title, the most important first."""
    log, errors = metrics.log, metrics.errors
    parts = [f"verdict: {metrics.verdict}", *_how(metrics), f"{format_length(log.path_length_m)} path"]
    parts += [format_duration(log.duration_s), f"{metrics.scans.total:,} scans".replace(",", " ")]
    if errors is not None:
        only = metrics.localised_only
        where = "" if only is None else f", {format_length(only.ape.trans_part.rmse)} where localised"
        parts.append(f"APE rmse {format_length(errors.ape.trans_part.rmse)}{where}")
    return parts


def _how(metrics: RunMetrics) -> list[str]:
    """What was done, and when the log begins where its clock is that of the calendar."""
    name, stamp = metrics.run.map, metrics.log.first_stamp_ns
    localised = f"localised on {'the map of the log' if name == 'log' else name}"
    parts = [localised if metrics.run.mode == "localise" else f"map {name}"]
    if stamp is not None and _YEAR_2000_NS <= stamp < _YEAR_2100_NS:
        parts.append(f"{datetime.fromtimestamp(stamp // 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC")
    return parts


def format_length(metres: float | None) -> str:
    """Three figures, in the unit that suits: 0.4 mm, 1.23 cm, 12.3 m, 1.23 km."""
    if metres is None or not isfinite(metres):
        return DASH
    if metres == 0.0:
        return "0 m"
    for limit, factor, unit in ((0.00095, 1e3, "mm"), (0.9995, 1e2, "cm"), (1e3, 1.0, "m"), (np.inf, 1e-3, "km")):
        if abs(metres) < limit:
            return f"{_three_figures(metres * factor)} {unit}"
    return DASH


def format_angle(angle: float | None) -> str:
    """Three figures and the sign of degrees."""
    return DASH if angle is None or not isfinite(angle) else f"{_three_figures(angle)}°"


def format_duration(seconds: float) -> str:
    """12.3 s, 4 min 05 s, 2 h 03 min."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def _three_figures(value: float) -> str:
    size = abs(value)
    decimals = 2 if size < 9.995 else 1 if size < 99.95 else 0
    return f"{value:.{decimals}f}"


def reason_text(reason: VerdictReason) -> str:
    """What was found, when (in seconds since the first pose) and where (in the map frame), and what to do about it."""
    times = [f"{begin:.1f} to {end:.1f} s" for begin, end in reason.times[:_LISTED]]
    places = [f"({x:.1f}, {y:.1f}) m" for x, y in reason.places[:_LISTED]]
    text = reason.text
    for words, listed, count in (("from", times, len(reason.times)), ("near", places, len(reason.places))):
        if listed:
            text += f", {words} {', '.join(listed)}" + (f" and {count - _LISTED} more" if count > _LISTED else "")
    return f"{text}; {reason.remedy}" if reason.remedy else text


def error_statistics(metrics: RunMetrics) -> list[tuple[str, str, Statistics]]:
    """(label, unit, statistics) of all errors that were measured, translation and rotation each."""
    found: list[tuple[str, PoseStatistics]] = []
    for label, errors in (
        ("", metrics.errors),
        (" where localised", metrics.localised_only),
        (" of odometry alone", metrics.odometry_alone),
    ):
        if errors is not None:
            found.append((f"APE{label}", errors.ape))
            found += [
                (f"RPE per {each.delta}{label}", each.statistics) for each in (errors.rpe, errors.rpe_1m, errors.rpe_1s)
            ]
    if metrics.relations is not None:
        found.append(("relations", metrics.relations.statistics))
    return [
        (f"{label}, {kind}", unit, values)
        for label, pose in found
        for kind, unit, values in (("translation", "m", pose.trans_part), ("rotation", "deg", pose.angle_deg))
    ]


def _error_rows(metrics: RunMetrics) -> list[Row]:
    rows = []

    def add(label: str, errors: PoseStatistics, name: str = "rmse") -> None:
        values = getattr(errors.trans_part, name), getattr(errors.angle_deg, name)
        if any(isfinite(value) for value in values):
            rows.append(Row(label, (format_length(values[0]), format_angle(values[1]))))

    errors = metrics.errors
    if errors is not None:
        add("APE rmse", errors.ape)
        if metrics.localised_only is not None:
            add("APE rmse where localised", metrics.localised_only.ape)
        add("APE max", errors.ape, "max")
        if metrics.odometry_alone is not None:
            add("APE rmse of odometry", metrics.odometry_alone.ape)
        # A path that is shorter than a metre still has pieces of a second, or from frame to frame.
        known = [each for each in (errors.rpe_1m, errors.rpe_1s, errors.rpe) if each.statistics.trans_part.count]
        for relative in known[:1]:
            add(f"RPE rmse per {relative.delta}", relative.statistics)
    if metrics.relations is not None:
        add("relations, mean", metrics.relations.statistics, "mean")
        add("relations, std", metrics.relations.statistics, "std")
    return rows


def _single_rows(metrics: RunMetrics) -> list[Row]:
    rows = []
    if metrics.errors is not None:
        axes = metrics.errors.axis_rmse
        values = f"{format_length(axes.x)}, {format_length(axes.y)}, {format_angle(degrees(axes.theta))}"
        rows.append(Row("rmse x, y, heading", (values,)))
    share = metrics.localised.share_of_poses
    if share < 1.0:
        rows.append(Row("localised", (f"{100.0 * share:.1f} % of the poses",)))
    rows += scan_rows(metrics.scans)
    if metrics.evaluations.median_per_match is not None:
        rows.append(Row("evaluations, median", (f"{metrics.evaluations.median_per_match:.0f}",)))
    if metrics.fitness.median is not None:
        rows.append(Row("fitness, median", (f"{metrics.fitness.median:.3f}",)))
    return [*rows, *_map_rows(metrics.map)]


def scan_rows(scans: ScanCounts) -> list[Row]:
    """How many scans were matched, and what became of the others: together they are all scans."""
    rows = [Row("scans matched", (f"{scans.used} of {scans.total}",))]
    known = [status.value for status in Status]
    names = [name for name in (*known, *sorted(set(scans.by_status) - set(known))) if scans.by_status.get(name)]
    unused = [name for name in names if name not in (Status.MATCHED, Status.RELOCALISED)]
    if unused:
        words = ", ".join(f"{scans.by_status[name]} {STATUS_WORDS.get(name, name)}" for name in unused)
        rows.append(Row("scans not matched", (words,)))
    return rows


def _map_rows(found: MapMetrics) -> list[Row]:
    rows, residuals = [], found.residuals
    if residuals.median is not None and residuals.p95 is not None and residuals.within_15_cm is not None:
        # The distance is that from cell to cell: a point in an occupied cell has no smaller distance.
        near = ["in the cell" if value == 0.0 else format_length(value) for value in (residuals.median, residuals.p95)]
        rows.append(Row("scan to map, median, 95 %", (", ".join(dict.fromkeys(near)),)))
        rows.append(Row("points within 15 cm of a wall", (f"{100.0 * residuals.within_15_cm:.1f} %",)))
    if found.mapping is not None:
        loops = f"{found.mapping.keyscans} keyscans, {found.mapping.loops} loops"
        rows.append(Row("map built from", (loops,)))
    if found.crispness is not None and isfinite(found.crispness.wall_thickness_median):
        rows.append(Row("wall thickness", (format_length(found.crispness.wall_thickness_median),)))
    compared = found.comparison
    if compared is not None and isfinite(compared.precision):
        values = f"{100.0 * compared.precision:.1f} %, {100.0 * compared.recall:.1f} %"
        rows.append(Row("map precision, recall", (values,)))
    return rows
