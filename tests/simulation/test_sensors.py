"""What the sensors see, against closed forms; their noise, against its parameters."""

from __future__ import annotations

from math import inf, pi, radians, tau
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hsloc.model import Pose2, Scan
from hsloc.simulation.floor_plan import polygon
from hsloc.simulation.sensors import RANGE_STEP, Lidar, PointSensor, SensorNoise, within_reach
from hsloc.simulation.simulator import LEG_RADIUS, PERSONAL_SPACE, Walkers
from hsloc.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

WAY = np.array([(1.0, 1.0), (2.0, 1.0)])
ROOM = World("room", polygon([(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]), WAY)
NO_PEOPLE = np.empty((0, 3))
IDEAL = Lidar(range_noise=0.0, range_step=1e-9)


def measure(
    sensor: Lidar | PointSensor,
    pose: NDArray[np.float64] | Pose2,
    world: World = ROOM,
    legs: NDArray[np.float64] = NO_PEOPLE,
    seed: int = 0,
) -> Scan:
    noise = SensorNoise(*(np.random.default_rng((seed, i)) for i in range(2)))
    poses = np.atleast_2d(pose.to_array() if isinstance(pose, Pose2) else pose)
    return sensor.measure(world, 42, 0.1, poses, legs, noise)


def distance_in_room(pose: Pose2, angle: float) -> float:
    """From inside the room, to whichever wall line is met first."""
    c, s = np.cos(pose.theta + angle), np.sin(pose.theta + angle)
    ways = ((6.0 if c > 0 else 0.0) - pose.x) / c, ((4.0 if s > 0 else 0.0) - pose.y) / s
    return float(min(ways))


@pytest.mark.parametrize("pose", [Pose2(2.5, 1.2, 0.4), Pose2(5.9, 3.9, -2.0), Pose2(0.3, 2.0, 3.1)])
def test_every_beam_measures_the_room(pose: Pose2) -> None:
    scan = measure(IDEAL, pose)
    expected = [distance_in_room(pose, angle) for angle in scan.angles()]
    np.testing.assert_allclose(scan.ranges, expected, rtol=3e-7)
    assert (scan.stamp_ns, len(scan.ranges), scan.time_increment) == (42, 360, 0.0)


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("mounting", [Pose2(), Pose2(0.3, -0.1, 0.5), Pose2(-0.2, 0.0, pi / 2)])
def test_hits_lie_on_the_walls_whatever_the_mounting(mounting: Pose2, upside_down: bool) -> None:
    lidar = Lidar(
        range_noise=0.0, range_step=1e-9, mounting=mounting, upside_down=upside_down, field_of_view=radians(200)
    )
    pose = Pose2(2.5, 1.2, 0.4)
    scan = measure(lidar, pose)
    points = pose @ scan.points_base()
    assert len(points) == 360
    assert ROOM.distance_to_walls(points).max() < 1e-6
    assert (scan.angle_increment < 0) == upside_down


def test_a_full_turn_does_not_measure_a_direction_twice_but_a_fan_has_both_ends() -> None:
    full, fan = measure(IDEAL, Pose2(2, 2, 0)), measure(Lidar(beams=181, field_of_view=pi), Pose2(2, 2, 0))
    assert full.angle_increment * 360 == pytest.approx(tau)
    assert (fan.angles()[0], fan.angles()[-1]) == pytest.approx((-pi / 2, pi / 2), abs=1e-6)


def test_range_noise_is_gaussian_with_the_asked_deviation() -> None:
    lidar = Lidar(range_noise=0.02)
    pose = Pose2(2.5, 1.2, 0.4)
    truth = measure(IDEAL, pose).ranges
    off = np.concatenate([measure(lidar, pose, seed=seed).ranges - truth for seed in range(40)])
    assert off.std() == pytest.approx(0.02, rel=0.03)  # 14,400 draws: the deviation's own is 0.6 %
    assert off.mean() == pytest.approx(0.0, abs=4 * 0.02 / len(off) ** 0.5)
    assert (np.abs(off) > 0.04).mean() == pytest.approx(0.0455, abs=0.008)


def test_ranges_are_whole_steps() -> None:
    ranges = measure(Lidar(), Pose2(2.5, 1.2, 0.4)).ranges.astype(float)
    np.testing.assert_array_equal(np.round(ranges / RANGE_STEP) * RANGE_STEP, ranges)


@pytest.mark.parametrize(("as_inf", "lost"), [(False, np.isnan), (True, np.isposinf)])
def test_dropouts_are_as_frequent_as_asked(as_inf: bool, lost: Callable[..., Any]) -> None:
    lidar = Lidar(beams=10_000, dropout=0.2, dropout_as_inf=as_inf)
    assert lost(measure(lidar, Pose2(2, 2, 0)).ranges).mean() == pytest.approx(0.2, abs=0.016)


def test_out_of_range_is_inf_and_too_near_is_minus_inf() -> None:
    scan = measure(Lidar(range_max=3.0, range_min=0.5, range_noise=0.0), Pose2(0.3, 2.0, 0.0))
    ahead, behind = scan.ranges[180], scan.ranges[0]
    assert ahead == inf
    assert behind == -inf
    assert scan.hits().sum() + np.isinf(scan.ranges).sum() == 360
    assert scan.ranges[scan.hits()].max() <= 3.0


def test_noise_never_returns_what_is_out_of_range() -> None:
    scans = [measure(Lidar(range_max=3.0, range_noise=0.2), Pose2(1.0, 2.0, 0.0), seed=seed) for seed in range(20)]
    truth = measure(IDEAL, Pose2(1.0, 2.0, 0.0)).ranges
    for scan in scans:
        assert np.isposinf(scan.ranges[truth > 3.0]).all()
        assert not (scan.ranges[np.isfinite(scan.ranges)] > 3.0).any()


def test_noise_sources_do_not_disturb_each_other() -> None:
    plain, dropping = (measure(Lidar(dropout=p), Pose2(2, 2, 0)).ranges for p in (0.0, 0.3))
    kept = np.isfinite(dropping)
    np.testing.assert_array_equal(plain[kept], dropping[kept])


def test_motion_distortion_measures_each_beam_from_where_it_was() -> None:
    lidar = Lidar(range_noise=0.0, range_step=1e-9, motion_distortion=True)
    turn = np.linspace(0.0, 0.2, 360, endpoint=False)
    poses = np.column_stack((np.full(360, 2.0), np.full(360, 2.0), turn))
    scan = measure(lidar, poses)
    expected = [distance_in_room(Pose2(2, 2, theta), angle) for theta, angle in zip(turn, scan.angles(), strict=True)]
    np.testing.assert_allclose(scan.ranges, expected, rtol=3e-7)
    assert scan.time_increment == pytest.approx(0.1 / 360)


def test_legs_hide_the_wall_behind_them() -> None:
    legs = np.array([(4.0, 2.0, LEG_RADIUS)])
    scan = measure(IDEAL, Pose2(2.0, 2.0, 0.0), legs=legs)
    assert scan.ranges[180] == pytest.approx(2.0 - LEG_RADIUS)
    assert np.count_nonzero(scan.ranges != measure(IDEAL, Pose2(2.0, 2.0, 0.0)).ranges) == 5  # +-2.0 degrees


def test_walkers_move_along_the_way_and_keep_their_distance() -> None:
    path = np.array([(0.0, 0.0), (20.0, 0.0)])
    walkers = Walkers(path, 5, np.random.default_rng(3))
    now, later = (walkers.legs(t, np.array((50.0, 50.0))) for t in (0.0, 0.5))
    assert now.shape == (10, 3)
    assert np.abs(now[:, 1]).max() < 0.4
    assert (now[:, 0].min() > -0.4) & (now[:, 0].max() < 20.4)
    moved = np.abs((later - now)[:, 0].reshape(2, 5).mean(axis=0))
    assert moved.min() > 0.1
    assert moved.max() < 0.75
    near = walkers.legs(0.0, now[0, :2])
    assert np.hypot(*(near[:, :2] - now[0, :2]).T).min() > PERSONAL_SPACE


def test_points_are_seen_through_walls_up_to_the_range() -> None:
    points = np.array([(10.0, 0.0), (20.0, 0.0), (0.0, -30.0), (49.9, 0.0), (0.0, 51.0)])
    world = World("points", np.empty((0, 4)), WAY, points=points)
    scan = measure(PointSensor(), Pose2(0.0, 0.0, pi / 2), world)
    seen = Pose2(0.0, 0.0, pi / 2) @ scan.points_base()
    np.testing.assert_allclose(
        sorted(seen.tolist()), [(0.0, -30.0), (10.0, 0.0)], atol=1e-2
    )  # the nearer of a direction


def test_points_are_put_into_the_nearest_direction() -> None:
    points = np.random.default_rng(1).uniform(-35, 35, (300, 2))
    world = World("points", np.empty((0, 4)), WAY, points=points)
    pose = Pose2(1.0, -2.0, 0.7)
    seen = pose @ measure(PointSensor(), pose, world).points_base()
    off = np.hypot(*(seen[:, None, :] - points).transpose(2, 0, 1)).min(axis=1)
    assert len(seen) >= 295
    assert off.max() < 50.0 * tau / 14_400 / 2 + RANGE_STEP


def test_segments_out_of_reach_are_left_out() -> None:
    segments = np.array([(0, 0, 1, 0), (9, 9, 10, 10), (-50, 1, 50, 1), (0, 3.1, 1, 3.1)], dtype=float)
    near = within_reach(segments, np.zeros(2), 3.0)
    np.testing.assert_array_equal(near, segments[[0, 2]])
