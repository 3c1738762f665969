"""Scans beside their place: one that the refinement left 0.4 m off, between others that are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from room_scans import room_scan

from hsloc.config import Config
from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.slam.joint_registration import Registration, refine
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.map_session import MapSession
from hsloc.slam.pose_graph import Edges
from hsloc.slam.stray_scans import put_back
from hsloc.slam.submaps import Submaps

N = 15
STRAY = (7, 8)


@pytest.fixture(scope="module")
def session() -> MapSession:
    true = np.column_stack((1.5 + 0.15 * np.arange(N), np.full(N, 2.0), np.zeros(N)))
    scans = [
        KeyScan.of(room_scan(Pose2.from_array(pose), beams=271, noise=0.01, seed=k)) for k, pose in enumerate(true)
    ]
    motions = np.concatenate((np.zeros((1, 3)), relative_poses(true[:-1], true[1:])))
    covariances = np.broadcast_to(np.diag((0.02**2, 0.02**2, 0.01**2)), (N, 3, 3)).copy()
    refused = np.zeros(N, dtype=bool)
    refused[STRAY[0]] = True
    submaps = Submaps.split_by_path_length(true, motions, covariances, 1.0, 0.3)
    steps = Edges.chain(motions[1:], covariances[1:])
    return MapSession(KeyScans.from_scans(scans), np.arange(N), true, motions, covariances, refused, steps, submaps)


def refined(session: MapSession, offset: float) -> Registration:
    """The map whose scans in the middle were taken `offset` metres aside, and where the odometry has no weight."""
    poses = session.poses.copy()
    poses[list(STRAY), 1] += offset
    parameters = Config().graph_mapper.joint_registration
    narrow = replace(parameters, gates=parameters.gates[-1:])
    return refine(poses, session.scans.arrays(parameters.points_per_scan), slipped(session), narrow)


def slipped(session: MapSession) -> Edges:
    return replace(session.steps, information=session.steps.information * 1e-4)


def test_scans_that_are_beside_their_place_are_put_back(session: MapSession) -> None:
    mapper = Config().graph_mapper
    stray = refined(session, 0.5)
    assert np.abs(stray.poses - session.poses)[list(STRAY), 1].min() > 0.3, "the refinement alone leaves them there"
    arrays = session.scans.arrays(mapper.joint_registration.points_per_scan)
    found, passes = put_back(stray, session, arrays, slipped(session), mapper)
    assert passes > 0
    assert np.abs(found.poses - session.poses).max() < 0.02


def test_a_right_map_and_scans_that_no_step_refused_stay(session: MapSession) -> None:
    mapper = Config().graph_mapper
    arrays = session.scans.arrays(mapper.joint_registration.points_per_scan)
    right = refined(session, 0.0)
    assert put_back(right, session, arrays, slipped(session), mapper) == (right, 0)
    stray = refined(session, 0.5)
    sure = replace(session, refused=np.zeros(N, dtype=bool))
    assert put_back(stray, sure, arrays, slipped(session), mapper) == (stray, 0)
