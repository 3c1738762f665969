"""A run that is doubtful as a whole says so: most scans without a place, odometry that jumps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions
from hsloc.log.writer import LogWriter
from hsloc.model import Odometry, Pose2, Scan
from hsloc.replay.doubts import doubts
from hsloc.replay.run import RunSpec, run

OFFICE = Path(__file__).resolve().parents[2] / "recordings" / "office.mcap"


def rewritten(path, change, end=20.0):
    """The office, with each event changed by `change`."""
    log = open_log(OFFICE, ReadOptions(end_s=end))
    with LogWriter(path) as writer:
        writer.occupancy_grid(log.map(), log.summary.origin_ns)
        for event in map(change, log.events()):
            if isinstance(event, Scan):
                writer.scan(event)
            elif isinstance(event, Odometry):
                writer.odometry(event.stamp_ns, event.T_odom_base)
    return path


def test_a_sound_run_leaves_no_doubt():
    assert doubts(run(RunSpec(logs=(OFFICE,), read=ReadOptions(end_s=20.0), unknown_start=True))) == []


def test_a_laser_that_hangs_head_down_and_is_not_said_to_leaves_a_doubt(tmp_path):
    def mirrored(event):
        return replace(event, ranges=event.ranges[::-1].copy()) if isinstance(event, Scan) else event

    found = run(RunSpec(logs=(rewritten(tmp_path / "run.mcap", mirrored),), unknown_start=True))
    (line,) = doubts(found)
    assert "scans found no place on the map" in line
    assert "--laser-pose" in line


def test_a_log_too_short_to_be_sure_is_all_guesses():
    found = run(RunSpec(logs=(OFFICE,), read=ReadOptions(end_s=0.5), unknown_start=True))
    assert not found.localised.any()
    assert "every pose is a guess" in doubts(found)[0]


@pytest.mark.parametrize("mode", ["localise", "slam"])
def test_odometry_that_is_reset_is_told_with_place_and_length(tmp_path, mode):
    def reset(event):
        if isinstance(event, Odometry) and event.stamp_ns >= 1_700_000_010_000_000_000:
            return replace(event, T_odom_base=Pose2(5.0, 0.0, 0.0) @ event.T_odom_base)
        return event

    log = rewritten(tmp_path / "run.mcap", reset, end=12.0)
    (line,) = doubts(run(RunSpec(logs=(log,), mode=mode, initial_pose=Pose2(2.6, 8.1, 1.5708))))
    assert line.startswith("odometry (/odom) jumps (1 times, first by 4.98 m at 10.000 s)")  # 5 m, less what it drove
