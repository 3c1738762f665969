"""Lone hits are left out of scans where they are many, as in rain or dust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hsloc.model import Odometry, Pose2, Scan
from hsloc.preprocessing.left_out_hits import without_isolated

ROOM = (3.0 / np.maximum(*np.abs([np.cos(np.radians(np.arange(360))), np.sin(np.radians(np.arange(360)))]))).astype(
    "f4"
)


def scan_with(outliers: int) -> tuple[Scan, np.ndarray]:
    """A square room of 6 m, some of whose ranges are too short, four beams and more apart."""
    rows = np.arange(outliers) * (360 // outliers)
    ranges = ROOM.copy()
    ranges[rows] *= np.random.default_rng(0).uniform(0.2, 0.7, outliers).astype(np.float32)
    return Scan(0, ranges, 0.0, np.radians(1.0), 0.1, 10.0), rows


@pytest.mark.parametrize(("outliers", "are_dropped"), [(9, False), (17, False), (19, True), (60, True)])
def test_isolated_hits_are_dropped_where_they_are_many(outliers: int, are_dropped: bool) -> None:
    scan, rows = scan_with(outliers)
    odometry = Odometry(1, Pose2(0.0, 0.0, 0.0))
    *before, kept, same = without_isolated([*[scan] * 10, odometry])
    assert same is odometry
    assert all(each is scan for each in before), "too few to say that it lasts"
    assert isinstance(kept, Scan)
    if not are_dropped:
        assert kept is scan
        return
    others = np.setdiff1d(np.arange(360), rows)
    assert np.isnan(kept.ranges[rows]).all()
    assert np.array_equal(kept.ranges[others], scan.ranges[others])


def test_one_scan_or_another_laser_with_many_is_left_as_it_is() -> None:
    (clean, _), (noisy, _) = scan_with(9), scan_with(60)
    scans = [*[clean] * 20, noisy, *[replace(noisy, frame_id="rear")] * 9]
    assert all(kept is scan for kept, scan in zip(without_isolated(scans), scans, strict=True))


def test_a_robot_that_waits_among_thin_things_keeps_them() -> None:
    (clean, _), (thin, _) = scan_with(9), scan_with(60)
    scans = [*[clean] * 200, *[thin] * 150]
    assert all(kept is scan for kept, scan in zip(without_isolated(scans), scans, strict=True))
