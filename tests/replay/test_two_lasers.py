"""Two lidars, or more, merged into one run: each scan with its own mounting."""

from __future__ import annotations

import json
from dataclasses import replace
from math import pi

import numpy as np
import pytest

from hsloc.cli.main import main
from hsloc.errors import TopicError
from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions
from hsloc.log.writer import LogWriter
from hsloc.model import Odometry, Pose2, Scan
from hsloc.replay.run import RunSpec, run
from hsloc.simulation.presets import preset
from hsloc.simulation.recorder import record

FRONT, REAR = Pose2(0.3, 0.0, 0.0), Pose2(-0.3, 0.05, pi)
BOTH = ReadOptions(scan_topic="/front,/rear")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A drive with two lidars of 180 degrees, one to the front and one to the rear, the latter 50 ms later."""
    folder = tmp_path_factory.mktemp("lasers")
    parts = {}
    for name, mounting, offset in (("front", FRONT, 0.0), ("rear", REAR, 0.05)):
        scenario = preset("office")
        sensor = replace(scenario.sensor, mounting=mounting, frame_id=name, field_of_view=pi, beams=180)
        scenario = replace(scenario, seed=9, duration_s=20.0, sensor=sensor, scan_offset_s=offset)
        record(scenario, folder / f"{name}.mcap")
        parts[name] = open_log(folder / f"{name}.mcap")
    path = folder / "both.mcap"
    start = parts["front"].initial_pose()[1]
    with LogWriter(path) as writer:
        writer.metadata("hsloc.initial_pose", {"x": repr(start.x), "y": repr(start.y), "theta": repr(start.theta)})
        writer.transforms(0, [("base_link", "front", FRONT), ("base_link", "rear", REAR)], static=True)
        writer.occupancy_grid(parts["front"].map(), 0)
        rear = [event for event in parts["rear"].events() if isinstance(event, Scan)]
        for event in sorted([*parts["front"].events(), *rear], key=lambda event: event.stamp_ns):
            if isinstance(event, Scan):
                writer.scan(event, topic=f"/{event.frame_id}")
            elif isinstance(event, Odometry):
                writer.odometry(event.stamp_ns, event.T_odom_base)
            else:
                writer.odometry(event.stamp_ns, event.T_map_base, topic="/ground_truth", frame_id="map")
    return path


def test_scans_of_all_topics_come_in_order_with_their_own_mounting(log):
    opened = open_log(log, BOTH)
    scans = [event for event in opened.events() if isinstance(event, Scan)]
    assert [scan.frame_id for scan in scans[:4]] == ["front", "rear", "front", "rear"]
    assert [scan.stamp_ns for scan in scans] == sorted(scan.stamp_ns for scan in scans)
    assert {scan.frame_id: scan.T_base_laser for scan in scans} == {"front": FRONT, "rear": REAR}
    assert opened.summary.scan_topic == "/front,/rear"
    assert [(laser.topic, laser.T_base_laser) for laser in opened.summary.lasers] == [
        ("/front", FRONT),
        ("/rear", REAR),
    ]
    alone = [scan for scan in open_log(log, ReadOptions(scan_topic="rear")).events() if isinstance(scan, Scan)]
    assert len(alone) == len(scans) // 2


def test_a_run_uses_both_lasers(log):
    result = run(RunSpec(logs=(log,), read=BOTH))
    assert len(result.diagnostics) == 401
    status = result.diagnostics.status
    # The first scan of each 25 cm is matched, and that is one of the rear as often as one of the front.
    assert all("matched" in status[side::2] for side in (0, 1))
    difference = result.trajectory.interpolated(result.reference.stamps_ns) - result.reference.poses
    assert np.hypot(difference[:, 0], difference[:, 1]).max() < 0.06


def test_the_command_takes_the_flag_twice_or_commas(log, tmp_path, capsys):
    assert main(["info", str(log), "--scan-topic", "/front", "--scan-topic", "/rear", "--json"]) == 0
    twice = json.loads(capsys.readouterr().out)
    assert main(["info", str(log), "--scan-topic=/front,/rear", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == twice
    assert [laser["topic"] for laser in twice["lasers"]] == ["/front", "/rear"]
    assert twice["events"]["scan"] == 401
    assert main(["info", str(log), "--scan-topic=/front,/rear"]) == 0
    assert "/rear: x -0.300 m, y 0.050 m, yaw 3.1416 rad (/tf_static)" in capsys.readouterr().out


def test_several_lasers_must_be_asked_for(log):
    with pytest.raises(TopicError, match=r"--scan-topic /front, or take all with --scan-topic /front,/rear"):
        open_log(log)
    with pytest.raises(TopicError, match="no topic /left"):
        open_log(log, ReadOptions(scan_topic="/front,/left"))


def test_a_mounting_by_hand_is_for_all_and_said_so(log):
    summary = open_log(log, replace(BOTH, laser_pose=Pose2(1.0, 0.0, 0.0))).summary
    assert [laser.T_base_laser.x for laser in summary.lasers] == [1.0, 1.0]
    assert "--laser-pose is taken for all 2 lasers" in summary.warnings
