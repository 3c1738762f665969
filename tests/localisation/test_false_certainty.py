"""What is called localised is right: on half a map, on a wrong map, among look-alikes, along a plain corridor."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hsloc.config import Config
from hsloc.localisation.localiser import Localiser
from hsloc.matching import LikelihoodField
from hsloc.model import Event, OccupancyGrid, Pose2, State, wrap_angles
from hsloc.replay.engine import replay
from hsloc.replay.run_history import RunHistory
from hsloc.simulation.built_in import built_in
from hsloc.simulation.presets import CORRIDOR_LOOP, DRIFTING, OFFICE
from hsloc.simulation.simulator import events
from hsloc.simulation.world import World

pytestmark = pytest.mark.unmeasured

WRONG_M, WRONG_RAD = 0.25, np.radians(5.0)
PLAIN = World(
    "plain",
    np.array([(0, 0, 60, 0), (60, 0, 60, 2.2), (60, 2.2, 0, 2.2), (0, 2.2, 0, 0)], dtype=np.float64),
    np.array([(12.0, 1.1), (48.0, 1.1)]),
)


@cache
def office_drive() -> tuple[Event, ...]:
    return tuple(events(replace(OFFICE, duration_s=60.0), built_in("office")))


def judge(
    drive: tuple[Event, ...], grid: OccupancyGrid, start: Pose2 | None, *, any_is_wrong: bool = False
) -> tuple[float, float, set[State]]:
    """Share of poses that are wrong and called localised, of right ones that are not, and the states there are."""
    config = Config()
    field = LikelihoodField.from_grid(grid)
    localiser = Localiser.from_parameters(
        grid, field, config.make_matcher(), config.localiser, np.random.default_rng(0), start
    )
    history = RunHistory()
    for event, estimate in replay(drive, localiser):
        history.add(event, estimate)
    trajectory, _ = history.trajectory()
    truth, states = history.reference(), history.states(localiser.map_scale, *history.mounting(), grid)
    assert truth is not None
    assert states is not None
    off = trajectory.poses - truth.poses
    wrong = (np.hypot(off[:, 0], off[:, 1]) > WRONG_M) | (np.abs(wrap_angles(off[:, 2])) > WRONG_RAD)
    wrong |= any_is_wrong
    localised = states.is_localised()
    return (
        float((wrong & localised).mean()),
        float((~wrong & ~localised).sum() / max((~wrong).sum(), 1)),
        set(states.state),
    )


def with_cells(grid: OccupancyGrid, cells: np.ndarray[tuple[int, int], np.dtype[np.int8]]) -> OccupancyGrid:
    return replace(grid, cells=np.ascontiguousarray(cells))


@pytest.mark.parametrize("known", [True, False])
def test_on_its_map_every_pose_is_localised(known: bool) -> None:
    world = built_in("office")
    false, doubted, _ = judge(office_drive(), world.occupancy_grid(0.05), world.start() if known else None)
    assert (false, doubted) == (0.0, 0.0)


def test_on_a_map_of_a_wrong_resolution_poses_are_as_uncertain_as_they_are_wrong() -> None:
    world = built_in("office")
    grid = world.occupancy_grid(0.05)
    false, _, states = judge(office_drive(), replace(grid, resolution=1.02 * grid.resolution), world.start())
    assert false == 0.0
    assert states == {State.LOCALISED, State.PREDICTED}


@pytest.mark.parametrize("known", [True, False])
def test_on_half_its_map_only_the_mapped_half_is_localised(known: bool) -> None:
    world = built_in("office")
    grid = world.occupancy_grid(0.05)
    cells = grid.cells.copy()
    cells[:, int(0.4 * cells.shape[1]) :] = -1
    false, doubted, states = judge(office_drive(), with_cells(grid, cells), world.start() if known else None)
    assert false <= 0.005
    assert doubted <= 0.05
    assert states & {State.OFF_MAP, State.LOST}


@pytest.mark.parametrize("known", [True, False])
def test_on_a_mirrored_map_no_pose_is_localised(known: bool) -> None:
    world = built_in("office")
    grid = world.occupancy_grid(0.05)
    mirrored = with_cells(grid, grid.cells[:, ::-1])
    false, _, _ = judge(office_drive(), mirrored, world.start() if known else None, any_is_wrong=True)
    assert false == 0.0


def test_on_the_map_of_another_building_no_pose_is_localised() -> None:
    grid = built_in("corridor-loop").occupancy_grid(0.05)
    false, _, _ = judge(office_drive(), grid, None, any_is_wrong=True)
    assert false == 0.0


def test_along_a_plain_corridor_the_uncertainty_grows_and_no_pose_is_localised() -> None:
    sensor = replace(CORRIDOR_LOOP.sensor, range_max=8.0)
    scenario = replace(OFFICE, world="plain", odometry=DRIFTING, sensor=sensor)
    drive = tuple(events(scenario, PLAIN))
    false, _, states = judge(drive, PLAIN.occupancy_grid(0.05), PLAIN.start())
    assert false == 0.0
    assert State.PREDICTED in states
