"""The table of a report: the figures of metrics.json that a reader looks for first, with units that fit them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from math import degrees, isfinite
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Status
from hsloc.report.data import status_counts
from hsloc.report.notes import text_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hsloc.report.data import ReportData, Scans

DASH = "–"
_YEAR_2000_NS, _YEAR_2100_NS = 946_684_800e9, 4_102_444_800e9


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table: a label and one value, or two (translation and rotation)."""

    label: str
    values: tuple[str, ...]


def table_rows(data: ReportData, metrics: Mapping[str, object]) -> list[Row]:
    """The most telling figures: those with two columns first, then those with one."""
    return [*_pair_rows(data, metrics), *_single_rows(data, metrics)]


def summary(data: ReportData, metrics: Mapping[str, object]) -> list[str]:
    """The facts under the title, the most important first."""
    parts = [*_how(metrics), f"{format_length(data.length_m)} path", f"{format_duration(data.duration_s)}"]
    if data.scans is not None:
        parts.append(f"{len(data.scans.seconds):,} scans".replace(",", " "))
    rmse = number(metrics, "ape", "trans_part", "rmse")
    if rmse is not None:
        believed = number(metrics, "localised_only", "ape", "trans_part", "rmse")
        where = "" if believed is None else f", {format_length(believed)} where localised"
        parts.append(f"APE rmse {format_length(rmse)}{where}")
    return parts


def _how(metrics: Mapping[str, object]) -> list[str]:
    """What was done, and when the log begins where its clock is that of the calendar."""
    mode, name = text_of(metrics, "run", "mode"), text_of(metrics, "run", "map")
    words = {"localise": f"localised on {'the map of the log' if name == 'log' else name}", "slam": f"map {name}"}
    parts = [words[mode]] if mode in words and name else []
    stamp = number(metrics, "log", "first_stamp_ns")
    if stamp is not None and _YEAR_2000_NS <= stamp < _YEAR_2100_NS:
        parts.append(f"{datetime.fromtimestamp(stamp // 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC")
    return parts


def number(metrics: Mapping[str, object], *keys: str) -> float | None:
    """The finite number under nested keys, or None."""
    value: object = metrics
    for key in keys:
        if not isinstance(value, dict) or key not in value:
            return None
        value = value[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if isfinite(value) else None


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


def _pair_rows(data: ReportData, metrics: Mapping[str, object]) -> list[Row]:
    rows = []

    def add(label: str, *keys: str, name: str = "rmse") -> None:
        trans, angle = number(metrics, *keys, "trans_part", name), number(metrics, *keys, "angle_deg", name)
        if trans is not None or angle is not None:
            rows.append(Row(label, (format_length(trans), format_angle(angle))))

    add("APE rmse", "ape")
    add("APE max", "ape", name="max")
    add("APE rmse where localised", "localised_only", "ape")
    if data.errors is not None and data.errors.odometry_alone is not None:
        alone = data.errors.odometry_alone.errors.statistics()
        rows.append(
            Row("odometry alone, rmse", (format_length(alone.trans_part.rmse), format_angle(alone.angle_deg.rmse)))
        )
    for key in ("rpe_1m", "rpe_1s", "rpe"):
        if number(metrics, key, "trans_part", "rmse") is not None:
            add(f"RPE rmse per {_delta(metrics, key)}", key)
            break
    add("relations, mean", "relations", name="mean")
    add("relations, std", "relations", name="std")
    return rows


def _delta(metrics: Mapping[str, object], key: str) -> str:
    value, entry = number(metrics, key, "delta"), metrics.get(key)
    unit = entry.get("delta_unit", "") if isinstance(entry, dict) else ""
    return f"{value:g} {unit}" if value is not None else str(unit)


def _single_rows(data: ReportData, metrics: Mapping[str, object]) -> list[Row]:
    rows = []
    axes = [number(metrics, "axis_rmse", axis) for axis in ("x", "y", "theta")]
    if all(axis is not None for axis in axes):
        x, y, theta = (axis or 0.0 for axis in axes)
        rows.append(Row("rmse x, y, θ", (f"{format_length(x)}, {format_length(y)}, {format_angle(degrees(theta))}",)))
    if data.scans is not None:
        rows += _scan_rows(data.scans)
        spent = data.scans.evaluations[data.scans.evaluations > 0]
        if len(spent):
            rows.append(Row("evaluations, median", (f"{np.median(spent):.0f}",)))
        fitness = data.scans.fitness[np.isfinite(data.scans.fitness)]
        if len(fitness):
            rows.append(Row("fitness, median", (f"{np.median(fitness):.3f}",)))
    median, p95 = (number(metrics, "map", "residuals", name) for name in ("median", "p95"))
    if median is not None and p95 is not None:
        # The distance is that from cell to cell: what falls into a wall's own cell is no nearer than that.
        near = ["in the cell" if value == 0.0 else format_length(value) for value in (median, p95)]
        rows.append(Row("scan to map, median, 95 %", (", ".join(dict.fromkeys(near)),)))
    thickness = number(metrics, "map", "crispness", "wall_thickness_median")
    if thickness is not None:
        rows.append(Row("wall thickness", (format_length(thickness),)))
    precision, recall = (number(metrics, "map", "comparison", name) for name in ("precision", "recall"))
    if precision is not None and recall is not None:
        rows.append(Row("map precision, recall", (f"{100 * precision:.1f} %, {100 * recall:.1f} %",)))
    return rows


def _scan_rows(scans: Scans) -> list[Row]:
    counts = status_counts(scans)
    used = counts.get(Status.MATCHED, 0) + counts.get(Status.RELOCALISED, 0)
    rows = [Row("scans matched", (f"{used} of {len(scans.seconds)}",))]
    unused = (Status.REJECTED, Status.NO_RETURNS, Status.SEARCHING)
    others = [f"{counts[name]} {name.replace('_', ' ')}" for name in unused if name in counts]
    return [*rows, Row("scans not used", (", ".join(others),))] if others else rows
