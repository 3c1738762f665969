"""Scans beside their place, between others that are right, which the refinement leaves there."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from room_scans import room_scan

from hsloc.config import Config
from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.slam.joint_registration import Registration, refine
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.map_session import MapSession
from hsloc.slam.pose_graph import Edges
from hsloc.slam.stray_scans import _joined, put_back
from hsloc.slam.submaps import Submaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

N = 15
STRAY = (7, 8)


def session_of(true: F64, refused: tuple[int, ...], steps: F64 | None = None) -> MapSession:
    """A robot at `true` poses (n, 3) in a room; the odometry measured `steps` (n - 1, 3), or the truth."""
    scans = [
        KeyScan.of(room_scan(Pose2.from_array(pose), beams=271, noise=0.01, seed=k)) for k, pose in enumerate(true)
    ]
    n, measured = len(true), relative_poses(true[:-1], true[1:]) if steps is None else steps
    motions = np.concatenate((np.zeros((1, 3)), measured))
    covariances = np.broadcast_to(np.diag((0.02**2, 0.02**2, 0.01**2)), (n, 3, 3)).copy()
    is_refused = np.zeros(n, dtype=bool)
    is_refused[list(refused)] = True
    submaps = Submaps.split_by_path_length(true, motions, covariances, 1.0, 0.3)
    edges = Edges.chain(motions[1:], covariances[1:])
    return MapSession(KeyScans.from_scans(scans), np.arange(n), true, motions, covariances, is_refused, edges, submaps)


@pytest.fixture(scope="module")
def session() -> MapSession:
    return session_of(np.column_stack((1.5 + 0.15 * np.arange(N), np.full(N, 2.0), np.zeros(N))), STRAY[:1])


def refined(session: MapSession, offset: float) -> Registration:
    """The map whose scans in the middle were taken `offset` metres aside, and where the odometry has no weight."""
    poses = session.poses.copy()
    poses[list(STRAY), 1] += offset
    return refined_from(session, poses)


def refined_from(session: MapSession, poses: F64) -> Registration:
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


def test_a_run_of_scans_is_put_back_where_the_odometry_counts_backwards_as_forwards() -> None:
    """The robot drives 1.2 m, back again, and on."""
    y = 1.2 + 0.15 * np.concatenate((np.arange(9), np.arange(7, -1, -1), np.arange(1, 9)))
    true = np.column_stack((np.full(len(y), 2.0), y, np.zeros(len(y))))
    steps = np.abs(relative_poses(true[:-1], true[1:]))
    run = tuple(range(10, 17))
    session = session_of(true, run[:1], steps)
    mapper = Config().graph_mapper
    arrays = session.scans.arrays(mapper.joint_registration.points_per_scan)
    poses = true.copy()
    poses[list(run), 1] += 0.3 * np.arange(1, len(run) + 1)
    stray = refined_from(session, poses)
    assert np.abs(stray.poses - true)[list(run), 1].max() > 1.0, "the refinement alone leaves them there"
    found, passes = put_back(stray, session, arrays, slipped(session), mapper)
    assert passes > 0
    assert np.abs(found.poses - true).max() < 0.03


def test_runs_with_few_scans_between_them_are_one() -> None:
    assert _joined([(3, 5), (7, 9), (14, 14)]) == [(3, 9), (14, 14)]
    assert _joined([]) == []
