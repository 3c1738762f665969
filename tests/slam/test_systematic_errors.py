from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from drives import ape_rmse

from hsloc.kernels.normal_equations import Evaluated, PairTerms
from hsloc.model import Pose2
from hsloc.slam import refinement
from hsloc.slam.joint_registration import Registration
from hsloc.slam.mapper import Mapper
from hsloc.slam.marginals import CommonErrors, marginal_covariances
from hsloc.slam.parameters import GraphMapperParameters
from hsloc.slam.pose_graph import Edges
from hsloc.slam.systematic_errors import SystematicErrors, find_systematic_errors

if TYPE_CHECKING:
    import pytest

BIAS = (0.97, 1.04, 0.002)
"""Translations and rotations are counted as this part of what they are; rotation (rad) that is counted for each m."""


def counted(poses: list[Pose2]) -> list[Pose2]:
    """The same odometry from wheels that are not as large as stated, nor equal, on a wrong wheelbase."""
    way, turn, curvature = BIAS
    found = poses[:1]
    for a, b in pairwise(poses):
        step = a.between(b)
        theta = turn * step.theta + curvature * float(np.hypot(step.x, step.y))
        found.append(found[-1] @ Pose2(way * step.x, way * step.y, theta))
    return found


def test_a_map_does_not_get_the_size_that_the_wheels_count(loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the correction this loop is 5.3 cm off: only its ends see the same walls."""
    events, truth = loop
    found: list[SystematicErrors] = []

    def noted(refined: Registration, steps: Edges, first: int) -> SystematicErrors:
        found.append(find_systematic_errors(refined, steps, first))
        return found[-1]

    monkeypatch.setattr(refinement, "find_systematic_errors", noted)
    mapper = Mapper(GraphMapperParameters(), np.random.default_rng(0))
    for event, pose in zip(events, counted([event.T_odom_base for event in events]), strict=True):
        mapper.update(replace(event, T_odom_base=pose))
    result = mapper.finish()
    assert ape_rmse(events, result.scan_poses, truth) < 0.04
    (errors,) = found
    way, turn, curvature = BIAS
    expected = np.array((1.0 / way - 1.0, 1.0 / turn - 1.0, -curvature / (way * turn)))
    sigma = np.sqrt(np.diag(errors.covariance))
    np.testing.assert_array_less(np.abs(errors.values - expected), 4.0 * sigma)
    np.testing.assert_array_less(sigma, (0.005, 0.02, 0.002))
    assert result.odometry_errors == errors.summary()
    assert result.odometry_errors is not None
    assert result.odometry_errors.translation == errors.values[0]
    assert result.odometry_errors.drift_sigma == sigma[2]
    assert abs(result.calibration.way - 1.0 / way) < 0.01


def arc(driven: float, turned: float, parts: int = 1000) -> Pose2:
    """Where a robot is that drives and turns evenly."""
    pose = Pose2(0.0, 0.0, 0.0)
    for _ in range(parts):
        pose @= Pose2(driven / parts, 0.0, turned / parts)
    return pose


def test_errors_are_added_from_the_first_step_of_the_log_that_was_read(rng: Any) -> None:
    """A step with them is where wheels would have counted that have none, forwards or backwards."""
    arcs = rng.uniform((-0.5, -1.5), (0.5, 1.5), size=(6, 2))
    measured = np.array([arc(*values).to_array() for values in arcs])
    steps = Edges.chain(measured, np.tile(np.eye(3), (6, 1, 1)))
    way, turn, drift = 0.01, -0.02, 0.005
    added = SystematicErrors(np.array((way, turn, drift)), np.eye(3), 2).added_to(steps)
    np.testing.assert_array_equal(added.measured[:2], steps.measured[:2])
    expected = [arc((1 + way) * driven, (1 + turn) * turned + drift * driven).to_array() for driven, turned in arcs[2:]]
    np.testing.assert_allclose(added.measured[2:], expected, atol=1e-3)
    off = np.abs(steps.measured[2:] - expected)
    assert (off.max(axis=0) > (3e-3, 1e-3, 1e-2)).all()
    np.testing.assert_array_equal(added.information, steps.information)


def straight(n: int) -> tuple[Registration, Edges]:
    """Keyscans each 0.1 m along a line, of which no two scans are compared, and the odometry between them."""
    measured = np.tile((0.1, 0.0, 0.0), (n - 1, 1))
    poses = np.column_stack((np.arange(n) * 0.1, np.zeros((n, 2))))
    nothing = PairTerms(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 5)), np.zeros((0, 3, 3)))
    pairs, at = np.zeros((0, 2), dtype=np.int64), Evaluated(np.zeros((0, 3)), np.zeros((0, 3)))
    refined = Registration(poses, pairs, nothing, poses, 1.0, 0.1, 0.1, 1, 0.0, at)
    return refined, Edges.chain(measured, np.tile(np.diag((0.01, 0.01, 0.005)) ** 2, (n - 1, 1, 1)))


def test_of_a_short_drive_nothing_is_found_and_little_is_known() -> None:
    errors = find_systematic_errors(*straight(30))
    assert not errors.values.any()
    assert errors.summary() is None
    assert (np.sqrt(np.diag(errors.covariance)) >= (0.03, 0.1, 0.03)).all()


def test_what_is_not_known_of_the_wheels_adds_up_along_the_way() -> None:
    """Of independent noise the standard deviation grows with the root of the way, of a wrong scale with the way."""
    refined, steps = straight(101)
    errors = SystematicErrors(np.zeros(3), np.diag((0.01, 0.02, 0.001)) ** 2)
    plain = marginal_covariances(refined, refined.terms, steps)
    common = CommonErrors(errors.changes(steps.measured), errors.covariance)
    added = marginal_covariances(refined, refined.terms, steps, common) - plain
    way = refined.poses[:, 0]
    np.testing.assert_allclose(np.sqrt(plain[-1, 0, 0]), 0.1, rtol=0.01)
    np.testing.assert_allclose(np.sqrt(added[:, 0, 0]), 0.01 * way, rtol=0.05, atol=1e-4)
    np.testing.assert_allclose(np.sqrt(added[:, 2, 2]), 0.001 * way, rtol=0.05, atol=1e-5)
    assert not added[0].any()
