"""What the page shows of a result: the errors that metrics.json counts, not others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hsloc.analysis import analyse
from hsloc.evaluation import compare
from hsloc.log import ReadOptions
from hsloc.model import Trajectory
from hsloc.replay.run import run
from hsloc.request import RunRequest
from hsloc_service.execution.worker import execute
from hsloc_service.results.preview import write_viewer

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"


@pytest.fixture(scope="module")
def hall() -> Any:
    return run(RunRequest(logs=(RECORDINGS / "hall.mcap",), read=ReadOptions(end_s=8.0)))


def viewer(result: Any, folder: Any) -> Any:
    analysis = analyse(result)
    write_viewer(result, analysis, folder)
    return json.loads((folder / "viewer.json").read_text()), analysis.metrics


def test_no_error_is_made_up_where_the_reference_has_a_gap(hall: Any, tmp_path: Path) -> None:
    """A robot that turns about while its reference is lost for 3 s was shown an error of metres in between."""
    seconds = (hall.reference.stamps_ns - hall.reference.stamps_ns[0]) / 1e9
    seen = (seconds < 2.0) | (seconds > 5.0)
    gap = Trajectory(hall.reference.stamps_ns[seen], hall.reference.poses[seen])
    shown, metrics = viewer(replace(hall, reference=gap), tmp_path)
    times = np.array(shown["errors"]["t"])
    assert not ((times > 2.1) & (times < 4.9)).any()
    assert len(times) == metrics.errors.matched
    assert max(shown["errors"]["position"]) == pytest.approx(metrics.errors.ape.trans_part.max, abs=1e-4)
    assert max(shown["errors"]["heading"]) == pytest.approx(metrics.errors.ape.angle_deg.max, abs=1e-4)


def test_no_peak_is_left_out_of_a_long_run(hall: Any, tmp_path: Path) -> None:
    reference = Trajectory(np.arange(40_000, dtype=np.int64) * 20_000_000, np.zeros((40_000, 3)))
    poses = np.zeros((40_000, 3))
    poses[12_345, 0], poses[34_567, 2] = 7.0, 1.0
    comparison = compare(Trajectory(reference.stamps_ns, poses), reference)
    write_viewer(hall, replace(analyse(hall), comparison=comparison), tmp_path)
    shown = json.loads((tmp_path / "viewer.json").read_text())["errors"]
    assert len(shown["t"]) <= 3000
    assert max(shown["position"]) == 7.0
    assert max(shown["heading"]) == pytest.approx(np.degrees(1.0), abs=1e-3)


def test_odometry_and_reference_are_those_of_the_report(hall: Any, tmp_path: Path) -> None:
    """The odometry begins at the first localised pose, which need not be the first."""
    localised = hall.localised.copy()
    localised[:40] = False
    moved = replace(hall, localised=localised)
    shown, _ = viewer(moved, tmp_path)
    start = hall.trajectory.poses[40]
    nearest = np.abs(
        np.array(shown["odometry"]["t"]) - (hall.trajectory.stamps_ns[40] - hall.trajectory.stamps_ns[0]) / 1e9
    )
    at = int(np.argmin(nearest))
    assert (shown["odometry"]["x"][at], shown["odometry"]["y"][at]) == pytest.approx(tuple(start[:2]), abs=1e-3)


def test_a_job_whose_poses_are_all_guesses_says_so(tmp_path: Path) -> None:
    """The warnings of the analysis are in the job's summary, not those of the replay alone."""
    (tmp_path / "input").mkdir()
    (tmp_path / "input" / "office.mcap").symlink_to(RECORDINGS / "office.mcap")
    request = {"preset": "default", "unknown_start": True, "seed": 0, "read": {"end_s": 0.5}}
    job = {"request": request, "logs": ["input/office.mcap"]}
    summary = execute(job, tmp_path, lambda *_: None)
    assert [each["code"] for each in summary["warnings"]] == ["scans_without_place"]
    assert summary["metrics"]["verdict"] == "failed"
    assert summary["verdict_reasons"][0]["remedy"]
