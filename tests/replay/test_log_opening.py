"""What a log states wrongly is decided by its data when it is opened for a run."""

from __future__ import annotations

import gzip
from typing import TYPE_CHECKING, Any

from log_builders import SECOND, START, make_scan

from hsloc.analysis import second_pass
from hsloc.log import Log, LogWriter, open_log
from hsloc.model import Pose2
from hsloc.replay.clock_offset import open_as_meant
from hsloc.replay.run import run
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


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


LINES = [
    f"ODOM {0.01 * k:.2f} 0 0 0 0 0 {k}.0 host {k}.0\nFLASER 9 {'1 ' * 9}0 0 0 0 0 0 {k}.0 host {k}.0\n"
    for k in range(9)
]


def test_a_log_is_opened_once_for_run_and_analysis_unless_that_holds_unpacked_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mcap, text = tmp_path / "a.mcap", "".join(LINES).encode()
    with LogWriter(mcap) as writer:
        writer.transforms(START, [("base_link", "laser", Pose2(0.0, 0.0, 0.0))], static=True)
        for k in range(9):
            writer.odometry(START + k * SECOND, Pose2(0.01 * k, 0.0, 0.0))
            writer.scan(make_scan(START + k * SECOND, k))
    contents = {"b.mcap.gz": gzip.compress(mcap.read_bytes()), "c.clf": text, "d.clf.gz": gzip.compress(text)}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    opened: list[str] = []

    def noted(*arguments: Any) -> Log:
        opened.append("again")
        return open_log(*arguments)

    monkeypatch.setattr(second_pass, "open_log", noted)
    for name, times in (("a.mcap", 0), ("b.mcap.gz", 1), ("c.clf", 0), ("d.clf.gz", 0)):
        opened.clear()
        result = run(RunRequest(logs=(tmp_path / name,), mode="slam"))
        assert (result.log is None) == (times == 1)
        assert sum(posed.localised for posed in second_pass.posed_events(result)) > 0
        assert len(opened) == times, name
