from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from drives import ape_rmse, drive

from hsloc.localisation.motion_models import OdometryNoise
from hsloc.model import Odometry, PairedScan, Pose2
from hsloc.simulation.odometer import Slip
from hsloc.simulation.presets import preset
from hsloc.slam.calibration import odometry_chi, odometry_scale
from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import GraphMapperParameters

if TYPE_CHECKING:
    from hsloc.slam.result import MappingResult


def mapped(events: list[Odometry | PairedScan]) -> MappingResult:
    mapper = Mapper(GraphMapperParameters(), np.random.default_rng(0))
    for event in events:
        mapper.update(event)
    return mapper.finish()


def test_the_weight_of_the_odometry_is_what_its_steps_deserve() -> None:
    noise, random = OdometryNoise(), np.random.default_rng(0)
    motion = Pose2(0.3, 0.0, 0.2)
    root = np.linalg.cholesky(noise.covariance(motion) + np.diag((0.005, 0.005, 0.002)) ** 2)
    for factor in (0.7, 1.0, 3.0):
        errors = factor * random.normal(size=(400, 3)) @ root.T
        motions = np.tile(motion.to_array(), (400, 1))
        chi = odometry_chi(motions, motions + errors, np.tile(noise.covariance(motion), (400, 1, 1)))
        assert odometry_scale(chi) == pytest.approx(factor, rel=0.15)
    assert odometry_scale(np.full(100, 0.01)) == 0.5
    assert odometry_scale(np.array([9.0])) == 1.0, "one step says nothing"


@pytest.mark.parametrize(
    "slip",
    [
        Slip(at_s=12.0, duration_s=0.5, factor=1.0, turn_rate=np.radians(160.0)),
        Slip(at_s=12.0, duration_s=0.5, factor=-1.0),
        Slip(at_s=12.0, duration_s=0.8, factor=2.0),
    ],
    ids=["80 deg", "reversed", "1 m"],
)
def test_a_step_that_odometry_has_wrong_is_found_by_the_scans(slip: Slip) -> None:
    """An 80 degree turn that did not happen was refused, and the rest of the map turned with it."""
    events, truth = drive("office", duration_s=25.0, seed=4, slips=(slip,))
    result = mapped(events)
    assert ape_rmse(events, result.scan_poses, truth) < 0.03
    assert result.evidence.verdict == "good"


def test_a_lidar_that_sees_four_metres_does_not_shorten_corridors() -> None:
    """The mean score pulled every step back to where the scans overlapped most."""
    sensor = replace(preset("corridor-loop").sensor, range_max=4.0)
    events, truth = drive("corridor-loop", duration_s=30.0, seed=2, sensor=sensor)
    result = mapped(events)
    assert ape_rmse(events, result.scan_poses, truth) < 0.15
