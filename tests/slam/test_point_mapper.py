from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from drives import drive

from hsloc.errors import ConfigError
from hsloc.matching.hide import Hide
from hsloc.model import PairedScan, Pose2, Scan, Status
from hsloc.simulation.odometer import SteeringNoise
from hsloc.simulation.presets import preset
from hsloc.slam.point_mapper import PointMapper, PointMapperParameters

if TYPE_CHECKING:
    from numpy.typing import NDArray


def scan_of(points: NDArray[np.float64], stamp: int = 0) -> Scan:
    ranges, angles = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    beams = np.full(720, np.inf, np.float32)
    beams[np.round((angles + np.pi) / (np.pi / 360)).astype(int) % 720] = ranges
    return Scan(stamp, beams, -np.pi, np.pi / 360, 0.0, 100.0)


@pytest.fixture
def mapper() -> PointMapper:
    return PointMapper(Hide(), PointMapperParameters(), np.random.default_rng(0), Pose2(10.0, 5.0, 0.2))


def test_the_first_scan_is_the_map(mapper: PointMapper) -> None:
    points = np.array([(5.0, 0.0), (0.0, 8.0), (-3.0, -3.0), (7.0, 7.0)])
    found = mapper.update(PairedScan(scan_of(points), Pose2()))
    assert found.T_map_base == Pose2(10.0, 5.0, 0.2)
    assert found.status is Status.MATCHED
    assert len(mapper.points) == 4
    np.testing.assert_allclose(np.sort(mapper.points, axis=0), np.sort(Pose2(10, 5, 0.2) @ points, axis=0), atol=0.1)


def test_only_points_far_from_the_map_are_added(mapper: PointMapper) -> None:
    points = np.array([(5.0, 0.0), (0.0, 8.0), (-3.0, -3.0), (7.0, 7.0), (-9.0, 2.0), (4.0, -8.0)])
    mapper.update(PairedScan(scan_of(points), Pose2()))
    more = np.concatenate((points, [(20.0, 6.0), (5.9, 0.3)]))
    found = mapper.update(PairedScan(scan_of(more, 10**8), Pose2()))
    assert found.fitness is not None
    assert found.fitness > 0.5
    assert len(mapper.points) == 7
    np.testing.assert_allclose(mapper.points[-1], Pose2(10, 5, 0.2) @ np.array((20.0, 6.0)), atol=0.4)


def test_a_scan_that_does_not_fit_adds_nothing(mapper: PointMapper) -> None:
    random = np.random.default_rng(2)
    mapper.update(PairedScan(scan_of(random.uniform(5, 9, (30, 2))), Pose2()))
    before = len(mapper.points)
    found = mapper.update(PairedScan(scan_of(-random.uniform(15, 40, (30, 2))), Pose2()))
    assert len(mapper.points) == before
    assert "nothing added" in found.reason


def test_too_few_points_leave_the_prediction(mapper: PointMapper) -> None:
    mapper.update(PairedScan(scan_of(np.array([(5.0, 0.0), (0.0, 8.0), (-3.0, -3.0)])), Pose2()))
    found = mapper.update(PairedScan(scan_of(np.array([(5.0, 0.0), (0.0, 8.0)])), Pose2(1.0, 0.0, 0.0)))
    assert found.status is Status.NO_RETURNS
    assert found.T_map_base.distance(Pose2(10, 5, 0.2) @ Pose2(1.0, 0.0, 0.0)) < 1e-12
    assert mapper.grid().occupied().sum() == 3


def test_the_reports_experiment_is_bettered() -> None:
    """E4: range 60 m, 0.2 m/s and 1 deg of noise; [P]: 0.223 m, 0.333 m, 0.0356 rad with Harmony Search."""
    sensor = replace(preset("paper").sensor, range_max=60.0)
    events, truth = drive("paper", seed=1, sensor=sensor, odometry=SteeringNoise(0.2, np.radians(1.0)))
    mapper = PointMapper(Hide(), PointMapperParameters(), np.random.default_rng(1), Pose2.from_array(truth.poses[0]))
    found = [mapper.update(event) for event in events]
    stamps = np.array([estimate.stamp_ns for estimate in found])
    errors = np.array([estimate.T_map_base.to_array() for estimate in found]) - truth.interpolated(
        np.clip(stamps, truth.stamps_ns[0], truth.stamps_ns[-1])
    )
    errors[:, 2] = (errors[:, 2] + np.pi) % (2 * np.pi) - np.pi
    x, y, theta = np.sqrt((errors**2).mean(axis=0))
    assert x < 0.223
    assert y < 0.333
    assert theta < 0.036
    assert 330 < len(mapper.points) < 420


@pytest.mark.parametrize("wrong", [{"sigma": 0.0}, {"max_distance": 1.0}, {"min_points": 0}])
def test_parameters_out_of_range_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        PointMapperParameters(**wrong)
