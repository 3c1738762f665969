"""Beams that see the robot itself are found by what does not change, and only they."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Odometry, Pose2, Scan
from hsloc.preprocessing.body_returns import body_beams, body_warnings, without_beams

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hsloc.model import Event

POST = np.arange(40, 46)


def drive(own: np.ndarray, *, moves: bool = True, turns: bool = True, last: int = 40) -> Iterator[Event]:
    """Scans, each from another place if it moves; in the first `last` of them the robot's `own` beams read 0.2 m."""
    random = np.random.default_rng(0)
    ranges = random.uniform(1.5, 8.0, 360)
    for k in range(40):
        ranges = random.uniform(1.5, 8.0, 360) if moves else ranges
        seen = ranges + random.normal(0.0, 0.01, 360)
        if k < last:
            seen[own] = 0.2 + random.normal(0.0, 0.01, len(own))
        yield Odometry(k * 10**8, Pose2(float(k), 0.0, 0.2 * k if turns else 0.0))
        yield Scan(k * 10**8, seen.astype(np.float32), 0.0, np.radians(1.0), 0.1, 10.0)


def test_returns_from_the_robot_itself_are_left_out() -> None:
    """A map with a chassis in 30 % of the beams was off by 20 m, for they say that the robot stands still."""
    found = body_beams(drive(POST))
    assert np.flatnonzero(found["laser"]).tolist() == [39, *POST, 46], "with the edges of the post"
    kept = [event for event in without_beams(drive(POST), found) if isinstance(event, Scan)]
    recorded = [event for event in drive(POST) if isinstance(event, Scan)]
    for scan, before in zip(kept, recorded, strict=True):
        assert np.isnan(scan.ranges[39:47]).all()
        assert np.array_equal(np.delete(scan.ranges, np.arange(39, 47)), np.delete(before.ranges, np.arange(39, 47)))
    (warning,) = body_warnings(found)
    assert warning.code == "scan_body_returns"
    assert "8 of 360 beams" in warning.text


def test_what_stays_where_the_robot_does_is_no_part_of_it() -> None:
    assert body_beams(drive(POST, moves=False)) == {}
    assert body_beams(drive(POST, turns=False)) == {}, "it may be a wall along which the robot drives"
    assert body_beams(drive(POST, last=12)) == {}, "something stood beside it for a while"


def test_no_more_is_read_than_it_takes() -> None:
    events = drive(np.arange(0))
    assert body_beams(events) == {}
    assert sum(1 for _ in events) == 80 - 4
