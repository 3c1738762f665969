"""sweep.html: a sweep as a matrix of logs and configurations, over seeds, with links to the report of each run."""

from __future__ import annotations

from html import escape
from math import isfinite, nan
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from hsloc.report.html import page_text
from hsloc.report.seeds import Spread, spread_text
from hsloc.report.table import DASH

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    Row = Mapping[str, Any]

_FIGURES = (("ape_m", "cm", "APE"), ("ape_deg", "°", ""), ("relations_m", "cm", "relations"))
_WORDS = ("good", "check", "failed")


def sweep_page(table: Sequence[Row]) -> str:
    """The page, from the rows of the sweep's table: it holds all it shows, but for the reports that it links to."""
    logs, configs = (list(dict.fromkeys(str(row[name]) for row in table)) for name in ("log", "config"))
    seeds = len({row["seed"] for row in table})
    head = "".join(f'<th scope="col" class="words">{escape(config or "default")}</th>' for config in configs)
    lines = []
    for log in logs:
        cells = [_cell(_of(table, log, config)) for config in configs]
        lines.append(f'<tr><th scope="row" class="words">{escape(log)}</th>{"".join(cells)}</tr>')
    if len(logs) > 1:
        whole = [log for log in logs if all(_known(_of(table, log, config), "ape_m") for config in configs)]
        cells = [_overall([row for row in table if row["config"] == config], whole) for config in configs]
        lines.append(f'<tr class="overall"><th scope="row" class="words">all logs</th>{"".join(cells)}</tr>')
    body = (
        f"<header><h1>Sweep</h1></header><main><p>{len(table)} runs: {len(logs)} logs, {len(configs)} configurations, "
        f'{seeds} seeds.</p><p class="muted">Absolute pose error (root mean square) of each log and configuration: '
        "mean ± standard deviation over the seeds, and in brackets the 95 % interval of the mean (bootstrap). The last "
        "line is the mean over the logs of which every configuration has an error. A number is a seed, in the colour "
        "of its verdict, and links to the report of its run.</p>"
        f'<div class="scroll" tabindex="0" role="region" aria-label="matrix of the sweep"><table class="matrix">'
        f"<tr><td></td>{head}</tr>{''.join(lines)}</table></div></main>"
    )
    return page_text("Sweep", body)


def _of(table: Sequence[Row], log: str, config: str) -> list[Row]:
    return [row for row in table if (row["log"], row["config"]) == (log, config)]


def _cell(rows: Sequence[Row]) -> str:
    """Verdicts of the runs, with links, and their figures."""
    if not rows:
        return f"<td>{DASH}</td>"
    links = " ".join(_link(row) for row in rows)
    figures = "".join(f"<div>{escape(text)}</div>" for text in _texts(rows))
    errors = "".join(f'<div class="muted">{escape(str(row["error"]))}</div>' for row in rows if row["error"])
    return f'<td class="words"><div>{links}</div>{figures}{errors}</td>'


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


def _known(rows: Sequence[Row], name: str) -> list[float]:
    return [float(row[name]) for row in rows if row[name] is not None and isfinite(float(row[name]))]


def _overall(rows: Sequence[Row], logs: Sequence[str]) -> str:
    """Counts of verdicts, and the mean over `logs` of the mean over seeds."""
    words = [str(row["verdict"] or row["state"]) for row in rows]
    counts = ", ".join(f"{words.count(word)} {word}" for word in dict.fromkeys(words))
    means = [Spread.of(_known([row for row in rows if row["log"] == log], "ape_m")).mean for log in logs]
    text = ""
    if means:
        mean = Spread(1, sum(means) / len(means), nan, nan, nan)
        text = f"<div>{escape(f'APE {spread_text(mean)}, over {len(means)} logs')}</div>"
    return f'<td class="words"><div>{escape(counts)}</div>{text}</td>'
