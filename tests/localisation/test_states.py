"""States of poses in hindsight, the reasons against a result, and states.csv."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.export.results_folder import STATES_HEADER, write_states
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.localisation.reasons import localisation_reasons
from hsloc.localisation.states import StateLog, StateRows, with_odometry_alone, with_pose_errors
from hsloc.model import Estimate, Evidence, Pose2, State, Status, Trajectory
from hsloc.model.estimate import LikelyPlace, Revised
from hsloc.model.verdict import Verdict, verdict_of

if TYPE_CHECKING:
    from pathlib import Path

GOOD, POOR = 0.95, 0.6


def estimate(
    k: int, explained: float = GOOD, sigma: float = 0.02, status: Status = Status.MATCHED, **more: object
) -> Estimate:
    covariance = np.diag((sigma**2, sigma**2, 0.005**2))
    evidence = Evidence(0.25, explained)
    return Estimate(k, Pose2(0.25 * k, 0.0, 0.0), status, covariance, 0.9, evidence=evidence, **more)  # type: ignore[arg-type]


def judged(*estimates: Estimate, between: int = 2) -> StateRows:
    """The states at the odometry messages, `between` of them before each scan."""
    log = StateLog()
    for k, each in enumerate(estimates):
        log.add(each, between * (k + 1))
    return log.at_odometry(between * len(estimates))


def test_a_track_that_fits_is_localised() -> None:
    states = judged(*(estimate(k) for k in range(20)))
    assert states.is_localised().all()
    assert states.probability.min() > 0.9
    np.testing.assert_allclose(states.sigma[:, 0], 0.02)


def test_on_a_mirrored_map_no_pose_is_known() -> None:
    track = [estimate(k) for k in range(20)]
    for k in (5, 12, 19):
        track[k] = replace(track[k], evidence=Evidence(0.25, GOOD, rival=0.85, mirrored=1.3))
    states = judged(*track)
    assert set(states.state) == {State.LOST}
    assert set(states.reason) == {"the scans fit the map better when they are mirrored"}
    assert states.mirrored > 0.4
    assert states.probability.max() < 0.6


def test_a_pose_that_no_scan_holds_is_predicted() -> None:
    states = judged(*(estimate(k, sigma=0.3) for k in range(20)))
    assert set(states.state) == {State.PREDICTED}
    assert states.reason[0].startswith("standard deviation 0.30 m")


def test_poses_off_the_map_are_not_localised_and_those_before_are() -> None:
    states = judged(*(estimate(k, GOOD if k < 30 else POOR) for k in range(60)))
    assert states.is_localised()[:40].all()
    assert states.state[-1] is State.OFF_MAP
    assert "0.60" in states.reason[-1]


def test_poses_that_follow_the_odometry_alone_become_predicted() -> None:
    states = judged(*(estimate(k) for k in range(20)))  # 40 poses
    poses = np.zeros((40, 3))
    poses[:, 0] = np.minimum(0.2 * np.arange(40), 6.0)  # at rest from the 31st on
    alone = np.arange(40) != 20
    grown = with_odometry_alone(states, poses, (5, 15), alone, OdometryNoise().covariance)
    x = grown.sigma[:, 0]
    assert (x[5:15] == states.sigma[5:15, 0]).all()
    assert (np.diff(x[14:31]) > 0.0).all()
    assert (np.diff(x[:6]) < 0.0).all()
    assert (x[31:] == x[30]).all()
    assert x[30] == pytest.approx(np.hypot(0.02, 0.1 * (6.0 - 2.8)))  # 10 % of the way
    # After 0.2 m the heading is open by more than 2 deg.
    assert np.flatnonzero(grown.is_localised()).tolist() == [*range(5, 15), 20]
    assert grown.reason[-1].endswith("by the odometry alone")


def test_a_guess_of_the_search_has_the_state_that_the_search_gave_it() -> None:
    searching = [estimate(k, status=Status.SEARCHING, state=State.AMBIGUOUS) for k in range(5)]
    states = judged(*(estimate(k) for k in range(20)), *searching)
    assert states.state[-1] is State.AMBIGUOUS
    assert states.probability[-1] == 0.0
    assert np.isnan(states.sigma[-1]).all()


def test_an_ambiguous_stretch_names_its_places() -> None:
    two = (LikelyPlace(Pose2(1.0, 2.0, 0.0), 0.6), LikelyPlace(Pose2(21.0, 2.0, 0.0), 0.4))
    log, other = StateLog(), Pose2(50.0, 0.0, 0.0)
    for k in range(16):
        if k < 4:
            found = estimate(k, status=Status.SEARCHING, state=State.AMBIGUOUS, places=two[: 2 * (k < 3)])
        else:
            found = estimate(k, status=Status.RELOCALISED if k == 4 else Status.MATCHED)
            # Far without a comparison that leaves all other places behind.
            of_rival = {"rival": 1.0, "other": other} if k in (6, 9) else {}
            found = replace(found, evidence=Evidence(30.0, GOOD, **of_rival))  # type: ignore[arg-type]
        log.add(found, k)
    search, track = log.ambiguities()
    assert (search.begin_ns, search.end_ns, search.stamp_ns, search.places) == (0, 3, 2, two)
    assert (track.end_ns, track.stamp_ns) == (15, 9)
    assert [place.pose.x for place in track.places] == [0.25 * 9, 50.0]
    assert 0.5 < track.places[0].probability < 0.9
    (reason,) = localisation_reasons(log.at_odometry(16), path(16), (search, track))
    assert f"at x {track.places[0].pose.x:.1f} m, y 0.0 m (" in reason.text


def test_scans_before_a_relocalisation_belong_to_the_track_that_was_found() -> None:
    searching = [Estimate(k, Pose2(), Status.SEARCHING, evidence=Evidence(0.0), state=State.LOST) for k in range(4)]
    found = estimate(4, status=Status.RELOCALISED, revision=(Revised(6, Pose2()),))
    states = judged(*searching, found, *(estimate(k) for k in range(5, 20)))
    assert set(states.state[:6]) == {State.LOST}
    assert states.is_localised()[6:].all()


def test_scans_before_a_relocalisation_are_as_sure_as_their_matches() -> None:
    searching = [Estimate(k, Pose2(), Status.SEARCHING, evidence=Evidence(0.0), state=State.LOST) for k in range(4)]
    track = (Revised(0, Pose2()), Revised(4, Pose2(), 0.04**2 * np.eye(3)))
    states = judged(*searching, estimate(4, status=Status.RELOCALISED, revision=track))
    np.testing.assert_allclose(states.sigma[:5, 0], 0.04)
    np.testing.assert_allclose(states.sigma[6:, 0], 0.02)


def test_a_pose_between_two_scans_is_no_surer_than_either() -> None:
    lost = Estimate(3, Pose2(), Status.SEARCHING, evidence=Evidence(0.0), state=State.LOST)
    states = judged(*(estimate(k) for k in range(3)), lost)
    assert states.state[5] is State.LOCALISED
    assert states.state[6] is State.LOST
    assert states.state[7] is State.LOST


def rows(**counts: int) -> StateRows:
    state = tuple(State(name) for name, count in counts.items() for _ in range(count))
    n = len(state)
    return StateRows(state, np.ones(n), np.full((n, 3), 0.01), np.full(n, 0.9), ("",) * n)


def path(n: int) -> Trajectory:
    return Trajectory(np.arange(n, dtype=np.int64) * 10**9, np.column_stack((np.arange(n), np.zeros((n, 2)))))


@pytest.mark.parametrize(
    ("counts", "verdict", "codes"),
    [
        ({"localised": 100}, Verdict.GOOD, []),
        ({"localised": 96, "predicted": 4}, Verdict.GOOD, []),
        ({"localised": 60, "off_map": 40}, Verdict.CHECK, ["poses_off_map"]),
        ({"localised": 40, "off_map": 30, "lost": 30}, Verdict.FAILED, ["poses_off_map", "poses_lost"]),
        ({"ambiguous": 10}, Verdict.FAILED, ["poses_ambiguous"]),
    ],
)
def test_the_verdict_follows_from_the_shares_of_the_states(
    counts: dict[str, int], verdict: Verdict, codes: list[str]
) -> None:
    found = rows(**counts)
    reasons = localisation_reasons(found, path(len(found)))
    assert [reason.code for reason in reasons] == codes
    assert verdict_of(reasons) is verdict


def test_a_reason_has_its_place_and_time() -> None:
    found = rows(localised=60, off_map=40)
    (reason,) = localisation_reasons(found, path(100))
    assert reason.text == "40.0 % of the poses are off the map, or the map has changed there"
    assert reason.places == ((60.0, 0.0),)
    assert reason.times == ((60.0, 99.0),)


def test_states_csv_has_a_line_for_each_pose(tmp_path: Path) -> None:
    found = StateRows(
        (State.LOCALISED, State.LOST),
        np.array((0.99, 0.0)),
        np.array(((0.01, 0.02, 0.003), (np.nan,) * 3)),
        np.array((0.9, np.nan)),
        ("", "found, or not"),
    )
    write_states(tmp_path / "states.csv", np.array((1_500_000_000, 2_000_000_000)), found)
    assert (tmp_path / "states.csv").read_text(encoding="utf-8").splitlines() == [
        ",".join(STATES_HEADER),
        "1.500000000,localised,0.9900,0.0100,0.0200,0.00300,0.900,",
        '2.000000000,lost,0.0000,nan,nan,nan,nan,"found, or not"',
    ]


def test_poses_on_a_map_of_a_wrong_scale_are_predicted_where_the_error_matters() -> None:
    states = judged(*(estimate(k) for k in range(4)))
    errors = np.array([(0.0, 0.0, 0.0), (0.15, 0.0, 0.0), (0.15, 0.15, 0.0), (0.3, 0.0, 0.0)] * 2)
    errors[4:6, 2] = np.radians((4.5, 5.0))
    found = with_pose_errors(states, errors, "the scale")
    assert [state is State.LOCALISED for state in found.state] == [True, True, False, False, True, False, False, False]
    assert found.reason[3] == "the scale"
    np.testing.assert_allclose(found.sigma[2], (np.hypot(0.02, 0.15), np.hypot(0.02, 0.15), 0.005))
