"""Scans, trajectories and grids."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pytest

from hsloc.model import OccupancyGrid, Pose2, Scan, Trajectory


def scan(ranges: list[float], **changes: Any) -> Scan:
    values: dict[str, Any] = {"angle_min": -pi / 2, "angle_increment": pi / 2, "range_min": 0.1, "range_max": 10.0}
    return Scan(0, np.array(ranges, dtype=np.float32), **{**values, **changes})


def test_hits_are_finite_and_within_the_limits_both_included() -> None:
    ranges = [0.1, 10.0, 0.05, 10.5, np.inf, -np.inf, np.nan, 0.0, 5.0]
    assert scan(ranges, range_min=np.float32(0.1)).hits().tolist() == [
        True, True, False, False, False, False, False, False, True
    ]  # fmt: skip
    assert scan(ranges).no_returns().tolist() == [False] * 4 + [True] + [False] * 4


def test_points_stand_where_the_beams_point_seen_from_the_base() -> None:
    points = scan([1.0, 2.0, 3.0], T_base_laser=Pose2(0.5, 0.0, pi / 2)).points_base()
    np.testing.assert_allclose(points, [[1.5, 0.0], [0.5, 2.0], [-2.5, 0.0]], atol=1e-6)


def test_negative_increments_run_clockwise() -> None:
    points = scan([1.0, 1.0, 1.0], angle_min=pi / 2, angle_increment=-pi / 2).points_base()
    np.testing.assert_allclose(points, [[0.0, 1.0], [1.0, 0.0], [0.0, -1.0]], atol=1e-6)


def test_trajectory_is_interpolated_the_short_way_round_and_held_at_its_ends() -> None:
    trajectory = Trajectory(np.array([0, 10]), np.array([[0.0, 0.0, 3.0], [1.0, 2.0, -3.0]]))
    found = trajectory.interpolated(np.array([-5, 5, 20]))
    np.testing.assert_allclose(found[0], [0.0, 0.0, 3.0])
    np.testing.assert_allclose(found[1, :2], [0.5, 1.0])
    assert abs(found[1, 2]) == pytest.approx(pi)
    np.testing.assert_allclose(found[2], [1.0, 2.0, -3.0])


def test_of_poses_with_one_stamp_the_last_counts_and_order_does_not() -> None:
    trajectory = Trajectory(np.array([10, 0, 10]), np.array([[1.0, 0, 0], [0.0, 0, 0], [2.0, 0, 0]]))
    assert trajectory.interpolated(np.array([10]))[0, 0] == 2.0
    assert trajectory.sorted().stamps_ns.tolist() == [0, 10, 10]


def test_a_trajectory_of_unequal_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="do not belong together"):
        Trajectory(np.array([1, 2]), np.zeros((3, 3)))


def test_cells_lie_where_the_origin_puts_them_turned_ones_too() -> None:
    cells = np.array([[0, 100, -1], [0, 0, 0]], dtype=np.int8)
    grid = OccupancyGrid(cells, 0.5, Pose2(10.0, 20.0, pi / 2))
    np.testing.assert_allclose(grid.centres(grid.occupied()), [[9.75, 20.75]])
    assert grid.free().sum() == 4
    np.testing.assert_allclose(grid.bounds(), (9.0, 20.0, 10.0, 21.5))


@pytest.mark.parametrize("increment", [np.radians(1.0), np.radians(-1.0)])
def test_beams_towards_points_are_those_that_see_them(increment: float) -> None:
    scan = Scan(0, np.array([2.0] * 90 + [np.inf] * 90, dtype=np.float32), 0.3, float(increment), 0.05, 12.0)
    points = scan.directions() * 2.0
    np.testing.assert_array_equal(scan.beams_towards(*points.T), np.arange(180))
    assert (scan.beams_towards(*(-points[10:-10]).T) >= 180).all()
    np.testing.assert_array_equal(np.isfinite(scan.hit_ranges()), scan.hits())
