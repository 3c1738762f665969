"""Poses before a relocalisation: matched backwards, and between these matches as sure as the odometry makes them."""

from __future__ import annotations

import numpy as np
import pytest

from hsloc.config import Config
from hsloc.localisation.between_matches import between_matches, bridge_variances
from hsloc.localisation.interpolated_odometry import AtStamp
from hsloc.localisation.kalman_filter import Anchor
from hsloc.localisation.localiser import Localiser
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.localisation.retraced_scans import RetracedScan, Retracer
from hsloc.localisation.revised_poses import composed, revised_matches
from hsloc.matching import LikelihoodField
from hsloc.model import IDENTITY, Odometry, PairedScan, Pose2, Scan, Status, Trajectory, wrap_angles
from hsloc.model.estimate import Revised
from hsloc.replay.engine import replay
from hsloc.replay.run_history import RunHistory
from hsloc.simulation import odometer
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world

SURE = np.diag((1e-6, 1e-6, 1e-6))
STAMPS = 100_000_000 * np.arange(9)


def drive(way: float = 0.1) -> Trajectory:
    """Straight on along x, nine messages."""
    return Trajectory(STAMPS, np.column_stack((way * np.arange(9), np.zeros((9, 2)))))


def revision(*matches: tuple[int, float]) -> tuple[Revised, ...]:
    """The robot was at x after a number of messages; in truth it went 20 % farther than the odometry says."""
    return tuple(Revised(count, Pose2(x - 0.1 * (count - 1), 0.0, 0.0), SURE) for count, x in matches)


def found(x: float) -> Anchor:
    """The match of the relocalisation, after the last message."""
    return Anchor(9, Pose2(0.8, 0.0, 0.0), Pose2(x, 0.0, 0.0), SURE, True, at=AtStamp(int(STAMPS[8])))


def test_between_matches_that_were_made_backwards_an_error_of_the_odometry_is_shared_out() -> None:
    odometry, true = drive(), drive(0.12).poses
    track = revision((1, 0.0), (5, 0.48), (9, 0.96))
    anchors, matched = revised_matches(track, found(0.96), 1.0, odometry, OdometryNoise())
    assert [each.count for each in anchors] == [1, 5, 9], "the last is that of the relocalisation"
    assert [each.begins for each in anchors] == [True, False, False]
    poses = composed(np.zeros((9, 3)), odometry.poses, track, 9)
    assert np.abs(poses - true).max() > 0.05
    smoothed = between_matches(poses, odometry.poses, anchors, matched)
    np.testing.assert_allclose(smoothed[:8], true[:8], atol=1e-6)


def test_poses_before_the_first_match_keep_to_it() -> None:
    odometry = drive()
    track = (Revised(0, Pose2(1.0, 0.0, 0.0)), *revision((5, 1.4)))
    poses = composed(np.zeros((9, 3)), odometry.poses, track, 9)
    np.testing.assert_allclose(poses[:, 0], 1.0 + odometry.poses[:, 0])
    anchors, _ = revised_matches(track, found(1.8), 1.0, odometry, OdometryNoise())
    assert [each.count for each in anchors] == [5, 9], "where no scan was matched there is no anchor"


def test_between_such_matches_the_odometry_adds_what_it_is_noisy_by() -> None:
    odometry, model = drive(), OdometryNoise()
    sigma = {}
    for scale in (1.0, 20.0):
        matches = revised_matches(revision((1, 0.0), (5, 0.4)), found(0.8), scale, odometry, model)
        variances, unsure = bridge_variances(odometry.poses, *matches, model, stamps_ns=odometry.stamps_ns)
        assert not unsure.any()
        sigma[scale] = np.sqrt(variances[:, 0])
        assert sigma[scale][2] > 3.0 * sigma[scale][0]
    np.testing.assert_allclose(sigma[20.0], np.sqrt(20.0) * sigma[1.0])


def test_a_slip_between_such_matches_is_one() -> None:
    odometry, model = drive(), OdometryNoise()
    matches = revised_matches(revision((1, 0.0), (5, 1.4)), found(1.8), 1.0, odometry, model)
    assert np.sqrt(matches[1].slips[:, 0]) == pytest.approx([0.0, 1.0, 0.0], abs=0.01)
    _, unsure = bridge_variances(odometry.poses, *matches, model, stamps_ns=odometry.stamps_ns)
    assert unsure.tolist() == [False, True, True, True, True, False, False, False, False]


def test_a_relocalisation_without_scans_before_it_revises_nothing() -> None:
    anchors, matched = revised_matches((), found(0.8), 1.0, drive(), OdometryNoise())
    assert len(anchors) == 1
    assert anchors[0].begins
    assert (matched.poses == [(0.8, 0.0, 0.0)]).all()


def test_a_trace_is_kept_as_far_as_scans_fit_and_is_smoothed() -> None:
    grid, hide = load_world("office").occupancy_grid(0.05), Config().make_matcher()
    field, rng = LikelihoodField.from_grid(grid), np.random.default_rng(0)
    retracer = Retracer(field, hide, OdometryNoise(), rng, lambda paired, pose: False)
    scan = Scan(0, np.ones(4, dtype=np.float32), 0.0, 1.0, 0.1, 10.0)
    traced = []
    for k in range(9):
        place = Pose2(0.1 * (20 - k), 0.0, 0.0)
        covariance = 1e-4 * (k + 1.0) * np.eye(3)
        traced.append(RetracedScan(20 - k, place, covariance, PairedScan(scan, place), k < 7))
    track, is_whole = retracer.revised(traced)
    assert not is_whole
    assert [each.odometry_count for each in track] == list(range(14, 21))
    assert all(each.T_map_odom.distance(IDENTITY) < 1e-9 for each in track), "the odometry is right"
    variances = [each.covariance[0, 0] for each in track if each.covariance is not None]
    assert variances[0] == pytest.approx(7e-4), "nothing comes before it"
    assert max(variances[1:]) < 6.1e-4, "the first know how the trace began, and are as sure as the sixth"
    assert retracer.revised(traced[:7])[1]
    assert retracer.revised([each._replace(fits=False) for each in traced]) == ((), False)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_poses_of_a_search_are_as_good_as_they_say_with_odometry_that_is_noisy(seed: int) -> None:
    world = load_world("office")
    noise = odometer.OdometryNoise(alpha1=4e-2, alpha2=2.4e-3, alpha3=8e-2, alpha4=4e-2)
    scenario = Scenario("office", seed=seed, odometry=noise, duration_s=15.0, scan_rate_hz=5.0)
    grid, config = world.occupancy_grid(0.05), Config()
    field = LikelihoodField.from_grid(grid)
    rng = np.random.default_rng(0)
    localiser = Localiser.from_parameters(grid, field, config.make_matcher(), config.localiser, rng)
    history = RunHistory(config.localiser.smoothing_model())
    searched = True
    first_known = 0
    for event, estimate in replay(events(scenario, world), localiser):
        history.add(event, estimate)
        searched &= estimate is None or estimate.status is Status.SEARCHING
        first_known += searched and isinstance(event, Odometry)
    assert first_known > 50
    trajectory, reference, states = history.trajectory()[0], history.reference(), history.states()
    assert reference is not None
    assert states is not None
    off = trajectory.poses - reference.interpolated(trajectory.stamps_ns)
    off[:, 2] = wrap_angles(off[:, 2])
    squared = ((off / states.sigma) ** 2).sum(axis=1)[:first_known]
    known = states.is_localised()[:first_known]
    assert known.sum() > 20
    assert np.hypot(off[:first_known, 0], off[:first_known, 1])[known].max() < 0.1
    assert np.abs(off[:first_known, 2]).max() < np.radians(5.0)
    assert squared.mean() < 6.0, "3 are expected"
