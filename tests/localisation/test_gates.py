"""The motion gate and the match gate."""

from __future__ import annotations

import pytest

from hsloc.localisation.gates import MatchGate, MatchLimits, MotionGate, RestGate, StandingOdometry
from hsloc.model import Pose2

LIMITS = MatchLimits(min_fitness=0.3, min_fitness_ratio=0.7, recovery_fitness_ratio=0.9)


@pytest.mark.parametrize(
    ("motion", "is_open"),
    [
        (Pose2(0.19, 0.0, 0.09), False),
        (Pose2(0.12, 0.16, 0.0), True),
        (Pose2(-0.2, 0.0, 0.0), True),
        (Pose2(0.0, 0.0, -0.1), True),
    ],
)
def test_a_motion_gate_opens_by_distance_or_by_angle(motion: Pose2, is_open: bool) -> None:
    assert MotionGate(0.2, 0.1).is_open(motion) is is_open
    assert MotionGate(0.2, 0.1).is_open(motion, (0.2, 0.0))


def test_a_fresh_gate_refuses_by_the_least_fitness_alone() -> None:
    gate = MatchGate(LIMITS)
    assert gate.is_fresh
    assert gate.refusal(0.3) == ""
    assert gate.refusal(0.29) == "fitness 0.29 below 0.30"


def test_the_usual_fitness_follows_the_accepted_matches() -> None:
    gate = MatchGate(LIMITS)
    gate.accept(0.9)
    assert not gate.is_fresh
    assert gate.refusal(0.62) == "fitness 0.62 far below the usual 0.90"
    for _ in range(200):
        gate.accept(0.8)
    assert gate.usual == pytest.approx(0.8, abs=1e-4)
    assert gate.refusal(0.62) == ""


def test_refusals_are_counted_in_a_row() -> None:
    gate = MatchGate(LIMITS)
    assert [gate.refuse(), gate.refuse()] == [1, 2]
    assert not gate.is_fresh
    gate.accept(0.9)
    assert gate.refuse() == 1
    gate.accept_hidden()
    assert (gate.refusals, gate.usual) == (0, 0.9)


def test_a_wide_match_must_gain_and_reach_most_of_the_usual_fitness() -> None:
    gate = MatchGate(LIMITS)
    gate.accept(0.9)
    assert gate.is_recovered(0.5, 0.81)
    assert not gate.is_recovered(0.5, 0.80)
    assert not gate.is_recovered(0.72, 0.815)


def test_a_match_that_is_not_as_fit_as_usual_gives_way_to_one_that_is() -> None:
    gate = MatchGate(LIMITS)
    assert gate.fits_as_usual(0.1)
    gate.accept(0.96)
    assert gate.fits_as_usual(0.92)
    assert not gate.fits_as_usual(0.9)
    assert gate.is_regained(0.88, 0.95)
    assert not gate.is_regained(0.9, 0.93)
    assert not gate.is_regained(0.8, 0.9)


def test_a_restart_takes_the_fitness_of_the_place_that_was_found() -> None:
    gate = MatchGate(LIMITS)
    gate.refuse()
    gate.restart(0.8)
    assert gate.refusals == 0
    assert gate.usual == 0.8


def test_a_match_that_fits_worse_than_usual_counts_less() -> None:
    gate = MatchGate(LIMITS)
    assert gate.trust(0.5) == 1.0
    gate.accept(0.9)
    least = LIMITS.min_fitness_ratio * 0.9
    assert gate.trust(0.95) == gate.trust(0.9) == 1.0
    assert gate.trust((0.9 + least) / 2.0) == pytest.approx(0.5)
    assert 0.0 < gate.trust(least) < 0.1


def test_a_rest_gate_opens_where_scans_change_and_the_odometry_does_not() -> None:
    gate = RestGate()
    gate.matched(0.9)
    stands = []
    for x in (0.0, 0.1, 0.1, 0.2):
        gate.follow(Pose2(x, 0.0, 0.0))
        stands.append(gate.stands)
    assert stands == [False, False, True, False]
    assert not gate.is_open(0.89)
    assert gate.is_open(0.8)


def test_a_rest_gate_opens_less_often_where_nothing_is_found() -> None:
    gate = RestGate()
    gate.matched(0.9)
    opened = []
    for _ in range(40):
        opened.append(gate.is_open(0.5))
        if opened[-1]:
            gate.searched(is_moved=False)
    assert opened[:5] == [True, True, False, True, False]
    assert sum(opened[20:]) < sum(opened[:20]) / 2
    gate.matched(0.8)
    assert gate.is_open(0.7)


def test_odometry_counts_nothing_where_two_scans_in_a_row_say_so() -> None:
    standing, found = StandingOdometry(), []
    for x, theta in ((0.0, 0.0), (0.2, 0.0), (0.2, 0.1), (0.205, 0.2), (0.205, 0.2), (0.205, 0.2), (0.3, 0.2)):
        standing.follow(Pose2(x, 0.0, theta))
        found.append((standing.counts_no_way, standing.counts_no_turn))
    # One scan may be the jitter of stamps.
    no_way = [False, False, False, True, True, True, False]
    no_turn = [False, False, False, False, False, True, True]
    assert found == list(zip(no_way, no_turn, strict=True))


def test_a_scan_near_the_last_match_may_fit_a_little_worse_than_one_at_rest() -> None:
    gate = RestGate()
    gate.matched(0.9)
    gate.follow(Pose2())
    gate.follow(Pose2(0.05, 0.0, 0.0))
    assert not gate.is_open(0.85)
    assert gate.is_open(0.8)
    gate.follow(Pose2(0.05, 0.0, 0.0))
    assert gate.is_open(0.85)
