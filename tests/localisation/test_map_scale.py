"""The scale of a map by what the lidar measures, in rooms whose map is too large, too small or right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from room_scans import DEGREE, room_scan
from rooms import seen, walls

from hsloc.localisation.map_scale import MapScale, MapScaleEstimator
from hsloc.matching import LikelihoodField
from hsloc.model import PairedScan, Pose2
from hsloc.simulation.world import World

CORNERS = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]
ROOM = World(
    "room",
    np.array([(*CORNERS[k], *CORNERS[k - 3]) for k in range(4)]),
    np.array([(1.0, 1.0), (5.0, 3.0)]),
)
PLACES = [Pose2(1.0 + 0.2 * k, 2.0 + np.sin(0.7 * k), 0.9 * k) for k in range(20)]


def estimator(scale: float, places: list[Pose2] = PLACES) -> MapScaleEstimator:
    """After scans 3 m of path apart, each matched 3 cm off its place on the map."""
    grid = ROOM.occupancy_grid(0.05)
    origin = Pose2(scale * grid.origin.x, scale * grid.origin.y, 0.0)
    field = LikelihoodField.from_grid(replace(grid, resolution=scale * grid.resolution, origin=origin))
    found = MapScaleEstimator(field, (origin.x, origin.y))
    for k, place in enumerate(places):
        scan = room_scan(place, beams=360, noise=0.01, seed=k, increment=DEGREE)
        found.move(3.0)
        found.matched(PairedScan(scan, place), Pose2(scale * place.x + 0.03, scale * place.y, place.theta))
    return found


@pytest.mark.parametrize("scale", [0.97, 1.0, 1.03])
def test_the_scale_is_found(scale: float) -> None:
    found = estimator(scale).estimate()
    assert found is not None
    assert found.value == pytest.approx(scale, abs=0.004)
    assert found.is_significant == (scale != 1.0)
    assert found.sigma < 0.01


@pytest.mark.parametrize("scale", [1.0, 1.02])
def test_the_noise_of_a_low_cost_lidar_is_no_scale(scale: float) -> None:
    # In a corridor all walls are about as far away, and the noise of the ranges differs more than these do.
    corners = [(0.0, 0.0), (24.0, 0.0), (24.0, 2.0), (13.0, 2.0), (13.0, 2.4), (12.0, 2.4), (12.0, 2.0), (0.0, 2.0)]
    segments = walls(*corners)
    rng, grid = np.random.default_rng(7), World("corridor", segments, np.zeros((2, 2))).occupancy_grid(0.05)
    found = MapScaleEstimator(LikelihoodField.from_grid(replace(grid, resolution=scale * 0.05)), (0.0, 0.0))
    for k in range(60):
        place = Pose2(1.5 + 21.0 * rng.random(), 1.0 + 0.2 * np.sin(k), 0.9 * k)
        paired = seen(segments, place, place, 0.0, beams=360)
        ranges = (paired.scan.ranges * (1.0 + 0.025 * rng.standard_normal(360))).astype(np.float32)
        found.move(3.0)
        x, y = scale * (np.array((place.x, place.y)) - grid.origin.to_array()[:2]) + grid.origin.to_array()[:2]
        found.matched(replace(paired, scan=replace(paired.scan, ranges=ranges)), Pose2(x, y, place.theta))
    estimate = found.estimate()
    assert estimate is not None
    assert estimate.value == pytest.approx(scale, abs=0.004)
    assert abs(estimate.value - scale) < 2.0 * estimate.sigma


def test_walls_that_are_drawn_where_they_are_become_surer() -> None:
    # Walls of a room in whole decimetres lie on borders of cells, both of which are drawn: their middle is right.
    cell = 0.05**2 / 12.0
    assert estimator(1.0, []).wall_variance == pytest.approx(cell)
    assert estimator(1.0).wall_variance < cell


def test_a_few_scans_give_no_scale() -> None:
    assert estimator(1.02, PLACES[:5]).estimate() is None


def test_two_scans_that_fit_at_another_scale_alone_show_it() -> None:
    # At 1.08 the walls are up to 0.4 m behind the points: the nearest ones are others, or none.
    found = estimator(1.08, PLACES[:2]).estimate()
    assert found is not None
    assert (found.by_fit, found.is_significant) == (True, True)
    assert found.value == pytest.approx(1.08, abs=3.0 * found.sigma)
    assert estimator(1.0, PLACES[:2]).estimate() is None
    assert estimator(1.08, PLACES[:1]).estimate() is None


def test_scans_of_one_place_count_once() -> None:
    found = estimator(1.02, PLACES[:5])
    for place in PLACES[5:]:
        found.matched(PairedScan(room_scan(place, beams=360), place), place)
    assert found.estimate() is None


def test_positions_are_off_by_their_distance_from_the_corner() -> None:
    poses = np.array([(1.0, 2.0, 0.0), (11.0, -8.0, 1.0)])
    significant = MapScale(1.02, 0.001, (1.0, 2.0))
    np.testing.assert_allclose(significant.pose_errors(poses), [(0.0, 0.0, 0.0), (0.21, 0.21, 0.0)])
    doubted = MapScale(1.02, 0.009, (1.0, 2.0))
    assert doubted.is_doubted
    assert not doubted.is_significant
    np.testing.assert_allclose(doubted.pose_errors(poses)[1], (0.29, 0.29, 0.0))
    np.testing.assert_array_equal(MapScale(1.02, 0.011).pose_errors(poses), np.zeros((2, 3)))
