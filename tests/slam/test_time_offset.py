"""The offset between the stamps of scans and odometry is found with an uncertainty that holds, or not at all."""

from __future__ import annotations

import re
from dataclasses import replace
from math import isfinite
from pathlib import Path

import numpy as np
import pytest

from hsloc.analysis.analyse import analyse
from hsloc.evaluation import evaluate
from hsloc.evaluation.association import interpolate_poses
from hsloc.log import ReadOptions, convert_log, open_log
from hsloc.model import Odometry, Scan
from hsloc.model.pose2 import relative_poses
from hsloc.replay.clock_offset import as_option
from hsloc.replay.run import run
from hsloc.request import RunRequest
from hsloc.slam.front_end_parameters import FrontEndParameters
from hsloc.slam.heading_offset import UNKNOWN, Headings, Offset, find_offset
from hsloc.slam.time_offset import best_offset, clock_warnings, estimate_offset, find_drift, offsets_of_log

OFFICE = Path(__file__).resolve().parents[2] / "recordings" / "office.mcap"
END = ReadOptions(end_s=30.0)


def headings(seed: int, offset_s: float, noise: float, turns: bool = True) -> tuple[Headings, Headings]:
    """A robot that turns at random for a minute: what its scans show, late by `offset_s`, and its odometry."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 60.0, 0.02)
    rate = np.interp(t, np.arange(0.0, 61.0, 1.5), rng.normal(0.0, 0.5, 41)) if turns else np.zeros(len(t))
    theta = np.cumsum(rate) * 0.02
    seen = np.arange(1.0, 58.0, 0.1)
    scans = np.interp(seen, t, theta) + rng.normal(0.0, noise, len(seen))
    drift = np.cumsum(rng.normal(0.0, 0.02, len(t)) * np.abs(rate)) * 0.02
    return (
        Headings.of(np.round((seen + offset_s) * 1e9).astype(np.int64), scans),
        Headings.of(np.round(t * 1e9).astype(np.int64), theta * 1.02 + drift),
    )


@pytest.mark.parametrize("offset", [-0.3, -0.05, 0.0, 0.013, 0.2, 0.45])
@pytest.mark.parametrize("noise", [0.0005, 0.005])
def test_the_offset_is_found_and_its_interval_holds(offset: float, noise: float) -> None:
    """95 of 100 intervals hold; of 40 at least 34 do with a probability of 0.9999."""
    found = [find_offset(*headings(seed, offset, noise)) for seed in range(40)]
    errors = np.array([each.seconds - offset for each in found])
    assert np.abs(errors).max() < 0.02
    assert sum(abs(error) < 1.96 * each.sigma for error, each in zip(errors, found, strict=True)) >= 34


def test_sound_stamps_raise_no_word() -> None:
    assert sum(find_offset(*headings(seed, 0.0, 0.003)).is_significant for seed in range(100)) == 0


@pytest.mark.parametrize("offset", [0.0, 0.15])
@pytest.mark.parametrize("hz", [1, 2, 3])
def test_sparse_odometry_is_compared_where_it_is(hz: int, offset: float) -> None:
    """Interpolated to the scans at 10 Hz it showed offsets of 0.03 to 0.07 s that were none."""
    found = []
    for seed in range(40):
        scans, odometry = headings(seed, offset, 0.003)
        found.append(find_offset(scans, Headings(odometry.stamps_ns[:: 50 // hz], odometry.theta[:: 50 // hz])))
    assert sum(each.is_significant for each in found) == (40 if offset else 0)
    assert sum(abs(each.seconds - offset) < 1.96 * each.sigma for each in found) >= 34


@pytest.mark.parametrize("late", [0.0, 0.2])
def test_noise_of_odometry_that_comes_with_the_scans_is_no_offset(late: float) -> None:
    """Half-way between two samples their noise is averaged: offsets of up to 0.09 s were found, 6 to 24 sigma."""
    found = []
    for seed in range(40):
        scans, odometry = headings(seed, late, 0.003)
        stamps = scans.stamps_ns[::2]
        theta = np.interp(stamps, odometry.stamps_ns, odometry.theta)
        steps = np.diff(theta)
        noisy = steps * (1.0 + 0.2 * np.random.default_rng(seed).normal(size=len(steps)))
        found.append(
            find_offset(Headings(stamps, scans.theta[::2]), Headings(stamps, np.concatenate(([0.0], np.cumsum(noisy)))))
        )
    assert not any(abs(each.seconds - late) > 4.0 * each.sigma for each in found)
    assert sum(each.is_significant for each in found) >= 38 if late else not any(each.is_certain for each in found)


def test_only_offsets_far_from_chance_are_removed_unasked() -> None:
    assert Offset(0.167, 0.003).is_certain
    assert not Offset(0.054, 0.012).is_certain
    assert not Offset(0.167, 0.003, drift_s=0.2).is_certain
    assert not UNKNOWN.is_certain


def test_an_offset_within_a_sweep_is_one_of_the_sweep() -> None:
    # Of robots that turn on the spot in flats, with lidars of 5 and 6 Hz.
    assert Offset(0.024, 0.002, half_sweep_s=0.1).is_of_sweep
    assert Offset(0.022, 0.002, half_sweep_s=0.083).is_of_sweep
    assert not Offset(0.09, 0.002, half_sweep_s=0.1).is_of_sweep
    assert not Offset(0.024, 0.002).is_of_sweep


def test_a_robot_that_does_not_turn_does_not_determine_it() -> None:
    found = find_offset(*headings(1, 0.2, 0.0005, turns=False))
    assert not found.is_significant
    assert found == UNKNOWN or found.sigma > 0.1


def test_clocks_that_are_seconds_apart_are_found_over_the_whole_range() -> None:
    for offset in (-20.0, 3.2, 30.0):
        assert find_offset(*headings(2, offset, 0.002), near_s=40.0).seconds == pytest.approx(offset, abs=0.02)


def test_a_turn_that_the_scans_missed_is_not_taken_for_the_next_one() -> None:
    """Where a lidar paused in a turn, the stamps of a right log were moved by 34.7 s, from corner to corner."""
    t = np.arange(0.0, 64.0, 0.02)
    theta = 0.5 * np.pi * np.clip(t[:, None] - np.arange(8.0, 60.0, 16.0), 0.0, 1.0).sum(axis=1)
    odometry = Headings.of(np.round(t * 1e9).astype(np.int64), theta)
    random = np.random.default_rng(0)
    seen = np.concatenate((np.arange(0.0, 24.1, 0.1), np.arange(34.0, 64.0, 0.1)))
    missed = np.interp(seen, t, theta) - 0.5 * np.pi * (seen > 30.0) + random.normal(0.0, 0.002, len(seen))
    for late in (0.0, 0.2):
        found = best_offset(Headings.of(np.round((seen + late) * 1e9).astype(np.int64), missed), odometry)
        assert found.seconds == pytest.approx(late, abs=0.02)


@pytest.mark.parametrize("drift", [0.0, 0.3, -0.5])
def test_clocks_that_drift_are_distinguished_from_an_offset(drift: float) -> None:
    scans, odometry = headings(3, 0.1, 0.001)
    first, last = scans.stamps_ns[[0, -1]]
    share = (scans.stamps_ns - first) / (last - first)
    moved = Headings(scans.stamps_ns + np.round(share * drift * 1e9).astype(np.int64), scans.theta)
    assert find_drift(moved, odometry, 0.1 + 0.5 * drift) == pytest.approx(drift, abs=0.4 * abs(drift))


def test_scans_that_turn_against_the_odometry_are_mirrored_and_not_late() -> None:
    fix = replace(END, scan_fix="angles=negate")
    (found,) = offsets_of_log((OFFICE,), fix, FrontEndParameters()).values()
    assert found.is_mirrored
    assert not found.is_significant
    ((_, warning),) = clock_warnings({"/scan": found})
    assert "angles=negate" in warning.remedy


@pytest.mark.unmeasured
@pytest.mark.parametrize("late", [0.0, 0.1, -0.25])
def test_the_scans_of_a_log_alone_show_it(late: float) -> None:
    def shifted() -> list[Odometry | Scan]:
        events = [event for event in open_log(OFFICE, END).events() if isinstance(event, Odometry | Scan)]
        return [
            replace(event, stamp_ns=event.stamp_ns + round(late * 1e9)) if isinstance(event, Scan) else event
            for event in events
        ]

    found = estimate_offset(shifted(), FrontEndParameters(), np.random.default_rng(0))
    assert isfinite(found.sigma)
    assert found.seconds == pytest.approx(late, abs=0.005)
    assert found.is_significant is (late != 0.0)


def test_a_run_warns_of_late_scans_and_auto_removes_it(tmp_path: Path) -> None:
    late = replace(END, time_offset="/scan=0.2")
    warned = run(RunRequest(logs=(OFFICE,), read=late))
    metrics = analyse(warned).metrics
    (warning,) = (w for w in metrics.warnings if w.code.startswith("clock_offset"))
    assert "0.20" in warning.text
    assert re.search(r"--time-offset /scan=-?0\.00", warning.remedy)
    assert metrics.verdict == "check"
    found = offsets_of_log((OFFICE,), END, FrontEndParameters())
    assert as_option(found, "/odom", deskew=False) is None
    sound = run(RunRequest(logs=(OFFICE,), read=replace(END, time_offset="auto")))
    assert sound.reference is not None
    assert evaluate(sound.trajectory, sound.reference).ape.trans_part.rmse < 0.01
    assert analyse(sound).metrics.warnings == ()


def test_what_is_late_is_moved() -> None:
    """Messages wait, and are stamped late, not early: of scans that are early it is the odometry that is late."""
    late, early = (UNKNOWN._replace(seconds=s, sigma=0.001, half_sweep_s=0.05) for s in (0.2, -0.2))
    assert as_option({"/scan": late}, "/odom", deskew=True) == "/scan=-0.200"
    assert as_option({"/scan": late}, "/odom", deskew=False) == "/scan=-0.150"
    assert as_option({"/scan": early}, "/odom", deskew=True) == "/odom=-0.200"
    assert as_option({"/scan": early}, "/odom", deskew=False) == "/odom=-0.200,/scan=0.050"
    assert as_option({"FLASER + RLASER": early}, None, deskew=False) == "FLASER=0.250"
    earlier = early._replace(seconds=-0.3)
    assert as_option({"/front": early, "/rear": earlier}, "/odom", deskew=True) == "/odom=-0.200,/rear=0.100"
    assert as_option({"/front": late, "/rear": early}, "/odom", deskew=True) == "/front=-0.200,/rear=0.200"
    sound = UNKNOWN._replace(seconds=0.0, sigma=0.001)
    assert as_option({"/front": sound, "/rear": early}, "/odom", deskew=True) == "/rear=0.200"


@pytest.mark.parametrize("seconds", [0.164, -0.164])
@pytest.mark.parametrize("odometry", ["/odom", None])
def test_why_a_correction_is_not_the_whole_offset_is_said(seconds: float, odometry: str | None) -> None:
    """Scans that are not deskewed are moved to the middle of their sweep, 0.067 s after the stamp of the first beam."""
    found = {"/scan": UNKNOWN._replace(seconds=seconds, sigma=0.002, half_sweep_s=0.067)}
    for deskew in (False, True):
        ((_, warning),) = clock_warnings(found, removed=as_option(found, odometry, deskew=deskew))
        assert ("half a sweep, 0.067 s, is kept" in warning.text) is not deskew
    ((_, warning),) = clock_warnings(found, removed="/scan=0.0")
    assert warning.text.endswith(f"; {seconds:.3f} s of it are left, as the corrected run shows")


def test_odometry_that_is_late_is_moved(tmp_path: Path) -> None:
    late = tmp_path / "late.mcap"
    convert_log(open_log((OFFICE,), replace(END, time_offset="/odom=0.3", end_s=20.0)), late)
    result = run(RunRequest(logs=(late,)))
    assert [warning.code for warning in analyse(result).metrics.warnings] == ["clock_offset_applied"]
    assert result.reading is not None
    assert result.reading.offsets_s()["odom"] == pytest.approx(-0.3, abs=0.01)
    assert result.reference is not None
    assert evaluate(result.trajectory, result.reference).ape.trans_part.max < 0.05


def test_late_scans_of_a_log_that_is_mapped_are_corrected(tmp_path: Path) -> None:
    """Relations with stamps of scans as recorded are compared at these scans, others in the odometry's clock."""
    late = tmp_path / "late.mcap"
    convert_log(open_log((OFFICE,), replace(END, time_offset="/scan=0.25", end_s=20.0)), late)
    scans = [event.stamp_ns for event in open_log(late).events() if isinstance(event, Scan)]
    truth = run(RunRequest(logs=(late,))).reference
    assert truth is not None
    at = np.array(scans[20:-20:15])
    means = []
    for name, stamps in (("recorded", at), ("moved", at - 250_000_000)):
        poses = interpolate_poses(truth, at - 250_000_000)
        steps = relative_poses(poses[:-1], poses[1:])
        path = tmp_path / f"{name}.relations"
        rows = zip(stamps[:-1].tolist(), stamps[1:].tolist(), steps.tolist(), strict=True)
        path.write_text("".join(f"{a / 1e9:.9f} {b / 1e9:.9f} {x} {y} 0 0 0 {theta}\n" for a, b, (x, y, theta) in rows))
        result = run(RunRequest(logs=(late,), mode="slam", relations=path))
        metrics = analyse(result).metrics
        assert [each.code for each in metrics.warnings] == ["clock_offset_applied"]
        assert metrics.verdict != "failed"
        assert metrics.log.clock_offsets is not None
        (offset,) = metrics.log.clock_offsets
        assert offset.corrected
        assert offset.seconds == pytest.approx(0.25, abs=0.005)
        topic, _, moved = (metrics.log.time_offset or "").partition("=")
        assert topic == "/scan"
        assert float(moved) == pytest.approx(-offset.seconds, abs=0.005)
        assert metrics.relations is not None
        means.append(metrics.relations.statistics.trans_part.mean)
    assert max(means) < 0.02


@pytest.mark.unmeasured
def test_stamps_of_a_log_that_is_localised_are_corrected_unless_the_user_gives_them(tmp_path: Path) -> None:
    late = tmp_path / "late.mcap"
    convert_log(open_log((OFFICE,), replace(END, time_offset="/scan=0.2", end_s=20.0)), late)
    result = run(RunRequest(logs=(late,)))
    metrics = analyse(result).metrics
    assert [warning.code for warning in metrics.warnings] == ["clock_offset_applied"]
    assert metrics.verdict == "good"
    assert result.reference is not None
    assert evaluate(result.trajectory, result.reference).ape.trans_part.max < 0.05
    as_stamped = run(RunRequest(logs=(late,), read=ReadOptions(time_offset="/scan=0")))
    assert [each.code for each in analyse(as_stamped).metrics.warnings] == ["clock_offset_large"]
    assert evaluate(as_stamped.trajectory, result.reference).ape.trans_part.max > 0.15


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_a_few_headings_show_neither_offset_nor_drift(n: int) -> None:
    few = Headings(np.arange(n) * 10**8, np.zeros(n))
    many = Headings(np.arange(50) * 10**8, np.sin(np.arange(50)))
    for scans, odometry in ((few, many), (many, few), (few, few)):
        assert not find_offset(scans, odometry).is_significant
        assert find_drift(scans, odometry, 0.0) == 0.0
