"""Codes for no return, found in readings of rooms: a wall is none, whatever its place."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_builders import START, make_scan

from hsloc.log import LogWriter, ReadOptions, open_log
from hsloc.log.range_codes import NoReturnCode
from hsloc.model import Pose2, Scan

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

INCREMENT = 2.0 * pi / 720
LIMITS = (0.05, 100.0)


def room(x: float, y: float, width: float, height: float, heading: float = 0.0) -> NDArray[np.float64]:
    """Ranges (720,) from a place in a rectangular room."""
    angles = heading + INCREMENT * np.arange(720) + 1e-4
    c, s = np.cos(angles), np.sin(angles)
    to_sides = np.where(c > 0.0, (width - x) / c, -x / c)
    return np.asarray(np.minimum(to_sides, np.where(s > 0.0, (height - y) / s, -y / s)))


def learned(scans: list[NDArray[np.float32]]) -> NoReturnCode:
    code = NoReturnCode()
    for ranges in scans:
        code.learn(ranges, INCREMENT, LIMITS)
    return code


@pytest.mark.parametrize(("low", "high"), [(50.0, 50.0), (51.05, 51.16), (8.0, 8.0)])
def test_readings_that_no_wall_can_show_are_a_code(low: float, high: float) -> None:
    rng = np.random.default_rng(1)
    scans = []
    for k in range(10):
        ranges = (room(2.0 + 0.1 * k, 2.0, 6.0, 4.0) + rng.normal(0.0, 0.02, 720)).astype(np.float32)
        ranges[100 : 160 + k] = rng.uniform(low, high, 60 + k)
        ranges[400] = low
        scans.append(ranges)
    scans[4][300] = 77.0  # a stray one
    code = learned(scans)
    assert code.is_known
    assert code.low == pytest.approx(low, abs=0.01)
    assert code.high == pytest.approx(high, abs=0.01)
    read = code.apply(scans[0])
    assert np.isposinf(read[100:160]).all()
    assert np.isposinf(read).sum() == (61 if low == high else np.isposinf(read).sum())
    assert np.isfinite(read[:100]).all()


@settings(max_examples=100)
@given(st.data())
def test_no_rectangular_room_makes_a_code(data: st.DataObject) -> None:
    def draw(low: float, high: float) -> float:
        return data.draw(st.floats(low, high))

    width, height, noise = draw(3.0, 80.0), draw(3.0, 80.0), draw(0.0, 0.03)
    x, y = draw(0.2, 0.8) * width, draw(0.2, 0.8) * height
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    scans = []
    for _ in range(4):
        ranges = room(x, y, width, height, draw(0.0, 6.0)) + rng.normal(0.0, noise, 720)
        scans.append(np.round(ranges, 2).astype(np.float32))  # centimetres, as a SICK gives them
    assert not learned(scans).is_known


def write_log(path: Path, coded: int) -> Path:
    """Five scans, of which the first ones show readings of 9.5 m as no wall does."""
    with LogWriter(path) as log:
        for k in range(5):
            beams = np.full(360, 3.0, dtype=np.float32)
            if k < coded:
                beams[100:180] = 9.5
            log.odometry(START + k, Pose2())
            scan = make_scan(START + k)
            log.scan(Scan(START + k, beams, 0.0, pi / 180.0, scan.range_min, 12.0, frame_id="laser"))
    return path


def test_a_code_is_read_as_no_return_and_named(tmp_path: Path) -> None:
    opened = open_log(write_log(tmp_path / "run.mcap", coded=5), ReadOptions())
    assert "scan_no_return_code" in [warning.code for warning in opened.summary.warnings]
    for _ in range(2):
        (first, *_rest) = [event for event in opened.events() if isinstance(event, Scan)]
        assert np.isposinf(first.ranges[100:180]).all()
        assert np.isfinite(first.ranges[:100]).all()


def test_scans_that_are_read_twice_prove_a_code_once(tmp_path: Path) -> None:
    opened = open_log(write_log(tmp_path / "run.mcap", coded=2), ReadOptions())
    assert opened.summary.warnings == open_log(write_log(tmp_path / "plain.mcap", coded=0)).summary.warnings
    assert all(np.isfinite(event.ranges).all() for event in opened.events() if isinstance(event, Scan))
