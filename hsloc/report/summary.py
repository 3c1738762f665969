"""What is said of a result first, wherever it is shown: its verdict, a sentence, the key figures, what to do."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from hsloc.model.estimate import Status
from hsloc.model.verdict import Verdict
from hsloc.report.table import Row, format_duration, format_length, format_share, reason_texts, table_rows

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.run_metrics import RunMetrics
    from hsloc.warnings import RunWarning

VERDICT_WORDS: dict[str, str] = {
    Verdict.GOOD: "nothing contradicts the result",
    Verdict.CHECK: "part of the result may be wrong",
    Verdict.FAILED: "the result is not usable",
}
"""What a verdict means."""
REASONS_HEADING = ("Look at this", "what speaks against the result: why the verdict is not good")
WARNINGS_HEADING = ("Warnings", "what was assumed, corrected, doubtful or lost: the verdict does not rest on it")
"""Headings of the two lists of texts, and by what these differ."""
_KEY_FIGURES: dict[str, tuple[str, ...]] = {
    "localise": ("localised", "APE rmse where localised", "APE rmse", "points within 15 cm of a wall"),
    "slam": ("loops closed", "relations, mean", "APE rmse", "points within 15 cm of a wall"),
}
"""By mode, the figures that are shown first, as far as they were measured."""
_MOST_KEY_FIGURES = 3
_YEAR_2000_NS, _YEAR_2100_NS = 946_684_800e9, 4_102_444_800e9


@dataclass(frozen=True, slots=True)
class ResultSummary:
    """A result in words, made from its metrics alone. Terminal, report.png, report.html, page and jobs show this."""

    verdict: Verdict
    """good, check or failed."""
    mode: str
    """localise or slam."""
    headline: str
    """What was found, in one sentence."""
    key_figures: tuple[Row, ...]
    """Two or three of `figures` that matter most in the mode of the run."""
    figures: tuple[Row, ...]
    """All figures, those with two columns (translation and rotation) first."""
    reasons: tuple[str, ...]
    """The evidence for a verdict that is not good: what, when, where, and what to do."""
    warnings: tuple[str, ...]
    """All other warnings with their remedies, what of the log was lost, and why there is no comparison."""
    facts: tuple[str, ...]
    """What was run on what: map, time of the recording, path length, duration, number of scans."""

    @staticmethod
    def of(metrics: RunMetrics) -> ResultSummary:
        """From the content of metrics.json."""
        rows = table_rows(metrics)
        by_label = {row.label: row for row in rows}
        names = _KEY_FIGURES.get(metrics.run.mode, ())
        if "APE rmse where localised" in by_label:
            names = tuple(name for name in names if name != "APE rmse")
        key_figures = [by_label[name] for name in names if name in by_label]
        return ResultSummary(
            verdict=metrics.verdict,
            mode=metrics.run.mode,
            headline=_headline(metrics),
            key_figures=tuple(key_figures[:_MOST_KEY_FIGURES]),
            figures=tuple(rows),
            reasons=tuple(reason_texts(metrics.verdict_reasons)),
            warnings=tuple(_warnings(metrics)),
            facts=tuple(_facts(metrics)),
        )

    @property
    def verdict_text(self) -> str:
        """The verdict and what it means."""
        return f"{self.verdict}: {VERDICT_WORDS[self.verdict]}"

    def to_json(self) -> dict[str, Any]:
        """For the web page: figures as {name, values, numbers, explanation, usual}, names of key figures, texts."""
        return {
            "verdict": str(self.verdict),
            "mode": self.mode,
            "verdict_text": self.verdict_text,
            "headline": self.headline,
            "key_figures": [row.label for row in self.key_figures],
            "figures": [
                {
                    "name": row.label,
                    "values": list(row.values),
                    "numbers": list(row.numbers),
                    "explanation": row.explanation,
                    "usual": row.usual,
                }
                for row in self.figures
            ],
            "reasons": list(self.reasons),
            "warnings": list(self.warnings),
            "facts": list(self.facts),
        }


def _headline(metrics: RunMetrics) -> str:
    if metrics.run.mode == "slam":
        mapping = metrics.map.mapping
        made = "Extended the map" if metrics.run.map != "built" else "Built a map"
        if mapping is None:
            return f"{made} from {metrics.scans.used} scans."
        if mapping.keyscans == 0:
            return "Built no map: no scan had enough returns."
        loops = "without a loop" if mapping.loops == 0 else f"with {count(mapping.loops, 'loop')} closed"
        return f"{made} from {mapping.keyscans} scans, {loops}."
    share = metrics.localised.share_of_poses
    if share == 0.0:
        codes = {reason.code for reason in metrics.verdict_reasons}
        why = "every pose is a guess"
        if "scans_without_place" in codes:
            why = f"most scans fit nowhere on it, and {why}"
        elif "poses_ambiguous" in codes:
            why = f"several places of it fit, and {why}"
        return f"Not localised on {_map_name(metrics)}: {why}."
    known = "every pose is known" if share == 1.0 else f"{format_share(share)} of the poses are known"
    return f"Localised on {_map_name(metrics)}: {known}{_lost_and_found(metrics)}."


def _lost_and_found(metrics: RunMetrics) -> str:
    """How often and how long the robot was lost, and whether its pose was found again."""
    spans = [span for reason in metrics.verdict_reasons if reason.code == "poses_lost" for span in reason.times]
    if not spans:
        return ""
    found = metrics.scans.by_status.get(Status.RELOCALISED, 0)
    again = ", and found again" if found >= len(spans) else ""
    total = format_duration(sum(end - begin for begin, end in spans))
    return f"; the pose was lost {'once' if len(spans) == 1 else f'{len(spans)} times'}, for {total} in all{again}"


def count(number: int, noun: str) -> str:
    """1 loop, 2 loops."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _map_name(metrics: RunMetrics) -> str:
    return "the map of the log" if metrics.run.map == "log" else metrics.run.map


def short_warnings(metrics: RunMetrics) -> list[str]:
    """The same texts as `ResultSummary.warnings`, each warning with its code before it and without its remedy."""
    return _warnings(metrics, lambda warning: f"{warning.code}: {warning.text}")


def _warnings(metrics: RunMetrics, written: Callable[[RunWarning], str] = str) -> list[str]:
    """Without those that are reasons of the verdict already."""
    reasons = {(reason.code, reason.text) for reason in metrics.verdict_reasons}
    found = [written(each) for each in metrics.warnings if (each.code, each.text) not in reasons]
    found += [f"log: {line}" for line in metrics.losses.notes]
    if metrics.evaluation_error is not None:
        found.append(f"no comparison with the reference: {metrics.evaluation_error}")
    return found


def _facts(metrics: RunMetrics) -> list[str]:
    """What was done, and when the log begins where its clock is that of the calendar."""
    log, name, stamp = metrics.log, metrics.run.map, metrics.log.first_stamp_ns
    parts = [f"localised on {_map_name(metrics)}" if metrics.run.mode == "localise" else f"map {name}"]
    if stamp is not None and _YEAR_2000_NS <= stamp < _YEAR_2100_NS:
        parts.append(f"{datetime.fromtimestamp(stamp // 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC")
    parts += [f"{format_length(log.path_length_m)} path", format_duration(log.duration_s)]
    return [*parts, f"{metrics.scans.total} scans"]
