"""CARMEN and Wean logs: beams, stamps, special ranges and odometry, to the last line."""

from __future__ import annotations

import gzip
from math import inf, nan, pi
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_builders import SECOND
from paths import DATA

from hsloc.errors import HslocError, LogFormatError, TopicError
from hsloc.log.range_codes import RangeRule
from hsloc.log.reader import open_log
from hsloc.log.summary import Losses, ReadOptions
from hsloc.log.text.formats import beam_angles
from hsloc.log.text.line_format import stamp_ns
from hsloc.model import Odometry, Pose2, Scan, Truth
from hsloc.model.calibration import Calibration, LidarCalibration

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def odom(stamp: str, x: float = 0.0) -> str:
    return f"ODOM {x} 2.0 0.5 0 0 0 {stamp} host 1.5"


def flaser(stamp: str, ranges: Sequence[float], x: float = 0.0) -> str:
    values = " ".join(str(r) for r in ranges)
    return f"FLASER {len(ranges)} {values} 9 9 9 {x} 2.0 0.5 {stamp} host 1.5"


def write(path: Path, lines: Sequence[str]) -> Path:
    text = "# a comment\n\nPARAM robot_width 1\n" + "\n".join(lines) + "\n"
    if path.suffix == ".gz":
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("count", "last", "increment"),
    [(180, 89.0, 1.0), (181, 90.0, 1.0), (360, 89.5, 0.5), (361, 90.0, 0.5)],
)
def test_beams_over_180_degrees(count: int, last: float, increment: float) -> None:
    angle_min, step = beam_angles(count)
    assert angle_min == -pi / 2
    assert np.degrees(step) == pytest.approx(increment)
    assert np.degrees(angle_min + (count - 1) * step) == pytest.approx(last)


@pytest.mark.parametrize("name", ["log.clf", "log.clf.gz", "log.txt"])
def test_each_line_is_an_event_in_the_order_of_the_file(tmp_path: Path, name: str) -> None:
    lines = [
        odom("976052857.337530", 1.0),
        odom("976052857.348896", 2.0),
        flaser("976052857.348896", [1.0] * 180),
        odom("976052857.100000", 3.0),
        "SYNC something else",
    ]
    log = open_log(write(tmp_path / name, lines))
    first, second, scan, third = log.events()
    assert isinstance(first, Odometry)
    assert isinstance(second, Odometry)
    assert isinstance(scan, Scan)
    assert isinstance(third, Odometry)
    assert first.stamp_ns == 976_052_857_337_530_000
    assert first.T_odom_base == Pose2(1.0, 2.0, 0.5)
    assert scan.stamp_ns == second.stamp_ns == 976_052_857_348_896_000
    assert (third.stamp_ns, third.T_odom_base.x) == (976_052_857_100_000_000, 3.0)
    assert log.losses.stamps_backwards == {"ODOM": 1}
    assert not log.losses.data_lost
    summary = log.summary
    assert (summary.format, summary.scan_topic, summary.odom_topic) == ("CARMEN", "FLASER", "ODOM")
    assert (summary.order, summary.extrinsics) == ("log", "identity")
    assert "--laser-pose" in summary.warnings[0].remedy


def test_the_laser_pose_may_be_given(tmp_path: Path) -> None:
    path = write(tmp_path / "log.clf", [odom("1"), flaser("1", [1.0] * 181)])
    log = open_log(path, ReadOptions(laser_pose=Pose2(0.1, 0, 0)))
    _, scan = log.events()
    assert isinstance(scan, Scan)
    assert scan.T_base_laser == Pose2(0.1, 0, 0)
    assert log.summary.warnings == ()


def test_the_calibration_of_another_lidar_does_not_count(tmp_path: Path) -> None:
    path = write(tmp_path / "log.clf", [odom("1"), flaser("1", [1.0] * 181)])
    other, own = LidarCalibration(Pose2(1, 0, 0), 2.0), LidarCalibration(Pose2(0.1, 0, 0), 0.5)
    both = open_log(path, ReadOptions(calibration=Calibration(lidars=(("/scan", other), ("/FLASER", own)))))
    _, scan = both.events()
    assert isinstance(scan, Scan)
    assert (scan.T_base_laser, scan.stamp_ns) == (Pose2(0.1, 0, 0), 3 * SECOND // 2)
    assert both.summary.extrinsics == "calibration"
    alone = open_log(path, ReadOptions(calibration=Calibration(lidars=(("/scan", other),)), time_offset="FLASER=0.25"))
    _, scan = alone.events()
    assert isinstance(scan, Scan)
    assert (scan.T_base_laser, scan.stamp_ns) == (Pose2(), 5 * SECOND // 4)
    assert alone.summary.extrinsics == "identity"


@pytest.mark.parametrize(
    ("offset", "order"),
    [(-1.2, "SOSOOO"), (-0.2, "OSOSOO"), (0.0, "OOSOSO"), (1.2, "OOOSOS")],
)
def test_scans_with_an_offset_are_in_the_order_of_their_corrected_stamps(
    tmp_path: Path, offset: float, order: str
) -> None:
    """Odometry at 1, 2, 3 and 4 s, scans at 2 and 3 s after the odometry of the same stamp."""
    lines = [odom("1"), odom("2"), flaser("2", [1.0] * 181), odom("3"), flaser("3", [1.0] * 181), odom("4")]
    log = open_log(write(tmp_path / "log.clf", lines), ReadOptions(time_offset=f"FLASER={offset}"))
    events = list(log.events())
    assert "".join("S" if isinstance(event, Scan) else "O" for event in events) == order
    if offset:
        assert [event.stamp_ns for event in events] == sorted(event.stamp_ns for event in events)


def test_odometry_with_an_offset_takes_its_place_among_the_scans(tmp_path: Path) -> None:
    path = write(tmp_path / "log.clf", [odom("1"), odom("2"), flaser("2.1", [1.0] * 181), odom("3")])
    events = list(open_log(path, ReadOptions(time_offset="ODOM=0.25")).events())
    assert [event.stamp_ns / SECOND for event in events] == [1.25, 2.1, 2.25, 3.25]
    with pytest.raises(TopicError, match="a text log has no fields to override; leave out --scan-fix range_max=12"):
        open_log(path, ReadOptions(scan_fix="range_max=12"))
    with pytest.raises(TopicError, match="no lines odom that --time-offset could move; it has FLASER, ODOM"):
        open_log(path, ReadOptions(time_offset="/odom=0.25"))


def test_laser_lines_give_odometry_only_where_nothing_else_does(tmp_path: Path) -> None:
    path = write(tmp_path / "log.clf", [flaser("1", [1.0] * 180, x=1.0), flaser("2", [1.0] * 180, x=2.0)])
    log = open_log(path)
    events = list(log.events())
    assert [type(event) for event in events] == [Odometry, Scan, Odometry, Scan]
    assert [event.T_odom_base.x for event in events if isinstance(event, Odometry)] == [1.0, 2.0]
    assert log.summary.odom_topic == "FLASER"


def test_robotlaser_lines_state_angles_limit_and_mounting(tmp_path: Path) -> None:
    line = (
        "ROBOTLASER1 0 -1.570796 3.141593 0.017453 50.0 0.010000 0 3 1.0 50.0 60.0 2 7 8 "
        "1.200000 2.000000 0.000000 1.000000 2.000000 0.000000 0 0 0 0 0 1234.5 host 1.0"
    )
    log = open_log(write(tmp_path / "log.clf", [line]))
    odometry, scan = log.events()
    assert isinstance(odometry, Odometry)
    assert isinstance(scan, Scan)
    assert odometry.T_odom_base == Pose2(1, 2, 0)
    assert scan.stamp_ns == 1234 * SECOND + SECOND // 2
    assert (scan.angle_min, scan.angle_increment, scan.range_max) == (-1.570796, 0.017453, 50.0)
    assert scan.ranges.tolist() == [1.0, inf, inf]
    assert scan.intensities is not None
    assert scan.intensities.tolist() == [7.0, 8.0]
    assert scan.T_base_laser == Pose2(0.2, 0, 0)
    assert log.summary.extrinsics == "file format"


def test_true_poses_are_truth(tmp_path: Path) -> None:
    lines = [odom("1"), "TRUEPOS 3 4 0.5 0 0 0 1.0 host 1.0", flaser("1", [1.0] * 180)]
    log = open_log(write(tmp_path / "log.clf", lines))
    truth = next(event for event in log.events() if isinstance(event, Truth))
    assert truth.T_map_base == Pose2(3, 4, 0.5)
    assert log.summary.truth_topic == "TRUEPOS"


@pytest.mark.parametrize("room", [64 << 20, 1500])
def test_broken_lines_are_counted_and_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """The lines of a log are kept, or read each time if they take too much memory: that makes no difference."""
    monkeypatch.setattr("hsloc.log.text.source.MAX_KEPT_BYTES", room)
    lines = [
        odom("1"),
        flaser("1", [1.0] * 180),
        "ODOM 1 2",
        odom("nonsense"),
        odom("1e99"),
        "ODOM nan 0 0 0 0 0 1 h 1",
        "FLASER 180 1 2 3",
        "FLASER -5 1 2 3 4 5 6 1 h 1",
        "FLASER 99999999999 1",
        flaser("1", [1.0] * 180).replace("1.0", "abc", 1),
    ]
    path = write(tmp_path / "log.clf", lines)
    log = open_log(path)
    for _ in range(2):
        assert len(list(log.events())) == 2
        assert log.losses.undecodable_messages == {"ODOM": 4, "FLASER": 4}
        assert len(log.losses.reasons) == 8
        assert log.losses.data_lost
    assert log.verify().undecodable_messages == log.losses.undecodable_messages
    path.write_text(odom("1") + "\n")
    assert len(list(log.events())) == (2 if room > 1500 else 1)


def test_a_gzip_that_ends_too_early(tmp_path: Path) -> None:
    path = write(tmp_path / "log.clf.gz", [odom(str(n), n) for n in range(5000)] + [flaser("1", [1.0] * 180)] * 50)
    path.write_bytes(path.read_bytes()[:-4000])
    log = open_log(path, ReadOptions(require_scan=False))
    assert 0 < len(list(log.events())) < 5050
    assert log.losses.truncated_files == 1
    assert log.losses.data_lost


def test_what_is_missing_is_reported(tmp_path: Path) -> None:
    path = write(tmp_path / "log.clf", [odom("1")])
    with pytest.raises(TopicError, match="no laser lines in this CARMEN log"):
        open_log(path)
    path = write(tmp_path / "log.clf", [odom("1"), flaser("1", [1.0] * 180)])
    with pytest.raises(TopicError, match="a text log has no topics; leave out --scan-topic /scan"):
        open_log(path, ReadOptions(scan_topic="/scan"))
    with pytest.raises(LogFormatError, match="one at a time"):
        open_log([path, path])


# Special ranges


def learned(*scans: Sequence[float]) -> RangeRule:
    rule = RangeRule()
    for scan in scans:
        rule.learn(np.array(scan, dtype=np.float32))
    return rule


def test_codes_of_the_scanner_are_no_ranges() -> None:
    scan = [5.0, 81.82, 81.83, 81.87, 81.91, 0.0]
    rule = learned(scan)
    found = rule.apply(np.array(scan, dtype=np.float32))
    np.testing.assert_array_equal(found, np.array([5.0, 81.82, inf, nan, nan, 0.0], dtype=np.float32))
    assert rule.clip is None
    assert rule.range_max == pytest.approx(81.83)


def test_a_pile_of_readings_at_whole_metres_is_a_clipping_value() -> None:
    rule = learned([50.0, 50.0, 3.0], [50.0, 49.99, 81.83])
    assert (rule.clip, rule.range_max) == (50.0, 50.0)
    found = rule.apply(np.array([50.0, 49.99, 81.83, 81.9], dtype=np.float32))
    np.testing.assert_array_equal(found, np.array([inf, 49.99, inf, nan], dtype=np.float32))


@pytest.mark.parametrize("scan", [[50.0, 50.0, 1.0], [26.23] * 10, [1.0] * 10])
def test_two_far_readings_or_an_odd_number_are_none(scan: list[float]) -> None:
    rule = learned(scan)
    assert rule.clip is None
    np.testing.assert_array_equal(rule.apply(np.array(scan, dtype=np.float32)), np.array(scan, dtype=np.float32))


def test_stamps_are_exact() -> None:
    assert stamp_ns("976052857.337530") == 976_052_857_337_530_000
    assert stamp_ns("1663967375.548411329") == 1_663_967_375_548_411_329
    assert stamp_ns("-0.5") == -SECOND // 2


# Wean


def test_wean_lines_in_centimetres(tmp_path: Path) -> None:
    ranges = ["100"] * 177 + ["8183", "8191", "8187"]
    lines = [
        "O 100.0 200.0 0.5 0.025",
        f"L 110.0 200.0 0.0 135.0 200.0 0.0 {' '.join(ranges)} 0.5",
        "L 1 2 3",
    ]
    log = open_log(write(tmp_path / "robot.log", lines))
    # The O line has the same path: it is not read beside L lines.
    odometry, scan = log.events()
    assert isinstance(odometry, Odometry)
    assert isinstance(scan, Scan)
    np.testing.assert_allclose(odometry.T_odom_base.to_array(), (1.1, 2.0, 0.0))
    assert (odometry.stamp_ns, scan.stamp_ns) == (SECOND // 2, SECOND // 2)
    assert log.summary.odom_topic == "L"
    (alone,) = open_log(write(tmp_path / "o.log", lines[:1]), ReadOptions(require_scan=False)).events()
    assert isinstance(alone, Odometry)
    assert alone.T_odom_base == Pose2(1.0, 2.0, 0.5)
    assert scan.T_base_laser == Pose2(0.25, 0.0, 0.0)
    assert scan.ranges[:177].tolist() == [1.0] * 177
    assert np.isposinf(scan.ranges[177])
    assert np.isnan(scan.ranges[178:]).all()
    assert log.summary.extrinsics == "file format"
    assert log.losses.undecodable_messages == {"L": 1}


@settings(max_examples=150)
@given(data=st.data())
def test_damaged_text_raises_nothing_but_our_errors(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    lines = [odom("1"), flaser("1", [1.0] * 20), odom("2"), flaser("2", [2.0] * 20)]
    path = write(tmp_path_factory.mktemp("text") / data.draw(st.sampled_from(["a.clf", "a.gz"])), lines)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    message = ""
    try:
        log = open_log(path, ReadOptions(require_scan=False, require_odometry=False))
        count = sum(1 for _ in log.events())
    except HslocError as error:
        message, count = str(error), 0
    assert count <= 8
    assert "\n" not in message


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "odometry", "scans", "backwards"),
    [
        ("intel/intel.clf.gz", 13631, 5437, {"ODOM": 1294, "FLASER": 425}),
        ("aces/aces.clf.gz", 7374, 440, {}),
        ("wean/robotdata1.log.gz", 713, 713, {}),
        ("wean/robotdata3.log.gz", 1241, 1241, {}),
    ],
)
def test_the_classic_logs(name: str, odometry: int, scans: int, backwards: dict[str, int]) -> None:
    if not (DATA / name).exists():
        pytest.skip(f"no {DATA / name}; set HSLOC_DATA")
    log = open_log(DATA / name)
    events = list(log.events())
    assert sum(isinstance(event, Odometry) for event in events) == odometry
    assert sum(isinstance(event, Scan) for event in events) == scans
    assert log.losses == Losses(stamps_backwards=log.losses.stamps_backwards)
    assert log.losses.stamps_backwards == backwards
    readings = np.concatenate([scan.ranges for scan in events if isinstance(scan, Scan)])
    assert readings[np.isfinite(readings)].max() < 54.0
    # Log 3 has codes of "no valid value" alone, the others "more than the maximum", or a clipping value.
    no_return, invalid = np.isposinf(readings).mean(), np.isnan(readings).mean()
    assert (no_return > 0.005, invalid > 0.015) == ((False, True) if "robotdata3" in name else (True, False))
    if name.startswith("wean"):
        assert log.summary.T_base_laser == Pose2(0.25, 0.0, 0.0)
    if name.startswith("intel"):
        # Each scan follows the odometry that was read with it, whatever its stamp is.
        last = None
        for event in events:
            if isinstance(event, Scan):
                assert last is not None
                assert last.stamp_ns == event.stamp_ns
            elif isinstance(event, Odometry):
                last = event


def test_a_gzip_that_unpacks_to_a_thousand_times_its_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.log.gz"
    with gzip.open(path, "wb") as file:
        file.write((odom("1.0") + "\n").encode())
        block = b"#" * 999 + b"\n"
        for _ in range(100):
            file.write(block * 1000)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(LogFormatError, match="unpacks to more than 100 times its size"):
        list(open_log(path).events())


@pytest.mark.parametrize("lines", [9, 10, 30])
def test_a_clock_that_was_set_back_is_found_once_enough_lines_agree(tmp_path: Path, lines: int) -> None:
    stamps = [100.0 + 0.1 * number for number in range(30)] + [100.0 + 0.1 * number for number in range(lines)]
    stamps[15] -= 0.9  # a single line, as in Intel's log
    path = write(tmp_path / "set.log", [odom(f"{stamp:.6f}", 1.0) for stamp in stamps])
    log = open_log(path, ReadOptions(require_scan=False))
    assert len(list(log.events())) == len(stamps)
    assert log.losses.clock_steps == ({} if lines < 10 else {"ODOM": [(-2_900_000_000, 102_900_000_000)]})
    assert all("--stamps" not in warning.remedy for warning in log.losses.step_warnings(log.summary))
