"""The table of a sweep: a row for each run, as text, CSV, JSON or Markdown."""

from __future__ import annotations

import csv
import io
import json
from typing import TYPE_CHECKING, Any

from hsloc import text_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hsloc.run_metrics import RunMetrics, RunTimings
    from hsloc.sweep.runs import Outcome

    Row = Mapping[str, Any]

COLUMNS = (
    "run",
    "log",
    "config",
    "seed",
    "state",
    "verdict",
    "ape_m",
    "ape_deg",
    "rpe_m",
    "rpe_deg",
    "relations_m",
    "relations_deg",
    "scans",
    "used",
    "localised",
    "residual_m",
    "seconds",
    "times_real_time",
    "data_lost",
    "limits",
    "error",
)
"""APE and RPE (per metre) are root mean squares, `residual_m` is the median distance from scan to map."""


def rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One dictionary of `COLUMNS` for each run; None where a run has no such value."""
    return [_row(outcome) for outcome in outcomes]


def _row(outcome: Outcome) -> dict[str, Any]:
    values: dict[str, Any] = dict.fromkeys(COLUMNS)
    values |= {
        "run": outcome.run.name,
        "log": outcome.run.log,
        "config": outcome.run.config,
        "seed": outcome.run.request.seed,
        "state": outcome.state,
        "data_lost": outcome.data_lost,
        "limits": "; ".join(outcome.limits),
        "error": outcome.error,
    }
    if outcome.metrics is not None:
        values |= figures(outcome.metrics, outcome.timings)
    return values


def figures(metrics: RunMetrics, times: RunTimings | None) -> dict[str, Any]:
    """The columns that a result decides; None for what is no number."""
    errors, relations = metrics.errors, metrics.relations
    values: dict[str, Any] = {
        "verdict": metrics.verdict.value,
        "scans": metrics.scans.total,
        "used": metrics.scans.used,
        "localised": metrics.localised.share_of_poses,
        "residual_m": metrics.map.residuals.median,
    }
    if errors is not None:
        values |= {
            "ape_m": errors.ape.trans_part.rmse,
            "ape_deg": errors.ape.angle_deg.rmse,
            "rpe_m": errors.rpe_1m.statistics.trans_part.rmse,
            "rpe_deg": errors.rpe_1m.statistics.angle_deg.rmse,
        }
    if relations is not None:
        values |= {
            "relations_m": relations.statistics.trans_part.mean,
            "relations_deg": relations.statistics.angle_deg.mean,
        }
    if times is not None:
        values |= {"seconds": times.seconds["replay"], "times_real_time": times.times_real_time}
    return {name: None if value != value else value for name, value in values.items()}


def as_json(table: Sequence[Row]) -> str:
    """A list of rows."""
    return json.dumps(table, indent=2) + "\n"


def as_csv(table: Sequence[Row]) -> str:
    """A header and a line for each run."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return stream.getvalue()


_TEXTS = ("run", "log", "config", "state", "verdict", "limits", "error")
_WHOLE = ("seed", "scans", "used")


def as_parquet(table: Sequence[Row]) -> bytes | None:
    """The same columns with types that do not depend on the values; None where the package pyarrow is missing."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return None

    def kind(name: str) -> Any:
        if name in _TEXTS:
            return pyarrow.string()
        return pyarrow.int64() if name in _WHOLE else pyarrow.bool_() if name == "data_lost" else pyarrow.float64()

    stream = io.BytesIO()
    schema = pyarrow.schema([(name, kind(name)) for name in COLUMNS])
    parquet.write_table(pyarrow.Table.from_pylist([dict(row) for row in table], schema=schema), stream)
    return stream.getvalue()


_SHOWN = (
    ("run", "run", "{}"),
    ("state", "state", "{}"),
    ("verdict", "verdict", "{}"),
    ("ape_m", "APE rmse [m]", "{:.4f}"),
    ("ape_deg", "APE rmse [deg]", "{:.3f}"),
    ("rpe_m", "RPE rmse [m]", "{:.4f}"),
    ("relations_m", "relations, mean [m]", "{:.4f}"),
    ("used", "scans matched", "{}"),
    ("localised", "localised", "{:.1%}"),
    ("times_real_time", "x real time", "{:.0f}"),
)


def as_text(table: Sequence[Row]) -> str:
    """For people; columns that no run has a value for are left out, and reasons of failures are below."""
    lines = _shown(table)
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    text = [
        "  ".join(c.ljust(w) if n < 2 else c.rjust(w) for n, (c, w) in enumerate(zip(line, widths, strict=True)))
        for line in lines
    ]
    return "\n".join(line.rstrip() for line in [*text, *_reasons(table)]) + "\n"


def as_markdown(table: Sequence[Row]) -> str:
    """As `as_text`, for a page: a table, and a list of reasons."""
    head, *lines = _shown(table)
    return "\n".join([*text_table.table(head, lines), *(f"- {reason}" for reason in _reasons(table))]).rstrip() + "\n"


def _shown(table: Sequence[Row]) -> list[list[str]]:
    """The titles, and a line for each run."""
    shown = [item for item in _SHOWN if any(row[item[0]] is not None for row in table)] or list(_SHOWN[:2])
    lines = [[title for _, title, _ in shown]]
    lines += [["-" if row[key] is None else form.format(row[key]) for key, _, form in shown] for row in table]
    return lines


def _reasons(table: Sequence[Row]) -> list[str]:
    return [f"{row['run']}: {row['error'] or row['limits']}" for row in table if row["error"] or row["limits"]]
