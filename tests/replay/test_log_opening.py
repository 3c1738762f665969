"""What a log states wrongly is decided by its data when it is opened for a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from log_builders import SECOND, START, make_scan

from hsloc.log import LogWriter
from hsloc.model import Pose2
from hsloc.replay.clock_offset import open_as_meant
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from pathlib import Path


def test_stamps_of_another_epoch_give_way_to_the_times_of_the_log(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as writer:
        writer.transforms(START, [("base_link", "laser", Pose2(0.2, 0.0, 0.0))], static=True)
        for k in range(30):
            now = START + k * SECOND // 10
            writer.odometry(now, Pose2(k / 10.0, 0.0, 0.0))
            writer.scan(make_scan(SECOND + k * SECOND // 10, k), log_time_ns=now)
    log, reading, (warning,) = open_as_meant(RunRequest(logs=(path,)), lidar_only=False)
    assert (reading.stamps, warning.code) == ("log", "clocks_apart")
    assert {event.stamp_ns // (1000 * SECOND) for event in log.events()} == {START // (1000 * SECOND)}
    given = RunRequest.from_values([path], {"stamps": "log"})
    assert open_as_meant(given, lidar_only=False)[1:] == (given.reading(), ())
