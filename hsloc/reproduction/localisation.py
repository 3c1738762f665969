"""E3 (Fig. 5, 6 of [P]): localisation of the vehicle of [P] along the waypoints, with the product's localiser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians, sqrt
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from hsloc.config import preset
from hsloc.evaluation import evaluate
from hsloc.localisation.localiser import Localiser
from hsloc.matching import LikelihoodField
from hsloc.model.estimate import Status
from hsloc.options import PRESETS
from hsloc.replay.engine import replay
from hsloc.replay.run_history import RunHistory
from hsloc.reproduction.variants import NAMES
from hsloc.simulation.presets import preset as scenario_preset
from hsloc.simulation.simulator import events

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.config import Config
    from hsloc.model import Event, OccupancyGrid, Trajectory
    from hsloc.simulation.world import World

INITIAL = (sqrt(0.1), sqrt(radians(0.5)))
"""P0 = diag(0.1, 0.1, 0.5 deg) of [P], read as a covariance: 0.32 m and 5.4 deg of standard deviation."""
RESOLUTION = 0.1
"""Of the field, m: fine enough for what is published; the map is the points themselves, not cells."""
MATCHERS = ("hide", "harmony_search")


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A run for a figure: the points of the map are in the material, all else is here."""

    estimate: Trajectory
    truth: Trajectory
    odometry: Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """One seed with one matcher and preset: RMSE over all odometry stamps (m, m, rad; theta wrapped).

    `seconds` are those of the localiser, without the simulation and the making of the field. `path` is kept for
    the first seed.
    """

    matcher: str
    preset: str
    seed: int
    rmse: tuple[float, float, float]
    seconds: float
    scans: int
    matched: int
    evaluations: int
    length_m: float
    duration_s: float
    path: Path | None

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "matcher": self.matcher,
            "preset": self.preset,
            "seed": self.seed,
            "rmse": dict(zip(("x_m", "y_m", "theta_rad"), self.rmse, strict=True)),
            "seconds": self.seconds,
            "scans": self.scans,
            "matched": self.matched,
            "evaluations": self.evaluations,
            "length_m": self.length_m,
            "duration_s": self.duration_s,
        }


def run_localisation(world: World, seeds: int, progress: Callable[[float], None]) -> tuple[Drive, ...]:
    """Drive with the seeds 0 to `seeds` - 1; each drive is localised by HIDE and HS with each preset.

    Vehicle, sensor (every point within 50 m, seen through walls) and noise are those of [P]; so is the start, which
    is known to within P0.
    """
    if world.points is None:
        raise ValueError(f"the world {world.name} has no points: the course report's sensor sees nothing")
    scenario = scenario_preset("paper")
    grid = world.occupancy_grid(scenario.map_resolution)
    configs = {
        (name, matcher): _with_start(replace(preset(name), matcher=matcher)) for name in PRESETS for matcher in MATCHERS
    }
    kinds = {config.likelihood_field for config in configs.values()}  # two presets share one field
    fields = {kind: LikelihoodField.from_points(world.points, kind.sigma, RESOLUTION, kind.margin) for kind in kinds}
    drives = []
    for seed in range(seeds):
        drive = list(events(replace(scenario, seed=seed), world))
        for (name, _), config in configs.items():
            drives.append(_localise(drive, world, grid, fields[config.likelihood_field], config, name, seed))
            progress(len(drives) / (seeds * len(configs)))
    return tuple(drives)


def _with_start(config: Config) -> Config:
    sigma, angle = INITIAL
    return replace(config, localiser=replace(config.localiser, initial_sigma=sigma, initial_sigma_angle=angle))


def _localise(
    drive: list[Event],
    world: World,
    grid: OccupancyGrid,
    field: LikelihoodField,
    config: Config,
    preset_name: str,
    seed: int,
) -> Drive:
    rng = np.random.default_rng(seed)
    localiser = Localiser.from_parameters(grid, field, config.make_matcher(), config.localiser, rng, world.start())
    history = RunHistory()
    begin = perf_counter()
    for event, estimate in replay(drive, localiser):
        history.add(event, estimate)
    seconds = perf_counter() - begin
    estimated, _ = history.trajectory()
    truth = history.reference()
    assert truth is not None
    diagnostics = history.diagnostics()
    return Drive(
        matcher=NAMES[config.matcher],
        preset=preset_name,
        seed=seed,
        rmse=evaluate(estimated, truth, deltas=()).axis_rmse,
        seconds=seconds,
        scans=len(diagnostics),
        matched=diagnostics.status.count(Status.MATCHED.value),
        evaluations=int(diagnostics.evaluations.sum()),
        length_m=truth.length(),
        duration_s=float(truth.stamps_ns[-1] - truth.stamps_ns[0]) * 1e-9,
        path=Path(estimated, truth, history.odometry()) if seed == 0 else None,
    )
