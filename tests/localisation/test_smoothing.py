"""Smoothing backwards: a random walk between matches, and the recursion over matches."""

from __future__ import annotations

import numpy as np
import pytest

from hsloc.localisation.motion_models import OdometryNoise
from hsloc.localisation.smoothing import Anchor, between_matches, smooth_matches
from hsloc.model import Pose2

SURE = np.diag((1e-6, 1e-6, 1e-6))


def anchor(
    count: int,
    odometry: Pose2,
    place: Pose2,
    covariance: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    *,
    begins: bool = False,
) -> Anchor:
    return Anchor(count, odometry, place, covariance, begins)


def straight(n: int, step: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.column_stack((step * np.arange(n), np.zeros(n), np.zeros(n)))


def test_between_two_matches_an_error_of_the_odometry_is_shared_out() -> None:
    odometry = straight(5, 0.1)  # a robot that in truth went 20 % farther
    true = odometry * (1.2, 1.0, 1.0)
    first = anchor(1, Pose2(), Pose2(), SURE, begins=True)
    last = anchor(5, Pose2(0.4, 0.0, 0.0), Pose2(0.48, 0.0, 0.0), SURE)
    matched = np.array([(0.0, 0.0, 0.0), (0.48, 0.0, 0.0)])
    smoothed = between_matches(odometry, odometry, [first, last], matched)
    assert smoothed == pytest.approx(true, abs=1e-9)


def test_over_the_begin_of_another_track_nothing_is_shared_out() -> None:
    odometry = straight(5, 0.1)
    anchors = [
        anchor(1, Pose2(), Pose2(), SURE, begins=True),
        anchor(4, Pose2(0.3, 0.0, 0.0), Pose2(9.0, 0.0, 0.0), SURE, begins=True),
    ]
    matched = np.array([a.T_map_base.to_array() for a in anchors])
    assert (between_matches(odometry, odometry, anchors, matched) == odometry).all()
    assert (smooth_matches(anchors, OdometryNoise()) == matched).all()


def test_what_the_end_of_a_corridor_shows_corrects_the_poses_before() -> None:
    # Along x nothing was measured until the last match; the filter had drifted by 0.2 m.
    along = np.diag((0.04, 1e-6, 1e-6))
    places = [Pose2(0.5 * k + 0.05 * k, 0.0, 0.0) for k in range(4)]
    anchors = [anchor(k, Pose2(0.55 * k, 0.0, 0.0), places[k], along, begins=k == 0) for k in range(4)]
    anchors.append(anchor(4, Pose2(2.2, 0.0, 0.0), Pose2(2.0, 0.0, 0.0), SURE))
    smoothed = smooth_matches(anchors, OdometryNoise())
    before = abs(places[3].x - 1.5)
    assert abs(smoothed[3, 0] - 1.5) < 0.5 * before
    assert np.abs(smoothed[:, 1:]).max() < 1e-9


def test_a_slip_is_not_taken_for_noise() -> None:
    anchors = [
        anchor(0, Pose2(), Pose2(), SURE, begins=True),
        anchor(1, Pose2(0.3, 0.0, 0.0), Pose2(1.3, 0.0, 0.0), SURE),
    ]
    assert (smooth_matches(anchors, OdometryNoise())[0] == 0.0).all()
