from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from room_scans import DEGREE, pair_term, room_scan, terms

from hsloc.kernels.point_to_line import bearing
from hsloc.kernels.registration import displaced_agreement
from hsloc.kernels.surfels import choose_hits
from hsloc.model import Pose2, Scan
from hsloc.slam.keyscans import KeyScan, KeyScans

if TYPE_CHECKING:
    from numpy.typing import NDArray


@pytest.fixture(scope="module")
def two() -> tuple[KeyScans, NDArray[np.float64]]:
    first, second = Pose2(2.0, 1.5, 0.3), Pose2(2.4, 1.8, 0.5)
    scans = KeyScans.from_scans([KeyScan.of(room_scan(first)), KeyScan.of(room_scan(second))])
    return scans, first.between(second).to_array()


def test_surfels_of_a_room_point_at_the_laser_across_the_walls(two: tuple[KeyScans, NDArray[np.float64]]) -> None:
    scans, _ = two
    valid = np.hypot(*scans.normals.T) > 0
    assert valid.mean() > 0.9
    pose = Pose2(2.0, 1.5, 0.3)
    first = scans.normals[: scans.start[1]][valid[: scans.start[1]]].astype(float)
    in_room = (Pose2(0, 0, pose.theta) @ first).round(2)
    axis = np.isclose(np.abs(in_room).max(axis=1), 1.0, atol=0.02)
    assert axis.mean() > 0.9
    towards = -(first * scans.hits(0)[valid[: scans.start[1]]]).sum(axis=1)
    assert (towards > 0).all()


def test_at_the_true_pose_nothing_pulls(two: tuple[KeyScans, NDArray[np.float64]]) -> None:
    scans, true = two
    _, gradient, counts = terms(scans, 1, 0, true)
    assert counts[0] > 120
    assert counts[1] == 0
    assert np.sqrt(counts[3] / counts[4]) < 0.01
    assert np.abs(gradient).max() / counts[0] < 0.004


@pytest.mark.parametrize("off", [(0.08, -0.05, 0.0), (0.0, 0.1, 0.02), (-0.06, 0.03, -0.03)])
def test_a_few_steps_lead_back_to_the_true_pose(
    two: tuple[KeyScans, NDArray[np.float64]], off: tuple[float, float, float]
) -> None:
    scans, true = two
    pose = true + off
    for _ in range(6):
        information, gradient, _ = terms(scans, 1, 0, pose)
        pose = pose - np.linalg.solve(information, gradient)
    assert (np.abs(pose - true) < (0.005, 0.005, 0.002)).all()


def test_the_gradient_is_that_of_half_the_sum_of_squares(two: tuple[KeyScans, NDArray[np.float64]]) -> None:
    scans, true = two
    pose = true + np.array((0.02, 0.01, 0.004))
    _, gradient, _ = terms(scans, 1, 0, pose)
    numeric = []
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-5
        numeric.append((terms(scans, 1, 0, pose + step)[2][3] - terms(scans, 1, 0, pose - step)[2][3]) / 4e-5)
    np.testing.assert_allclose(gradient, numeric, rtol=0.02, atol=0.05)


def test_a_scan_moved_into_the_room_conflicts() -> None:
    scans = KeyScans.from_scans(
        [KeyScan.of(room_scan(Pose2(1.0, 2.0, 0.0))), KeyScan.of(room_scan(Pose2(1.0, 2.0, 0.0)))]
    )
    _, _, counts = terms(scans, 1, 0, (-2.0, 0.0, 0.0))
    assert counts[1] > 20
    assert terms(scans, 1, 0, (0.0, 0.0, 0.0))[2][1] == 0


def test_the_two_sides_of_a_wall_are_not_paired() -> None:
    """A wall at x = 1 seen from x = 0, and one 5 cm behind it seen from the other side."""
    angles = np.radians(np.arange(-40, 41))
    ranges = (1.0 / np.cos(angles)).astype(np.float32)
    scan = Scan(0, ranges, float(angles[0]), float(np.radians(1.0)), 0.05, 30.0)
    scans = KeyScans.from_scans([KeyScan.of(scan), KeyScan.of(scan)])
    assert terms(scans, 1, 0, (0.05, 0.0, 0.0))[2][0] > 60
    assert terms(scans, 1, 0, (2.05, 0.0, np.pi))[2][0] == 0


def test_bearing_is_the_arctangent() -> None:
    angles = np.linspace(-np.pi + 1e-6, np.pi, 721)
    got = np.array([bearing(3.0 * np.sin(t), 3.0 * np.cos(t)) for t in angles])
    np.testing.assert_allclose(got, angles, atol=2e-5)
    assert bearing(0.0, 0.0) == 0.0


def test_rare_directions_are_chosen_in_full() -> None:
    normals = np.zeros((100, 2), np.float32)
    normals[:90] = (0.0, 1.0)
    normals[90:95] = (1.0, 0.0)
    chosen = np.empty(100, np.int32)
    count = choose_hits(normals, 20, chosen)
    rows = chosen[:count]
    assert set(range(90, 95)) <= set(rows.tolist())
    assert (rows < 95).all(), "hits without a surfel are of no use"
    assert count == 20
    assert (np.diff(rows) > 0).all()
    assert np.ptp(rows[rows < 90]) > 70, "spread over the whole wall"


def test_what_lies_beyond_a_short_range_was_not_looked_through() -> None:
    """A lidar that sees 4 m has no return from farther walls: they are no conflict with what another scan saw there."""
    pose = Pose2(1.0, 2.0, 0.0)
    far = room_scan(pose)
    short = Scan(0, np.where(far.ranges < 4.0, far.ranges, np.inf).astype(np.float32), far.angle_min, DEGREE, 0.05, 4.0)
    scans = KeyScans.from_scans([KeyScan.of(far), KeyScan.of(short)])
    _, _, counts = terms(scans, 0, 1, (0.0, 0.0, 0.0))
    assert counts[1] == 0
    assert counts[0] > 60
    near = KeyScans.from_scans([KeyScan.of(room_scan(Pose2(3.5, 2.0, 0.0))), KeyScan.of(short)])
    _, _, counts = terms(near, 0, 1, (0.0, 0.0, 0.0))
    assert counts[1] > 10, "a wall 2.5 m ahead was looked through"


def information_of_both_normals(scans: KeyScans, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    return pair_term(scans, 1, 0, pose)[0].observed


def corridor(noise: float) -> tuple[KeyScans, NDArray[np.float64]]:
    """The room's walls without those at its ends: a corridor 4 m wide."""
    poses = [Pose2(2.0, 1.5, 0.1), Pose2(3.0, 1.8, -0.1)]
    kept = []
    for seed, pose in enumerate(poses):
        scan = room_scan(pose, beams=361, noise=noise, seed=seed)
        walls = np.abs((pose @ scan.points_base())[:, 1] - 2.0) > 1.999 - 3.0 * noise
        kept.append(KeyScan.of(replace(scan, ranges=np.where(walls, scan.ranges, np.nan).astype(np.float32))))
    return KeyScans.from_scans(kept), poses[0].between(poses[1]).to_array()


def test_without_noise_both_normals_give_the_information_of_one(two: tuple[KeyScans, NDArray[np.float64]]) -> None:
    scans, true = two
    information, _, _ = terms(scans, 1, 0, true)
    np.testing.assert_allclose(information_of_both_normals(scans, true), information, rtol=0.02, atol=0.5)


def test_noise_of_normals_is_no_information_along_a_bare_corridor() -> None:
    scans, true = corridor(0.02)
    along = np.array((np.cos(0.1), -np.sin(0.1), 0.0))
    of_one, of_both = terms(scans, 1, 0, true)[0], information_of_both_normals(scans, true)
    assert along @ of_one @ along > 0.15
    assert abs(along @ of_both @ along) < 0.3 * (along @ of_one @ along)


@pytest.mark.parametrize("is_bare", [False, True])
def test_a_displaced_scan_agrees_less_unless_the_corridor_is_bare(
    two: tuple[KeyScans, NDArray[np.float64]], is_bare: bool
) -> None:
    scans, true = corridor(0.0) if is_bare else two
    first = Pose2(2.0, 1.5, 0.1 if is_bare else 0.3)
    poses = np.array((first.to_array(), (first @ Pose2.from_array(true)).to_array()))
    sums, across = np.empty((2, 2, 2))
    groups, tried = (np.array([0]), np.array([1])), np.array(((0.0, 0.0), (0.5, 0.0)))
    displaced_agreement(poses, groups, tried, (0.0, 0.0), scans.arrays(10_000), 0.15, 0.05, sums)
    agreement = sums[:, 0] / sums[:, 1]
    assert agreement[0] > 0.95
    displaced_agreement(poses, groups, tried, (1.0, 0.0), scans.arrays(10_000), 0.15, 0.05, across)
    if is_bare:
        assert (across[:, 1] == 0.0).all()
    else:
        assert 0.0 < across[0, 1] < sums[0, 1]
        assert across[0, 0] > 0.95 * across[0, 1]
        assert across[1, 0] < 0.1 * across[1, 1]
    assert agreement[0] - agreement[1] < 0.02 if is_bare else agreement[0] - agreement[1] > 0.3
