"""M1 ([M] Table 1, 2): how often, and how well, a scan is matched when the pose is known to 20 or 30 cm and 10 deg."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from hsloc.matching import LikelihoodField, Window
from hsloc.model import Pose2, Scan, Truth
from hsloc.model.pose2 import wrap_angle
from hsloc.reproduction.variants import Tally, matching_variants
from hsloc.simulation.built_in import built_in
from hsloc.simulation.presets import OFFICE
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.reproduction.variants import Variant

UNCERTAINTIES = (0.2, 0.3)
"""Half-width of the window in x and y, metres."""
ANGLE = radians(10.0)
SUCCESS = (0.05, 1.0)
"""Ours, metres and degrees: one cell of the map. What [M] calls a success is not stated there."""
SEED = 7
RANGE_NOISE = 0.01
SENSORS = {
    "office lidar": Lidar(range_noise=RANGE_NOISE, mounting=OFFICE.sensor.mounting),
    "like a URG-04LX": Lidar(
        beams=682, field_of_view=radians(240.0), range_min=0.02, range_max=4.0, range_noise=RANGE_NOISE
    ),
}
"""Ours: 360 beams all round, 15 m. That of [M]: 682 beams over 240 deg, 4 m; it sees few walls."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """One variant over all windows of one uncertainty."""

    sensor: str
    uncertainty: float
    variant: Variant
    tally: Tally

    @property
    def success(self) -> float:
        """Part of the windows within `SUCCESS`."""
        return self.tally.success(*SUCCESS)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "sensor": self.sensor,
            "uncertainty_m": self.uncertainty,
            "matcher": self.variant.matcher,
            "preset": self.variant.preset,
            "windows": len(self.tally.ms),
            "success": self.success,
            **self.tally.to_dict(),
        }


def run_windows(count: int, progress: Callable[[float], None]) -> tuple[Windows, ...]:
    """`count` scans, evenly chosen from a drive through the built-in office, each in a window of its own.

    The window's centre is off the truth by a uniform sample of the window itself, the same for all matchers. The map
    is the office in cells of 5 cm, so that its walls are known to a few centimetres only.
    """
    grid = built_in("office").occupancy_grid(0.05)
    variants = [variant for variant in matching_variants() if variant.matcher != "ICP"]
    fields = {sigma: LikelihoodField.from_grid(grid, sigma) for sigma in sorted({v.sigma for v in variants})}
    results = []
    total = len(SENSORS) * len(UNCERTAINTIES) * len(variants)
    for sensor, lidar in SENSORS.items():
        scans = _scans(lidar, count)
        for half in UNCERTAINTIES:
            offsets = np.random.default_rng(SEED).uniform(-1.0, 1.0, (count, 3)) * (half, half, ANGLE)
            for variant in variants:
                rng = np.random.default_rng(SEED)
                rows = []
                for (points, truth), offset in zip(scans, offsets, strict=True):
                    centre = Pose2(truth.x + offset[0], truth.y + offset[1], wrap_angle(truth.theta + offset[2]))
                    begin = perf_counter()
                    match = variant.search.match(points, fields[variant.sigma], Window(centre, half, half, ANGLE), rng)
                    rows.append((match, truth, perf_counter() - begin))
                results.append(Windows(sensor, half, variant, Tally.of(rows)))
                progress(len(results) / total)
    return tuple(results)


def _scans(lidar: Lidar, count: int) -> list[tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]], Pose2]]:
    """Points seen from the base, and where it truly was."""
    truth: dict[int, Pose2] = {}
    scans: list[Scan] = []
    for event in events(replace(OFFICE, seed=SEED, sensor=lidar), built_in("office")):
        if isinstance(event, Truth):
            truth[event.stamp_ns] = event.T_map_base
        elif isinstance(event, Scan):
            scans.append(event)
    chosen = np.linspace(0, len(scans) - 1, count).round().astype(int)
    return [(scans[i].points_base(), truth[scans[i].stamp_ns]) for i in chosen]
