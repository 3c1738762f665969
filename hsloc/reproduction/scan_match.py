"""E1 (Fig. 2, 3 of [P]): match one scan from one start, with many seeds."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from hsloc.matching import LikelihoodField, Window
from hsloc.model.pose2 import Pose2
from hsloc.reproduction.material import SEEN_FROM
from hsloc.reproduction.variants import Tally, matching_variants

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.reproduction.variants import Variant

    F64 = NDArray[np.float64]

START = Pose2(1.2, -0.5, 1.21)
HALF = (0.5, 0.5, radians(15.0))
"""Start and box of [P], metres and radians."""
SUCCESS = (0.02, 0.5)
"""Ours, metres and degrees: [P] shows pictures and gives no number."""
RESOLUTION = 0.02
"""Of the field, m. Its nodes know the exact distance to the nearest point, between them it is interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanMatch:
    """One variant over all seeds; `poses` (n, 3) are its answers, `typical` is the seed of the median error."""

    variant: Variant
    tally: Tally
    poses: F64

    @property
    def success(self) -> float:
        """Part of the seeds within `SUCCESS`."""
        return self.tally.success(*SUCCESS)

    @property
    def typical(self) -> int:
        """Seed whose error in metres is the median."""
        return int(np.argsort(self.tally.metres)[(len(self.poses) - 1) // 2])

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "matcher": self.variant.matcher,
            "preset": self.variant.preset,
            "seeds": len(self.poses),
            "success": self.success,
            **self.tally.to_dict(),
        }


def scan_seen(scan: F64) -> F64:
    """The scan's points (n, 2) as the robot at `SEEN_FROM` sees them."""
    return SEEN_FROM.inverse() @ scan


def run_scan_match(scan: F64, seeds: int, progress: Callable[[float], None]) -> tuple[ScanMatch, ...]:
    """Match `scan` (n, 2), which is also the map, with every variant and the seeds 0 to `seeds` - 1."""
    points = scan_seen(scan)
    window = Window(START, *HALF)
    variants = matching_variants()
    fields = {
        sigma: LikelihoodField.from_points(scan, sigma, RESOLUTION, margin=1.0)
        for sigma in sorted({variant.sigma for variant in variants})
    }
    results = []
    for index, variant in enumerate(variants):
        field = fields[variant.sigma]
        variant.search.match(points, field, window, np.random.default_rng(0))  # compiled, cache warm
        rows = []
        for seed in range(seeds):
            begin = perf_counter()
            match = variant.search.match(points, field, window, np.random.default_rng(seed))
            rows.append((match, SEEN_FROM, perf_counter() - begin))
            progress((index + (seed + 1) / seeds) / len(variants))
        poses = np.array([match.pose.to_array() for match, _, _ in rows])
        results.append(ScanMatch(variant, Tally.of(rows), poses))
    return tuple(results)
