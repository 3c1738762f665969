"""E4 (Fig. 7, 8 of [P]): SLAM of the vehicle of [P] along the waypoints, with the product's point mapper."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from hsloc.config import preset
from hsloc.evaluation import evaluate
from hsloc.model.estimate import Status
from hsloc.model.trajectory import Trajectory
from hsloc.options import PRESETS
from hsloc.replay.engine import replay
from hsloc.replay.run_history import RunHistory
from hsloc.reproduction.localisation import MATCHERS, Path
from hsloc.reproduction.variants import NAMES
from hsloc.simulation.odometer import SteeringNoise
from hsloc.simulation.presets import preset as scenario_preset
from hsloc.simulation.simulator import events
from hsloc.slam.point_mapper import PointMapper

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.config import Config
    from hsloc.model import Event, Pose2
    from hsloc.simulation.world import World

    F64 = NDArray[np.float64]

RANGE = 60.0
"""Distance (m) within which every point is seen, through walls, as in [P]."""
NOISE = SteeringNoise(0.2, radians(1.0))
"""Of the wheels (m/s) and of the steering (rad) [P]."""
NEAR = 3.0
"""A true point is in the map if one of the map lies so near (m): twice the threshold beneath which none is added."""


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """One seed with one matcher and preset: RMSE over all stamps (m, m, rad; theta wrapped).

    Of each stamp the pose counts that is known once all that bears it is taken in, a scan as well: so does [P].
    `points` are those of the map, `complete` the part of the world's points near which the map has one, `distance`
    the mean distance (m) of the map's points from the world's. `path` and `map_points` are kept for the first seed.
    """

    matcher: str
    preset: str
    seed: int
    rmse: tuple[float, float, float]
    seconds: float
    scans: int
    matched: int
    points: int
    complete: float
    distance: float
    path: Path | None
    map_points: F64 | None

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
            "points": self.points,
            "complete": self.complete,
            "distance_m": self.distance,
        }


def run_mapping(world: World, seeds: int, progress: Callable[[float], None]) -> tuple[Mapped, ...]:
    """Drive with the seeds 0 to `seeds` - 1; each drive is mapped with HIDE and HS, with each of `PRESETS`."""
    if world.points is None:
        raise ValueError(f"the world {world.name} has no points: the course report's sensor sees nothing")
    scenario = scenario_preset("paper")
    scenario = replace(scenario, sensor=replace(scenario.sensor, range_max=RANGE), odometry=NOISE)
    configs = {(name, matcher): replace(preset(name), matcher=matcher) for name in PRESETS for matcher in MATCHERS}
    mapped = []
    for seed in range(seeds):
        drive = list(events(replace(scenario, seed=seed), world))
        for (name, _), config in configs.items():
            mapped.append(_map(drive, world, config, name, seed))
            progress(len(mapped) / (seeds * len(configs)))
    return tuple(mapped)


def _map(drive: list[Event], world: World, config: Config, preset_name: str, seed: int) -> Mapped:
    rng = np.random.default_rng(seed)
    mapper = PointMapper(config.make_matcher(), config.point_mapper, rng, world.start())
    history = RunHistory()
    known: dict[int, Pose2] = {}
    begin = perf_counter()
    for event, estimate in replay(drive, mapper):
        history.add(event, estimate)
        if estimate is not None:
            known[estimate.stamp_ns] = estimate.T_map_base  # the scan's follows that of the odometry
    seconds = perf_counter() - begin
    estimated = Trajectory.from_pairs(sorted(known.items()))
    truth = history.reference()
    assert truth is not None
    assert world.points is not None
    diagnostics = history.diagnostics()
    points = mapper.points
    return Mapped(
        matcher=NAMES[config.matcher],
        preset=preset_name,
        seed=seed,
        rmse=evaluate(estimated, truth, deltas=()).axis_rmse,
        seconds=seconds,
        scans=len(diagnostics),
        matched=diagnostics.status.count(Status.MATCHED.value),
        points=len(points),
        complete=float((_distances(world.points, points) < NEAR).mean()),
        distance=float(_distances(points, world.points).mean()),
        path=Path(estimated, truth, history.odometry()) if seed == 0 else None,
        map_points=points if seed == 0 else None,
    )


def _distances(points: F64, others: F64) -> F64:
    """Of each point to the nearest of the others, m."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(points)[0], dtype=np.float64)
