from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from room_scans import room_scan, terms

from hsloc.kernels.point_to_line import Term
from hsloc.kernels.registration import Prior, RegistrationParameters, Scene, add_pairs, register
from hsloc.model import Pose2, Scan
from hsloc.slam.keyscans import KeyScan, KeyScans

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    Room = tuple[KeyScans, F64, Pose2]

PARAMETERS = RegistrationParameters((0.3, 0.2, 0.15), 0.33, 100.0, np.inf, 10)


def scene(first_moving: int, poses: F64, scans: KeyScans) -> Scene:
    return Scene(first_moving, poses, np.arange(len(poses)), scans.arrays(10_000))


def naive_pairs(pose: F64, first_moving: int, scan_poses: F64, scans: KeyScans, gate: float) -> tuple[F64, F64, F64]:
    """The same equations by numeric derivatives of the relative poses, pair by pair."""
    information, gradient, counts = np.zeros((3, 3)), np.zeros(3), np.zeros(5)

    def relative(at: F64, k: int, m: int, moving_first: bool) -> F64:
        moved = Pose2.from_array(at) @ Pose2.from_array(scan_poses[k])
        fixed = Pose2.from_array(scan_poses[m])
        return (fixed.between(moved) if moving_first else moved.between(fixed)).to_array()

    for k in range(first_moving, len(scan_poses)):
        for m in range(first_moving):
            for moving_first in (True, False):
                rel = relative(pose, k, m, moving_first)
                i, j = (k, m) if moving_first else (m, k)
                h, g, tally = terms(scans, i, j, rel, gate=gate, scale=PARAMETERS.scale_of_gate * gate)
                jacobian = np.empty((3, 3))
                for axis in range(3):
                    step = np.zeros(3)
                    step[axis] = 1e-6
                    ends = [relative(pose + sign * step, k, m, moving_first) for sign in (1.0, -1.0)]
                    jacobian[:, axis] = (ends[0] - ends[1]) / 2e-6
                information += PARAMETERS.weight * jacobian.T @ h @ jacobian
                gradient += PARAMETERS.weight * jacobian.T @ g
                counts += tally
    return information, gradient, counts


@pytest.fixture(scope="module")
def room() -> Room:
    """Two scans that stand still and two that move together, one of them a companion mounted behind."""
    still = [Pose2(2.0, 1.5, 0.3), Pose2(2.2, 1.6, 0.2)]
    base, companion = Pose2(2.5, 1.8, 0.5), Pose2(-0.3, 0.1, 0.4)
    scans = [KeyScan.of(room_scan(pose)) for pose in (*still, base, base @ companion)]
    poses = np.array([pose.to_array() for pose in still] + [[0.0, 0.0, 0.0], companion.to_array()])
    return KeyScans.from_scans(scans), poses, base


def test_equations_are_those_of_the_pairs(room: Room) -> None:
    scans, poses, base = room
    pose = base.to_array() + np.array((0.04, -0.03, 0.01))
    information, gradient, counts = np.zeros((3, 3)), np.zeros(3), np.zeros(5)
    add_pairs(pose, scene(2, poses, scans), 0.3, PARAMETERS, Term(information, gradient), counts)
    expected = naive_pairs(pose, 2, poses, scans, 0.3)
    np.testing.assert_allclose(information, expected[0], rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(gradient, expected[1], rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(counts, expected[2], rtol=1e-9)


def test_a_scan_finds_its_pose(room: Room) -> None:
    scans, poses, base = room
    pose = base.to_array() + np.array((0.12, -0.1, 0.05))
    prior = np.eye(3) * 1e-3
    counts = np.zeros(5)
    register(pose, scene(2, poses, scans), Prior(pose.copy(), prior), PARAMETERS, np.zeros((3, 3)), counts)
    assert np.abs(pose - base.to_array()).max() < 0.005
    assert counts[0] > 300
    assert counts[1] == 0


def corridor_scan(reach: float = 4.0) -> Scan:
    """A laser in a corridor 2 m wide without an end, that sees `reach` metres."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    with np.errstate(divide="ignore"):
        ranges = np.abs(1.0 / np.sin(angles))
    return Scan(0, np.where(ranges < reach, ranges, np.inf).astype(np.float32), -np.pi / 2, np.pi / 180.0, 0.05, reach)


def test_along_a_corridor_the_prior_decides() -> None:
    """A field of scores pulls such a scan back to where both overlap; here nothing pulls along the walls."""
    scans = KeyScans.from_scans([KeyScan.of(corridor_scan()), KeyScan.of(corridor_scan())])
    poses, prior = np.zeros((2, 3)), np.diag((100.0, 100.0, 100.0))
    predicted, information = np.array((1.0, 0.0, 0.0)), np.zeros((3, 3))
    for start in (predicted, predicted - (0.4, 0.0, 0.0)):
        pose = start.copy()
        register(pose, scene(1, poses, scans), Prior(predicted, prior), PARAMETERS, information, np.zeros(5))
        assert np.abs(pose - predicted).max() < 0.01
    assert information[0, 0] < 1e-3 * information[1, 1]


def test_a_refuted_prior_loses_its_weight(room: Room) -> None:
    scans, poses, base = room
    predicted = base.to_array() + np.array((0.0, 0.0, 0.6))
    prior = np.diag((1e6, 1e6, 1e5))
    trusted, doubted = base.to_array(), base.to_array()
    fixed, refutable = PARAMETERS, PARAMETERS._replace(prior_scale=3.0)
    register(trusted, scene(2, poses, scans), Prior(predicted, prior), fixed, np.zeros((3, 3)), np.zeros(5))
    chi = register(doubted, scene(2, poses, scans), Prior(predicted, prior), refutable, np.zeros((3, 3)), np.zeros(5))
    assert abs(doubted[2] - base.theta) < 0.01 < abs(trusted[2] - base.theta)
    assert chi > 100.0
