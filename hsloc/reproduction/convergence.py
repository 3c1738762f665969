"""E2 (Fig. 4 of [P]): how the best fitness grows over 1000 iterations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.matching import HarmonySearch, Hide, LikelihoodField, Window
from hsloc.reproduction.material import SEEN_FROM
from hsloc.reproduction.scan_match import HALF, START, scan_seen

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

ITERATIONS = 1000
SIGMA = 1.0
"""[P]: d in metres."""
RESOLUTION = 0.01
"""Of the field, m: interpolation rounds off the tip at a point, the finer the less."""
REACHED = 0.99
"""[P]: HIDE is there before iteration 100."""
COUNTS = ("improvisations", "evaluations")


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Best fitness after iteration 1 .. 1000, shape (seeds, 1000).

    `counts` is what an iteration means: an improvisation, as in the program of [P], which counts none of HIDE's
    differential evolution, or a fitness evaluation [M], the initial ones included.
    """

    matcher: str
    preset: str
    counts: str
    fitness: F64

    @property
    def mean(self) -> F64:
        """Over the seeds, shape (1000,)."""
        mean: F64 = self.fitness.mean(axis=0)
        return mean

    def first(self, fitness: float = REACHED) -> int | None:
        """The first iteration at which the mean is at `fitness`."""
        there = np.flatnonzero(self.mean >= fitness)
        return int(there[0]) + 1 if len(there) else None

    def to_dict(self) -> dict[str, object]:
        """For JSON: the mean at some iterations, and when it reached 0.99."""
        at = {str(k): float(self.mean[k - 1]) for k in (30, 50, 100, 200, 500, 1000)}
        return {
            "matcher": self.matcher,
            "preset": self.preset,
            "counts": self.counts,
            "seeds": len(self.fitness),
            "mean_fitness_at": at,
            "first_at_0.99": self.first(),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Convergence:
    """All curves, and the fitness at the true pose: no curve rises above it but by the field's interpolation."""

    curves: tuple[Curve, ...]
    fitness_at_truth: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {"fitness_at_truth": self.fitness_at_truth, "curves": [curve.to_dict() for curve in self.curves]}


def run_convergence(scan: F64, seeds: int, progress: Callable[[float], None]) -> Convergence:
    """HIDE and HS with both readings of the bandwidth and both budgets, seeds 0 to `seeds` - 1."""
    points, window = scan_seen(scan), Window(START, *HALF)
    field = LikelihoodField.from_points(scan, SIGMA, RESOLUTION, margin=1.5)
    curves: list[Curve] = []
    presets: tuple[tuple[str, tuple[HarmonySearch, HarmonySearch]], ...] = (
        ("paper", (Hide.paper(), HarmonySearch.paper())),
        ("paper-literal", (Hide.paper_literal(), HarmonySearch.paper_literal())),
    )
    for counts in COUNTS:
        for name, searches in presets:
            for matcher, search in zip(("HIDE", "HS"), searches, strict=True):
                long = replace(search, budget=ITERATIONS, count_improvisations=counts == "improvisations")
                rows = []
                for seed in range(seeds):
                    match = long.match(points, field, window, np.random.default_rng(seed), keep_history=True)
                    assert match.history is not None
                    rows.append(match.history[_after(long, len(match.history))])
                    progress((len(curves) + (seed + 1) / seeds) / (len(COUNTS) * 4))
                curves.append(Curve(matcher, name, counts, np.array(rows)))
    return Convergence(tuple(curves), field.fitness(points, SEEN_FROM))


def _after(search: HarmonySearch, evaluations: int) -> NDArray[np.int64]:
    """Indices into the history, which has an entry for each evaluation, of the iterations 1 .. 1000."""
    iteration = np.arange(1, ITERATIONS + 1)
    if not search.count_improvisations:
        return np.minimum(iteration, evaluations) - 1
    passes = (iteration - 1) // search.improvisations_per_pass if isinstance(search, Hide) else 0
    return search.memory_size * (1 + passes) + iteration - 1
