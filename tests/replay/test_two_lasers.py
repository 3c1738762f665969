"""Two lidars, or more, merged into one run: each scan with its own mounting."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from math import pi
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.cli.main import main
from hsloc.errors import TopicError
from hsloc.evaluation import evaluate
from hsloc.log import Log, LogWriter, ReadOptions, open_log
from hsloc.model import Odometry, Pose2, Scan, Truth
from hsloc.model.events import HELD
from hsloc.replay.run import Result, run
from hsloc.request import RunRequest
from hsloc.simulation.presets import preset
from hsloc.simulation.recorder import record

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from hsloc.model import Event

FRONT, REAR = Pose2(0.3, 0.0, 0.0), Pose2(-0.3, 0.05, pi)
BOTH = ReadOptions(scan_topic="/front,/rear")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with two lidars of 180 degrees, one to the front and one to the rear, the latter 50 ms later."""
    folder = tmp_path_factory.mktemp("lasers")
    parts = {}
    for name, mounting, offset in (("front", FRONT, 0.0), ("rear", REAR, 0.05)):
        scenario = preset("corridor_loop")
        sensor = replace(scenario.sensor, mounting=mounting, frame_id=name, field_of_view=pi, beams=180)  # type: ignore[arg-type]
        scenario = replace(scenario, seed=9, duration_s=20.0, sensor=sensor, scan_offset_s=offset)
        record(scenario, folder / f"{name}.mcap")
        parts[name] = open_log(folder / f"{name}.mcap")
    rear = [event for event in parts["rear"].events() if isinstance(event, Scan)]
    events = sorted([*parts["front"].events(), *rear], key=lambda event: event.stamp_ns)
    return write(folder / "both.mcap", parts["front"], events, REAR)


def write(path: Path, log: Log, events: Sequence[Event], T_base_rear: Pose2 | None) -> Path:
    """Events, map and start of a log, and a rear laser with the declared mounting (None: not declared)."""
    start = log.initial_pose()[1]
    links = [("base_link", "front", FRONT)] + ([] if T_base_rear is None else [("base_link", "rear", T_base_rear)])
    with LogWriter(path) as writer:
        writer.metadata("hsloc.initial_pose", {"x": repr(start.x), "y": repr(start.y), "theta": repr(start.theta)})
        writer.transforms(0, links, static=True)
        writer.occupancy_grid(log.map(), 0)  # type: ignore[arg-type]
        for event in events:
            if isinstance(event, Scan):
                writer.scan(event, topic=f"/{event.frame_id}")
            elif isinstance(event, Odometry):
                writer.odometry(event.stamp_ns, event.T_odom_base)
            elif isinstance(event, Truth):
                writer.odometry(event.stamp_ns, event.T_map_base, topic="/ground_truth", frame_id="map")
    return path


def test_scans_of_all_topics_come_in_order_with_their_own_mounting(log: Path) -> None:
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


def error(log: Path, topics: str, mode: str) -> tuple[float, Result]:
    """RMSE of APE (m) and the result."""
    result = run(RunRequest(logs=(log,), read=ReadOptions(scan_topic=topics), mode=mode))
    alignment = "none" if mode == "localise" else "se2"
    return evaluate(result.trajectory, result.reference, alignment=alignment).ape.trans_part.rmse, result  # type: ignore[arg-type]


def test_both_lasers_are_matched_as_one_cloud_and_are_better_than_either(log: Path) -> None:
    alone = [error(log, topic, "localise")[0] for topic in ("/front", "/rear")]
    both, result = error(log, "/front,/rear", "localise")
    assert both < min(alone)
    assert len(result.diagnostics) == 401
    held = [reason == HELD for reason in result.diagnostics.reason]
    # The first scan comes before the other laser is known of; then each second one carries the one before.
    assert held == [False, *([True, False] * 200)]
    assert "matched" in result.diagnostics.status


def test_a_map_of_both_lasers_holds_the_beams_of_both(log: Path) -> None:
    result = error(log, "/front,/rear", "slam")[1]
    mounted = {tuple(np.round(row[:3], 6)) for row in result.mapping.state.scans.geometry}
    assert mounted == {(0.3, 0.0, 0.0), (-0.3, 0.05, round(pi, 6))}
    stamps = result.mapping.keyscan_stamps_ns
    assert (np.diff(stamps) > 0).all()
    assert evaluate(result.trajectory, result.reference, alignment="se2").ape.trans_part.max < 0.03  # type: ignore[arg-type]


def test_the_command_takes_the_flag_twice_or_commas(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(log), "--scan-topic", "/front", "--scan-topic", "/rear", "--json"]) == 0
    twice = json.loads(capsys.readouterr().out)
    assert main(["info", str(log), "--scan-topic=/front,/rear", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == twice
    assert [laser["topic"] for laser in twice["lasers"]] == ["/front", "/rear"]
    assert twice["events"]["scan"] == 401
    assert main(["info", str(log), "--scan-topic=/front,/rear"]) == 0
    assert "/rear: x -0.300 m, y 0.050 m, yaw 3.1416 rad (/tf_static)" in capsys.readouterr().out


def test_several_lasers_need_an_option(log: Path) -> None:
    with pytest.raises(TopicError, match=r"--scan-topic /front, or take all with --scan-topic /front,/rear"):
        open_log(log)
    with pytest.raises(TopicError, match="no topic /left"):
        open_log(log, ReadOptions(scan_topic="/front,/left"))


def test_a_mounting_by_hand_is_for_all_and_reported(log: Path) -> None:
    summary = open_log(log, replace(BOTH, laser_pose=Pose2(1.0, 0.0, 0.0))).summary
    assert [laser.T_base_laser.x for laser in summary.lasers] == [1.0, 1.0]
    assert "laser_pose_shared" in [warning.code for warning in summary.warnings]


@pytest.mark.parametrize(
    ("T_base_rear", "expected"),
    [
        (REAR, []),
        (
            Pose2(-0.3, 0.05, pi - 0.1),
            [r"the laser rear does not fit front: .* states -0\.30, 0\.05 m, 174\.3 deg, by the map"],
        ),
        (
            Pose2(-0.05, 0.05, pi),
            [r"the laser rear does not fit front: .* by the map it is at about -0\.(29|30|31),"],
        ),
        (
            Pose2(-0.3, 0.05, pi / 2),
            [r"of the points of the laser rear lie at a wall of the map, but (9\d|100) % of those"],
        ),
        (
            None,
            [
                "no transform from base_link to rear",
                r"the laser of /rear looks backwards .* --laser-pose=0.000,0.000,-?3.14",
                "of the points of the laser rear lie at a wall",
            ],
        ),
    ],
)
def test_a_laser_that_is_not_mounted_as_declared_is_reported(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], T_base_rear: Pose2 | None, expected: list[str]
) -> None:
    opened = open_log(log, BOTH)
    path = write(tmp_path / "told.mcap", opened, list(opened.events()), T_base_rear)
    options = ["--scan-topic=/front,/rear", "--out", str(tmp_path / "out"), "--json"]
    assert main(["replay", str(path), *options]) == 0
    captured = capsys.readouterr()
    warnings = [line for line in captured.err.splitlines() if line.startswith("hsloc: warning: ")]
    assert len(warnings) == len(expected)
    for line, pattern in zip(warnings, expected, strict=True):
        assert re.search(pattern, line)
    assert [
        f"hsloc: warning: {each['text']}; {each['remedy']}" for each in json.loads(captured.out)["warnings"]
    ] == warnings
