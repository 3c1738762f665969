"""Transforms in space against 4 x 4 matrices, and how a laser's mounting comes down to the plane."""

from __future__ import annotations

from math import cos, pi, radians, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_builders import make_scan

from hsloc.log.transforms import FrameTree, Transform3, laser_mounting
from hsloc.model import Pose2

numbers = st.floats(-10, 10)


@st.composite
def transforms(draw: st.DrawFn) -> Transform3:
    quaternion = np.array([draw(st.floats(-1, 1)) for _ in range(4)])
    if np.linalg.norm(quaternion) < 0.1:
        quaternion = np.array((0.0, 0.0, 0.0, 1.0))
    x, y, z, w = (float(v) for v in quaternion / np.linalg.norm(quaternion))
    return Transform3((draw(numbers), draw(numbers), draw(numbers)), (x, y, z, w))


def matrix(t: Transform3) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """The textbook's matrix of a quaternion: the same as `rotate`."""
    x, y, z, w = t.rotation
    result = np.eye(4)
    result[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result[:3, 3] = t.translation
    return result


@given(transforms(), transforms())
def test_composition_and_inverse_are_those_of_matrices(a: Transform3, b: Transform3) -> None:
    np.testing.assert_allclose(matrix(a @ b), matrix(a) @ matrix(b), atol=1e-9)
    np.testing.assert_allclose(matrix(a.inverse()), np.linalg.inv(matrix(a)), atol=1e-9)


@given(numbers, numbers, st.floats(-3, 3))
def test_the_plane_goes_up_and_comes_down(x: float, y: float, theta: float) -> None:
    back = Transform3.from_pose2(Pose2(x, y, theta)).to_pose2()
    np.testing.assert_allclose(back.to_array(), (x, y, theta), atol=1e-12)


def test_an_unset_quaternion_is_no_rotation() -> None:
    assert Transform3((1, 2, 3), (0, 0, 0, 0)).normalised() == Transform3((1, 2, 3))


def test_the_tree_finds_ways_up_and_down() -> None:
    tree = FrameTree()
    tree.add("base_footprint", "base_link", Transform3((0, 0, 0.1)))
    tree.add("base_link", "shelf", Transform3.from_pose2(Pose2(0.1, 0, pi / 2)))
    tree.add("shelf", "laser", Transform3((0.2, 0, 0.3)))
    tree.add("base_link", "wheel", Transform3((0, 0.2, 0)))
    found = tree.lookup("wheel", "laser")
    assert found is not None
    np.testing.assert_allclose(found.translation, (0.1, 0.0, 0.3), atol=1e-12)
    assert tree.lookup("base_link", "base_link") == Transform3()
    assert tree.lookup("base_link", "camera") is None
    assert "shelf" in tree
    assert "camera" not in tree


def test_a_loop_in_the_tree_ends() -> None:
    tree = FrameTree()
    tree.add("a", "b", Transform3())
    tree.add("b", "a", Transform3())
    assert tree.lookup("c", "a") is None
    assert tree.lookup("a", "b") is not None


def test_what_comes_later_overrides_and_motion_is_distinguished_from_noise() -> None:
    tree = FrameTree()
    tree.add("base", "laser", Transform3((1, 0, 0)))
    tree.add("base", "laser", Transform3((1.0001, 0, 0)))
    assert not tree.is_moving("laser")
    tree.add("base", "laser", Transform3((2, 0, 0)))
    assert tree.is_moving("laser")
    found = tree.lookup("base", "laser")
    assert found is not None
    assert found.translation == (2, 0, 0)


def about_x(angle: float) -> Transform3:
    return Transform3((0, 0, 0), (sin(angle / 2), 0, 0, cos(angle / 2)))


def about_y(angle: float) -> Transform3:
    return Transform3((0, 0, 0), (0, sin(angle / 2), 0, cos(angle / 2)))


@pytest.mark.parametrize("yaw", [0.0, 0.3, pi / 2, -2.5])
@pytest.mark.parametrize("turn", [Transform3(), about_x(pi), about_y(pi)], ids=["upright", "rolled", "pitched"])
def test_beams_of_a_mounted_laser_point_where_they_point_in_space(yaw: float, turn: Transform3) -> None:
    mount = Transform3.from_pose2(Pose2(0.2, 0.1, yaw)) @ turn
    mounting = laser_mounting(mount)
    assert mounting.flipped is (turn != Transform3())
    assert mounting.tilt == pytest.approx(0.0, abs=1e-7)
    scan = make_scan(0)
    sign = -1.0 if mounting.flipped else 1.0
    for angle in scan.angles():
        x, y, _ = mount.rotate((cos(angle), sin(angle), 0.0))
        flat = mounting.T_base_laser.theta + sign * angle
        np.testing.assert_allclose((cos(flat), sin(flat)), (x, y), atol=1e-12)


@pytest.mark.parametrize(("angle", "flipped"), [(5.0, False), (175.0, True)])
def test_tilt_is_measured_from_the_plane_either_side_up(angle: float, flipped: bool) -> None:
    mounting = laser_mounting(about_x(radians(angle)))
    assert mounting.flipped is flipped
    assert mounting.tilt == pytest.approx(radians(5.0))
