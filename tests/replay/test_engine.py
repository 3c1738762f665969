"""Pairing of scans with odometry: exact, between, at the ends, and with clocks that run backwards."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hsloc.model import Estimate, Event, Odometry, PairedScan, Pose2, Scan, Status, Truth
from hsloc.preprocessing.scans import pair
from hsloc.replay.engine import replay

RANGES = np.ones(3, dtype=np.float32)


def odometry(stamp: int, x: int) -> Odometry:
    return Odometry(stamp, Pose2(float(x), 0.0, 0.0))


def scan(stamp: int) -> Scan:
    return Scan(stamp, RANGES, 0.0, 0.1, 0.1, 10.0)


def pairs(events: list[Any]) -> list[Any]:
    """What comes out, in short: O stamp, S stamp x, T stamp."""
    out: list[Any] = []
    for event in pair(events):
        if isinstance(event, PairedScan):
            out.append(("S", event.scan.stamp_ns, round(event.T_odom_base.x, 9)))
        else:
            out.append(("O" if isinstance(event, Odometry) else "T", event.stamp_ns))
    return out


def test_a_scan_waits_for_the_odometry_after_it() -> None:
    events = [odometry(0, 0), scan(5), odometry(10, 1), scan(12), odometry(20, 2)]
    assert pairs(events) == [("O", 0), ("S", 5, 0.5), ("O", 10), ("S", 12, 1.2), ("O", 20)]


def test_a_scan_with_the_stamp_of_an_odometry_takes_it() -> None:
    assert pairs([odometry(0, 0), odometry(10, 1), scan(10), odometry(20, 5)])[2] == ("S", 10, 1.0)
    assert pairs([scan(10), odometry(10, 1)]) == [("O", 10), ("S", 10, 1.0)]


def test_at_the_ends_the_nearest_odometry_must_do() -> None:
    assert pairs([scan(0), odometry(10, 1)]) == [("S", 0, 1.0), ("O", 10)]
    assert pairs([odometry(0, 3), scan(5)]) == [("O", 0), ("S", 5, 3.0)]


def test_a_log_without_odometry_gives_all_its_scans() -> None:
    assert pairs([scan(k) for k in range(100)]) == [("S", k, 0.0) for k in range(100)]


def test_clocks_that_run_backwards_pair_by_stamp() -> None:
    events = [odometry(50, 1), scan(50), odometry(45, 2), scan(45), odometry(60, 3)]
    assert pairs(events) == [("O", 50), ("S", 50, 1.0), ("O", 45), ("S", 45, 2.0), ("O", 60)]


def test_a_late_scan_is_placed_among_recent_odometry() -> None:
    events = [odometry(0, 0), odometry(10, 1), odometry(20, 2), scan(15), odometry(30, 3)]
    assert ("S", 15, 1.5) in pairs(events)


def test_order_of_scans_is_kept_and_none_is_lost() -> None:
    events: list[Event] = [odometry(0, 0)]
    for k in range(1, 300):
        events += [scan(10 * k - 3), scan(10 * k - 2), odometry(10 * k, k)]
    out = pairs(events)
    scans = [entry for entry in out if entry[0] == "S"]
    assert [stamp for _, stamp, _ in scans] == [event.stamp_ns for event in events if isinstance(event, Scan)]
    for _, stamp, x in scans:
        assert x == pytest.approx(stamp / 10.0)


class Spy:
    def __init__(self) -> None:
        self.seen: list[Odometry | PairedScan] = []

    def update(self, event: Odometry | PairedScan) -> Estimate:
        self.seen.append(event)
        return Estimate(0, Pose2(), Status.PREDICTED)


def test_the_truth_never_reaches_the_estimator() -> None:
    spy = Spy()
    events: list[Event] = [odometry(0, 0), Truth(0, Pose2(9.0, 9.0, 0.0)), scan(0)]
    out = list(replay(events, spy))
    assert [type(event) for event in spy.seen] == [Odometry, PairedScan]
    assert [(type(event), estimate is None) for event, estimate in out] == [
        (Odometry, False), (Truth, True), (PairedScan, False)
    ]  # fmt: skip


def test_scans_long_before_the_odometry_wait_where_it_begins() -> None:
    early = [scan(k) for k in range(100)]
    paired = [e for e in pair([*early, odometry(200, 7)], first=Pose2(7.0, 0.0, 0.0)) if isinstance(e, PairedScan)]
    assert [event.T_odom_base.x for event in paired] == [7.0] * 100


def test_a_scan_from_the_future_does_not_hold_up_the_others() -> None:
    """It used to: the 64 behind it came seconds late, and were paired with the odometry of that time."""
    events = [event for k in range(200) for event in (odometry(20 * k, k), scan(20 * k + 10))]
    events[41] = scan(10**12)
    found = [entry for entry in pairs(events) if entry[0] == "S"]
    assert found[:20] == [("S", 20 * k + 10, k + 0.5) for k in range(20)]
    assert found[20] == ("S", 10**12, 22.0)
    assert found[21:-1] == [("S", 20 * k + 10, k + 0.5) for k in range(21, 199)]
