"""Tracks that the odometry joins, those that it does not, and ground off the map."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from math import exp, log, pi

import numpy as np
import pytest

from hsloc.localisation import track_consistency
from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.localisation.odometry_errors import Errors, Way
from hsloc.localisation.states import StateLog, StateRows
from hsloc.localisation.track_consistency import MappedGround, Track, right_tracks
from hsloc.localisation.track_evidence import PRIOR
from hsloc.model import Estimate, Evidence, OccupancyGrid, Pose2, State, Status

STEP = 0.25
TURNED = Pose2(20.0, 8.0, pi)
"""A hall of 20 by 8 m onto itself."""


def hall(known: float = 1.0) -> OccupancyGrid:
    """20 by 8 m with walls around, known up to a share of its length; the map ends with the walls."""
    cells = np.zeros((80, 200), dtype=np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    cells[:, int(200 * known) :] = -1
    return OccupancyGrid(cells, 0.1, Pose2())


def along(n: int = 61) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Odometry from 2 m to 17 m along the hall."""
    return np.column_stack((2.0 + STEP * np.arange(n), np.full(n, 4.0), np.zeros(n)))


def a_track(first: int, last: int, T_map_odom: Pose2 = Pose2(), **more: object) -> Track:  # noqa: B008
    messages = np.arange(first, last + 1)
    poses = [T_map_odom @ Pose2.from_array(along()[k]) for k in messages]
    headings = np.array([pose.theta for pose in poses])
    track = Track(first, poses[0], last, poses[-1], messages, headings, 1e-4, 1e-6, np.arange(0), True)
    return replace(track, **more)  # type: ignore[arg-type]


def said(short: float = 0.0, through: float = 0.0, rival: float = float("nan")) -> tuple[Evidence, ...]:
    return (Evidence(STEP, 0.95, short, through, rival=rival),)


def probabilities(*tracks: Track, known: float = 1.0) -> list[float]:
    way = Way.of(along(), OdometryNoise())
    return [float(p) for p in right_tracks(tracks, way, MappedGround(hall(known)), PRIOR)]


def test_noise_adds_up_as_in_the_filter() -> None:
    turning = np.column_stack((np.arange(9) * 0.3, 0.1 * np.arange(9) ** 2, 0.25 * np.arange(9) - 1.0))
    model, poses = OdometryNoise(), [Pose2.from_array(row) for row in turning]
    expected = np.zeros((3, 3))
    for before, after in pairwise(poses[2:8]):
        motion = before.between(after)
        expected = predict_covariance(expected, before, motion, model.covariance(motion))
    way = replace(Way.of(turning, model), bias=np.zeros((9, 3, 3)))
    np.testing.assert_allclose(way.between(2, 7, Errors(1.0, 0.0)), expected, atol=1e-12)


def test_wheels_that_differ_bend_a_straight_way() -> None:
    way = replace(Way.of(along(), OdometryNoise()), noise=np.zeros((61, 3, 3)))
    spread = way.between(20, 60, Errors(1.0, 0.02))
    metres = 40 * STEP
    assert spread[2, 2] == pytest.approx((0.02 * metres) ** 2)
    assert spread[1, 1] == pytest.approx((0.02 * metres**2 / 2.0) ** 2)
    assert spread[0, 0] == pytest.approx((0.03 * metres) ** 2)


def test_ground_is_open_where_it_borders_on_what_is_unknown() -> None:
    ground = MappedGround(hall(0.5))
    assert ground.is_open(np.array((9.8, 4.0)), 0.5)
    assert not ground.is_open(np.array((9.0, 4.0)), 0.5)
    assert not ground.is_open(np.array((5.0, 0.2)), 0.5)
    assert not ground.is_open(np.array((-30.0, 4.0)), 0.5)
    assert ground.holds(np.array(((5.0, 4.0), (15.0, 4.0), (-1.0, 4.0)))).tolist() == [True, False, False]


def test_tracks_that_the_odometry_joins_are_both_right() -> None:
    assert min(probabilities(a_track(0, 20), a_track(30, 50))) > 0.99


def test_a_look_alike_of_ground_that_is_not_mapped_is_in_doubt() -> None:
    # From 10 m on nothing is mapped; what the robot sees there fits in the mapped half as well, turned round.
    turned = a_track(36, 60, TURNED, said=said(0.2))
    first, second = probabilities(a_track(0, 20, is_found=False), turned, known=0.5)
    assert first > 0.99
    assert second < 0.1
    again = probabilities(a_track(0, 20), turned, known=0.5)
    assert again[0] > 0.9 > again[1]
    alike = probabilities(a_track(0, 20), replace(turned, said=said(0.0)), known=0.5)
    assert max(alike) < 0.9


def test_a_robot_that_was_carried_is_right_where_all_is_mapped() -> None:
    carried = a_track(30, 50, TURNED, said=said(0.02), astray=1e-9, alike=1e-9)
    first, second = probabilities(a_track(0, 20, astray=1e-9, alike=1e-9), carried)
    assert min(first, second) > 0.99


def test_a_robot_that_is_not_found_on_mapped_ground_was_not_where_it_seemed() -> None:
    lost = np.arange(6, 61)
    vague = a_track(0, 5, alike=0.5, astray=0.5)
    (tracked,), (on_map,), (off_map,) = (
        probabilities(vague),
        probabilities(replace(vague, lost=lost)),
        probabilities(replace(vague, lost=lost), known=0.25),
    )
    odds = [p / (1.0 - p) for p in (tracked, off_map, on_map)]
    assert odds[0] == pytest.approx(odds[1])
    assert odds[2] < 0.5 * odds[0]


def test_no_robot_leaves_a_map_whose_free_ground_is_enclosed_by_walls() -> None:
    # The odometry turns by half a radian a metre: where it leads is not known.
    way, track, vague = Way.of(along(), OdometryNoise()), a_track(0, 5, lost=np.arange(6, 61)), Errors(1.0, 0.5)
    opened = hall()
    opened.cells[40, 0] = 0
    metres = [track_consistency._lost_way(track, track, way, MappedGround(each), vague) for each in (hall(), opened)]
    assert metres[0] == pytest.approx(54 * STEP)
    assert metres[1] < 0.5 * metres[0]


def test_beams_behind_walls_and_places_that_fit_as_well_are_those_of_look_alikes() -> None:
    weights = [replace(a_track(0, 9), said=each).look_alike() for each in (said(), said(0.3), said(0.3, 0.02))]
    assert weights[0] < 0.01 < 0.1 < weights[1] < weights[2]
    assert replace(a_track(0, 9), said=said(0.5, 0.5)).look_alike() == pytest.approx(3.0)
    people = tuple(replace(each, lasting=0.0) for each in said(0.3))
    assert replace(a_track(0, 9), said=people).look_alike() == pytest.approx(weights[0])


def test_on_another_map_other_places_fit_and_tracks_end() -> None:
    way, track = Way.of(along(), OdometryNoise()), a_track(0, 9, said=said(), astray=0.0)
    lasted = exp(-9 * STEP / 20.0)
    assert track.on_another_map(way, 0.0) == pytest.approx(lasted * track.look_alike())
    for rival, ratio in ((1.0, 9.0), (0.85, 0.04), (0.92, 1.0)):
        compared = replace(track, said=said(rival=rival) * 2)
        assert compared.on_another_map(way, 0.0) == pytest.approx(ratio * track.on_another_map(way, 0.0))
    assert track.on_another_map(way, 4.0) == pytest.approx(10.0 * track.on_another_map(way, 2.0))
    # A start that is given is not on it: the scans do not fit from the beginning.
    misfit = replace(track, astray=5.0).on_another_map(way, 0.0)
    assert misfit == pytest.approx(0.15 + track.on_another_map(way, 0.0))
    gone_astray = replace(a_track(0, 29), leaves=9, exit=track.exit)
    for over in (gone_astray, replace(track, lost=np.arange(10, 30))):
        for known, metres in ((1.0, 20 * STEP), (0.3, 6 * STEP)):
            pairs = track_consistency._Pairs.of([track, over], way, MappedGround(hall(known)))
            np.testing.assert_allclose(pairs.went_on, (0.0, metres), atol=1e-9)


def test_one_track_that_ends_on_mapped_ground_may_be_on_another_map() -> None:
    odometry = along()

    def states(ends: int, misfit: float) -> StateRows:
        found = StateLog()
        for k, row in enumerate(odometry):
            explained, rival = 0.93 if k < ends else 0.75, 1.0 if k in (10, 16) else float("nan")
            evidence = Evidence(STEP, explained, misfit, rival=rival)
            status = Status.RELOCALISED if k == 0 else Status.MATCHED
            found.add(Estimate(k, Pose2.from_array(row), status, 1e-4 * np.eye(3), 0.9, evidence=evidence), k + 1)
        found.join_tracks(odometry, OdometryNoise(), hall())
        return found.at_scans()

    assert states(61, 0.0).is_localised().all()
    right, wrong = states(25, 0.0), states(25, 0.25)
    assert right.is_localised()[:16].all()
    assert not wrong.is_localised().any()
    assert "another place" in wrong.reason[0]


def test_evidence_that_is_overwhelming_stays_a_number() -> None:
    # Several begin at one message, and none is joined to another.
    misfit = [a_track(k // 3, (k + 1) // 3, Pose2(0, 0, k), said=said(0.5, 0.2, 0.99)) for k in range(150)]
    other = [replace(each, alike=0.0, astray=0.0) for each in misfit[:5]]
    for tracks in (misfit, other):
        found = probabilities(*tracks)
        assert np.isfinite(found).all()
        assert min(found) > 0.0
    assert max(probabilities(*misfit)) < 1e-9


def test_all_subsets_are_summed() -> None:
    tracks = [
        a_track(0, 10, alike=0.3, astray=0.1, is_found=False),
        a_track(14, 20, TURNED, said=said(0.1), lost=np.arange(21, 24)),
        a_track(25, 40, said=said(0.04), astray=0.5),
        a_track(44, 60, TURNED, alike=2.0),
    ]
    way, ground = Way.of(along(), OdometryNoise()), MappedGround(hall(0.6))
    pairs = track_consistency._Pairs.of(tracks, way, ground)
    own = np.array([each.wrong(PRIOR) for each in tracks])
    look_alike = np.array([each.look_alike() if each.is_found else 0.0 for each in tracks])
    total, right = (
        exp(log(3e-2) + sum(log(k.on_another_map(way, m)) for k, m in zip(tracks, pairs.went_on, strict=True))),
        np.zeros(4),
    )
    for chosen in product((False, True), repeat=4):
        stops = [-1, *np.flatnonzero(chosen).tolist(), 4]
        weight = PRIOR[0] ** sum(chosen)
        for i, j in pairwise(stops):
            weight *= exp(pairs.between(i, j, own, look_alike))
        total += weight
        right += weight * np.array(chosen)
    np.testing.assert_allclose(right_tracks(tracks, way, ground, PRIOR), right / total, rtol=1e-9)


def test_states_of_tracks_that_contradict_each_other() -> None:
    odometry, log_of_states = along(), StateLog()
    for k, row in enumerate(odometry):
        if 20 < k < 36:
            status, T_map_odom, misfit = Status.SEARCHING, Pose2(), 0.0
        elif k <= 20:
            status, T_map_odom, misfit = Status.MATCHED, Pose2(), 0.0
        else:
            status, T_map_odom, misfit = Status.RELOCALISED if k == 36 else Status.MATCHED, TURNED, 0.25
        rival = 0.8 if k in (10, 20, 45, 55) else float("nan")
        evidence = Evidence(STEP, 0.95, misfit, rival=rival) if status is not Status.SEARCHING else Evidence(0.0)
        pose = T_map_odom @ Pose2.from_array(row)
        log_of_states.add(Estimate(k, pose, status, 1e-4 * np.eye(3), 0.9, evidence=evidence), k + 1)
    assert log_of_states.at_scans().is_localised()[36:].all()
    log_of_states.join_tracks(odometry, OdometryNoise(), hall(0.5))
    rows = log_of_states.at_scans()
    assert rows.is_localised()[:21].all()
    assert not rows.is_localised()[21:].any()
    assert rows.state[-1] is State.LOST
    assert "odometry" in rows.reason[-1]
