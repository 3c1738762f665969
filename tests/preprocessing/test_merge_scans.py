"""Which scans of several lasers are joined, and where their points come to lie."""

from __future__ import annotations

import numpy as np
import pytest

from hsloc.model import Odometry, Pose2, Scan
from hsloc.model.events import PairedScan
from hsloc.preprocessing.scans import merged_scans

MS = 1_000_000


def scan(frame: str, ms: float, at: Pose2 | None = None) -> PairedScan:
    ranges = np.array([1.0], dtype=np.float32)
    return PairedScan(Scan(round(ms * MS), ranges, 0.0, 0.1, 0.1, 10.0, frame_id=frame), at or Pose2())


def merged(*scans: PairedScan) -> list[tuple[str, float, tuple[str, ...] | str]]:
    """(frame, ms, companions or "held") after an odometry message."""
    first = Odometry(0, Pose2())
    passed = list(merged_scans([first, *scans]))
    assert passed[0] is first
    return [
        (
            paired.scan.frame_id,
            paired.scan.stamp_ns / MS,
            "held" if paired.is_held else tuple(other.scan.frame_id for other in paired.companions),
        )
        for paired in passed[1:]
        if isinstance(paired, PairedScan)
    ]


def test_one_laser_is_left_alone() -> None:
    scans = [scan("a", ms) for ms in (0, 100, 200)]
    assert list(merged_scans([Odometry(0, Pose2()), *scans]))[1:] == scans


@pytest.mark.parametrize("offset", [0, 20, 50])
def test_the_last_of_each_pair_carries_the_other(offset: int) -> None:
    scans = [scan(frame, ms + (offset if frame == "b" else 0)) for ms in (0, 100, 200) for frame in "ab"]
    # Before b is known a leads alone; b's first scan then waits for a's second where that is near, as all do.
    found = merged(*scans)
    assert found[0] == ("a", 0, ())
    carried = [entry for entry in found[1:] if entry[2] != "held"]  # type: ignore[unreachable]
    assert len(carried) == 2
    for _, ms, companions in carried:
        (other,) = companions
        assert any(entry[0] == other and entry[2] == "held" and abs(entry[1] - ms) <= 60 for entry in found)


@pytest.mark.parametrize("frames", ["abc", "abcd"])
def test_lasers_that_take_turns_are_one_cloud_each_period(frames: str) -> None:
    found = merged(
        *(scan(frame, 100 * k + 100 / len(frames) * at) for k in range(20) for at, frame in enumerate(frames))
    )
    carried = [entry for entry in found[2 * len(frames) :] if entry[2] != "held"]
    assert all({frame, *companions} == {*frames} for frame, _, companions in carried)
    assert len(carried) == 18


def test_two_slow_lasers_that_never_coincide_are_both_used() -> None:
    scans = [entry for k in range(20) for entry in (scan("a", 450 * k), scan("b", 450 * k + 110))]
    frames = [frame for frame, _, what in merged(*scans) if what != "held"]
    assert frames.count("a") == 20
    assert frames.count("b") >= 18


def test_the_slower_of_two_lasers_sets_the_pace() -> None:
    fast, slow = [("a", 25 * k) for k in range(20)], [("b", 10 + 100 * k) for k in range(5)]
    found = merged(*(scan(*entry) for entry in sorted(fast + slow, key=lambda entry: entry[1])))
    carried = [entry for entry in found[6:] if entry[2] != "held"]
    assert len(carried) == 4
    assert all({frame, *companions} == {"a", "b"} for frame, _, companions in carried)


def test_a_laser_that_falls_silent_is_not_waited_for() -> None:
    pairs = [scan(frame, 100 * k) for k in range(3) for frame in "ab"]
    found = merged(*pairs, *(scan("a", 100 * k) for k in range(3, 12)))
    alone = [entry[1] for entry in found if entry[2] == ()][1:]
    # b is waited for half a second, in which a scan of a leads now and then; afterwards each does.
    assert alone[-5:] == [700, 800, 900, 1000, 1100]
    assert 300 < alone[0] < 700


def test_lasers_that_never_meet_are_matched_alone_now_and_then() -> None:
    """One at 10 Hz, and one whose scans come at odd times after it, too late for it and too early for the next."""
    scans = [entry for k in range(20) for entry in (scan("a", 100 * k), scan("b", 100 * k + 65))]
    frames = [frame for frame, _, what in merged(*scans) if what != "held"]
    assert len(frames) > 10
    assert {*frames} == {"a", "b"} or frames.count("a") > 10


def test_without_odometry_none_is_held() -> None:
    scans = [scan(frame, ms) for ms in (0, 100) for frame in "ab"]
    assert list(merged_scans(scans)) == scans


def test_the_points_of_a_companion_are_moved_by_odometry() -> None:
    first, second = scan("a", 0, Pose2(2.0, 1.0, np.pi / 2)), scan("b", 50, Pose2(2.0, 1.2, np.pi / 2))
    joined = PairedScan(second.scan, second.T_odom_base, companions=(first,))
    # Seen from 0.2 m further on, the point of before lies 0.2 m less ahead.
    np.testing.assert_allclose(joined.points_base(), [(1.0, 0.0), (0.8, 0.0)], atol=1e-9)
