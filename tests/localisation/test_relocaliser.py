"""The relocaliser in a room that exists once, and in one that exists twice."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rooms import L_SHAPE, beside, grid, seen

from hsloc.errors import ConfigError
from hsloc.localisation.global_search import most_likely
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.localisation.relocaliser import Relocaliser, RelocaliserParameters
from hsloc.matching import Hide, LikelihoodField
from hsloc.model import Pose2, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rooms import Box, Segments

    from hsloc.localisation.global_search import RelocaliserResult

ONE: list[Box] = [(0, 0, 9, 3), (0, 0, 4, 7)]
TWO: list[Box] = [*ONE, (20, 0, 29, 3), (20, 0, 24, 7)]
START = Pose2(1.5, 5.5, -1.2)
STEP = Pose2(0.4, 0.0, 0.1)


def search(
    segments: Segments, free: Sequence[Box], scans: int, **changes: Any
) -> tuple[Relocaliser, list[RelocaliserResult], list[Pose2]]:
    """The verdicts on scans along an arc, and the true poses."""
    occupancy = grid(segments, free)
    field = LikelihoodField.from_grid(occupancy)
    subject = Relocaliser(
        occupancy, field, Hide(), replace(RelocaliserParameters(), **changes), OdometryNoise(), np.random.default_rng(0)
    )
    true, odometry = START, Pose2()
    verdicts: list[RelocaliserResult] = []
    truth: list[Pose2] = []
    for k in range(scans):
        verdicts.append(subject.update(seen(segments, true, odometry, float(k)), k))
        truth.append(true)
        true, odometry = true @ STEP, odometry @ STEP
    return subject, verdicts, truth


def near(pose: Pose2 | None, other: Pose2) -> bool:
    assert pose is not None
    return pose.distance(other) < 0.05 and abs(wrap_angle(pose.theta - other.theta)) < 0.03


def test_a_room_that_exists_once_is_found() -> None:
    _, verdicts, truth = search(L_SHAPE, ONE, 5)
    sure = [k for k, verdict in enumerate(verdicts) if verdict.is_sure]
    assert sure
    assert sure[0] >= RelocaliserParameters().min_scans - 1
    assert near(verdicts[sure[0]].pose, truth[sure[0]])
    fitness = verdicts[sure[0]].fitness
    assert fitness is not None
    assert fitness > 0.9


def test_the_winner_carries_the_poses_of_the_scans_before() -> None:
    _, verdicts, truth = search(L_SHAPE, ONE, 5)
    verdict = next(verdict for verdict in verdicts if verdict.is_sure)
    assert verdict.track_is_whole
    counts = [each.odometry_count for each in verdict.track]
    assert counts == list(range(len(counts)))
    odometry = Pose2()
    for each, true in zip(verdict.track, truth, strict=False):
        assert near(each.T_map_odom @ odometry, true)
        odometry = odometry @ STEP


def test_of_two_rooms_that_look_alike_neither_is_claimed() -> None:
    _, verdicts, truth = search(beside(L_SHAPE, 20.0), TWO, 9)
    assert not any(verdict.is_sure for verdict in verdicts)
    pose = verdicts[-1].pose
    assert pose is not None
    x = pose.x
    assert min(abs(x - truth[-1].x), abs(x - 20.0 - truth[-1].x)) < 0.1
    assert verdicts[0].places == ()  # too few scans for that
    places = verdicts[-1].places
    assert sorted(round(place.pose.x - truth[-1].x) for place in places[:2]) == [0, 20]
    assert places[0].probability == pytest.approx(places[1].probability) == pytest.approx(0.5, abs=0.1)


def test_the_odds_of_places_follow_from_their_fitness() -> None:
    poses = [Pose2(float(k), 0.0, 0.0) for k in range(12)]
    alike = most_likely((pose, 0.8) for pose in poses)
    assert [place.probability for place in alike] == pytest.approx([1.0 / 12.0] * 8)
    worse, best = most_likely([(poses[0], 0.6), (poses[1], 0.9)])[::-1]
    assert (worse.pose, best.pose) == (poses[0], poses[1])
    assert best.probability / worse.probability == pytest.approx(np.exp(4.0))
    assert most_likely([]) == ()


def test_a_scan_without_motion_adds_no_evidence() -> None:
    occupancy = grid(L_SHAPE, ONE)
    field = LikelihoodField.from_grid(occupancy)
    subject = Relocaliser(occupancy, field, Hide(), RelocaliserParameters(), OdometryNoise(), np.random.default_rng(0))
    subject.update(seen(L_SHAPE, START, Pose2(), 0.0), 0)
    for k in range(1, 12):
        verdict = subject.update(seen(L_SHAPE, START, Pose2(), float(k)), k)
        assert not verdict.is_sure
        assert verdict.evaluations == 0


def test_a_search_says_how_far_it_is() -> None:
    _, verdicts, _ = search(L_SHAPE, ONE, 4)
    fits = r"fitness [01]\.\d\d over \d+ scans?"
    several = rf"\d+ places possible; the best has {fits}, in sum \d+\.\d\d more than the next"
    assert all(re.fullmatch(rf"{several}|one place possible, with {fits}", verdict.reason) for verdict in verdicts)
    assert re.search(r"over 1 scan\b", verdicts[0].reason)


def test_start_removes_all_hypotheses() -> None:
    subject, _, _ = search(L_SHAPE, ONE, 3)
    subject.start()
    verdict = subject.update(seen(L_SHAPE, START, Pose2(), 0.0, beams=10), 0)
    assert verdict.pose is None
    assert verdict.reason == "searching the whole map"


def test_the_same_seed_gives_the_same_verdicts() -> None:
    first, second = (search(L_SHAPE, ONE, 4)[1] for _ in range(2))
    assert [v.pose for v in first] == [v.pose for v in second]
    assert [v.evaluations for v in first] == [v.evaluations for v in second]


@pytest.mark.parametrize(("name", "value"), [("renew_distance", 0.0), ("min_scans", 0), ("min_fitness", -0.1)])
def test_a_parameter_out_of_range_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"RelocaliserParameters.{name} is"):
        replace(RelocaliserParameters(), **{name: value})  # type: ignore[arg-type]
