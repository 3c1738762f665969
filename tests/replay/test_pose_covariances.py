"""Covariances of the poses between matched scans."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.model import Trajectory
from hsloc.model.pose2 import Pose2
from hsloc.replay.pose_covariances import pose_covariances


def test_each_is_that_of_the_last_known_scan_propagated_over_the_motion_since(rng: np.random.Generator) -> None:
    n, model = 12, OdometryNoise()
    poses = rng.uniform(-2.0, 2.0, (n, 3))
    trajectory, localised = Trajectory(np.arange(n, dtype=np.int64) * 10, poses), np.arange(n) != 7
    roots = rng.normal(size=(4, 3, 3))
    covariance = roots @ roots.transpose(0, 2, 1)
    covariance[2] = np.nan
    scans: Any = SimpleNamespace(stamps_ns=np.array([65, 18, 30, 40], dtype=np.int64), covariance=covariance)
    found = pose_covariances(trajectory, localised, scans, model.covariance)
    for row in range(n):
        if row < 2 or row == 7:  # before the first scan, and where the pose is not localised
            assert np.isnan(found[row]).all()
            continue
        scan, first = (1, 2) if row < 4 else (3, 4) if row < 7 else (0, 8)
        anchor = Pose2.from_array(poses[first])
        motion = anchor.between(Pose2.from_array(poses[row]))
        expected = predict_covariance(covariance[scan], anchor, motion, model.covariance(motion))
        np.testing.assert_allclose(found[row], expected, rtol=1e-9, atol=1e-12)
    assert np.isnan(pose_covariances(trajectory, np.zeros(n, dtype=bool), scans, model.covariance)).all()
