"""Odometry that does not move or has no heading is ignored with a warning; a robot is followed by its lidar alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import log_formats
import numpy as np
import pytest

from hsloc.cli.main import main
from hsloc.evaluation import evaluate
from hsloc.log import ReadOptions, open_log
from hsloc.model import Odometry, Pose2, Scan
from hsloc.preprocessing.odometry import OdometryWatch, UnusableOdometry
from hsloc.replay.run import run
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from collections.abc import Callable

OFFICE = Path(__file__).resolve().parents[2] / "recordings" / "office.mcap"
END = ReadOptions(end_s=14.0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda number, pose: Pose2(0.0, 0.0, 0.0), "does not move"),
        (lambda number, pose: pose if number < 200 else Pose2(1.0, 2.0, 0.5), "does not move"),
        (lambda number, pose: None, "not set"),
        (lambda number, pose: pose if number < 150 else None, "not set"),
    ],
    ids=["zero", "freezes", "no heading", "heading lost"],
)
def test_unusable_odometry_is_ignored_with_a_warning(
    tmp_path: Path, change: Callable[[int, Pose2], Pose2 | None], reason: str
) -> None:
    log = log_formats.with_odometry(tmp_path / "log.mcap", OFFICE, change)
    result = run(RunRequest(logs=(log,), read=END))
    (warning,) = [warning for warning in result.warnings if warning.code == "odometry_unusable"]
    assert reason in warning.text
    assert result.lidar_only
    assert result.mode == "localise"
    assert result.localised.all()
    assert result.reference is not None
    errors = evaluate(result.trajectory, result.reference).ape.trans_part
    assert errors.rmse < 0.02
    assert errors.max < 0.1


def test_sound_odometry_is_kept(tmp_path: Path) -> None:
    result = run(RunRequest(logs=(OFFICE,), read=END))
    assert not result.lidar_only
    assert result.warnings == ()


def test_a_map_is_built_without_the_odometry_that_does_not_move(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = log_formats.with_odometry(tmp_path / "log.mcap", OFFICE, lambda number, pose: Pose2(0.0, 0.0, 0.0))
    result = run(RunRequest(logs=(log,), read=END, mode="slam"))
    assert any(warning.code == "odometry_unusable" for warning in result.warnings)
    assert result.reference is not None
    assert evaluate(result.trajectory, result.reference, alignment="se2").ape.trans_part.rmse < 0.03
    assert main(["check", str(log), "-q"]) == 1
    assert "error: /odom: the odometry cannot be used: it does not move" in capsys.readouterr().out


def test_lidar_alone_on_a_given_map_gives_the_same_bytes_twice() -> None:
    request = RunRequest(logs=(OFFICE,), read=END, mode="localise", no_odometry=True)
    first, second = run(request), run(request)
    assert first.trajectory.poses.tobytes() == second.trajectory.poses.tobytes()
    assert len(first.odometry) == len(first.diagnostics)


# The watch by itself.


def still(seconds: float, changed: float, moving_odometry: bool) -> list[Odometry | Scan]:
    """Odometry at 50 Hz and scans at 10 Hz, of which a part of the beams changes from scan to scan."""
    rng = np.random.default_rng(3)
    base = rng.uniform(1.0, 8.0, 360).astype(np.float32)
    events: list[Odometry | Scan] = []
    for tick in range(int(seconds * 50)):
        stamp = tick * 20_000_000
        events.append(Odometry(stamp, Pose2(1e-3 * tick if moving_odometry else 1e-3 * rng.random(), 0.0, 0.0)))
        if tick % 5 == 0:
            ranges = (base + rng.normal(0.0, 0.01, 360)).astype(np.float32)
            beams = rng.random(360) < changed
            ranges[beams] = rng.uniform(0.5, 9.0, int(beams.sum()))
            events.append(Scan(stamp, ranges, -3.14, 0.01745, 0.05, 12.0))
    return events


@pytest.mark.parametrize(
    ("changed", "moving_odometry"), [(0.0, False), (0.25, False), (0.95, True)], ids=["at rest", "in a crowd", "moves"]
)
def test_a_robot_at_rest_and_odometry_that_ticks_raise_nothing(changed: float, moving_odometry: bool) -> None:
    events = still(60.0, changed, moving_odometry)
    assert list(OdometryWatch(events)) == events


def test_a_robot_that_moves_without_odometry_is_detected_within_seconds() -> None:
    passed: list[Odometry | Scan] = []
    with pytest.raises(UnusableOdometry, match="does not move"):
        passed.extend(OdometryWatch(still(60.0, 0.95, False)))  # type: ignore[arg-type]
    assert len(passed) < 6 * 60


def test_a_heading_that_never_changes_is_detected_when_the_scans_turn() -> None:
    events = [
        replace(e, T_odom_base=Pose2(e.T_odom_base.x, e.T_odom_base.y, 0.0)) if isinstance(e, Odometry) else e
        for e in open_log(OFFICE).events()
    ]
    with pytest.raises(UnusableOdometry, match="heading never changes"):
        list(OdometryWatch(events))


def test_odometry_that_ends_before_the_scans_is_not_frozen() -> None:
    events = [e for e in still(30.0, 0.95, True) if isinstance(e, Scan) or e.stamp_ns < 20_000_000_000]
    assert list(OdometryWatch(events)) == events


def test_the_watch_needs_no_pass_of_its_own_over_a_real_log() -> None:
    events = list(open_log(OFFICE).events())
    assert list(OdometryWatch(events)) == events
