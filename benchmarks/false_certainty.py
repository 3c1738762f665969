"""False certainty in simulation: poses that are wrong by more than 0.25 m or 5 deg and called localised.

    python benchmarks/false_certainty.py [--seed N] [CASE ...]

A line for each case: share of wrong poses called localised, share of right poses called anything else, and the mean
squared error of the right poses by the variances in states.csv (3 is expected), with the coverage at 95 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.config import Config
from hsloc.localisation.localiser import Localiser
from hsloc.matching import LikelihoodField
from hsloc.model import Event, OccupancyGrid, Pose2, Scan, wrap_angles
from hsloc.replay.clock_offset import ClockEvidence
from hsloc.replay.engine import replay
from hsloc.replay.map_and_start import ScaleEvidence
from hsloc.replay.run_history import RunHistory
from hsloc.simulation import presets
from hsloc.simulation.built_in import built_in
from hsloc.simulation.odometer import OdometryNoise
from hsloc.simulation.scenario import Kidnap, Scenario
from hsloc.simulation.simulator import events
from hsloc.simulation.world import World
from hsloc.slam.time_offset import estimate_offset

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.localisation.map_scale import MapScale
    from hsloc.localisation.odometry_scale import OdometryScale
    from hsloc.localisation.states import StateRows

NOISE_20 = OdometryNoise(4e-2, 2.4e-3, 8e-2, 4e-2)
PLAIN = World(
    "plain",
    np.array([(0, 0, 60, 0), (60, 0, 60, 2.2), (60, 2.2, 0, 2.2), (0, 2.2, 0, 0)], dtype=np.float64),
    np.array([(12.0, 1.1), (48.0, 1.1)]),
)
PLAIN_DRIVE = Scenario(
    "plain",
    robot=presets.BRISK,
    sensor=replace(presets.AHEAD, range_max=8.0),
    odometry=presets.DRIFTING,
)
OFFICE = replace(presets.OFFICE, duration_s=90.0)
HALL = replace(presets.HALL, duration_s=90.0)
LOOP = presets.CORRIDOR_LOOP
SYMMETRIC = replace(presets.preset("symmetric-corridor"), laps=1.5)

Change = Callable[[OccupancyGrid], OccupancyGrid]


def same(grid: OccupancyGrid) -> OccupancyGrid:
    return grid


def known(share: float) -> Change:
    """The map is known up to a share of its width."""

    def cut(grid: OccupancyGrid) -> OccupancyGrid:
        cells = grid.cells.copy()
        cells[:, int(share * cells.shape[1]) :] = -1
        return replace(grid, cells=cells)

    return cut


def mirrored(grid: OccupancyGrid) -> OccupancyGrid:
    return replace(grid, cells=np.ascontiguousarray(grid.cells[:, ::-1]))


def scaled(by: float) -> Change:
    """A resolution that is wrong: the cells grow from the corner."""
    return lambda grid: replace(grid, resolution=by * grid.resolution)


def map_of(world: str) -> Change:
    return lambda _: built_in(world).occupancy_grid(0.05)


CASES: dict[str, tuple[Scenario, Change, float]] = {
    "office": (OFFICE, same, 0.0),
    "loop": (LOOP, same, 0.0),
    "hall": (HALL, same, 0.0),
    "office, half its map": (OFFICE, known(0.5), 0.0),
    "office, two thirds": (OFFICE, known(0.667), 0.0),
    "loop, half its map": (LOOP, known(0.5), 0.0),
    "hall, half its map": (HALL, known(0.5), 0.0),
    "office, map of the loop": (OFFICE, map_of("corridor-loop"), 0.0),
    "hall, map of the office": (HALL, map_of("office"), 0.0),
    "office, mirrored": (OFFICE, mirrored, 0.0),
    "loop, mirrored": (LOOP, mirrored, 0.0),
    "office, kidnapped": (replace(OFFICE, kidnaps=(Kidnap(30.0, 21.0),)), same, 0.0),
    "loop, kidnapped": (replace(LOOP, kidnaps=(Kidnap(30.0, 25.0),)), same, 0.0),
    "office, scaled by 1.02": (OFFICE, scaled(1.02), 0.0),
    "loop, scaled by 1.02": (LOOP, scaled(1.02), 0.0),
    "hall, scaled by 0.98": (HALL, scaled(0.98), 0.0),
    "symmetric": (SYMMETRIC, same, 0.0),
    "symmetric, kidnapped": (replace(SYMMETRIC, kidnaps=(Kidnap(20.0, 12.0),)), same, 0.0),
    "plain corridor": (PLAIN_DRIVE, same, 0.0),
    "office, crowd of 50 %": (OFFICE, same, 0.5),
    "loop, crowd of 50 %": (LOOP, same, 0.5),
    "office, noise x 20": (replace(OFFICE, odometry=NOISE_20), same, 0.0),
    "loop, noise x 20": (replace(LOOP, odometry=NOISE_20), same, 0.0),
    "hall, noise x 20": (replace(HALL, odometry=NOISE_20), same, 0.0),
}
"""Scenario, what becomes of its map, and the share of beams that a crowd blocks."""


def crowded(drive: list[Event], share: float, seed: int) -> Iterator[Event]:
    """Twelve sectors that wander around the robot see something 0.6 to 1.6 m away."""
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0.0, 2.0 * np.pi, 12), rng.normal(0.0, 0.5, 12)
    for event in drive:
        if isinstance(event, Scan):
            time = (event.stamp_ns - drive[0].stamp_ns) * 1e-9
            ranges, bearing = event.ranges.copy(), event.angles() + event.T_base_laser.theta
            for k in range(12):
                inside = np.abs(wrap_angles(bearing - phase[k] - speed[k] * time)) < share * np.pi / 12.0
                ranges[inside] = np.minimum(ranges[inside], 1.1 + 0.5 * np.sin(0.3 * time + k))
            yield replace(event, ranges=ranges.astype(np.float32))
        else:
            yield event


class Scored(NamedTuple):
    """Errors of poses in x, y and heading (n, 3; m, m, rad), which are wrong, the states, and the odometry's scale."""

    off: NDArray[np.float64]
    wrong: NDArray[np.bool_]
    states: StateRows
    odometry_scale: OdometryScale | None

    def false(self) -> float:
        """The share of all poses that are wrong and called localised."""
        return float((self.wrong & self.states.is_localised()).mean())

    def doubted(self) -> float:
        """The share of the right poses that are called anything else."""
        return float((~self.wrong & ~self.states.is_localised()).sum() / max(int((~self.wrong).sum()), 1))

    def squared(self) -> NDArray[np.float64]:
        """The squared errors of the right poses by the variances in states.csv, where these are known."""
        known = ~self.wrong & np.isfinite(self.states.sigma).all(axis=1)
        squared: NDArray[np.float64] = ((self.off[known] / self.states.sigma[known]) ** 2).sum(axis=1)
        return squared


def scored(
    drive: Iterable[Event], grid: OccupancyGrid, start: Pose2 | None, rng: np.random.Generator, is_wrong: bool
) -> Scored:
    """Localise on a map; wrong are poses off by more than 0.25 m or 5 deg, and all where the map `is_wrong`.

    As in `hsloc.run`, the drive is replayed again with stamps of scans that turn out to be late or early corrected, on
    a map whose resolution turns out to be wrong with that corrected, or with odometry that turns out to count wrongly.
    """
    drive, state = list(drive), rng.bit_generator.state
    found, before = _scored_on(drive, grid, start, rng, is_wrong)
    if before.hints:
        assert before.scale is not None
        rng.bit_generator.state = state
        begin = None if start is None else before.scale.moved(before.start)
        again, after = _scored_on(drive, grid, begin, rng, is_wrong, before.scale)
        if after.is_better(before):
            return again
    odometry, of_map = found.odometry_scale, before.scale
    if odometry is not None and odometry.is_significant and not (of_map is not None and of_map.moves_poses):
        rng.bit_generator.state = state
        again, after = _scored_on(list(odometry.applied(drive)), grid, start, rng, is_wrong)
        if odometry.is_mended(again.odometry_scale) and after.fits_as(before):
            return again
    return found


def _scored_on(
    drive: list[Event],
    grid: OccupancyGrid,
    start: Pose2 | None,
    rng: np.random.Generator,
    is_wrong: bool,
    scale: MapScale | None = None,
) -> tuple[Scored, ScaleEvidence]:
    """On the map, or on that of another scale; and what that shows of the scale."""
    state, config = rng.bit_generator.state, Config()

    def localised(each: list[Event]) -> tuple[Scored, ClockEvidence, ScaleEvidence]:
        rng.bit_generator.state = state
        return _localised(each, grid if scale is None else scale.applied(grid), start, rng, is_wrong, scale)

    found, evidence, of_scale = localised(drive)
    if evidence.hints:
        offset = estimate_offset(drive, config.graph_mapper.front_end, np.random.default_rng(0))
        if offset.is_certain:
            by = round((offset.seconds - offset.half_sweep_s) * 1e9)
            moved = [replace(each, stamp_ns=each.stamp_ns - by) if isinstance(each, Scan) else each for each in drive]
            moved.sort(key=lambda event: event.stamp_ns)
            again, after, of_moved = localised(moved)
            if after.is_better(evidence):
                return again, of_moved
    return found, of_scale


def _localised(
    drive: list[Event],
    grid: OccupancyGrid,
    start: Pose2 | None,
    rng: np.random.Generator,
    is_wrong: bool,
    corrected: MapScale | None,
) -> tuple[Scored, ClockEvidence, ScaleEvidence]:
    field, config = LikelihoodField.from_grid(grid), Config()
    localiser = Localiser.from_parameters(grid, field, config.make_matcher(), config.localiser, rng, start)
    history = RunHistory(config.localiser.smoothing_model())
    for event, estimate in replay(drive, localiser):
        history.add(event, estimate)
    trajectory, _ = history.trajectory()
    scale = localiser.map_scale
    if scale is not None and corrected is not None:
        scale = replace(scale, corrected=corrected.value)
    states = history.states(scale, *history.mounting(), grid)
    reference = history.reference()
    assert states is not None
    assert reference is not None
    off = trajectory.poses - reference.poses
    off[:, 2] = wrap_angles(off[:, 2])
    wrong = (np.hypot(off[:, 0], off[:, 1]) > 0.25) | (np.abs(off[:, 2]) > np.radians(5.0)) | is_wrong
    of_clock = ClockEvidence.of(history.diagnostics(), history.odometry(), trajectory, states.is_localised())
    of_scale = ScaleEvidence.of(scale, history.diagnostics(), history.odometry(), trajectory)
    return Scored(off, wrong, states, localiser.odometry_scale), of_clock, of_scale


def measure(name: str, seed: int, is_known: bool) -> str:
    scenario, change, crowd = CASES[name]
    world = PLAIN if scenario.world == "plain" else built_in(scenario.world)
    drive = list(events(replace(scenario, seed=seed), world))
    grid = change(world.occupancy_grid(0.05))
    start = world.start() if is_known else None
    found = scored(
        crowded(drive, crowd, seed) if crowd else drive,
        grid,
        start,
        np.random.default_rng(seed),
        is_wrong="mirrored" in name or "map of" in name,
    )
    squared = found.squared()
    nees = f"{np.mean(squared):6.2f} {100.0 * np.mean(squared < 7.81):5.1f} %" if len(squared) else ""
    start_name = "given" if is_known else "unknown"
    right = np.hypot(*found.off[~found.wrong, :2].T)
    rmse = f"{100.0 * np.sqrt(np.mean(right**2)):5.2f} cm" if len(right) else ""
    shares = f"{100.0 * found.false():5.1f} % {100.0 * found.doubted():5.1f} %"
    return f"{name:26s} {start_name:8s} {shares} {rmse} {nees}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {'; '.join(CASES)}".replace("%", "%%"))
    arguments = parser.parse_args()
    print("case, start: wrong and localised, right and not localised, rmse of the right ones, NEES, coverage")
    for name in arguments.cases or CASES:
        for is_known in (True, False):
            print(measure(name, arguments.seed, is_known), flush=True)


if __name__ == "__main__":
    main()
