"""Where a single scan fits on a whole floor: how long the search takes, and whether it is right."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from hsloc.benchmark.floors import floor, random_pose, scan_at
from hsloc.localisation.whole_map_search import WholeMapSearch
from hsloc.matching import LikelihoodField
from hsloc.model.pose2 import wrap_angle

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

AREAS = (2_000.0, 10_000.0, 40_000.0)
"""Square metres of the floors."""
BLOCKED = (0.0, 0.1)
"""Shares of the beams that end at something that is not on the map."""
SEED = 1
_RIGHT = (0.3, np.radians(3.0))


@dataclass(frozen=True, slots=True)
class WholeMapTiming:
    """Searches from random places on one floor, one scan each, in processor time; the preparation of the map
    is not counted.

    `right`: the share in which the true place is among the modes; `unique`: in which it was proven to be the only one;
    `wrong`: in which one place was proven to be the only one and is another; `complete`: in which the work sufficed.
    """

    area: float
    blocked: float
    scans: int
    right: float
    unique: float
    wrong: float
    complete: float
    median_s: float
    p95_s: float
    worst_s: float
    prepare_s: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def measure_whole_map(
    areas: Sequence[float], scans: int, progress: Callable[[float], None] = lambda share: None
) -> tuple[WholeMapTiming, ...]:
    """Search each floor with `scans` scans of 360 beams for each share of blocked beams."""
    results: list[WholeMapTiming] = []
    for area in areas:
        world = floor(area, SEED)
        grid = world.occupancy_grid(0.05)
        field = LikelihoodField.from_grid(grid)
        begin = process_time()
        search = WholeMapSearch(grid, field)
        prepared = process_time() - begin
        for blocked in BLOCKED:
            rows = []
            for index in range(scans):
                rng = np.random.default_rng((SEED, index))
                true = random_pose(grid, rng)
                points = scan_at(world, true, rng, blocked=blocked)
                if index == 0:
                    search.search(points)
                begin = process_time()
                result = search.search(points)
                seconds = process_time() - begin
                right = any(
                    mode.pose.distance(true) <= _RIGHT[0] and abs(wrap_angle(mode.pose.theta - true.theta)) <= _RIGHT[1]
                    for mode in result.modes
                )
                rows.append((right, result.is_unique, result.is_unique and not right, result.is_complete, seconds))
                progress((len(results) + (index + 1) / scans) / (len(areas) * len(BLOCKED)))
            table = np.array(rows, dtype=np.float64)
            right_share, unique, wrong, complete = (float(share) for share in table[:, :4].mean(axis=0))
            results.append(
                WholeMapTiming(
                    area=area,
                    blocked=blocked,
                    scans=scans,
                    right=right_share,
                    unique=unique,
                    wrong=wrong,
                    complete=complete,
                    median_s=float(np.median(table[:, 4])),
                    p95_s=float(np.percentile(table[:, 4], 95)),
                    worst_s=float(table[:, 4].max()),
                    prepare_s=prepared,
                )
            )
    return tuple(results)
