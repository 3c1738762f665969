"""Whether the result of a run can be used: good, check or failed, with the reasons, their places and times."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray


class Verdict(StrEnum):
    """How far the result of a run can be trusted, by evidence found in the run itself (never by the truth)."""

    GOOD = "good"
    """Nothing contradicts the result."""
    CHECK = "check"
    """Part of the result may be wrong: look at the places and times that the reasons name."""
    FAILED = "failed"
    """The result is not usable as a whole."""


@dataclass(frozen=True, slots=True)
class VerdictReason:
    """One piece of evidence against a result. Results without a reason are good."""

    verdict: Verdict
    """The verdict that this reason alone would give: check or failed."""
    code: str
    """Stable name of the kind of evidence."""
    text: str
    """What was found, in one line with figures and units."""
    remedy: str = ""
    """What to do about it; empty where nothing can be done."""
    places: tuple[tuple[float, float], ...] = ()
    """Points (x, y) in the map frame [m] where it was found; empty where it concerns the whole map."""
    times: tuple[tuple[float, float], ...] = ()
    """Spans (begin, end) [s since the first pose] in which it was found; empty where it concerns the whole run."""


def verdict_of(reasons: Iterable[VerdictReason]) -> Verdict:
    """The worst verdict of the reasons; good where there is none."""
    order = (Verdict.GOOD, Verdict.CHECK, Verdict.FAILED)
    return max((reason.verdict for reason in reasons), key=order.index, default=Verdict.GOOD)


def spans_of(rows: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last row of each run of True: what a reason names the places and times of."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], rows, [False]))))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


def counted(n: int, word: str) -> str:
    """`1 stretch`, `2 stretches`: a number of things in a reason."""
    return f"{n} {word}" if n == 1 else f"{n} {word}{'es' if word.endswith('ch') else 's'}"
