"""All scans registered onto each other."""

from __future__ import annotations

import numpy as np
import pytest
from room_scans import room_scan

from hsloc.errors import ConfigError
from hsloc.model.pose2 import Pose2
from hsloc.slam.joint_registration import JointRegistrationParameters, refine
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.pose_graph import Edges


def test_a_pass_uses_what_the_one_before_found_of_scans_that_did_not_move() -> None:
    true = [Pose2(1.0 + 0.3 * k, 1.5, 0.1 * k) for k in range(10)]
    scans = KeyScans.from_scans([KeyScan.of(room_scan(pose, noise=0.01, seed=k)) for k, pose in enumerate(true)])
    poses = np.array([pose.to_array() for pose in true])
    start = poses + np.random.default_rng(3).normal(0.0, (0.03, 0.03, 0.01), poses.shape)
    start[0] = poses[0]
    parameters = JointRegistrationParameters(rounds=6, temporal=9)
    arrays = scans.arrays(parameters.points_per_scan)
    first = refine(start, arrays, Edges.none(), parameters)
    np.testing.assert_allclose(first.poses[:, :2], poses[:, :2], atol=0.02)
    at = first.evaluated.at.copy()
    later = JointRegistrationParameters(gates=parameters.gates[-1:], temporal=9)
    again = refine(first.poses, arrays, Edges.none(), later, previous=first)
    afresh = refine(first.poses, arrays, Edges.none(), later)
    np.testing.assert_array_equal(again.evaluated.at, at)
    np.testing.assert_array_equal(again.counts, first.counts)
    np.testing.assert_allclose(again.poses, afresh.poses, atol=3e-4)
    moved = first.poses.copy()
    moved[4, 0] += 0.02
    changed = refine(moved, arrays, Edges.none(), later, previous=first)
    touches = (first.pairs == 4).any(axis=1)
    assert (changed.evaluated.at[touches] != at[touches]).any(axis=1).all()
    np.testing.assert_allclose(changed.poses, afresh.poses, atol=3e-3)


def test_a_registration_of_no_scans_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_scans_per_view is 0; it must be from 1"):
        JointRegistrationParameters(max_scans_per_view=0)
