"""Real robots on real maps. The logs are not part of the repository; without them these tests skip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hsloc.analysis.analyse import analyse
from hsloc.log import ReadOptions
from hsloc.replay.run import run
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.data, pytest.mark.unmeasured]


@pytest.mark.parametrize(("name", "seed"), [("robotdata1", 0), ("robotdata1", 2), ("robotdata1", 3), ("robotdata3", 0)])
def test_wean_hall_from_an_unknown_start(data: Path, name: Any, seed: int) -> None:
    folder = data / "wean"
    found = run(RunRequest(logs=(folder / f"{name}.log.gz",), map_path=folder / "wean.yaml", seed=seed))
    reference = np.loadtxt(folder / f"{name}.pf.ref.txt")
    poses = found.trajectory.interpolated(np.round(reference[:, 0] * 1e9).astype(np.int64))
    metres = np.hypot(poses[:, 0] - reference[:, 1], poses[:, 1] - reference[:, 2])
    certain = reference[:, 4] < 0.2  # the reference's own spread (m): less so where its runs have just converged
    assert found.localised.mean() > 0.9
    assert metres[certain].max() < 0.6
    assert np.median(metres) < 0.15


@pytest.mark.parametrize("log", ["mcap_zstd/mcap_zstd.mcap", "macfirst_floor_take_2/macfirst_floor_take_2_0.db3"])
def test_turtlebot_from_an_unknown_start(data: Path, log: Any) -> None:
    folder = data / "turtlebot4"
    request = RunRequest(
        logs=(folder / log,), map_path=folder / "mac_1st_floor_final.yaml", read=ReadOptions(), unknown_start=True
    )
    found = run(request)
    assert found.localised.all()
    metrics = analyse(found).metrics
    # The stamps of this robot's lidar are a tenth of a second late, which is corrected.
    assert metrics.warnings == found.warnings
    (offset,) = (warning for warning in found.warnings if warning.code.startswith("clock_offset"))
    assert offset.code == "clock_offset_applied"
    assert "0.16" in offset.text
    assert metrics.verdict_reasons == ()
    assert metrics.map.residuals.within_15_cm >= 0.85  # type: ignore[operator]
    assert any(warning.code == "map_unknown_read_as_free" for warning in found.warnings)
