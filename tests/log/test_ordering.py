"""The order of events: total, repeatable, and right where stamps are wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_builders import SECOND, START, describe, make_scan

from hsloc.log.container import RecorderClock
from hsloc.log.session.ordering import KIND_ODOMETRY, KIND_SCAN, WINDOW_NS, Arrivals, Reorder, TopicClock
from hsloc.log.summary import LogSummary, Losses, TopicStatistics
from hsloc.model import Odometry, Pose2

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from hsloc.model import Event

MS = SECOND // 1000


def batched(items: list[tuple[str, int, int]], size: int) -> Iterator[list[tuple[str, int, int]]]:
    for at in range(0, len(items), size):
        yield items[at : at + size]


def order(arrivals: list[tuple[str, int, int]], size: int = 64) -> tuple[list[tuple[str, int]], Losses]:
    """Send (kind, stamp, log time) in the order of arrival, in batches; returns (kind, stamp) as they come out."""
    losses = Losses()
    clocks = {
        "odometry": TopicClock("/odom", KIND_ODOMETRY, losses),
        "scan": TopicClock("/scan", KIND_SCAN, losses),
    }
    reorder = Reorder(list(clocks.values()), losses)
    out: list[Event] = []
    for batch in batched(arrivals, size):
        rows: dict[str, list[tuple[int, int, int, Event]]] = {}
        for place, (kind, stamp, log_time) in enumerate(batch):
            event: Event = make_scan(stamp) if kind == "scan" else Odometry(stamp, Pose2())
            rows.setdefault(kind, []).append((place, log_time, stamp, event))
        reorder.take([Arrivals(clocks[kind], *zip(*found, strict=True)) for kind, found in rows.items()], len(batch))
        out += [found for _, found in reorder.ready()]
    out += [found for _, found in reorder.rest()]
    return [describe(event)[:2] for event in out], losses


def test_stamps_and_not_arrival_decide() -> None:
    # A scan arrives when it is complete, 100 ms after its stamp; odometry at once.
    arrivals = []
    for number in range(500):
        stamp = START + number * 20 * MS
        arrivals.append(("odometry", stamp, stamp))
        if number % 5 == 0:
            arrivals.append(("scan", stamp - 100 * MS, stamp))
    found, losses = order(arrivals)
    assert [stamp for _, stamp in found] == sorted(stamp for _, stamp, _ in arrivals)
    assert losses == Losses()


def test_equal_stamps_odometry_comes_first() -> None:
    found, _ = order([("scan", START, START), ("odometry", START, START)])
    assert [kind for kind, _ in found] == ["odometry", "scan"]


def test_stamps_that_run_backwards_keep_the_order_of_the_log() -> None:
    # As in the Intel log: pairs of odometry and scan, whose stamps fall back by 0.9 s and catch up.
    stamps = [0, 200, 400, 1300, 600, 800, 1000, 1400, 1600]
    arrivals = [
        (kind, START + stamp * MS, START + number * 200 * MS)
        for number, stamp in enumerate(stamps)
        for kind in ("odometry", "scan")
    ]
    found, losses = order(arrivals)
    assert found == [(kind, stamp) for kind, stamp, _ in arrivals]
    assert losses.stamps_backwards == {"/odom": 1, "/scan": 1}
    assert losses.late_messages == 0


def test_one_stamp_from_the_future_does_not_hold_up_what_follows() -> None:
    arrivals = [("odometry", START + n * 20 * MS, START + n * 20 * MS) for n in range(200)]
    arrivals[50] = ("odometry", START + 10**6 * SECOND, START + 1000 * MS)
    found, losses = order(arrivals)
    assert found == [(kind, stamp) for kind, stamp, _ in arrivals]
    assert losses.stamp_jumps == {"/odom": 1}


@pytest.mark.parametrize("step", [3600 * SECOND, -3600 * SECOND])
def test_a_clock_that_is_set_goes_on_from_there(step: int) -> None:
    arrivals = []
    for n in range(400):
        stamp = START + n * 20 * MS + (step if n >= 200 else 0)
        arrivals += [(kind, stamp, START + n * 20 * MS) for kind in ("odometry", "scan")]
    found, losses = order(arrivals)
    assert sorted(found) == sorted((kind, stamp) for kind, stamp, _ in arrivals)
    assert losses.stamp_jumps == {"/odom": 2, "/scan": 2}
    for kind in ("odometry", "scan"):
        assert [s for k, s in found if k == kind] == [s for k, s, _ in arrivals if k == kind]


@pytest.mark.parametrize("size", [1, 7, 10, 11, 400])
def test_a_clock_that_is_set_is_counted_alike_however_messages_are_batched(size: int) -> None:
    # With batches of 10 and 11 the first stamp that jumps is a batch's last one.
    arrivals = [("odometry", START + n * 20 * MS + (n >= 109) * 3600 * SECOND, START + n * 20 * MS) for n in range(300)]
    found, losses = order(arrivals, size)
    assert found == [(kind, stamp) for kind, stamp, _ in arrivals]
    step = 3600 * SECOND, START + 109 * 20 * MS
    assert losses == Losses(stamp_jumps={"/odom": 2}, clock_steps={"/odom": [step]})  # type: ignore[arg-type]


def test_a_clock_that_is_set_back_twice_at_once_makes_nothing_late() -> None:
    # As where a log is played again and again: each round is in order, and none is late for the one before.
    rounds = [0] * 100 + [1] * 20 + [2] * 100
    arrivals = [
        (kind, START + n * 20 * MS - turn * 60 * SECOND, START + n * 20 * MS)
        for n, turn in enumerate(rounds)
        for kind in ("odometry", "scan")
    ]
    found, losses = order(arrivals, 180)  # both in the second batch
    assert len(found) == len(arrivals)
    assert losses.stamp_jumps == {"/odom": 4, "/scan": 4}
    assert losses.late_messages == 0


def test_a_gap_in_the_recording_is_no_jump() -> None:
    arrivals = [("odometry", START + n * SECOND + (n > 5) * 1000 * SECOND, 0) for n in range(10)]
    arrivals = [(kind, stamp, stamp + 5) for kind, stamp, _ in arrivals]
    assert order(arrivals)[1] == Losses()


def test_a_topic_that_fell_silent_holds_nothing_up_for_longer_than_the_window() -> None:
    losses = Losses()
    odometry, scan = TopicClock("/odom", KIND_ODOMETRY, losses), TopicClock("/scan", KIND_SCAN, losses)
    reorder = Reorder([odometry, scan], losses)
    reorder.push(scan, make_scan(START), START)
    held = 0
    for number in range(2000):
        stamp = START + number * 20 * MS
        reorder.push(odometry, Odometry(stamp, Pose2()), stamp)
        if number % 64 == 0:
            list(reorder.ready())
        held = max(held, len(reorder._pending))
    assert held < WINDOW_NS / (20 * MS) + 100


def test_an_event_later_than_the_window_is_counted() -> None:
    arrivals = [("odometry", START + n * 20 * MS, START + n * 20 * MS) for n in range(1000)]
    arrivals.insert(900, ("scan", START + 100 * MS, START + 900 * 20 * MS))
    found, losses = order(arrivals)
    assert losses.late_messages == 1
    assert len(found) == 1001


def test_missing_stamps() -> None:
    losses = Losses()
    same, other = TopicClock("/a", 0, losses, True), TopicClock("/b", 0, losses, False)
    assert same.stamp(0, START) == START
    assert other.stamp(0, START) is None
    assert same.stamp(5, START) == 5
    assert same.stamp(0, 0) == 0  # a simulation's first message
    assert (losses.stamps_zero, losses.stamps_zero_dropped) == ({"/a": 1}, {"/b": 1})


@settings(max_examples=60)
@given(st.data())
def test_any_delays_below_the_window_come_out_sorted(data: st.DataObject) -> None:
    arrivals = []
    for kind, period, limit in (("odometry", 20, 100), ("scan", 100, 1500)):
        delay = data.draw(st.integers(0, limit), label=kind)
        jitter = data.draw(st.integers(0, period - 1))
        for number in range(4000 // period):
            stamp = START + number * period * MS
            late = data.draw(st.integers(0, jitter)) if number % 7 == 0 else 0
            arrivals.append((kind, stamp, stamp + (delay + late) * MS))
    arrivals.sort(key=lambda arrival: arrival[2])
    found, losses = order(arrivals)
    assert found == [(k, s) for s, k in sorted((s, k) for k, s, _ in arrivals)]
    assert losses == Losses()


@pytest.mark.parametrize("size", [1, 7, 64])
@pytest.mark.parametrize("step_s", [-15.0, -3.0, -1.2, 1.2, 3.0])
def test_a_clock_that_was_set_is_found_on_the_topics_that_it_stamps(step_s: float, size: int) -> None:
    step = round(step_s * SECOND)
    arrivals = [
        (kind, log_time - 30 * MS + (step if set_at <= number else 0), log_time)
        for number in range(200)
        for log_time in [START + number * 50 * MS]
        for kind, set_at in (("odometry", 90), ("scan", 300 if step_s > 0.0 else 90))
    ]
    _, losses = order(arrivals, size)
    topics = ["/odom"] if step_s > 0.0 else ["/odom", "/scan"]
    assert losses.clock_steps == {topic: [(step, START + 90 * 50 * MS)] for topic in topics}
    (warning,) = losses.step_warnings(LogSummary((), "mcap", start_ns=START))
    for part in (", ".join(topics), "back" if step_s < 0.0 else "forward", f"{abs(step_s):.1f} s at 4.5 s"):
        assert part in warning.text


@pytest.mark.parametrize("size", [1, 64])
def test_delays_and_gaps_are_no_steps_of_a_clock(size: int) -> None:
    stamps = [START + number * 50 * MS for number in range(400) if not 100 <= number < 140]  # 2 s without messages
    log_times = [stamp + 30 * MS for stamp in stamps]
    for first, last in ((0, 30), (200, 260)):  # kept somewhere, and written together
        log_times[first:last] = [log_times[last]] * (last - first)
    stamps[300] -= 3 * SECOND  # a single one
    _, losses = order([("odometry", *times) for times in zip(stamps, log_times, strict=True)], size)
    assert losses.clock_steps == {}


@pytest.mark.parametrize(
    ("step_s", "by_topic", "cut"),
    [(-3.0, False, ("6.9", "10.0")), (-40.0, False, ("9.9", "30.0")), (-3.0, True, None), (5.0, False, None)],
)
def test_a_clock_of_the_recorder_that_was_set_back_is_found(
    tmp_path: Path, step_s: float, by_topic: bool, cut: tuple[str, str] | None
) -> None:
    """20 s at 10 Hz, set at 10 s; a file that was put together topic by topic looks alike, and is none."""
    seconds = np.arange(200) / 10.0
    times = START + np.round((seconds + (seconds >= 10.0) * step_s) * SECOND).astype(np.int64)
    channels = (np.arange(200) >= 100) * 1 if by_topic else np.arange(200) % 2
    clock = RecorderClock()
    for k in range(0, 200, 33):
        clock.take(channels[k : k + 33], times[k : k + 33])
    statistics = TopicStatistics()
    statistics.add(int(times.min()), int(times.max()), 200, 0)
    warnings = clock.warnings(tmp_path / "log", [statistics])
    assert [warning.code for warning in warnings] == ["clock_set"] * (cut is not None)
    for warning in warnings:
        assert f"step back by {-step_s - 0.1:.1f} s" in warning.text
        assert cut is not None
        assert f"--end {cut[0]}, or --start {cut[1]}," in warning.remedy


def test_one_wrong_log_time_is_no_step_of_the_clock(tmp_path: Path) -> None:
    times = START + np.arange(100) * SECOND // 10
    times[50] -= 100 * SECOND
    clock = RecorderClock()
    clock.take(np.zeros(100, np.int64), times)
    assert clock.warnings(tmp_path, [TopicStatistics(100, START, START + 10 * SECOND)]) == []
