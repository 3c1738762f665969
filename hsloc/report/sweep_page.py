"""sweep.html: a sweep as a matrix of logs and configurations, over seeds, with links to the report of each run."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from math import isfinite, nan
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from hsloc import text_table
from hsloc.report.html import page_text
from hsloc.report.seeds import Spread, counted, spread_text
from hsloc.report.summary import count
from hsloc.report.table import DASH

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    Row = Mapping[str, Any]

_FIGURES = (("ape_m", "cm", "APE rmse"), ("ape_deg", "°", ""), ("relations_m", "cm", "relations, mean"))
_WORDS = ("good", "check", "failed")


@dataclass(frozen=True, slots=True)
class SweepCell:
    """A log and a configuration: numbers of its rows in the table, one for each seed, and texts of their figures."""

    rows: tuple[int, ...]
    texts: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SweepMatrix:
    """A sweep by logs and configurations."""

    logs: tuple[str, ...]
    configs: tuple[str, ...]
    cells: tuple[tuple[SweepCell, ...], ...]
    """By log, then by configuration."""
    overall: tuple[tuple[str, ...], ...]
    """By configuration: counts of verdicts, and the mean over the logs of which every configuration has an error."""


def sweep_matrix(table: Sequence[Row]) -> SweepMatrix:
    """From the rows of the sweep's table."""
    logs, configs = (tuple(dict.fromkeys(str(row[name]) for row in table)) for name in ("log", "config"))
    numbers: dict[tuple[str, str], list[int]] = {}
    for k, row in enumerate(table):
        numbers.setdefault((str(row["log"]), str(row["config"])), []).append(k)

    def of(log: str, config: str) -> list[Row]:
        return [table[k] for k in numbers.get((log, config), ())]

    whole = [log for log in logs if all(_known(of(log, config), "ape_m") for config in configs)]
    return SweepMatrix(
        logs,
        configs,
        tuple(
            tuple(SweepCell(tuple(numbers.get((log, each), ())), tuple(_texts(of(log, each)))) for each in configs)
            for log in logs
        ),
        tuple(tuple(_overall([row for row in table if row["config"] == each], whole)) for each in configs),
    )


def sweep_lines(table: Sequence[Row]) -> list[str]:
    """The matrix as a table in Markdown, after a line that explains it; nothing where every cell is one run alone."""
    found = sweep_matrix(table)
    if len(table) <= len(found.logs) and len(found.configs) < 2:
        return []
    lines = [
        (log, config or "default", counted([_state(table[k]) for k in cell.rows]), ", ".join(cell.texts))
        for log, cells in zip(found.logs, found.cells, strict=True)
        for config, cell in zip(found.configs, cells, strict=True)
    ]
    if len(found.logs) > 1:
        lines += [
            ("all logs", config or "default", verdicts, ", ".join(means))
            for config, (verdicts, *means) in zip(found.configs, found.overall, strict=True)
        ]
    title = "over seeds: mean ± standard deviation [95 % interval of the mean, by bootstrap]"
    return ["", title, "", *text_table.table(("log", "configuration", "verdicts", "errors"), lines)]


def sweep_page(table: Sequence[Row]) -> str:
    """The page, from the rows of the sweep's table: it holds all it shows, but for the reports that it links to."""
    found = sweep_matrix(table)
    logs, configs, seeds = found.logs, found.configs, len({row["seed"] for row in table})
    head = "".join(f'<th scope="col" class="words">{escape(config or "default")}</th>' for config in configs)
    lines = []
    for log, cells in zip(logs, found.cells, strict=True):
        shown = "".join(_cell([table[k] for k in cell.rows], cell.texts) for cell in cells)
        lines.append(f'<tr><th scope="row" class="words">{escape(log)}</th>{shown}</tr>')
    if len(logs) > 1:
        shown = "".join(f'<td class="words">{_lines(texts)}</td>' for texts in found.overall)
        lines.append(f'<tr class="overall"><th scope="row" class="words">all logs</th>{shown}</tr>')
    body = (
        f"<header><h1>Sweep</h1></header><main><p>{count(len(table), 'run')}: {count(len(logs), 'log')}, "
        f"{count(len(configs), 'configuration')}, {count(seeds, 'seed')}.</p>"
        '<p class="muted">Absolute pose error (root mean square) of each log and configuration: '
        "mean ± standard deviation over the seeds, and in brackets the 95 % interval of the mean (bootstrap). The last "
        "line is the mean over the logs of which every configuration has an error. A number is a seed, in the colour "
        "of its verdict, and links to the report of its run.</p>"
        f'<div class="scroll" tabindex="0" role="region" aria-label="matrix of the sweep"><table class="matrix">'
        f"<tr><td></td>{head}</tr>{''.join(lines)}</table></div></main>"
    )
    return page_text("Sweep", body)


def _lines(texts: Sequence[str]) -> str:
    return "".join(f"<div>{escape(text)}</div>" for text in texts)


def _cell(rows: Sequence[Row], texts: Sequence[str]) -> str:
    """Verdicts of the runs, with links, and their figures."""
    if not rows:
        return f"<td>{DASH}</td>"
    links = " ".join(_link(row) for row in rows)
    errors = "".join(f'<div class="muted">{escape(str(row["error"]))}</div>' for row in rows if row["error"])
    return f'<td class="words"><div>{links}</div>{_lines(texts)}{errors}</td>'


def _link(row: Row) -> str:
    """The seed of a run as a link to its report, in the colour of its verdict."""
    verdict = row["verdict"] if row["verdict"] in _WORDS else "failed"
    words = f"seed {row['seed']}: {row['verdict'] or row['state']}"
    text = f'<strong class="verdict {verdict}" title="{escape(words)}">{escape(str(row["seed"]))}</strong>'
    hidden = f'<span class="hidden-text">{escape(words)}</span>'
    if row["verdict"] is None:
        return text + hidden
    return f'<a href="{escape(quote(str(row["run"])))}/report.html" aria-label="{escape(words)}">{text}</a>'


def _texts(rows: Sequence[Row]) -> list[str]:
    found = []
    for name, like, label in _FIGURES:
        values = _known(rows, name)
        if values:
            found.append(f"{label} {spread_text(Spread.of(values), f'1 {like}')}".strip())
    shares = _known(rows, "localised")
    if shares and min(shares) < 1.0:
        found.append(f"localised {spread_text(Spread.of(shares), '%')}")
    return found


def _state(row: Row) -> str:
    """The verdict of a run, or what became of it."""
    return str(row["verdict"] or row["state"])


def _known(rows: Sequence[Row], name: str) -> list[float]:
    return [float(row[name]) for row in rows if row[name] is not None and isfinite(float(row[name]))]


def _overall(rows: Sequence[Row], logs: Sequence[str]) -> list[str]:
    """Counts of verdicts, and the mean over `logs` of the mean over seeds."""
    found = [counted(map(_state, rows))]
    means = [Spread.of(_known([row for row in rows if row["log"] == log], "ape_m")).mean for log in logs]
    if means:
        mean = Spread(1, sum(means) / len(means), nan, nan, nan)
        found.append(f"APE rmse {spread_text(mean)}, over {len(means)} logs")
    return found
