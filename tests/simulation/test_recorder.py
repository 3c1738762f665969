"""The file: every topic, the same bytes, nothing left behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from mcap.reader import make_reader

from hsloc.errors import OutputError
from hsloc.log import open_log
from hsloc.model import Odometry, Pose2, Scan, Truth
from hsloc.simulation.built_in import built_in
from hsloc.simulation.presets import SCENARIOS
from hsloc.simulation.recorder import Recording, record
from hsloc.simulation.scenario import Kidnap, Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import Tick, simulate

if TYPE_CHECKING:
    from pathlib import Path

SHORT = replace(SCENARIOS["kidnapped"], duration_s=4.0, kidnaps=(Kidnap(at_s=2.0, skip_s=10.0),))
"""Laser upside down and not straight, 25 Hz odometry, and a jump."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Recording]:
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    return path, record(SHORT, path)


def test_topics_types_and_counts(recorded: tuple[Path, Recording]) -> None:
    path, recording = recorded
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        counts = {
            summary.channels[key].topic: (summary.schemas[summary.channels[key].schema_id].name, count)
            for key, count in summary.statistics.channel_message_counts.items()
        }
        assert reader.get_header().profile == "ros2"
    assert counts == {
        "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
        "/map": ("nav_msgs/msg/OccupancyGrid", 1),
        "/tf": ("tf2_msgs/msg/TFMessage", 101),
        "/odom": ("nav_msgs/msg/Odometry", 101),
        "/ground_truth": ("nav_msgs/msg/Odometry", 101),
        "/scan": ("sensor_msgs/msg/LaserScan", 41),
    }
    assert (recording.odometry, recording.scans, recording.seconds) == (101, 41, pytest.approx(4.0))  # type: ignore[comparison-overlap]
    assert recording.size == path.stat().st_size


def test_what_is_read_is_what_was_simulated(recorded: tuple[Path, Recording]) -> None:
    """Also through an upside-down mounting: the reader turns back what the recorder wrote as the laser sees it."""
    path, _ = recorded
    simulated = list(simulate(SHORT, built_in("office")))
    ticks = [item for item in simulated if isinstance(item, Tick)]
    scans = [item for item in simulated if isinstance(item, Scan)]
    events = list(open_log(path).events())
    truths, odometry = ([e for e in events if isinstance(e, kind)] for kind in (Truth, Odometry))
    for tick, truth, odom in zip(ticks, truths, odometry, strict=True):
        assert tick.stamp_ns == truth.stamp_ns == odom.stamp_ns
        assert tick.T_map_base.distance(truth.T_map_base) == 0.0
        assert tick.T_odom_base.distance(odom.T_odom_base) == 0.0
        assert truth.T_map_base.theta == pytest.approx(tick.T_map_base.theta, abs=1e-12)
        np.testing.assert_array_equal(tick.covariance, odom.covariance)
    for written, read in zip(scans, [e for e in events if isinstance(e, Scan)], strict=True):
        assert written.stamp_ns == read.stamp_ns
        np.testing.assert_array_equal(written.ranges, read.ranges)
        np.testing.assert_allclose(written.points_base(), read.points_base(), atol=1e-9)


def test_the_log_holds_its_map_its_start_and_its_scenario(recorded: tuple[Path, Recording]) -> None:
    path, recording = recorded
    log = open_log(path)
    grid, world = log.map(), built_in("office")
    np.testing.assert_array_equal(grid.cells, world.occupancy_grid(0.05).cells)
    assert log.initial_pose() == (SHORT.start_stamp_ns, world.start())
    assert recording.start == world.start()
    metadata = log.metadata()["hsloc.scenario"]
    assert Scenario.from_dict(json.loads(metadata["scenario"])) == SHORT
    assert metadata["seed"] == "0"
    assert metadata["world_sha256"] == world.fingerprint()


def test_the_jump_of_a_kidnapping_is_not_driven(recorded: tuple[Path, Recording]) -> None:
    assert recorded[1].metres < 3.0


def test_points_travel_with_the_log(tmp_path: Path) -> None:
    path = tmp_path / "paper.mcap"
    record(replace(SCENARIOS["paper"], duration_s=0.5), path)
    with path.open("rb") as stream:
        (attachment,) = make_reader(stream).iter_attachments()
    rows = np.array([line.split(b",") for line in attachment.data.splitlines()[1:]], dtype=float)
    np.testing.assert_array_equal(rows, built_in("paper").points)


def test_same_seed_same_bytes_whatever_the_threads_and_the_day(
    recorded: tuple[Path, Recording], tmp_path: Path
) -> None:
    path, recording = recorded
    program = (
        "import json, sys; from hsloc.simulation.recorder import record;"
        "from hsloc.simulation.scenario import Scenario;"
        "print(record(Scenario.from_dict(json.loads(sys.argv[1])), sys.argv[2]).sha256)"
    )
    for threads in "12":
        again = tmp_path / f"{threads}.mcap"
        done = subprocess.run(
            [sys.executable, "-c", program, json.dumps(SHORT.to_dict()), again],
            env=os.environ | {"NUMBA_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "TZ": "Asia/Tokyo"},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.strip() == recording.sha256
        assert again.read_bytes() == path.read_bytes()


def test_another_seed_gives_other_bytes(recorded: tuple[Path, Recording], tmp_path: Path) -> None:
    assert record(replace(SHORT, seed=1), tmp_path / "x.mcap").sha256 != recorded[1].sha256


def test_an_existing_file_is_only_replaced_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already"):
        record(SHORT, path)
    assert path.read_bytes() == b"precious"
    record(replace(SHORT, duration_s=0.2), path, overwrite=True)
    assert path.stat().st_size > 1000


def test_an_interrupted_recording_leaves_nothing(tmp_path: Path) -> None:
    def interrupt(seconds: float, metres: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(SHORT, tmp_path / "x.mcap", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_the_drive() -> None:
    """Ten times as long, the simulation holds no more: it is a stream."""
    import tracemalloc

    peaks = []
    for seconds in (4.0, 40.0):
        scenario = replace(SCENARIOS["corridor-loop"], duration_s=seconds, sensor=Lidar(beams=5))
        world = built_in(scenario.world)
        tracemalloc.start()
        for _ in simulate(scenario, world):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 20_000


def test_progress_is_reported_in_seconds_and_metres(tmp_path: Path) -> None:
    reported = []
    record(SHORT, tmp_path / "x.mcap", progress=lambda seconds, metres: reported.append((seconds, metres)))
    assert [round(seconds) for seconds, _ in reported] == [1, 2, 3, 4]
    assert reported[0][1] < 0.01  # it stands still at first
    assert isinstance(built_in("office").start(), Pose2)
