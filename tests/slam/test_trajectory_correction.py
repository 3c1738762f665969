from __future__ import annotations

import numpy as np

from hsloc.model import Pose2
from hsloc.model.pose2 import compose_poses
from hsloc.slam.trajectory_correction import EventLog


def test_a_shift_of_all_keyscans_shifts_everything() -> None:
    track = EventLog(0.3)
    for k in range(10):
        track.add(Pose2(0.1 * k, 0.0, 0.0), is_scan=False)
        if k % 3 == 0:
            track.add(Pose2(0.1 * k, 0.0, 0.0), is_scan=True, is_key=True)
    moved = compose_poses(np.array((5.0, 1.0, 0.5)), track.key_odometry())
    odometry, scans = track.corrected(moved)
    np.testing.assert_allclose(odometry, compose_poses(np.array((5.0, 1.0, 0.5)), track.odometry()), atol=1e-12)
    np.testing.assert_allclose(scans, moved, atol=1e-12)


def test_what_two_keyscans_disagree_in_is_shared_along_the_way() -> None:
    track = EventLog(0.3)
    track.add(Pose2(), is_scan=True, is_key=True)
    for x in (0.25, 0.5, 0.5, 1.0):
        track.add(Pose2(x), is_scan=False)
    track.add(Pose2(1.0), is_scan=True, is_key=True)
    odometry, _ = track.corrected(np.array(((0.0, 0.0, 0.0), (1.2, 0.0, 0.0))))
    np.testing.assert_allclose(odometry[:, 0], (0.3, 0.6, 0.6, 1.2), atol=1e-9)


def test_before_the_first_and_after_the_last_keyscan_odometry_goes_on() -> None:
    track = EventLog(0.3)
    track.add(Pose2(-1.0), is_scan=False)
    track.add(Pose2(0.0), is_scan=True, is_key=True)
    track.add(Pose2(2.0), is_scan=False)
    odometry, scans = track.corrected(np.array(((0.0, 0.0, np.pi / 2),)))
    np.testing.assert_allclose(odometry[:, :2], ((0.0, -1.0), (0.0, 2.0)), atol=1e-9)
    assert scans.shape == (1, 3)


def test_without_keyscans_there_is_only_odometry() -> None:
    track = EventLog(0.3)
    track.add(Pose2(1.0), is_scan=False)
    track.add(Pose2(2.0), is_scan=True)
    odometry, scans = track.corrected(np.zeros((0, 3)))
    assert odometry[0, 0] == 1.0
    assert scans[0, 0] == 2.0


def between_two_keyscans(*x: float) -> EventLog:
    """A keyscan, odometry at these places, and a keyscan at the last of them."""
    track = EventLog(0.3)
    track.add(Pose2(), is_scan=True, is_key=True)
    for each in x:
        track.add(Pose2(each), is_scan=False)
    track.add(Pose2(x[-1]), is_scan=True, is_key=True)
    return track


def test_a_push_is_shared_out_evenly_while_the_wheels_stand() -> None:
    track = between_two_keyscans(0.0, 0.0, 0.0, 0.0)
    odometry, _ = track.corrected(np.array(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
    np.testing.assert_allclose(odometry[:, 0], (0.2, 0.4, 0.6, 0.8), atol=1e-9)


def test_a_robot_that_moved_farther_than_is_counted_was_pushed_while_the_wheels_stood() -> None:
    track = between_two_keyscans(0.1, 0.2, *[0.2] * 8)
    odometry, _ = track.corrected(np.array(((0.0, 0.0, 0.0), (1.1, 0.0, 0.0))))
    np.testing.assert_allclose(odometry[:, 0], (0.1, 0.2, *np.linspace(0.3, 1.0, 8)), atol=1e-9)
    # One that moved less slipped while the wheels turned.
    odometry, _ = track.corrected(np.array(((0.0, 0.0, 0.0), (0.04, 0.0, 0.0))))
    np.testing.assert_allclose(odometry[:, 0], (0.02, *[0.04] * 9), atol=1e-6)


def test_what_the_robot_does_after_its_odometry_has_ended_moves_no_pose_before() -> None:
    track = EventLog(0.3)
    track.add(Pose2(), is_scan=True, is_key=True)
    for x in (0.1, 0.2):
        track.add(Pose2(x), is_scan=False)
    for k in range(4):
        track.add(Pose2(0.2), is_scan=True, is_key=k == 3)
    odometry, scans = track.corrected(np.array(((0.0, 0.0, 0.0), (0.8, 0.0, 0.0))))
    np.testing.assert_allclose(odometry[:, 0], (0.1, 0.2), atol=1e-3)
    np.testing.assert_allclose(scans[1:, 0], (0.2, 0.4, 0.6, 0.8), atol=1e-3)


def test_what_it_does_before_its_odometry_begins_moves_no_pose_after() -> None:
    track = EventLog(0.3)
    for k in range(4):
        track.add(Pose2(), is_scan=True, is_key=k == 0)
    for x in (0.0, 0.1, 0.2):
        track.add(Pose2(x), is_scan=False)
    track.add(Pose2(0.2), is_scan=True, is_key=True)
    odometry, scans = track.corrected(np.array(((-0.6, 0.0, 0.0), (0.2, 0.0, 0.0))))
    np.testing.assert_allclose(odometry[:, 0], (0.0, 0.1, 0.2), atol=1e-3)
    np.testing.assert_allclose(scans[:4, 0], (-0.6, -0.4, -0.2, 0.0), atol=1e-3)


def test_what_is_no_noise_may_have_happened_at_any_time_between_two_keyscans() -> None:
    sure = np.zeros((2, 3, 3))
    track = between_two_keyscans(0.25, 0.5, 0.75, 1.0)
    for gap, half_way, at_the_end in ((0.2, 0.2 / 2.0, 0.0), (0.8, 0.8 / np.sqrt(12.0), 0.8 / np.sqrt(3.0))):
        of_odometry, of_scans = track.covariances(np.array(((0.0, 0.0, 0.0), (1.0 + gap, 0.0, 0.0))), sure)
        sigma = np.sqrt(of_odometry[:, 0, 0])
        np.testing.assert_allclose(sigma[1], half_way, rtol=1e-6)
        np.testing.assert_allclose(sigma[3], at_the_end, atol=1e-4)
        assert (of_odometry[:, 1:, 1:] == 0.0).all()
        assert (of_scans == 0.0).all(), "the keyscans are where they are"
