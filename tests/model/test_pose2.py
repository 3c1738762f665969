"""The axioms of SE(2), and what composing means."""

from __future__ import annotations

from math import atan2, cos, pi, sin
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.model import IDENTITY, Pose2, wrap_angle, wrap_angles
from hsloc.model.pose2 import compose_poses, pose_differences, relative_poses

coordinates = st.floats(-100.0, 100.0)
angles = st.floats(-10.0, 10.0)
poses = st.builds(lambda x, y, t: Pose2(x, y, wrap_angle(t)), coordinates, coordinates, angles)


def close(a: Pose2, b: Pose2) -> bool:
    return abs(a.x - b.x) < 1e-9 and abs(a.y - b.y) < 1e-9 and abs(wrap_angle(a.theta - b.theta)) < 1e-9


@given(poses)
def test_identity(T: Any) -> None:
    assert close(T @ IDENTITY, T)
    assert close(IDENTITY @ T, T)


@given(poses)
def test_inverse(T: Any) -> None:
    assert close(T @ T.inverse(), IDENTITY)
    assert close(T.inverse() @ T, IDENTITY)


@given(poses, poses, poses)
def test_associativity(A: Any, B: Any, C: Any) -> None:
    assert close((A @ B) @ C, A @ (B @ C))


@given(poses, poses)
def test_between_is_inverse_then_compose(A: Any, B: Any) -> None:
    assert close(A.between(B), A.inverse() @ B)


@given(poses, poses, st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=5))
def test_acting_on_points_composes(A: Any, B: Any, points: Any) -> None:
    array = np.array(points)
    np.testing.assert_allclose((A @ B) @ array, A @ (B @ array), atol=1e-9)


def test_a_quarter_turn_by_hand() -> None:
    T_map_base = Pose2(1.0, 2.0, pi / 2)
    assert close(T_map_base @ Pose2(1.0, 0.0, 0.0), Pose2(1.0, 3.0, pi / 2))
    np.testing.assert_allclose(T_map_base @ np.array([[1.0, 0.0], [0.0, 1.0]]), [[1.0, 3.0], [0.0, 2.0]], atol=1e-12)


@given(angles)
def test_wrapping_keeps_the_direction(angle: Any) -> None:
    wrapped = wrap_angle(angle)
    assert -pi < wrapped <= pi
    assert abs(atan2(sin(wrapped - angle), cos(wrapped - angle))) < 1e-9
    assert abs(wrap_angles(np.array([angle]))[0] - wrapped) < 1e-9 or abs(abs(wrapped) - pi) < 1e-9


@pytest.mark.parametrize("angle", [pi, -pi, 3 * pi, -3 * pi])
def test_half_a_turn_is_plus_pi(angle: float) -> None:
    assert wrap_angle(angle) == pytest.approx(pi)


@given(poses)
def test_quaternion_round_trip(T: Any) -> None:
    assert close(Pose2.from_quaternion(T.x, T.y, *T.to_quaternion()), T)


@given(poses, poses)
def test_interpolation_ends_at_the_ends_and_goes_the_short_way(A: Any, B: Any) -> None:
    assert close(A.interpolate(B, 0.0), A)
    assert close(A.interpolate(B, 1.0), B)
    half = A.interpolate(B, 0.5)
    assert abs(wrap_angle(half.theta - A.theta)) <= pi / 2 + 1e-9


@given(st.lists(st.tuples(poses, poses), min_size=1, max_size=5))
def test_rows_are_poses(pairs: Any) -> None:
    first = np.array([A.to_array() for A, _ in pairs])
    second = np.array([B.to_array() for _, B in pairs])
    for row, (A, B) in zip(relative_poses(first, second), pairs, strict=True):
        assert close(Pose2.from_array(row), A.between(B))
    for row, (A, B) in zip(compose_poses(first, second), pairs, strict=True):
        assert close(Pose2.from_array(row), A @ B)
    for row, (A, B) in zip(pose_differences(first, second), pairs, strict=True):
        assert (row[0], row[1]) == (A.x - B.x, A.y - B.y)
        assert abs(wrap_angle(row[2] - (A.theta - B.theta))) < 1e-9
        assert -pi < row[2] <= pi
