"""Odometry that counts wrongly is corrected, and the log replayed again."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest
from log_builders import write_events
from paths import RECORDINGS

from hsloc.analysis.analyse import analyse
from hsloc.localisation.odometry_scale import OdometryScale
from hsloc.log import open_log
from hsloc.maps import save_map
from hsloc.model import Trajectory, Truth
from hsloc.replay.run import run
from hsloc.simulation.built_in import built_in
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path


def test_distances_that_are_counted_0_8_times_are_corrected(tmp_path: Path) -> None:
    events = list(open_log(RECORDINGS / "office.mcap").events())
    events = events[: 6 * len(events) // 10]
    path = write_events(tmp_path / "run.mcap", list(OdometryScale(-0.2, 0.0).applied(events)))
    world = built_in("office")
    found = run(path, map=save_map(world.occupancy_grid(0.05), tmp_path), initial_pose=world.start())
    (warning,) = found.warnings
    assert warning.code == WarningCode.ODOMETRY_SCALE
    counts = re.search(r"counts distances (\S+) times", warning.text)
    assert counts is not None
    assert float(counts[1]) == pytest.approx(0.8, abs=0.004)
    assert found.odometry_scale is not None
    assert abs(found.odometry_scale.way) < 0.01
    assert found.odometry.length() == pytest.approx(found.trajectory.length(), rel=0.02)
    true = Trajectory.from_pairs([(each.stamp_ns, each.T_map_base) for each in events if isinstance(each, Truth)])
    off = found.trajectory.poses - true.interpolated(found.trajectory.stamps_ns)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    assert found.localised.all()
    near = analyse(found).metrics.map.residuals.within_15_cm
    assert near is not None
    assert near > 0.95, "the scans are read again with the odometry as it was corrected"
