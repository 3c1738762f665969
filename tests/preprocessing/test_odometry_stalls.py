"""Odometry that stalls and catches up goes on meanwhile; robots that stand, resets and ticks are left as they are."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from math import cos, sin
from operator import length_hint
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.cli.main import main
from hsloc.log import LogWriter
from hsloc.model import Odometry, Pose2, Scan
from hsloc.preprocessing.odometry import ContinuousOdometry
from hsloc.preprocessing.odometry_stalls import UnstalledOdometry

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hsloc.model import Event

SECOND = 1_000_000_000
PERIOD = SECOND // 50


def arc(seconds: float, speed: float = 1.0, rate: float = 0.3) -> Pose2:
    """Where a robot is that drives a circle from (3, 0)."""
    angle = rate * seconds
    return Pose2(3.0 + speed / rate * sin(angle), speed / rate * (1.0 - cos(angle)), angle)


def drive(change: Callable[[float, Odometry], Odometry | None], seconds: float = 12.0) -> list[Event]:
    """Odometry at 50 Hz as `change` makes it by the time (s), and scans at 10 Hz, in the order of their stamps."""
    found: list[Event] = []
    for tick in range(int(seconds * 50)):
        stamp = tick * PERIOD
        event = change(tick / 50.0, Odometry(stamp, arc(tick / 50.0)))
        if event is not None:
            found.append(event)
        if tick % 5 == 2:
            found.append(Scan(stamp, np.full(8, 2.0, dtype=np.float32), -1.0, 0.05, 0.05, 12.0))
    return sorted(found, key=lambda event: event.stamp_ns)


def repeats(begin: float, end: float) -> Callable[[float, Odometry], Odometry]:
    return lambda at, event: replace(event, T_odom_base=arc(begin)) if begin <= at < end else event


def late(begin: float, end: float) -> Callable[[float, Odometry], Odometry]:
    """Messages of this time come 0.1 ms after each other at its end."""

    def change(at: float, event: Odometry) -> Odometry:
        if not begin < at < end:
            return event
        return replace(event, stamp_ns=round(end * SECOND) - PERIOD + round((at - begin) * 50) * 100_000)

    return change


def error_of(events: list[Event]) -> float:
    """How far the odometry is from where the robot was, at most (m)."""
    found = [(e, arc(e.stamp_ns / SECOND)) for e in events if isinstance(e, Odometry)]
    return max(event.T_odom_base.distance(true) for event, true in found)


@pytest.mark.parametrize("seconds", [0.5, 1.5, 2.9])
@pytest.mark.parametrize("stall", [repeats, late])
def test_a_stall_is_filled(
    stall: Callable[[float, float], Callable[[float, Odometry], Odometry]], seconds: float
) -> None:
    events = drive(stall(4.0, 4.0 + seconds))
    assert error_of(events) > 0.9 * seconds
    odometry = ContinuousOdometry(events, "/odom")
    found = list(odometry)
    assert [type(event) for event in found] == [type(event) for event in events]
    assert [event for event in found if isinstance(event, Scan)] == [e for e in events if isinstance(e, Scan)]
    # What an arc of 0.3 rad/s is away from its chord at 1 m/s, and one period.
    assert error_of(found) < 0.3 * seconds**2 / 8.0 + 0.021
    (warning,) = odometry.warnings()
    assert warning.code == "odometry_stalls"
    assert "(/odom)" in warning.text
    assert "1 times" in warning.text
    (longest, at) = (float(part) for part in re.findall(r"([0-9.]+) s(?: at|\))", warning.text))
    assert (longest, at) == pytest.approx((seconds, 4.0), abs=0.03)


def test_a_stall_that_begins_at_rest_is_filled_where_the_robot_drives_on_after_it() -> None:
    def change(at: float, event: Odometry) -> Odometry:
        return replace(event, T_odom_base=arc(max(at - 1.0, 0.0) if not 1.0 <= at < 2.5 else 0.0))

    odometry = ContinuousOdometry(drive(change))
    found = [event for event in odometry if isinstance(event, Odometry)]
    assert [warning.code for warning in odometry.warnings()] == ["odometry_stalls"]
    steps = [a.T_odom_base.distance(b.T_odom_base) for a, b in pairwise(found)]
    assert max(steps) < 0.03


def stops(at: float) -> Pose2:
    """It brakes from 4 s on, and stands from 5 s on."""
    return arc(at if at < 4.0 else 4.5 - 0.5 * max(5.0 - at, 0.0) ** 2)


@pytest.mark.parametrize(
    ("pose", "codes"),
    [
        (lambda at: stops(at) if at < 7.0 else arc(at - 2.5), []),
        (stops, []),
        (lambda at: None if 4.0 <= at < 6.5 else arc(at), []),
        (lambda at: Pose2(*(np.round(arc(at).to_array() / 0.05) * 0.05).tolist()), []),
        (lambda at: arc(int(at * 50) // 7 * 7 / 50), []),
        (lambda at: stops(at) if at < 7.0 else Pose2(0.0, 0.0, 0.0), ["odometry_reset"]),
        (lambda at: stops(at) if at < 7.0 else arc(6.0), ["odometry_reset"]),
        (lambda at: arc(max(at - 9.0, 0.0)), []),
        (lambda at: arc(at if at < 4.0 else at + 3.0), ["odometry_reset"]),
    ],
    ids=["starts", "stops", "lost", "ticks", "slow", "reset at rest", "set at rest", "stands first", "jumps"],
)
def test_what_is_no_stall_is_left_as_it_is(pose: Callable[[float], Pose2 | None], codes: list[str]) -> None:
    def change(at: float, event: Odometry) -> Odometry | None:
        place = pose(at)
        return None if place is None else replace(event, T_odom_base=place)

    events = drive(change)
    stalls = UnstalledOdometry(events)
    assert list(stalls) == events
    assert stalls.warnings() == ()
    odometry = ContinuousOdometry(events)
    list(odometry)
    assert [warning.code for warning in odometry.warnings()] == codes


def test_a_check_names_stalls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        for event in drive(repeats(4.0, 5.5)):
            if isinstance(event, Odometry):
                log.odometry(event.stamp_ns, event.T_odom_base)
            elif isinstance(event, Scan):
                log.scan(event)
    main(["check", str(tmp_path / "log.mcap")])
    printed = capsys.readouterr().out
    assert "warning: /odom: odometry (/odom) stalls while the robot drives on" in printed
    assert "look for a driver or a network that hangs" in printed


@pytest.mark.parametrize(
    "events",
    [
        drive(lambda at, e: replace(e, T_odom_base=stops(at)), 30.0),
        drive(lambda at, e: e if at < 2.0 or 2.3 <= at < 2.31 else None, 30.0),
        [replace(e, stamp_ns=0) for e in drive(repeats(0.0, 200.0), 200.0)],
    ],
    ids=["stands", "odometry ends", "no time"],
)
def test_what_is_held_back_is_bounded(events: list[Event]) -> None:
    source = iter(events)
    passed = 0
    for _ in UnstalledOdometry(source):
        passed += 1
        assert len(events) - length_hint(source) - passed <= 5001
    assert passed == len(events)
