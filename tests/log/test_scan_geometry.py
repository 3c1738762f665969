"""What is wrong with the scans of a topic is found from the first of them, and overridden by the user alone."""

from __future__ import annotations

from math import degrees, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsloc.errors import ConfigError
from hsloc.log.messages.decode import ScanMessage
from hsloc.log.session.scan_geometry import ScanFixes, TurnAssembler, survey

TURN = 2.0 * pi
SECOND = 1_000_000_000


def scans(
    count: int = 30,
    *,
    beams: int = 360,
    low: float = -pi,
    increment: float = TURN / 360,
    high: float | None = None,
    step: float = 0.1 / 360,
    range_max: float = 12.0,
    far: float = 0.0,
    code: float | None = None,
) -> list[ScanMessage]:
    """Scans at 10 Hz; a part `far` of the readings lies beyond range_max, or is the code for no return."""
    rng = np.random.default_rng(1)
    found = []
    for number in range(count):
        ranges = rng.uniform(0.5, 0.95 * range_max, beams)
        beyond = rng.random(beams) < far
        ranges[beyond] = rng.uniform(1.05 * range_max, 2.0 * range_max, int(beyond.sum())) if code is None else code
        end = low + (beams - 1) * increment if high is None else high
        found.append(
            ScanMessage(
                number * SECOND // 10,
                "laser",
                low,
                increment,
                step,
                0.05,
                range_max,
                ranges.astype(np.float32),
                None,
                0.1,
                angle_max=end,
            )
        )
    return found


def codes(found: list[ScanMessage]) -> list[str]:
    return [problem.code for problem in survey(found).problems]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"high": pi},  # the last beam counted as if it closed the turn
        {"beams": 181, "low": -pi / 2, "increment": pi / 180},
        {"beams": 270, "low": 0.75 * pi, "increment": -1.5 * pi / 269},  # clockwise, as by angle_max
        {"low": 0.0},
        {"step": 0.0},
        {"far": 0.01},
        {"far": 0.4, "code": 65.533},  # what a driver writes for no return
        {"range_max": 450.0},
        {"beams": 721, "increment": TURN / 720, "step": 0.1 / 720},
        {"step": -0.1 / 360},
    ],
)
def test_sound_scans_raise_no_word(changes: dict[str, float]) -> None:
    assert codes(scans(**changes)) == []  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "code", "flag"),
    [
        ({"increment": -TURN / 360, "high": pi}, "scan_angle_increment", "increment=negate"),
        ({"increment": TURN / 720, "high": pi}, "scan_angle_increment", "increment=angles"),
        ({"increment": TURN / 180, "high": pi}, "scan_angle_increment", "increment=angles"),
        ({"increment": TURN / 180}, "scan_angle_increment", "increment=0.0174533"),
        ({"low": -180.0, "increment": 1.0}, "scan_angle_unit", "angles=degrees"),
        ({"beams": 271, "low": -135.0, "increment": 1.0}, "scan_angle_unit", "angles=degrees"),
        ({"increment": 1.0, "high": pi}, "scan_angle_unit", "increment=angles"),
        ({"low": -180.0, "high": 179.0}, "scan_angle_unit", "angles=degrees,increment=angles"),
        ({"step": 0.1 / 360 / 1000}, "scan_time_increment", "time_increment=interval"),
        ({"step": 0.1 / 360 / 20}, "scan_time_increment", "time_increment=interval"),
        ({"step": 0.1 / 360 * 50}, "scan_time_increment", "time_increment=interval"),
        ({"far": 0.3}, "scan_range_max", "range_max="),
        ({"range_max": 12e3}, "scan_range_unit", "ranges=millimetres"),
    ],
)
def test_what_does_not_fit_is_named_with_the_flag(changes: dict[str, float], code: str, flag: str) -> None:
    (problem,) = survey(scans(**changes)).problems  # type: ignore[arg-type]
    assert problem.code == code
    assert flag in problem.remedy


def test_limits_and_ranges_of_another_unit_are_named_and_corrected() -> None:
    plain = scans(1)[0]
    scan = plain._replace(ranges=plain.ranges * 100, range_min=5.0, range_max=1200.0)
    assert codes([scan]) == ["scan_range_unit"]
    assert codes([ScanFixes.parse("ranges=centimetres").apply(scan, 0.1)]) == []
    near = plain._replace(range_min=50.0, range_max=12e3)
    assert codes([near]) == ["scan_range_min"]
    assert codes([ScanFixes.parse("range_min=0.05").apply(near, 0.1)]) == []
    # Limits may be in metres already.
    for limits in ((50.0, 12e3), (0.05, 12.0)):
        scan = plain._replace(ranges=plain.ranges * 1000, range_min=limits[0], range_max=limits[1])
        assert codes([scan]) == ["scan_range_unit"]
        fixed = ScanFixes.parse("ranges=millimetres").apply(scan, 0.1)
        np.testing.assert_allclose(fixed.ranges, plain.ranges, rtol=1e-6)
        assert (fixed.range_min, fixed.range_max) == (0.05, 12.0)


@pytest.mark.parametrize(
    ("changes", "fix"),
    [
        ({"increment": -TURN / 360, "high": pi - TURN / 360}, "increment=angles"),
        ({"increment": -TURN / 360, "high": pi - TURN / 360}, "increment=negate"),
        ({"low": -180.0, "increment": 1.0, "high": 179.0}, "angles=degrees"),
        ({"low": -180.0, "high": 179.0}, "angles=degrees,increment=angles"),
        ({"low": pi, "increment": -TURN / 360, "high": TURN / 360 - pi}, "angles=negate"),
        ({"step": 1e-9}, "time_increment=interval"),
    ],
)
def test_the_flag_makes_the_scan_what_it_should_be(changes: dict[str, float], fix: str) -> None:
    (right, *_), (wrong, *_) = scans(), scans(**changes)  # type: ignore[arg-type]
    fixed = ScanFixes.parse(fix).apply(wrong, 0.1)
    assert fixed.angle_min == pytest.approx(right.angle_min)
    assert fixed.angle_increment == pytest.approx(right.angle_increment)
    if "time" in fix:
        assert fixed.time_increment == pytest.approx(right.time_increment)
    assert codes([ScanFixes.parse(fix).apply(scan, 0.1) for scan in scans(**changes)]) == []  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "item", ["increment=", "range_max=-1", "range_max=nan", "speed=1", "angles=radians", "angles=3", "x"]
)
def test_a_wrong_flag_is_named(item: str) -> None:
    with pytest.raises(ConfigError, match=f"--scan-fix {item}"):
        ScanFixes.parse(item)


def in_segments(whole: list[ScanMessage], count: int) -> list[ScanMessage]:
    """Each scan as several messages, stamped when their first beam was measured."""
    found = []
    for scan in whole:
        size = len(scan.ranges) // count
        for number in range(count):
            ranges = scan.ranges[number * size : (number + 1) * size]
            low = scan.angle_min + number * size * scan.angle_increment
            stamp = scan.stamp_ns + round(number * size * scan.time_increment * 1e9)
            high = low + (size - 1) * scan.angle_increment
            found.append(scan._replace(stamp_ns=stamp, angle_min=low, ranges=ranges, angle_max=high))
    return found


@settings(max_examples=40)
@given(count=st.sampled_from([3, 4, 6, 12]), skipped=st.integers(0, 11), clockwise=st.booleans())
def test_segments_become_turns(count: int, skipped: int, clockwise: bool) -> None:
    """Whatever segment a log begins with, each whole turn comes out as the scan that it was made of."""
    whole = scans(12, low=pi, increment=-TURN / 360) if clockwise else scans(12)
    parts = in_segments(whole, count)[skipped % count :]
    found = survey(parts)
    assert found.segments == count
    assert found.interval_s == pytest.approx(0.1, rel=0.05)
    assembler = TurnAssembler(found)
    turns = [turn for part in parts for turn in assembler.add(part)]
    complete = [turn for turn in turns if len(turn.ranges) == 360]
    assert len(complete) >= 11
    by_stamp = {scan.stamp_ns: scan for scan in whole}
    for turn in complete:
        scan = by_stamp[turn.stamp_ns]
        np.testing.assert_array_equal(turn.ranges, scan.ranges)
        assert turn.angle_min == scan.angle_min
        assert turn.time_increment == pytest.approx(scan.time_increment, rel=1e-3)


def test_segments_that_overlap_become_turns() -> None:
    whole = scans(6)
    parts = []
    for scan in whole:
        for number, part in enumerate(in_segments([scan], 6)):
            shared = 5 if number else 0
            begin = number * 60 - shared
            low = scan.angle_min + begin * scan.angle_increment
            parts.append(part._replace(ranges=scan.ranges[begin : begin + 60 + shared], angle_min=low))
    found = survey(parts)
    assert found.segments == 6
    assembler = TurnAssembler(found)
    turns = [turn for part in parts for turn in assembler.add(part)]
    assert [turn.ranges.tolist() for turn in turns] == [scan.ranges.tolist() for scan in whole]


def test_a_lost_segment_splits_a_turn_and_no_other() -> None:
    count = 12
    parts = in_segments(scans(6), count)
    found = survey(parts)
    del parts[count + 5]
    turns = [turn for part in parts for turn in TurnAssembler(found).add(part)]
    assert turns == []  # an assembler for each part never completes one
    assembler = TurnAssembler(found)
    lengths = [len(turn.ranges) for part in parts for turn in assembler.add(part)]
    assert sum(lengths) == sum(len(part.ranges) for part in parts)
    assert lengths.count(360) == 5


def test_scans_of_a_narrow_lidar_are_no_segments() -> None:
    assert survey(scans(beams=90, low=-pi / 4, step=0.0)).segments == 1


def test_degrees_are_degrees() -> None:
    scan = scans()[0]
    fixed = ScanFixes(degrees=True).apply(scan._replace(angle_min=degrees(scan.angle_min)), None)
    assert fixed.angle_min == pytest.approx(scan.angle_min)
