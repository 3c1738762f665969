"""Log times of some messages are wrong: the order of the events is as if they were right."""

from __future__ import annotations

import shutil
import sqlite3
from typing import TYPE_CHECKING, Any

import log_formats
import pytest
from log_builders import START, describe

from hsloc.log import check_log, open_log

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def expected(plain: Path) -> list[tuple[str, int, float]]:
    return [describe(event) for event in open_log(plain).events()]


@pytest.mark.parametrize("wrong", [2**64 - 5, 2**63 + 7, 0, START + 10**9 * SECOND])
def test_a_few_impossible_log_times_leave_the_order_alone(
    tmp_path: Path, plain: Path, expected: list[Any], wrong: int
) -> None:
    items = list(log_formats.messages(plain))
    for number in (30, 71, 110):
        schema, channel, _, data = items[number]
        items[number] = (schema, channel, wrong, data)
    log = open_log(log_formats.write(tmp_path / "times.mcap", items))
    assert [describe(event) for event in log.events()] == expected
    everything = log.verify().log_times_repaired
    assert everything == 3 >= log.losses.log_times_repaired > 0
    assert log.losses.stamps_backwards == {}
    assert log.summary.duration_s == pytest.approx(open_log(plain).summary.duration_s, abs=0.2)


@pytest.mark.parametrize("shift_s", [-2, 2, 100])
def test_log_times_that_those_around_them_contradict_leave_the_order_alone(
    tmp_path: Path, plain: Path, db3: Path, expected: list[Any], shift_s: int
) -> None:
    items = list(log_formats.messages(plain))
    for number in (30, 71, 100):
        schema, channel, log_time, data = items[number]
        items[number] = (schema, channel, log_time + shift_s * SECOND, data)
    shutil.copy(db3, tmp_path / "times.db3")
    with sqlite3.connect(tmp_path / "times.db3") as bag:
        bag.execute("UPDATE messages SET timestamp = timestamp + ? WHERE id IN (31, 72, 101)", (shift_s * SECOND,))
    for path in (log_formats.write(tmp_path / "times.mcap", items), tmp_path / "times.db3"):
        report = check_log(open_log(path))
        assert [(found.code, found.count) for found in report.findings] == [("log_time", 3)]
        log = open_log(path)
        assert [describe(event) for event in log.events()] == expected
        assert log.losses.stamps_backwards == {}


def test_log_times_of_a_database_that_overflowed_leave_the_order_alone(
    tmp_path: Path, db3: Path, expected: list[Any]
) -> None:
    path = tmp_path / "times.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as bag:
        bag.execute("UPDATE messages SET timestamp = -17 WHERE id IN (40, 80)")
    log = open_log(path)
    assert [describe(event) for event in log.events()] == expected
    assert log.losses.log_times_repaired == 2
