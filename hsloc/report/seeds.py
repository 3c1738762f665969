"""Figures over runs that differ in their seed alone: mean, standard deviation, bootstrap interval of the mean."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.report.table import DASH, LENGTHS, format_angle, format_length, format_share

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

LEVEL = 0.95
"""Coverage of the intervals."""
RESAMPLES = 4000
"""Of the bootstrap: the ends of an interval vary by about 1 % of its length with the seed of the resampling."""
_NUMBER = re.compile(r"[<>]? ?-?[\d.]+ ?(mm|cm|m|km|°|%.*)?")
_LENGTHS = {unit: factor for _, factor, unit in LENGTHS}


@dataclass(frozen=True, slots=True)
class Spread:
    """A figure over n seeds, in the unit of its numbers. With one seed all but `mean` is NaN."""

    n: int
    mean: float
    std: float
    """Standard deviation of a run (n - 1 in the denominator)."""
    low: float
    """Lower end of the interval of the mean."""
    high: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        """Of the figure in each run, one for each seed."""
        found = np.asarray(values, dtype=np.float64)
        if len(found) < 2:
            return Spread(len(found), float(found.mean()) if len(found) else np.nan, np.nan, np.nan, np.nan)
        low, high = bootstrap_interval(found)
        return Spread(len(found), float(found.mean()), float(found.std(ddof=1)), low, high)


def bootstrap_interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Expanded percentile interval of the mean of n values, two or more; the same values give the same one.

    T. C. Hesterberg, "What Teachers Should Know about the Bootstrap" (2015), section 4.6: the percentiles are moved out
    for few values as Student's t is, for the plain percentile interval is too short: of 10 values by a tenth. Of three
    it reaches from the least to the greatest.
    """
    from scipy.special import ndtr, stdtrit

    n = len(values)
    rows = np.random.default_rng(0).integers(n, size=(RESAMPLES, n))
    tail = float(ndtr(np.sqrt(n / (n - 1.0)) * stdtrit(n - 1.0, 0.5 - 0.5 * LEVEL)))
    low, high = np.quantile(values[rows].mean(axis=1), (tail, 1.0 - tail))
    return float(low), float(high)


def spread_text(spread: Spread, like: str = "1 m") -> str:
    """`0.80 ± 0.03 cm [0.78, 0.83]`; `like` is the figure of one of the runs as it is shown, with its unit."""
    if not isfinite(spread.mean):
        return DASH
    unit, factor, decimals = _scale(spread.mean, like)
    if unit != " %":
        decimals += _further_decimals(spread.std * factor, decimals)

    def text(value: float) -> str:
        return format_share(value).removesuffix(" %") if unit == " %" else f"{value * factor:.{decimals}f}"

    if spread.n < 2:
        return f"{text(spread.mean)}{unit}"
    return f"{text(spread.mean)} ± {spread.std * factor:.{decimals}f}{unit} [{text(spread.low)}, {text(spread.high)}]"


def _scale(mean: float, like: str) -> tuple[str, float, int]:
    """Unit with the space before it, factor to it, and decimals, as the figure itself is written."""
    if "°" in like:
        return "°", 1.0, _decimals(format_angle(mean))
    if re.search(r"(^| )(mm|cm|m|km)$", like):
        text = format_length(mean)
        unit = text.split()[-1]
        return f" {unit}", _LENGTHS[unit], _decimals(text)
    if "%" in like:
        return " %", 100.0, 1
    return "", 1.0, max(_decimals(like), 1)


def _further_decimals(std: float, decimals: int) -> int:
    """At most two, of which a small standard deviation needs one digit that is not zero."""
    return next((more for more in range(3) if abs(std) >= 0.5 * 10.0 ** -(decimals + more)), 0)


def _decimals(text: str) -> int:
    """Digits behind the point of the first number."""
    found = re.search(r"\d+\.(\d+)", text)
    return len(found[1]) if found else 0


@dataclass(frozen=True, slots=True)
class SeedGroup:
    """Views (see hsloc.report.view) of runs that differ in their seed alone, one for each seed."""

    name: str
    views: tuple[dict[str, Any], ...]


_SEED = re.compile(r"[-_, ]*seed[ =]?\d+$")
"""At the end of the name of a run."""


def seed_groups(runs: Sequence[tuple[str, dict[str, Any]]]) -> list[SeedGroup]:
    """From (name, view) of each run, in the order of their first runs.

    A group is called as its first run, with the number of seeds; where two would be called the same, also by the
    numbers of their runs.
    """
    found: dict[Any, tuple[str, dict[Any, dict[str, Any]], list[int]]] = {}
    for k, (name, view) in enumerate(runs):
        of_run = view.get("run") or {"group": k, "seed": 0}
        _, views, numbers = found.setdefault(of_run["group"], (name, {}, []))
        views.setdefault(of_run["seed"], view)
        numbers.append(k + 1)
    names = [
        name if len(views) < 2 else f"{_SEED.sub('', name)}: {len(views)} seeds" for name, views, _ in found.values()
    ]
    return [
        SeedGroup(name if names.count(name) < 2 else f"{name} ({_spans(numbers)})", tuple(views.values()))
        for name, (_, views, numbers) in zip(names, found.values(), strict=True)
    ]


def _spans(numbers: Sequence[int]) -> str:
    return f"{'run' if len(numbers) == 1 else 'runs'} {', '.join(map(str, numbers))}"


def seed_rows(groups: Sequence[SeedGroup]) -> list[tuple[str, ...]]:
    """A line for the verdicts, and one for each number of a figure: its name, then its spread in each group."""
    verdicts = (counted([str((view["summary"] or {}).get("verdict", "")) for view in group.views]) for group in groups)
    figures = [[_figures(view) for view in group.views] for group in groups]
    names = figure_names([each for group in figures for each in group])
    return [("verdict", *verdicts)] + [
        (name, *(_cell([each[name] for each in group if name in each]) for group in figures)) for name in names
    ]


def is_number(text: str) -> bool:
    """Whether the value of a figure is one number with or without a unit, and not words or a count of something."""
    return _NUMBER.fullmatch(text) is not None


def figure_names(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """All names of figures, in the order of the run that has most of them; then those that it has not."""
    return list(dict.fromkeys(name for run in sorted(runs, key=len, reverse=True) for name in run))


def counted(words: Iterable[str]) -> str:
    """`2 good, 1 check`: how often each word is there, in the order of the first ones."""
    return ", ".join(f"{count} {word}" for word, count in Counter(words).items())


def _figures(view: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Figures whose numbers are those that are shown; counts of several kinds are not."""
    found = (view["summary"] or {}).get("figures", ())
    shown = [each for each in found if len(each.get("numbers", ())) == len(each["values"])]
    return {each["name"]: each for each in shown if not each["values"][0][:1].isdigit() or is_number(each["values"][0])}


def _cell(figures: Sequence[dict[str, Any]]) -> str:
    parts = []
    for k in range(len(figures[0]["values"]) if figures else 0):
        numbers = [each["numbers"][k] for each in figures if each["numbers"][k] is not None]
        texts = [each["values"][k] for each in figures]
        like = next((text for text in texts if any(letter.isdigit() for letter in text)), None)
        parts.append(texts[0] if like is None else spread_text(Spread.of(numbers), like) if numbers else DASH)
    return " / ".join(parts) or DASH
