"""Any log as MCAP: the same events from both, and nothing half-written."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from log_builders import SECOND, START, chunk_data_at, chunks_of, describe, flipped, make_scan, write_run
from mcap.reader import make_reader
from paths import DATA

from hsloc.errors import LogFormatError
from hsloc.log.convert import convert_log
from hsloc.log.reader import open_log
from hsloc.log.summary import Losses, ReadOptions
from hsloc.log.transforms import Transform3
from hsloc.log.writer import LogWriter
from hsloc.model import OccupancyGrid, Odometry, Pose2, Scan

if TYPE_CHECKING:
    from pathlib import Path

BACKWARDS = [0.0, 0.2, 0.4, 1.3, 0.6, 0.8, 1.0, 1.4, 1.6]


@pytest.fixture
def carmen(tmp_path: Path) -> Path:
    """Stamps run backwards, and not every odometry line has a scan."""
    lines = []
    for number, stamp in enumerate(BACKWARDS):
        lines.append(f"ODOM {number} 0 0 0 0 0 {100 + stamp} h 1")
        if number % 3 != 1:
            ranges = " ".join(["2.5"] * 179 + ["81.83"])
            lines.append(f"FLASER 180 {ranges} 0 0 0 {number} 0 0 {100 + stamp} h 1")
    path = tmp_path / "log.clf"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_same_events_from_text_and_from_its_mcap(tmp_path: Path, carmen: Path) -> None:
    log = open_log(carmen, ReadOptions(laser_pose=Pose2(0.1, -0.2, 0.3)))
    conversion = convert_log(log, tmp_path / "log.mcap")
    assert (conversion.scans, conversion.odometry, conversion.truths) == (6, 9, 0)
    assert conversion.stamps_backwards == 2
    assert not conversion.losses.data_lost
    converted = open_log(tmp_path / "log.mcap")
    first, second = list(log.events()), list(converted.events())
    assert [describe(event) for event in first] == [describe(event) for event in second]
    for a, b in zip(first, second, strict=True):
        if isinstance(a, Scan):
            assert isinstance(b, Scan)
            np.testing.assert_array_equal(a.ranges, b.ranges)
            assert b.angle_min == pytest.approx(a.angle_min)
            assert b.angle_increment == pytest.approx(a.angle_increment)
            assert b.range_max == pytest.approx(a.range_max)
            np.testing.assert_allclose(b.T_base_laser.to_array(), (0.1, -0.2, 0.3), atol=1e-12)
        elif isinstance(a, Odometry):
            assert isinstance(b, Odometry)
            np.testing.assert_allclose(a.T_odom_base.to_array(), b.T_odom_base.to_array(), atol=1e-12)
    assert converted.summary.order == "log"
    assert converted.summary.extrinsics == "/tf_static"
    assert converted.losses.stamps_backwards == {"/odom": 1, "/scan": 1}
    for window in ((0.5, None), (None, 1.0), (0.3, 1.35)):
        options = ReadOptions(start_s=window[0], end_s=window[1])
        expected = [describe(event) for event in open_log(carmen, options).events()]
        assert [describe(event) for event in open_log(tmp_path / "log.mcap", options).events()] == expected
        assert 0 < len(expected) < len(first)


def test_the_file_is_in_order_though_its_stamps_are_not(tmp_path: Path, carmen: Path) -> None:
    convert_log(open_log(carmen), tmp_path / "log.mcap")
    with (tmp_path / "log.mcap").open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_a_second_conversion_changes_nothing(tmp_path: Path, carmen: Path) -> None:
    convert_log(open_log(carmen), tmp_path / "first.mcap")
    convert_log(open_log(carmen), tmp_path / "again.mcap")
    assert (tmp_path / "first.mcap").read_bytes() == (tmp_path / "again.mcap").read_bytes()
    convert_log(open_log(tmp_path / "first.mcap"), tmp_path / "second.mcap")
    first = [describe(event) for event in open_log(tmp_path / "first.mcap").events()]
    assert [describe(event) for event in open_log(tmp_path / "second.mcap").events()] == first


def test_map_truth_start_and_an_upside_down_laser_come_along(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "in.mcap") as log:
        log.metadata("hsloc.initial_pose", {"x": "1", "y": "2", "theta": "0.5"})
        log.transforms(START, [("base", "laser", Transform3((0.3, 0, 1), (1, 0, 0, 0)))], static=True)
        log.occupancy_grid(OccupancyGrid(np.array([[0, 100]], np.int8), 0.05), START)
        for number in range(5):
            stamp = START + number * SECOND
            log.odometry(stamp, Pose2(number), child_frame_id="base", covariance=np.diag((0.1, 0.2, 0.3)))
            log.odometry(stamp, Pose2(number, 1), topic="/ground_truth", frame_id="map", child_frame_id="base")
            log.scan(make_scan(stamp, number))
    source = open_log(tmp_path / "in.mcap")
    conversion = convert_log(source, tmp_path / "out.mcap")
    assert (conversion.truths, conversion.has_map) == (5, True)
    converted = open_log(tmp_path / "out.mcap")
    assert [describe(event) for event in converted.events()] == [describe(event) for event in source.events()]
    a, b = (next(e for e in log.events() if isinstance(e, Scan)) for log in (source, converted))
    np.testing.assert_allclose(a.points_base(), b.points_base(), atol=1e-6)
    assert b.angle_increment < 0.0
    assert converted.initial_pose() == source.initial_pose()
    grid = converted.map()
    assert grid is not None
    np.testing.assert_array_equal(grid.cells, [[0, 100]])
    odometry = next(e for e in converted.events() if isinstance(e, Odometry))
    assert odometry.covariance is not None
    assert converted.summary.truth_topic == "/ground_truth"


def test_a_log_without_events_leaves_nothing(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "in.mcap") as log:
        log.pose(START, Pose2())
    source = open_log(tmp_path / "in.mcap", ReadOptions(require_scan=False, require_odometry=False))
    with pytest.raises(LogFormatError, match="neither scans nor odometry"):
        convert_log(source, tmp_path / "out.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["in.mcap"]


def test_losses_of_the_input_are_reported(tmp_path: Path) -> None:
    path = write_run(tmp_path / "in.mcap", scans=200)
    data = path.read_bytes()
    path.write_bytes(flipped(data, chunk_data_at(data, chunks_of(data)[9]) + 30))
    conversion = convert_log(open_log(path), tmp_path / "out.mcap")
    assert conversion.losses.data_lost
    assert 180 < conversion.scans < 200


@pytest.mark.data
def test_the_intel_log(tmp_path: Path) -> None:
    source = DATA / "intel" / "intel.clf.gz"
    if not source.exists():
        pytest.skip(f"no {source}; set HSLOC_DATA")
    log = open_log(source)
    conversion = convert_log(log, tmp_path / "intel.mcap")
    assert (conversion.scans, conversion.odometry, conversion.stamps_backwards) == (5437, 13631, 1294 + 425)
    converted = open_log(tmp_path / "intel.mcap")
    assert [describe(event) for event in converted.events()] == [describe(event) for event in log.events()]
    assert converted.losses == Losses(stamps_backwards=converted.losses.stamps_backwards)
