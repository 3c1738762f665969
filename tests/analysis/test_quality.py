"""A run that is doubtful as a whole has a warning: most scans without a place, odometry that jumps and is mended."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hsloc.analysis.analyse import analyse
from hsloc.analysis.quality import quality_warnings, verdict_reasons
from hsloc.log import LogWriter, ReadOptions, open_log
from hsloc.model import Odometry, Pose2, Scan, Truth
from hsloc.model.estimate import Ambiguity, State
from hsloc.replay.run import run
from hsloc.report.summary import ResultSummary
from hsloc.request import RunRequest
from hsloc.warnings import WarningCode

OFFICE = Path(__file__).resolve().parents[2] / "recordings" / "office.mcap"


def rewritten(path: Any, change: Any, end: float = 20.0) -> Any:
    """The office, with each event changed by `change`."""
    log = open_log(OFFICE, ReadOptions(end_s=end))
    with LogWriter(path) as writer:
        writer.occupancy_grid(log.map(), log.summary.origin_ns)  # type: ignore[arg-type]
        for event in map(change, log.events()):
            if isinstance(event, Scan):
                writer.scan(event)
            elif isinstance(event, Odometry):
                writer.odometry(event.stamp_ns, event.T_odom_base)
    return path


def test_a_sound_run_is_good() -> None:
    found = run(RunRequest(logs=(OFFICE,), read=ReadOptions(end_s=20.0), unknown_start=True))
    assert quality_warnings(found) == []
    assert verdict_reasons(found, found.warnings) == ()
    assert not found.clock_evidence().hints  # else all scans of the log are matched once more
    # A robot that stood for long before it could be found was where it was found: its scans have a place.
    stood = replace(found.diagnostics, status=("searching",) * len(found.diagnostics))
    assert quality_warnings(replace(found, diagnostics=stood)) == []
    guessed = replace(found, diagnostics=stood, localised=np.zeros_like(found.localised))
    assert [each.code for each in quality_warnings(guessed)] == [WarningCode.SCANS_WITHOUT_PLACE]


@pytest.mark.unmeasured
def test_a_laser_that_is_mounted_upside_down_unstated_is_warned_of(tmp_path: Path) -> None:
    def mirrored(event: Any) -> Any:
        return replace(event, ranges=event.ranges[::-1].copy()) if isinstance(event, Scan) else event

    found = run(RunRequest(logs=(rewritten(tmp_path / "run.mcap", mirrored, end=12.0),), unknown_start=True))
    (warning,) = quality_warnings(found)
    assert warning.code == WarningCode.SCANS_WITHOUT_PLACE
    assert "--laser-pose" in warning.remedy
    reason = verdict_reasons(found, [warning])[0]
    assert (reason.code, reason.text) == (warning.code, warning.text)
    assert reason.verdict == ("failed" if not found.localised.any() else "check")
    assert 0.0 <= reason.times[0][0] <= reason.times[-1][1] <= 12.0


def test_a_mirrored_map_is_named() -> None:
    found = run(RunRequest(logs=(OFFICE,), read=ReadOptions(end_s=4.0)))
    assert found.states is not None
    assert found.states.mirrored < 0.1
    found = replace(found, states=replace(found.states, mirrored=0.95))
    (warning,) = quality_warnings(found)
    assert (warning.code, "95 %" in warning.text) == (WarningCode.MAP_MIRRORED, True)
    assert [reason.verdict for reason in verdict_reasons(found, [warning])] == ["failed"]


@pytest.mark.unmeasured
def test_a_log_too_short_to_be_sure_is_all_guesses() -> None:
    found = run(RunRequest(logs=(OFFICE,), read=ReadOptions(end_s=0.5), unknown_start=True))
    assert not found.localised.any()
    (warning,) = quality_warnings(found)
    assert "every pose is a guess" in warning.text
    reasons = verdict_reasons(found, [warning])
    assert reasons
    assert {reason.verdict for reason in reasons} == {"failed"}


def test_of_scans_that_fit_nowhere_is_not_said_that_several_places_fit() -> None:
    """On the map of another building there may be some places that fit alike, and badly."""
    found = run(RunRequest(logs=(OFFICE,), read=ReadOptions(end_s=3.0), unknown_start=True))
    assert found.states is not None
    n, stamps = len(found.trajectory), found.diagnostics.stamps_ns
    fitness = np.full(len(stamps), 0.4)
    nowhere = replace(
        found,
        localised=np.zeros(n, dtype=np.bool_),
        states=replace(found.states, state=(State.AMBIGUOUS,) * n),
        diagnostics=replace(found.diagnostics, status=("searching",) * len(stamps), fitness=fitness),
        ambiguities=(Ambiguity(int(stamps[0]), int(stamps[-1]), int(stamps[-1]), ()),),
    )
    summary = ResultSummary.of(analyse(nowhere).metrics)
    assert summary.headline.endswith("most scans fit nowhere on it, and every pose is a guess.")
    assert "found no place on the map" in summary.reasons[0]
    assert "is it the map of this building?" in summary.reasons[0]
    assert not any("several places" in reason for reason in summary.reasons)
    fitting = replace(nowhere, diagnostics=replace(nowhere.diagnostics, fitness=fitness + 0.5))
    summary = ResultSummary.of(analyse(fitting).metrics)
    assert summary.headline.endswith("several places of it fit, and every pose is a guess.")
    assert not any("found no place" in reason for reason in summary.reasons)


def test_odometry_in_millimetres_is_not_mended(tmp_path: Path) -> None:
    def in_millimetres(event: Any) -> Any:
        if isinstance(event, Odometry):
            pose = event.T_odom_base
            return replace(event, T_odom_base=Pose2(1000.0 * pose.x, 1000.0 * pose.y, pose.theta))
        return event

    log = rewritten(tmp_path / "run.mcap", in_millimetres, end=4.0)
    found = run(RunRequest(logs=(log,), initial_pose=Pose2(2.6, 8.1, 1.5708)))
    (warning,) = (each for each in found.warnings if each.code.startswith("odometry"))
    assert warning.code == WarningCode.ODOMETRY_JUMPS
    assert "check" in [reason.verdict for reason in verdict_reasons(found, found.warnings)]
    assert found.odometry.length() > 1000.0  # as it is, but for the first few jumps


def test_a_log_without_a_return_builds_no_map_and_says_what_to_look_at(tmp_path: Path) -> None:
    def without_returns(event: Any) -> Any:
        return replace(event, ranges=np.full_like(event.ranges, np.inf)) if isinstance(event, Scan) else event

    log = rewritten(tmp_path / "run.mcap", without_returns, end=3.0)
    summary = ResultSummary.of(analyse(run(RunRequest(logs=(log,), mode="slam"))).metrics)
    assert (summary.verdict, summary.headline) == ("failed", "Built no map: no scan had enough returns.")
    assert any("hsloc check" in reason for reason in summary.reasons)
    assert not any("--seed" in reason for reason in summary.reasons)


@pytest.mark.parametrize("mode", ["localise", "slam"])
@pytest.mark.parametrize("reset", [Pose2(5.0, 0.0, 0.0), Pose2(0.1, 0.0, 3.0), Pose2(-40.0, 7.0, -2.0)])
def test_odometry_that_is_reset_goes_on_where_it_was_with_a_warning(tmp_path: Path, mode: Any, reset: Any) -> None:
    def reset_odometry(event: Any) -> Any:
        if isinstance(event, Odometry) and event.stamp_ns >= 1_700_000_010_000_000_000:
            return replace(event, T_odom_base=reset @ event.T_odom_base)
        return event

    start = Pose2(2.6, 8.1, 1.5708)
    request = RunRequest(
        logs=(rewritten(tmp_path / "run.mcap", reset_odometry, end=14.0),), mode=mode, initial_pose=start
    )
    found = run(request)
    whole = run(replace(request, logs=(rewritten(tmp_path / "whole.mcap", lambda event: event, end=14.0),)))
    (warning,) = (each for each in found.warnings if each.code == WarningCode.ODOMETRY_RESET)
    assert warning.text.startswith("odometry (/odom) jumps (1 times, first by ")
    assert " at 10.000 s); it is continued" in warning.text
    assert not any(each.code.startswith("odometry") for each in whole.warnings)
    # But for the one step in which it jumped, 2 cm at 1 m/s.
    for name in ("odometry", "trajectory"):
        a, b = getattr(found, name), getattr(whole, name)
        assert np.array_equal(a.stamps_ns, b.stamps_ns)
        assert np.abs(a.poses - b.poses)[:, :2].max() < 0.05
    assert found.localised.all()


def test_the_way_is_retraced_as_far_as_the_scans_fit_and_no_farther(tmp_path: Path) -> None:
    """For three seconds the lidar sees nothing of the map, so that the first poses of the robot cannot be found."""
    rng = np.random.default_rng(0)

    def blind(event: Any) -> Any:
        if isinstance(event, Scan) and event.stamp_ns < 1_700_000_003_000_000_000:
            clutter = rng.uniform(0.3, 6.0, len(event.ranges)).astype(np.float32)
            return replace(event, ranges=clutter)
        return event

    found = run(RunRequest(logs=(rewritten(tmp_path / "run.mcap", blind, end=14.0),), unknown_start=True))
    seconds = (found.trajectory.stamps_ns - 1_700_000_000_000_000_000) / 1e9
    assert not found.localised[seconds < 1.5].any()
    assert found.localised[seconds > 11.0].all()
    truth = open_log(OFFICE, ReadOptions(end_s=14.0))
    known = {e.stamp_ns: e.T_map_base for e in truth.events() if isinstance(e, Truth)}
    for stamp, pose, sure in zip(found.trajectory.stamps_ns, found.trajectory.poses, found.localised, strict=True):
        assert not sure or np.hypot(*(pose[:2] - known[int(stamp)].to_array()[:2])) < 0.3
