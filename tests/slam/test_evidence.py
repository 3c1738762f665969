from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from hsloc.kernels.normal_equations import Evaluated, PairTerms
from hsloc.slam.evidence import nothing_seen, weigh
from hsloc.slam.joint_registration import Registration
from hsloc.slam.pose_graph import Edges
from hsloc.slam.recorded import Recorded
from hsloc.slam.slips import Held, Stretches, held_by_the_rest

N = 200


@pytest.fixture
def lap() -> Recorded:
    """Two laps of a square of 10 m, keyscans each 0.4 m; the second lap sees the walls of the first."""
    s = np.arange(N) * 0.4 % 40.0
    side, along = (s // 10.0).astype(int), s % 10.0
    corner, heading = np.array([(0, 0), (10, 0), (10, 10), (0, 10)])[side], np.pi / 2 * side
    ahead = np.column_stack((np.cos(heading), np.sin(heading)))
    poses = np.column_stack((corner + along[:, None] * ahead, heading))
    pairs = np.column_stack((np.arange(100), np.arange(100, 200)))
    return Recorded(
        stamps_ns=np.arange(N) * 10**9,
        poses=poses,
        motions=np.tile((0.4, 0.0, 0.0), (N, 1)),
        covariances=np.tile(np.diag((0.01, 0.01, 0.005)) ** 2, (N, 1, 1)),
        refused=np.zeros(N, dtype=bool),
        odometry=poses.copy(),
        pairs=pairs,
        counts=np.tile((150.0, 1.0, 180.0, 0.0, 150.0), (100, 1)),
        loops=np.array([(10, 110)]),
        torn=np.zeros((0, 2), dtype=np.int64),
        joints=np.zeros(0, dtype=np.int64),
        after_gaps=(),
        no_return_share=0.1,
        stretches=stretches(np.full(3, 0.01), np.ones(3)),
        held=held(),
        pose_covariances=np.tile(np.diag((0.1, 0.1, 0.01)) ** 2, (N, 1, 1)),
    )


def stretches(sigma: np.ndarray, normalised: np.ndarray) -> Stretches:
    """A hundred stretches of which the first two of three overlap; the others are beyond doubt."""
    ends = np.array([(40, 60), (45, 65), (120, 140), *((150, 170) for _ in range(97))])
    sigma, normalised = (np.concatenate((values, np.full(97, 0.01))) for values in (sigma, normalised))
    return Stretches(ends, np.zeros((100, 3)), normalised, sigma, np.zeros(100), np.tile((1.0, 0.0), (100, 1)))


def held(*stretches: tuple[int, float, float]) -> Held:
    """Of some stretches: number, standard deviation of the rest of the map, difference to the odometry."""
    numbers, sigma, difference = np.array(stretches).reshape(-1, 3).T
    return Held(numbers.astype(int), sigma, difference, np.full(len(sigma), 0.03))


def test_slips_and_stretches_in_which_none_would_be_detected_are_named(lap: Recorded) -> None:
    slipped = stretches(np.array((0.02, 0.15, 0.02)), np.array((9.0, 6.0, 12.0)))
    loose = replace(lap, stretches=slipped, held=held((1, 0.3, 0.0)))
    (reason,) = weigh(loose).reasons
    assert reason.code == "slip"
    assert reason.times_s == ((44.0, 65.0),), "only where the scans hardly know the motion"
    assert codes(replace(loose, held=held((1, 0.05, 0.0)))) == ("good", []), "the rest of the map shows how far it was"
    hidden = stretches(np.array((0.2, 0.3, 0.2)), np.ones(3))
    weak = replace(lap, stretches=hidden, held=held((0, 0.5, 0.0), (1, 0.4, 0.0), (2, 0.5, 0.0)))
    (reason,) = weigh(weak).reasons
    assert reason.code == "unobserved"
    np.testing.assert_allclose(reason.times_s, ((39.0, 65.0), (119.0, 140.0)))
    firm = replace(weak, held=held((0, 0.05, 0.0), (1, 0.05, 0.02), (2, 0.05, -0.05)))
    assert codes(firm) == ("good", []), "loops bind both ends"
    assert codes(replace(firm, held=held((0, 0.05, 0.2), (1, 0.05, 0.2))))[1] == ["unobserved"], "and a slip is likely"
    assert codes(replace(firm, odometry=None)) == ("good", [])
    assert codes(replace(weak, odometry=None))[1] == ["unobserved"]


def test_stretches_along_bare_walls_that_agree_better_displaced_are_named(lap: Recorded) -> None:
    bare = stretches(np.array((0.2, 0.2, 0.2)), np.ones(3))
    firm = replace(lap, held=held((0, 0.02, 0.0), (1, 0.02, 0.0), (2, 0.02, 0.0)))
    margin = np.zeros(100)
    margin[:2] = -0.1
    (reason,) = weigh(replace(firm, stretches=replace(bare, margin=margin))).reasons
    assert (reason.code, reason.verdict, reason.times_s) == ("hidden-slip", "check", ((39.0, 65.0),))
    margin[1] = 0.0
    assert codes(replace(firm, stretches=replace(bare, margin=margin))) == ("good", []), "a single one is a door"
    margin[:2] = -0.1
    slipped = replace(bare, margin=margin, normalised=np.full(100, 5.0))
    assert "hidden-slip" not in codes(replace(firm, stretches=slipped))[1], "it was found, and the odometry left out"


def test_a_gap_of_the_record_is_named(lap: Recorded) -> None:
    stamps = lap.stamps_ns + np.where(np.arange(N) >= 80, 30 * 10**9, 0)
    paused = replace(lap, stamps_ns=stamps, after_gaps=((80, 31.0),))
    (reason,) = weigh(paused).reasons
    assert (reason.code, reason.verdict, reason.times_s) == ("record-gap", "check", ((79.0, 110.0),))
    assert reason.text.startswith("nothing was recorded for 31 s, in 1 gap:")
    assert codes(replace(paused, joints=np.array([80])))[1] == ["relocated"], "that says more"


def test_places_of_a_right_map_that_are_hardly_known_are_named(lap: Recorded) -> None:
    covariances = lap.pose_covariances.copy()
    covariances[0] = 0.0
    covariances[50:70, :2, :2] = ((0.05, 0.04), (0.04, 0.05))  # 0.3 m along a diagonal, 0.1 m across
    (reason,) = weigh(replace(lap, pose_covariances=covariances)).reasons
    assert (reason.code, reason.verdict, reason.times_s) == ("uncertain", "check", ((49.0, 69.0),))
    assert "0.30 m" in reason.text
    covariances[50:70, :2, :2] = np.eye(2) * 0.19**2
    assert codes(replace(lap, pose_covariances=covariances)) == ("good", [])


def test_what_loops_say_of_a_stretch_leaves_out_its_own_odometry_and_the_scans_of_a_bare_corridor() -> None:
    """Forty steps of 0.1 m; scans agree to a millimetre, a loop from first to last is known to 2 cm, and one of the
    stretches is bare: 0.3 m too far by the odometry."""
    n = 41
    poses = np.column_stack((0.1 * np.arange(n), np.zeros((n, 2))))
    chain = np.column_stack((np.arange(n - 1), np.arange(1, n)))
    measured = np.tile((0.1, 0.0, 0.0), (n - 1, 1))
    measured[10, 0] += 0.3
    information = np.tile(np.diag((1e4, 1e4, 1e6)), (n - 1, 1, 1))
    steps = Edges(chain, measured, information, np.full(n - 1, np.inf))
    loop = Edges(np.array([(0, n - 1)]), np.array([(4.0, 0.0, 0.0)]), np.diag((2500.0, 2500.0, 1e6))[None], np.ones(1))
    agreed = np.tile(np.diag((1e4, 1e4, 1e4)), (n - 1, 1, 1))
    terms = PairTerms(agreed, np.zeros((n - 1, 3)), np.ones((n - 1, 5)), agreed)
    evaluated = Evaluated(np.zeros((n - 1, 3)), np.zeros((n - 1, 3)))
    refined = Registration(poses, chain, terms, poses, 1.0, 0.15, 0.05, 1, 0.0, evaluated)
    ends = np.array([(5, 25), (15, 35)])
    bare = Stretches(
        ends, np.zeros((2, 3)), np.ones(2), np.array((0.2, 0.01)), np.zeros(2), np.tile((1.0, 0.0), (2, 1))
    )
    found = held_by_the_rest(refined, terms, Edges.concatenate([steps, loop]), steps, bare)
    np.testing.assert_array_equal(found.stretches, [0])
    # The loop, and twenty steps of a centimetre each and of the scans outside.
    assert 0.02 < found.sigma[0] < 0.06
    assert found.difference[0] == pytest.approx(0.3, abs=0.02)
    assert found.normalised[0] > 4.0
    assert found.marked(bare).contradicted.tolist() == [True, False]
    open_end = held_by_the_rest(refined, terms, steps, steps, bare)
    assert open_end.sigma[0] > 1.0, "nothing else leads across"
    none = held_by_the_rest(refined, terms, steps, steps, replace(bare, margin=np.ones(2)))
    assert len(none.stretches) == 0


def codes(recorded: Recorded) -> tuple[str, list[str]]:
    found = weigh(recorded)
    return found.verdict, [reason.code for reason in found.reasons]


def test_a_right_map_is_good(lap: Recorded) -> None:
    assert codes(lap) == ("good", [])


def test_refused_steps_that_no_loop_spans_are_named(lap: Recorded) -> None:
    refused = lap.refused.copy()
    refused[150:153] = True
    found = weigh(replace(lap, refused=refused))
    assert found.verdict == "check"
    (reason,) = found.reasons
    assert reason.code == "open-joint"
    assert reason.places == (tuple(lap.poses[152, :2]),)
    assert reason.times_s == ((149.0, 152.0),)
    assert json.loads(json.dumps(found.to_dict()))["reasons"][0]["code"] == "open-joint"
    once = replace(lap, refused=np.roll(refused, -100))
    assert codes(once) == ("check", ["open-joint"]), "a single loop shares out the errors of what it spans"
    assert codes(replace(once, loops=np.array([(10, 110), (20, 120)]))) == ("good", [])


def test_a_place_that_a_search_of_the_map_found_is_named(lap: Recorded) -> None:
    (reason,) = weigh(replace(lap, joints=np.array([150]))).reasons
    assert (reason.code, reason.verdict, reason.times_s) == ("relocated", "check", ((149.0, 150.0),))


@pytest.mark.parametrize(("counts", "expected"), [((90.0, 5.0), []), ((60.0, 60.0), ["open-joint"])])
def test_scans_around_refused_steps_may_agree_after_all(
    lap: Recorded, counts: tuple[float, float], expected: list[str]
) -> None:
    refused = lap.refused.copy()
    refused[150:153] = True
    around = replace(
        lap,
        refused=refused,
        pairs=np.vstack((lap.pairs, (149, 154))),
        counts=np.vstack((lap.counts, (*counts, 150.0, 0.0, 90.0))),
    )
    assert codes(around)[1] == expected


@pytest.mark.parametrize(
    ("sigma", "conflict", "expected"),
    [(0.01, 1.0, []), (0.1, 1.0, ["open-joint", "odometry"]), (0.01, 60.0, ["open-joint", "odometry"])],
)
def test_a_slip_that_the_scans_measured_step_by_step_is_no_doubt(
    lap: Recorded, sigma: float, conflict: float, expected: list[str]
) -> None:
    """The scans contradict the odometry over 20 steps, longer than any pair of keyscans, and agree with each other."""
    refused, odometry = lap.refused.copy(), lap.poses.copy()
    refused[140:160] = True
    odometry[150:, 0] += 8.0
    steps = np.arange(115, 185)
    counts = np.tile((100.0, 1.0, 120.0, 0.0, 100.0), (len(steps), 1))
    counts[steps == 149, 1] = conflict
    slipped = replace(
        lap,
        refused=refused,
        odometry=odometry,
        pairs=np.vstack((lap.pairs, np.column_stack((steps, steps + 1)))),
        counts=np.vstack((lap.counts, counts)),
        stretches=Stretches(
            np.array([(110, 190)]), np.zeros((1, 3)), np.array((9.0,)), np.array((sigma,)), np.zeros(1), np.ones((1, 2))
        ),
    )
    assert codes(slipped)[1] == expected


def test_one_refused_step_matters_if_it_may_hide_much(lap: Recorded) -> None:
    refused = lap.refused.copy()
    refused[150] = True
    assert codes(replace(lap, refused=refused)) == ("good", [])
    covariances = lap.covariances.copy()
    covariances[150] = np.diag((0.4, 0.4, 0.3)) ** 2
    assert codes(replace(lap, refused=refused, covariances=covariances)) == ("check", ["open-joint"])


@pytest.mark.parametrize(("wrong", "verdict"), [(5, "check"), (40, "failed")])
def test_second_visits_that_look_through_walls_are_wrong(lap: Recorded, wrong: int, verdict: str) -> None:
    counts = lap.counts.copy()
    counts[20 : 20 + wrong, :2] = (50.0, 100.0)
    assert codes(replace(lap, counts=counts)) == (verdict, ["second-visit"])


def test_a_person_who_stands_in_the_way_is_no_wrong_map(lap: Recorded) -> None:
    counts = lap.counts.copy()
    counts[20:22, :2] = (50.0, 100.0)
    assert codes(replace(lap, counts=counts)) == ("good", [])


def test_a_refused_scan_that_does_not_fit_is_named_and_condemns_no_map(lap: Recorded) -> None:
    refused, counts = lap.refused.copy(), lap.counts.copy()
    counts[50, :2] = (70.0, 30.0)
    assert weigh(replace(lap, counts=counts)).stray_scans == (), "people stand in the way of a scan that was believed"
    refused[50] = True
    found = weigh(replace(lap, counts=counts, refused=refused))
    assert (found.verdict, len(found.stray_scans)) == ("good", 1)


def test_odometry_that_contradicts_is_reported_where_no_loop_spans(lap: Recorded) -> None:
    odometry = lap.poses.copy()
    odometry[150:, 0] += 8.0
    assert codes(replace(lap, odometry=odometry)) == ("check", ["odometry"])
    within = lap.poses.copy()
    within[50:, 0] += 8.0
    assert codes(replace(lap, odometry=within)) == ("good", [])
    assert codes(replace(lap, odometry=None)) == ("good", [])


@pytest.mark.parametrize("steps", [1, 4])
def test_a_path_that_loops_tore_is_a_failed_map(lap: Recorded, steps: int) -> None:
    torn = lap.poses.copy()
    torn[50:, 0] += 7.0 * np.minimum(np.arange(N - 50) + 1, steps)[:, None].squeeze() / steps
    found = weigh(replace(lap, poses=torn))
    (reason,) = [each for each in found.reasons if each.code == "jump"]
    assert (found.verdict, reason.verdict) == ("failed", "failed")
    assert reason.times_s[0][0] <= 49.0
    assert reason.times_s[0][1] >= 50.0
    # Odometry that jumps where the scans do not is no fault of the map; one that drove as far agrees with it.
    assert "jump" not in codes(replace(lap, odometry=torn))[1]
    assert "jump" not in codes(replace(lap, poses=torn, odometry=torn))[1]
    assert "jump" in codes(replace(lap, poses=torn, odometry=None))[1]


def test_a_few_scans_beside_the_path_do_not_condemn_the_map(lap: Recorded) -> None:
    beside = lap.poses.copy()
    beside[50:54, 0] += 7.0
    found = weigh(replace(lap, poses=beside))
    (reason,) = [each for each in found.reasons if each.code == "jump"]
    assert reason.verdict == "check"
    assert "misplaced" in reason.text


def test_loops_that_contradict_each_other_are_reported(lap: Recorded) -> None:
    assert codes(replace(lap, torn=np.array([(20, 120), (30, 140)]))) == ("check", ["torn-loop"])


def test_what_the_lidar_did_not_see_is_reported(lap: Recorded) -> None:
    motions = lap.motions.copy()
    motions[60:70, 0] = 3.0
    assert codes(replace(lap, motions=motions)) == ("check", ["blind"])
    assert codes(replace(lap, no_return_share=0.6)) == ("check", ["no-returns"])
    assert nothing_seen().verdict == "failed"
