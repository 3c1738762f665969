"""The localiser, scan by scan: what is matched, what is refused, when the window widens and when the pose is lost."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rooms import L_SHAPE, grid, seen
from scripted_matcher import ScriptedMatcher, localiser, odometry, paired

from hsloc.errors import ConfigError
from hsloc.localisation.parameters import LocaliserParameters
from hsloc.matching import Hide
from hsloc.model import IDENTITY, Pose2, Status

if TYPE_CHECKING:
    from hsloc.localisation.localiser import Localiser
    from hsloc.model import Estimate


def drive(subject: Localiser, steps: range, step: float = 0.3) -> list[Estimate]:
    """Scans at multiples of `step`; the estimates."""
    return [subject.update(paired(step * k)) for k in steps]


def test_the_first_scan_is_matched_and_a_small_motion_is_not() -> None:
    # The scan does not fit the room: the second one is searched for, and found where it was.
    subject = localiser(ScriptedMatcher([0.9, 0.9, 0.9]))
    assert subject.update(paired(0.0)).status is Status.MATCHED
    still = subject.update(paired(0.1))
    assert (still.status, still.reason, still.fitness) == (Status.PREDICTED, "motion gate", None)
    assert subject.update(paired(0.3)).status is Status.MATCHED


def test_a_turn_opens_the_motion_gate_too() -> None:
    subject = localiser(ScriptedMatcher([0.9, 0.9, 0.9]))
    subject.update(paired(0.0))
    assert subject.update(paired(0.0, theta=0.1)).status is Status.PREDICTED
    assert subject.update(paired(0.0, theta=0.25)).status is Status.MATCHED


def test_a_matched_pose_lies_between_prediction_and_match() -> None:
    subject = localiser(ScriptedMatcher([0.9], offset=Pose2(0.1, 0.0, 0.0)))
    estimate = subject.update(paired(0.0))
    assert 0.0 < estimate.T_map_base.x <= 0.1


def test_without_fusion_the_match_is_the_pose() -> None:
    subject = localiser(ScriptedMatcher([0.9], offset=Pose2(0.1, 0.0, 0.0)), fuse=False)
    assert subject.update(paired(0.0)).T_map_base == Pose2(0.1, 0.0, 0.0)


def test_a_scan_with_few_returns_is_not_matched() -> None:
    matcher = ScriptedMatcher([])
    estimate = localiser(matcher).update(paired(0.0, beams=9))
    assert (estimate.status, estimate.reason) == (Status.NO_RETURNS, "9 returns")
    assert matcher.windows == []


def test_a_match_below_the_least_fitness_is_refused() -> None:
    matcher = ScriptedMatcher([0.2], offset=Pose2(0.1, 0.0, 0.0))
    estimate = localiser(matcher).update(paired(0.0))
    assert estimate.status is Status.REJECTED
    assert estimate.reason == "fitness 0.20 below 0.30"
    assert estimate.T_map_base == Pose2()


REFUSED = [0.1, 0.1, 0.1]
"""Of a scan: in the narrow window, in the wide one, and within reach."""


def test_a_match_far_below_the_usual_fitness_is_refused() -> None:
    matcher = ScriptedMatcher([0.9, 0.5, 0.5, 0.5])
    estimates = drive(localiser(matcher), range(2))
    assert estimates[1].status is Status.REJECTED
    assert estimates[1].reason == "fitness 0.50 far below the usual 0.90"


def test_a_refused_match_grows_the_covariance() -> None:
    matcher = ScriptedMatcher([0.9, 0.2, 0.2, 0.2])
    first, second = drive(localiser(matcher), range(2))
    assert first.covariance is not None
    assert second.covariance is not None
    assert np.all(np.diag(second.covariance) > np.diag(first.covariance))


def test_after_a_refusal_a_wide_window_is_searched_and_a_convincing_match_in_it_taken() -> None:
    matcher = ScriptedMatcher([0.9, 0.5, 0.85])
    estimates = drive(localiser(matcher, initial_sigma=0.01, initial_sigma_angle=0.01), range(2))
    narrow, wide = matcher.windows[1:]
    assert estimates[1].status is Status.MATCHED
    assert estimates[1].evaluations == 14
    assert (wide.half_x, wide.half_theta) == (0.5, np.radians(20.0))
    assert narrow.half_x < wide.half_x


@pytest.mark.parametrize("wide_fitness", [0.80, 0.58])
def test_a_wide_match_must_reach_most_of_the_usual_fitness(wide_fitness: float) -> None:
    matcher = ScriptedMatcher([0.9, 0.5, wide_fitness, 0.5])
    assert drive(localiser(matcher), range(2))[1].status is Status.REJECTED


def test_a_match_within_reach_is_taken_only_where_scans_say_that_the_odometry_is_wrong() -> None:
    # The scan is the same from everywhere: from scan to scan the robot did not move.
    matcher = ScriptedMatcher([0.9, 0.5, 0.5, 0.9])
    assert drive(localiser(matcher), range(2))[1].status is Status.REJECTED
    assert matcher.windows[3].half_x == pytest.approx(0.6 + matcher.windows[1].half_x)
    matcher = ScriptedMatcher([0.9, 0.5, 0.5, 0.9], offsets=[IDENTITY] * 3 + [Pose2(-0.3, 0.0, 0.0)])
    assert drive(localiser(matcher), range(2))[1].status is Status.MATCHED


def test_the_window_widens_with_every_refusal() -> None:
    matcher = ScriptedMatcher([0.9, *REFUSED * 4])
    drive(localiser(matcher), range(5))
    half = [window.half_x for window in matcher.windows[1::3]]
    assert half == sorted(half)
    assert half[-1] > half[0]


def test_the_fifth_refusal_in_a_row_starts_the_search() -> None:
    matcher = ScriptedMatcher([0.9, *REFUSED * 5])
    estimates = drive(localiser(matcher), range(6))
    assert [e.status for e in estimates] == [Status.MATCHED] + [Status.REJECTED] * 4 + [Status.SEARCHING]
    assert estimates[-1].reason == "lost: fitness 0.10 below 0.30"


def test_an_accepted_match_forgives_the_refusals_before() -> None:
    matcher = ScriptedMatcher([0.9, *REFUSED * 4, 0.9, *REFUSED * 4])
    statuses = [e.status for e in drive(localiser(matcher), range(10))]
    assert Status.SEARCHING not in statuses


def test_an_unknown_start_is_searched_for_and_the_odometry_is_followed_meanwhile() -> None:
    subject = localiser(ScriptedMatcher([0.0] * 100_000), start=None)
    assert subject.update(odometry(0.0, 0.0)).status is Status.SEARCHING
    assert subject.update(odometry(0.5, 1.0)).T_map_base == Pose2(0.5, 0.0, 0.0)


def test_odometry_between_matches_is_composed() -> None:
    subject = localiser(ScriptedMatcher([0.9]), start=Pose2(1.0, 2.0, np.pi / 2.0))
    subject.update(paired(0.0))
    estimate = subject.update(odometry(0.5, 1.0))
    assert estimate.status is Status.PREDICTED
    assert estimate.T_map_base.distance(Pose2(1.0, 2.5, 0.0)) < 1e-6


@pytest.mark.parametrize("name", ["max_consecutive_rejections", "min_points", "window_min", "min_fitness"])
def test_a_parameter_out_of_range_is_refused_by_name(name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        replace(LocaliserParameters(), **{name: -1})  # type: ignore[arg-type]


def test_a_robot_that_was_moved_is_lost_and_found_again() -> None:
    occupancy = grid(L_SHAPE, [(0, 0, 9, 3), (0, 0, 4, 7)])
    subject = localiser(Hide(), start=Pose2(7.5, 1.5, 3.0), grid=occupancy)
    true, carried, odometry_pose, step = Pose2(7.5, 1.5, 3.0), Pose2(1.5, 5.5, -1.2), Pose2(), Pose2(0.3, 0.0, 0.05)
    estimates = []
    for k in range(20):
        estimates.append(subject.update(seen(L_SHAPE, true, odometry_pose, float(k))))
        true, odometry_pose = (carried if k == 4 else true @ step), odometry_pose @ step
    statuses = [e.status for e in estimates]
    assert statuses[:5] == [Status.MATCHED] * 5
    assert Status.SEARCHING in statuses
    assert Status.RELOCALISED in statuses
    assert estimates[-1].status is Status.MATCHED
    assert estimates[-1].T_map_base.distance(true @ step.inverse()) < 0.05


def test_a_robot_that_is_pushed_is_followed_while_its_odometry_stands_still() -> None:
    subject = localiser(
        Hide(), start=Pose2(7.5, 1.5, 3.0), grid=grid(L_SHAPE, [(0.0, 0.0, 9.0, 3.0), (0.0, 0.0, 4.0, 7.0)])
    )
    for k in range(12):
        true = Pose2(7.5 - 0.25 * max(k - 2, 0), 1.5, 3.0)
        subject.update(odometry(0.0, float(k)))
        estimate = subject.update(seen(L_SHAPE, true, Pose2(), float(k)))
    assert estimate.T_map_base.distance(true) < 0.1


def test_people_around_a_robot_that_stands_do_not_move_it() -> None:
    subject = localiser(
        Hide(), start=Pose2(7.5, 1.5, 3.0), grid=grid(L_SHAPE, [(0.0, 0.0, 9.0, 3.0), (0.0, 0.0, 4.0, 7.0)])
    )
    for k in range(20):
        subject.update(odometry(0.0, float(k)))
        paired = seen(L_SHAPE, Pose2(7.5, 1.5, 3.0), Pose2(), float(k))
        ranges = paired.scan.ranges.copy()
        if k > 0:
            ranges[5 * k : 5 * k + 80] = np.minimum(ranges[5 * k : 5 * k + 80], 0.6)
        estimate = subject.update(replace(paired, scan=replace(paired.scan, ranges=ranges)))
    assert estimate.status is Status.PREDICTED
    assert estimate.T_map_base.distance(Pose2(7.5, 1.5, 3.0)) < 0.05
