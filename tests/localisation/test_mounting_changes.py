"""When a laser was turned on the robot is found from the steps between matches and those of the odometry."""

from __future__ import annotations

from math import radians

import numpy as np
import pytest
from mounting_drives import drive

from hsloc.localisation.mounting_changes import YawPiece, piece_errors, yaw_pieces
from hsloc.localisation.mounting_error import steps_of_anchors
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.model.trajectory import Trajectory

STAMPS_NS = 10**9 * np.arange(200)


def pieces_of(turned: list[tuple[int, float]], seed: int) -> tuple[YawPiece, ...]:
    """Of a laser that from these matches on has these yaws (deg), and is moved a little by each knock."""

    def wrong_by(k: int) -> Pose2:
        yaw, moved = 0.0, 0.0
        for begin, each in turned:
            if k >= begin:
                yaw, moved = each, moved + 0.01
        return Pose2(moved, -moved, radians(yaw))

    steps = steps_of_anchors(drive(wrong_by, seed))
    assert steps is not None
    return yaw_pieces(steps, STAMPS_NS)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("at", "yaw"), [(100, 5.0), (40, -4.0), (150, 10.0)])
def test_a_laser_that_is_knocked_is_found_with_the_moment(seed: int, at: int, yaw: float) -> None:
    before, after = pieces_of([(at, yaw)], seed)
    assert before.begin_ns == 0
    assert abs(after.begin_ns - STAMPS_NS[at]) <= 3e9
    assert (before.is_turned, after.is_turned) == (False, True)
    assert abs(np.degrees(before.yaw)) < 0.5
    assert np.degrees(after.yaw) == pytest.approx(yaw, abs=0.5)
    assert np.degrees(after.sigma) < 0.5


def test_a_laser_that_is_turned_back_is_found_twice() -> None:
    pieces = pieces_of([(70, 6.0), (130, 0.0)], 0)
    assert [round(piece.begin_ns / 1e10) for piece in pieces] == [0, 7, 13]
    assert [piece.is_turned for piece in pieces] == [False, True, False]


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("yaw", [0.0, 3.0, 20.0])
def test_one_that_looks_elsewhere_from_the_start_was_not_turned(seed: int, yaw: float) -> None:
    assert pieces_of([(0, yaw)], seed) == ()


@pytest.mark.parametrize("seed", range(10))
def test_noise_of_the_odometry_turns_no_laser(seed: int) -> None:
    steps = steps_of_anchors(drive(IDENTITY, seed, turned=0.1))
    assert steps is not None
    assert yaw_pieces(steps, STAMPS_NS) == ()


def test_too_few_steps_say_nothing() -> None:
    steps = steps_of_anchors(drive(lambda k: Pose2(0.0, 0.0, 0.1 * (k > 30)), 0)[:45])
    assert steps is not None
    assert len(steps.rows) == 44  # a change needs 20 on each side: 4 m
    assert yaw_pieces(steps, STAMPS_NS) == ()


def test_poses_are_off_by_what_the_laser_is_turned_by_in_each_piece() -> None:
    sure = radians(0.1)
    pieces = (
        YawPiece(0, 0.001, sure), YawPiece(4 * 10**9, radians(-5.0), sure), YawPiece(8 * 10**9, radians(5.0), 1.0),
    )  # fmt: skip
    trajectory = Trajectory(STAMPS_NS[:12] - 10**8, np.zeros((12, 3)))
    errors = piece_errors(pieces, trajectory)
    assert not errors[:5].any()
    assert errors[5:9, 2] == pytest.approx(radians(5.0))
    assert (errors[5:9, :2] > 0.0).all()
    assert not errors[9:].any()  # not beyond doubt
