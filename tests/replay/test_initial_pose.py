"""Where a run begins: what the log states holds for its own time alone, and must lie on the map."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.errors import ConfigError, MapError
from hsloc.log import ReadOptions, open_log
from hsloc.model import Odometry, Pose2
from hsloc.model.occupancy_grid import OccupancyGrid
from hsloc.replay.map_and_start import find_start
from hsloc.replay.run import run
from hsloc.request import RunRequest
from hsloc.warnings import WarningCode

OFFICE = RECORDINGS / "office.mcap"
ROOM = OccupancyGrid(np.zeros((100, 200), dtype=np.int8), 0.1, Pose2(0.0, 0.0, np.pi / 2.0))
"""x from -10 to 0, y from 0 to 20."""
S = 10**9


def found_start(
    stated: tuple[float, Pose2] | None,
    odometry: list[tuple[int, float]] = (),  # type: ignore[assignment]
    start_s: float | None = None,
    grid: OccupancyGrid = ROOM,
    **spec: Pose2 | bool,
) -> tuple[Any, ...]:
    """find_start on a log that states `stated` = (s, pose) and begins at 100 s."""
    events = [Odometry(round(stamp * S), Pose2(x, 0.0, 0.0)) for stamp, x in odometry]
    log = SimpleNamespace(
        initial_pose=lambda: (round(stated[0] * S), stated[1]) if stated else None,
        summary=SimpleNamespace(origin_ns=100 * S),
        events=lambda: iter(events),
    )
    read = ReadOptions(start_s=start_s)
    return find_start(RunRequest(logs=(Path("run.mcap"),), read=read, **spec), log, grid)  # type: ignore[arg-type]


def test_the_start_of_the_log_holds_at_its_beginning_alone() -> None:
    pose = Pose2(-2.0, 3.0, 0.0)
    assert found_start((100.0, pose)) == (pose, ())
    assert found_start((99.5, pose)) == (pose, ())
    start, (warning,) = found_start((100.0, pose), start_s=60.0)
    assert start is None
    assert "60.0 s before the first event" in warning.text
    assert found_start((160.0, pose), start_s=60.0) == (pose, ())
    assert found_start((100.0, pose), unknown_start=True) == (None, ())


def test_a_start_stated_late_is_carried_back_over_a_short_way() -> None:
    start, warnings = found_start((110.0, Pose2(-2.0, 3.0, np.pi / 2)), odometry=[(100, 5.0), (105, 5.5), (110, 6.0)])
    assert not warnings
    assert start is not None
    assert np.allclose(start.to_array(), (-2.0, 2.0, np.pi / 2))  # a metre back along its heading
    start, (warning,) = found_start((110.0, Pose2(-2.0, 3.0, 0.0)), odometry=[(100, 0.0), (105, 9.0), (110, 0.0)])
    assert start is None
    assert warning.code == WarningCode.START_LATE
    assert "10.0 s after the first event" in warning.text


def test_a_start_that_is_not_on_the_map_is_named_with_its_remedy() -> None:
    with pytest.raises(MapError, match=r"--initial-pose, \(50, 0\), is not on the map, which spans x from -10 to"):
        found_start(None, initial_pose=Pose2(50.0, 0.0, 0.0))
    with pytest.raises(MapError, match=r"run.mcap: the start that the log states.*--unknown-start"):
        found_start((100.0, Pose2(5.5, 0.0, 0.0)))
    assert found_start(None, initial_pose=Pose2(3.0, 21.0, 0.0))[0] is not None


def test_an_unknown_start_needs_a_free_cell() -> None:
    unknown = OccupancyGrid(np.full((5, 5), -1, dtype=np.int8), 0.1)
    with pytest.raises(MapError, match="no free cell"):
        found_start(None, grid=unknown)
    assert found_start(None, grid=unknown, initial_pose=Pose2(0.1, 0.1, 0.0))[0] is not None


def test_a_run_from_the_middle_of_a_log_does_not_begin_at_the_log_s_start() -> None:
    result = run(RunRequest(logs=(OFFICE,), read=ReadOptions(start_s=60.0, end_s=90.0)))
    assert WarningCode.START_STALE in [warning.code for warning in result.warnings]
    assert result.reference is not None
    truth = dict(zip(result.reference.stamps_ns.tolist(), result.reference.poses[:, :2], strict=True))
    stamps = result.trajectory.stamps_ns.tolist()
    errors = np.array([np.hypot(*(truth[t] - p)) for t, p in zip(stamps, result.trajectory.poses[:, :2], strict=True)])
    assert result.localised.mean() > 0.9
    assert errors[result.localised].max() < 0.2


@pytest.mark.parametrize(
    ("read", "expected"),
    [
        (ReadOptions(start_s=float("nan")), "--start is nan"),
        (ReadOptions(start_s=float("inf")), "--start is inf"),
        (ReadOptions(end_s=1e300), "--end is 1e"),
        (ReadOptions(start_s=10.0, end_s=5.0), "--end is 5; it must be later than --start 10"),
        (ReadOptions(end_s=-1.0), "later than the beginning of the log"),
    ],
)
def test_a_window_that_is_none_is_refused(read: ReadOptions, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        RunRequest(logs=(OFFICE,), read=read)


def test_what_the_log_states_at_the_middle_is_known_by_its_stamp() -> None:
    log = open_log(OFFICE)
    stated = log.initial_pose()
    assert stated is not None
    assert stated[0] == log.summary.origin_ns


def test_a_log_that_is_named_twice_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """It used to be read twice, message by message, as if each scan had been taken again."""
    monkeypatch.chdir(OFFICE.parent)
    with pytest.raises(ConfigError, match="a log is named twice"):
        RunRequest(logs=(OFFICE, Path(OFFICE.name)))
