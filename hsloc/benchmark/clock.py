"""Time that a piece of work takes, on a machine that others use as well."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of wall time. `best` is the time without disturbance, `median` the usual one."""

    best: float
    median: float
    repeats: int

    @staticmethod
    def of(seconds: list[float]) -> Timing:
        """From the repeats."""
        return Timing(min(seconds), median(seconds), len(seconds))

    def to_dict(self, factor: float = 1.0) -> dict[str, object]:
        """For JSON, in units of 1 / `factor` seconds."""
        return {"best": self.best * factor, "median": self.median * factor, "repeats": self.repeats}


def measure(work: Callable[[], object], repeats: int) -> Timing:
    """Run `work` once to warm up, then `repeats` times against the clock."""
    work()
    seconds = []
    for _ in range(repeats):
        begin = perf_counter()
        work()
        seconds.append(perf_counter() - begin)
    return Timing.of(seconds)
