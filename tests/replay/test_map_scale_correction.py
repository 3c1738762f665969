"""A map whose resolution is wrong is corrected where the odometry agrees with the lidar, and the log replayed again."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.analysis.metrics import map_metrics
from hsloc.analysis.quality import quality_warnings
from hsloc.localisation.map_scale import MapScale
from hsloc.maps import save_map
from hsloc.model import Pose2, Trajectory
from hsloc.model.estimate import ScanDiagnostics, Status
from hsloc.replay.map_and_start import ScaleEvidence
from hsloc.replay.run import run
from hsloc.run_metrics import ResidualMetrics
from hsloc.simulation.built_in import built_in
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

LARGER = MapScale(1.02, 0.001, (1.0, 2.0))
RIGHT = MapScale(1.001, 0.001, corrected=1.02)


def test_on_a_map_that_is_too_large_poses_are_right_in_metres(tmp_path: Path) -> None:
    grid = built_in("office").occupancy_grid(0.05)
    path = save_map(replace(grid, resolution=1.02 * grid.resolution), tmp_path)
    found = run(RECORDINGS / "office.mcap", map=path)
    assert found.reference is not None
    off = found.trajectory.interpolated(found.reference.stamps_ns) - found.reference.poses
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.06
    assert found.localised[1:].all()
    assert found.given_resolution == pytest.approx(0.051)
    assert found.grid.resolution == pytest.approx(0.05, rel=0.002)
    no_points = ResidualMetrics(points=0, median=None, p95=None, within_15_cm=None)
    scale = map_metrics(found, no_points, comparison=None).scale
    assert scale is not None
    assert (scale.corrected, scale.resolution) == (True, found.grid.resolution)
    assert scale.value == pytest.approx(1.02, abs=3.0 * scale.sigma)
    (warning,) = (each for each in quality_warnings(found) if each.code == WarningCode.MAP_SCALE)
    assert "larger than the lidar" in warning.text
    assert f"set resolution: {found.grid.resolution:.5g} in the map's YAML (it is 0.051)" in warning.remedy


def evidence(
    by_odometry: float, scale: MapScale = LARGER, fitness: float = 0.8, status: Status = Status.MATCHED
) -> ScaleEvidence:
    """Of a robot that drives 30 m along the odometry, and `by_odometry` times that on the map."""
    x = np.linspace(0.0, 30.0, 301)
    poses = np.column_stack((x, np.zeros(301), np.zeros(301)))
    stamps = np.arange(301, dtype=np.int64) * 100_000_000
    scans = ScanDiagnostics(
        stamps,
        (status.value,) * 301,
        np.full(301, fitness),
        np.zeros((301, 3)),
        stamps,
        ("",) * 301,
        np.zeros((301, 3, 3)),
    )
    return ScaleEvidence.of(scale, scans, Trajectory(stamps, poses), Trajectory(stamps, poses * (by_odometry, 1, 1)))


@pytest.mark.parametrize(
    ("by_odometry", "is_right"), [(1.03, True), (1.0, True), (0.992, True), (0.988, False), (0.98, False)]
)
def test_the_odometry_decides_whether_map_or_lidar_is_wrong(by_odometry: float, is_right: bool) -> None:
    after = evidence(by_odometry, RIGHT, 0.9)
    assert after.by_odometry == pytest.approx(by_odometry)
    assert after.is_better(evidence(1.02)) == is_right


def test_a_scale_that_may_be_right_is_not_corrected() -> None:
    assert evidence(1.02).hints
    assert not evidence(1.02, replace(LARGER, sigma=0.007)).hints


def test_where_most_scans_find_no_match_only_a_scale_at_which_they_fit_is_tried() -> None:
    assert not evidence(1.02, status=Status.REJECTED).hints
    assert evidence(1.02, replace(LARGER, by_fit=True), status=Status.REJECTED).hints


def test_a_correction_is_kept_where_scans_fit_better_and_nothing_is_left() -> None:
    before = evidence(1.02)
    assert not evidence(1.0, RIGHT, 0.7).is_better(before)
    assert not evidence(1.0, replace(RIGHT, value=1.01), 0.9).is_better(before)


def test_a_pose_keeps_its_cell_on_the_corrected_map() -> None:
    grid = replace(built_in("office").occupancy_grid(0.05), origin=Pose2(1.0, 2.0, 0.3))
    corrected, pose = LARGER.applied(grid), Pose2(7.0, 5.0, 0.4)
    before, after = (
        (each.origin.inverse() @ at).to_array() / (each.resolution, each.resolution, 1.0)
        for each, at in ((grid, pose), (corrected, LARGER.moved(pose)))
    )
    np.testing.assert_allclose(before, after)
    errors = replace(LARGER, value=1.0, corrected=1.02).pose_errors(np.array([(11.0, 2.0, 0.0)]))
    np.testing.assert_allclose(errors, [(0.01, 0.0, 0.0)])
