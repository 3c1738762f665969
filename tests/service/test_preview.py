"""What the page shows of a result: the errors that metrics.json counts, not others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hsloc.analysis.analyse import analyse
from hsloc.export.results_folder import report_parts
from hsloc.log import ReadOptions
from hsloc.model import Trajectory
from hsloc.replay.run import run
from hsloc.report.view import view_of
from hsloc.request import RunRequest
from hsloc_service.execution.worker import execute

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"


@pytest.fixture(scope="module")
def hall() -> Any:
    return run(RunRequest(logs=(RECORDINGS / "hall.mcap",), read=ReadOptions(end_s=8.0)))


def shown(result: Any) -> Any:
    analysis = analyse(result)
    return view_of(report_parts(result, analysis))[0], analysis.metrics


def chart(view: Any, name: str) -> Any:
    (found,) = [each for each in view["charts"] if each["name"] == name]
    return found


def test_no_error_is_made_up_where_the_reference_has_a_gap(hall: Any) -> None:
    """A robot that turns about while its reference is lost for 3 s was shown an error of metres in between."""
    seconds = (hall.reference.stamps_ns - hall.reference.stamps_ns[0]) / 1e9
    seen = (seconds < 2.0) | (seconds > 5.0)
    gap = Trajectory(hall.reference.stamps_ns[seen], hall.reference.poses[seen])
    view, metrics = shown(replace(hall, reference=gap))
    curve = chart(view, "error_cm")
    times = np.array(curve["t"])
    assert not ((times > 2.1) & (times < 4.9)).any()
    assert len(times) == metrics.errors.matched
    assert max(curve["v"]) == pytest.approx(100.0 * metrics.errors.ape.trans_part.max, rel=1e-4)
    assert max(chart(view, "error_deg")["v"]) == pytest.approx(metrics.errors.ape.angle_deg.max, rel=1e-4)
    path = view["trajectory"]
    known = [t for t, error in zip(path["t"], path["error"], strict=True) if error is not None]
    assert not any(2.2 < t < 4.8 for t in known)


def test_odometry_and_reference_are_those_of_the_report(hall: Any) -> None:
    """The odometry begins at the first localised pose, which need not be the first."""
    localised = hall.localised.copy()
    localised[:40] = False
    view, _ = shown(replace(hall, localised=localised))
    start = hall.trajectory.poses[40]
    x, y = np.array(view["odometry"]["x"]), np.array(view["odometry"]["y"])
    assert np.hypot(x - start[0], y - start[1]).min() < 2e-3
    assert view["lost"] == [[0.0, pytest.approx((hall.trajectory.stamps_ns[40] - hall.trajectory.stamps_ns[0]) / 1e9)]]
    # All scans of a run on a map that fits lie on walls.
    assert max(far for far in view["scans"]["far"]) <= 0.15
    assert view["ellipses"] is not None


def test_a_job_whose_poses_are_all_guesses_has_a_warning(tmp_path: Path) -> None:
    """The warnings of the analysis are in the job's summary, not those of the replay alone."""
    (tmp_path / "input").mkdir()
    (tmp_path / "input" / "office.mcap").symlink_to(RECORDINGS / "office.mcap")
    request = {"preset": "default", "unknown_start": True, "seed": 0, "read": {"end_s": 0.5}}
    job = {"request": request, "logs": ["input/office.mcap"]}
    summary = execute(job, tmp_path, lambda *_: None)
    assert [each["code"] for each in summary["warnings"]] == ["scans_without_place"]
    assert summary["metrics"]["verdict"] == "failed"
    assert summary["verdict_reasons"][0]["remedy"]
    assert summary["run"]["seed"] == 0
    assert len(summary["run"]["group"]) == 16
