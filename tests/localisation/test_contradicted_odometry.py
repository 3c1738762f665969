"""Wheels that count backwards as forwards, or slip: the robot is found within the distance that they count."""

from __future__ import annotations

from pathlib import Path

import log_formats
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.localisation.contradicted_odometry import ContradictedOdometry
from hsloc.model import IDENTITY, Pose2
from hsloc.model.estimate import State
from hsloc.replay.run import run
from hsloc.request import RunRequest

OFFICE = Path(__file__).resolve().parents[2] / "recordings" / "office.mcap"


def walls(place: Pose2, *, ends: bool) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """What a lidar sees of a corridor along x, 2 m wide, from a place; `ends` are walls across at -4 m and 5 m."""
    along, across = np.arange(-4.0, 5.0, 0.05), np.arange(-1.0, 1.0, 0.05)
    sides = [(x, y) for y in (-1.0, 1.0) for x in along]
    fronts = [(x, y) for x in (-4.0, 5.0) for y in across] if ends else []
    return place.inverse() @ np.array(sides + fronts)


def test_scans_show_that_the_robot_went_the_other_way() -> None:
    contradicted = ContradictedOdometry(0.2)
    contradicted.known(Pose2(7.0, 3.0, 0.5), IDENTITY, walls(IDENTITY, ends=True))
    by_odometry, back = Pose2(7.0, 3.0, 0.5) @ Pose2(0.6, 0.0, 0.0), Pose2(-0.6, 0.0, 0.0)
    points = walls(back, ends=True)
    assert contradicted.is_seen(by_odometry, back, points)
    assert not contradicted.is_seen(by_odometry, Pose2(0.0, 0.6, 0.0), points)


def test_along_a_corridor_scans_contradict_nothing() -> None:
    contradicted = ContradictedOdometry(0.2)
    contradicted.known(IDENTITY, IDENTITY, walls(IDENTITY, ends=False))
    # The end of what is seen moves with the robot.
    assert not contradicted.is_seen(Pose2(0.6, 0.0, 0.0), Pose2(-0.6, 0.0, 0.0), walls(IDENTITY, ends=False))


def test_odometry_that_is_right_is_not_contradicted() -> None:
    contradicted, there = ContradictedOdometry(0.2), Pose2(0.6, 0.1, 0.2)
    contradicted.known(IDENTITY, IDENTITY, walls(IDENTITY, ends=True))
    points = walls(there, ends=True)
    assert not contradicted.is_seen(there, there, points)
    assert not contradicted.is_seen(there, Pose2(0.9, 0.1, 0.2), points), "a map that changed is no motion"


@given(
    st.lists(st.tuples(st.floats(0.01, 0.3), st.floats(-1.0, 1.0)), min_size=1, max_size=5),
    st.floats(-np.pi, np.pi),
    st.floats(0.0, 1.0),
)
def test_all_places_within_the_distance_are_within_reach(
    steps: list[tuple[float, float]], bearing: float, part: float
) -> None:
    contradicted, at = ContradictedOdometry(0.2), Pose2(2.0, -1.0, 0.3)
    contradicted.known(IDENTITY, at, np.zeros((0, 2)))
    predicted, way = at, 0.0
    for length, turn in steps:
        predicted, way = predicted @ Pose2(length, 0.0, turn), way + length
        contradicted.move(length)
    x, y = contradicted.half_widths(predicted)
    place = at @ Pose2(part * way * np.cos(bearing), part * way * np.sin(bearing), 0.0)
    assert abs(place.x - predicted.x) <= x + 1e-9
    assert abs(place.y - predicted.y) <= y + 1e-9


def test_nothing_is_within_reach_of_a_place_that_is_not_known_or_far() -> None:
    contradicted = ContradictedOdometry(0.2)
    contradicted.move(0.3)
    assert contradicted.half_widths(IDENTITY) == (0.0, 0.0)
    contradicted.known(IDENTITY, IDENTITY, np.zeros((0, 2)))
    contradicted.move(0.3)
    assert contradicted.half_widths(IDENTITY) == (0.3, 0.3)
    assert not contradicted.is_seen(IDENTITY, IDENTITY, np.zeros((1, 2))), "a scan without points shows nothing"
    contradicted.move(2.0)
    assert contradicted.half_widths(IDENTITY) == (0.0, 0.0)
    contradicted.known(IDENTITY, IDENTITY, np.zeros((0, 2)))
    contradicted.move(0.3)
    contradicted.lost()
    assert contradicted.half_widths(IDENTITY) == (0.0, 0.0)


@pytest.mark.parametrize("factor", [-1.0, 2.0, 0.0], ids=["backwards as forwards", "wheels slip", "pushed"])
def test_a_robot_is_followed_while_its_odometry_is_wrong(tmp_path: Path, factor: float) -> None:
    """Over 300 messages, 6 s and 4 m, the odometry counts the distance `factor` times."""

    def change(number: int, motion: Pose2) -> Pose2:
        times = factor if 600 <= number < 900 else 1.0
        return Pose2(times * motion.x, times * motion.y, motion.theta)

    result = run(RunRequest(logs=(log_formats.with_motions(tmp_path / "log.mcap", OFFICE, change),)))
    assert result.reference is not None
    off = result.trajectory.poses[:, :2] - result.reference.interpolated(result.trajectory.stamps_ns)[:, :2]
    error = np.hypot(off[:, 0], off[:, 1])
    assert result.states is not None
    assert set(result.states.state) <= {State.LOCALISED, State.PREDICTED}
    assert np.count_nonzero(~result.localised) <= 300
    assert error[result.localised].max() < 0.25
    assert error.max() < 0.5
