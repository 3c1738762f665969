"""Gaps of a record: a recorder that was stopped, and streams that are slow by themselves."""

from __future__ import annotations

import pytest

from hsloc.slam.record_gaps import RecordGaps

SECOND = 10**9


@pytest.mark.parametrize(
    ("period_s", "gap_s", "met"),
    [(0.02, 5.0, False), (0.02, 12.0, True), (1.0, 12.0, False), (1.0, 25.0, True), (5.0, 60.0, False)],
)
def test_a_gap_is_long_and_unusual(period_s: float, gap_s: float, met: bool) -> None:
    gaps = RecordGaps()
    stamp = 0
    for _ in range(100):
        gaps.add(stamp)
        stamp += round(period_s * SECOND)
    assert gaps.take() == 0.0
    gaps.add(stamp + round(gap_s * SECOND))
    assert gaps.take() == pytest.approx((gap_s + period_s) if met else 0.0)
    assert gaps.take() == 0.0, "it is reported once"


def test_stamps_that_go_back_are_no_gap() -> None:
    gaps = RecordGaps()
    for stamp in (0, 1, 30, 2, 3):
        gaps.add(stamp * SECOND // 10)
    gaps.add(3 * SECOND + 1)
    assert gaps.take() == 0.0
