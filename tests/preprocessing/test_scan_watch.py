"""Scans that repeat, stamps that stand still, and topics that end early."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.model import Odometry, Pose2, Scan
from hsloc.preprocessing.scans import ScanWatch

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hsloc.model import Event

SECOND = 1_000_000_000


def drive(ranges: Callable[[int], int], speed: float = 0.4, scans: int = 80, odometry: int = 80) -> list[Event]:
    """10 scans and odometry messages a second; scan k has the noise of number `ranges(k)`."""
    found: list[Event] = []
    for k in range(max(scans, odometry)):
        stamp = k * SECOND // 10
        if k < odometry:
            found.append(Odometry(stamp, Pose2(speed * k / 10.0, 0.0, 0.0)))
        if k < scans:
            noise = np.random.default_rng(ranges(k)).normal(0.0, 0.01, 40)
            found.append(Scan(stamp, (2.0 + noise).astype(np.float32), -1.0, 0.05, 0.05, 12.0, frame_id="laser"))
    return found


def watched(events: Sequence[Event]) -> tuple[int, list[str]]:
    """How many scans come through, and the codes of the warnings."""
    watch = ScanWatch(events, "/scan")
    scans = sum(isinstance(event, Scan) for event in watch)
    return scans, [warning.code for warning in watch.warnings()]


@pytest.mark.parametrize(
    ("events", "scans", "codes"),
    [
        (drive(lambda k: k), 80, []),
        (drive(lambda k: k // 2), 80, []),  # within 5 cm: too near to decide
        (drive(lambda k: k // 3), 54, ["scans_repeated"]),
        (drive(lambda k: min(k, 40)), 42, ["scans_frozen"]),
        (drive(lambda k: min(k, 40), speed=0.0), 80, []),
        (drive(lambda k: k, scans=50), 50, ["topics_end_apart"]),
        (drive(lambda k: k, odometry=50), 80, ["topics_end_apart"]),
    ],
)
def test_scans_that_repeat_are_left_out_and_what_ends_early_is_reported(
    events: list[Event], scans: int, codes: list[str]
) -> None:
    assert watched(events) == (scans, codes)


def test_stamps_of_scans_that_stand_still_are_reported() -> None:
    events = [
        event if isinstance(event, Odometry) else Scan(SECOND, event.ranges, -1.0, 0.05, 0.05, 12.0, frame_id="laser")
        for event in drive(lambda k: k)
        if isinstance(event, Odometry | Scan)
    ]
    scans, codes = watched(events)
    assert (scans, codes[0]) == (80, "scan_stamps_stuck")


def test_scans_without_returns_are_not_the_same() -> None:
    events = [
        event
        if isinstance(event, Odometry)
        else Scan(event.stamp_ns, np.full(40, np.inf, np.float32), -1.0, 0.05, 0.05, 12.0)
        for event in drive(lambda k: k)
        if isinstance(event, Odometry | Scan)
    ]
    assert watched(events) == (80, [])
