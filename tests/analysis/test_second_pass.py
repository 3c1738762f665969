"""The second pass over a log has the scans as the run saw them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from log_builders import write_events
from paths import RECORDINGS

from hsloc.analysis.analyse import analyse
from hsloc.analysis.second_pass import posed_events
from hsloc.log import open_log
from hsloc.maps import save_map
from hsloc.model import Scan
from hsloc.model.events import PairedScan
from hsloc.replay.run import run
from hsloc.simulation.built_in import built_in

if TYPE_CHECKING:
    from pathlib import Path

POST = slice(100, 160)


def test_beams_that_see_the_robot_itself_are_left_out_as_in_the_run(tmp_path: Path) -> None:
    events = list(open_log(RECORDINGS / "office.mcap").events())
    rng = np.random.default_rng(0)
    for k, event in enumerate(events):
        if isinstance(event, Scan):
            ranges = event.ranges.copy()
            ranges[POST] = 0.3 + rng.normal(0.0, 0.005, 60)
            events[k] = replace(event, ranges=ranges)
    path = write_events(tmp_path / "run.mcap", events)
    world = built_in("office")
    result = run(path, map=save_map(world.occupancy_grid(0.05), tmp_path), initial_pose=world.start())
    assert [warning.code for warning in result.warnings] == ["scan_body_returns"]
    scans = [posed.event.scan for posed in posed_events(result) if isinstance(posed.event, PairedScan)]
    assert len(scans) == len(result.diagnostics)
    assert all(np.isnan(scan.ranges[POST]).all() for scan in scans)
    near = analyse(result).metrics.map.residuals.within_15_cm
    assert near is not None
    assert near > 0.98, "a sixth of the beams ends at the robot"
