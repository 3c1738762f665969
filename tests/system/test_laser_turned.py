"""A laser that is turned on the robot during a drive: named with the moment, on a given map and a new one."""

from __future__ import annotations

from dataclasses import replace
from math import radians
from typing import TYPE_CHECKING

import numpy as np
import pytest
from log_builders import write_events

from hsloc import run
from hsloc.analysis.analyse import analyse
from hsloc.maps import save_map
from hsloc.model import Scan
from hsloc.model.verdict import Verdict
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.replay.run import Result
    from hsloc.warnings import RunWarning

KNOCKED_S, TURNED_DEG = 20.0, 6.0


@pytest.fixture(scope="module", params=[TURNED_DEG, 0.0], ids=["knocked", "as it was"])
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, float]:
    """A log of 40 s, its map and by how much the laser was turned half way (deg)."""
    folder, world = tmp_path_factory.mktemp("drive"), load_world("office")
    scenario = Scenario("office", seed=4, sensor=Lidar(beams=180), duration_s=2.0 * KNOCKED_S, scan_rate_hz=5.0)
    recorded = list(events(scenario, world))
    for k, event in enumerate(recorded):
        if isinstance(event, Scan) and event.stamp_ns - recorded[0].stamp_ns >= KNOCKED_S * 1e9:
            # A laser that is turned to the left states angles that are too small.
            recorded[k] = replace(event, angle_min=event.angle_min - radians(request.param))
    return (
        write_events(folder / "run.mcap", recorded),
        save_map(world.occupancy_grid(), folder / "map.yaml"),
        request.param,
    )


def require_named(result: Result, turned: float) -> RunWarning | None:
    """The warning, which is there where the laser was turned."""
    metrics = analyse(result).metrics
    found = [each for each in metrics.warnings if each.code == WarningCode.LASER_TURNED]
    assert bool(found) == bool(turned)
    assert WarningCode.EXTRINSICS_WRONG not in {each.code for each in metrics.warnings}
    if not found:
        return None
    assert metrics.verdict is Verdict.CHECK
    assert WarningCode.LASER_TURNED in {reason.code for reason in metrics.verdict_reasons}
    (warning,) = found
    seconds, angle = warning.text.partition("robot: at ")[2].split(" s by ")
    assert float(seconds) == pytest.approx(KNOCKED_S, abs=2.0)
    assert float(angle.split()[0]) == pytest.approx(turned, abs=0.5)
    yaw = float(warning.remedy.rpartition(",")[2])
    assert yaw == pytest.approx(radians(turned), abs=0.01)
    return warning


def test_headings_after_it_are_doubted_on_a_given_map(drive: tuple[Path, Path, float]) -> None:
    log, of_world, turned = drive
    result = run(log, map=of_world, initial_pose=load_world("office").start())
    require_named(result, turned)
    late = result.trajectory.stamps_ns - result.trajectory.stamps_ns[0] > (KNOCKED_S + 2.0) * 1e9
    assert result.states is not None
    if turned:
        assert not result.localised[late].any()
        assert (result.states.sigma[late, 2] > radians(0.9 * turned)).all()
        assert np.mean(result.localised[~late]) > 0.8
    else:
        assert result.localised.all()


def test_a_map_is_not_called_good(drive: tuple[Path, Path, float]) -> None:
    log, _, turned = drive
    result = run(log, mode="slam")
    require_named(result, turned)
