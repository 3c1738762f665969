"""Scans whose beams all point the same way do not locate the robot, and are counted as unusable."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.log.reader import open_log
from hsloc.log.writer import LogWriter
from hsloc.model import Pose2, Scan

if TYPE_CHECKING:
    from pathlib import Path


def test_an_increment_of_zero_is_no_scan(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path) as writer:
        for k, increment in enumerate((0.0, 0.1, 0.0)):
            stamp = 10**9 + k * 10**8
            writer.odometry(stamp, Pose2())
            writer.scan(Scan(stamp, np.ones(5, dtype=np.float32), 0.0, increment, 0.1, 10.0))
    log = open_log(path)
    assert [event.angle_increment > 0.0 for event in log.events() if isinstance(event, Scan)] == [True]
    assert log.losses.invalid_messages == {"/scan": 2}
    assert any("no usable values" in line for line in log.losses.lines())
