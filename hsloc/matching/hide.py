"""HIDE: harmony memory improved with differential evolution ([P] III-C, [M] 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from hsloc.matching.harmony_search import HarmonySearch
from hsloc.parameters import Count, NonNegative


@dataclass(frozen=True, slots=True, kw_only=True)
class Hide(HarmonySearch):
    """Harmony Search with one pass of differential evolution over the memory after every HRT improvisations.

    For each row i: `x_i + attraction (x_best - x_i) + differential_weight (x_r1 - x_r2)`, r1 and r2 random rows
    (DE/rand-to-best/1 of [DE] with lambda and F); it replaces the row if it is fitter. A fitter row serves
    the rest of the pass at once. [M] gives (HRT, NFE) = (14, 220) for matching and (4, 20) for localisation.
    """

    PAPER_BUDGET: ClassVar[int] = 220
    """NFE of the scan matching in [P] and [M]."""

    improvisations_per_pass: Count = 14
    """Number of improvisations between two passes of differential evolution (HRT)."""
    attraction: NonNegative = 0.7
    """Factor of a row's move towards the best row of the memory (lambda of [DE])."""
    differential_weight: NonNegative = 0.44
    """Factor of the difference of two random rows that is added to a row (F of [DE])."""

    def _differential_evolution(self) -> tuple[int, float, float]:
        return self.improvisations_per_pass, self.attraction, self.differential_weight
