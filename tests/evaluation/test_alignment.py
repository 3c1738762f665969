from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from evaluation_paths import disturb, make_path
from hypothesis import given
from hypothesis import strategies as st

from hsloc.errors import EvaluationError
from hsloc.evaluation.alignment import align, parse_alignment, umeyama
from hsloc.model import Pose2
from hsloc.model.pose2 import compose_poses

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import SimpleNamespace


def test_a_quarter_turn_by_hand() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    turned = Pose2(3.0, -2.0, np.pi / 2) @ square
    found = umeyama(turned, square)
    assert (found.x, found.y, found.theta) == pytest.approx((3.0, -2.0, np.pi / 2))


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(-3.1, 3.1), st.integers(0, 2**32 - 1))
def test_a_rigid_motion_is_found_again(x: Any, y: Any, theta: Any, seed: Any) -> None:
    path = make_path(np.random.default_rng(seed), 30)
    motion = Pose2(x, y, theta)
    moved = compose_poses(motion.to_array(), path.poses)
    for alignment in ("se2", "origin"):
        found = align(moved, path.poses, alignment)
        assert (found.x, found.y) == pytest.approx((x, y), abs=1e-7)
        assert np.cos(found.theta - theta) == pytest.approx(1.0)


def test_none_moves_nothing(rng: np.random.Generator) -> None:
    path = make_path(rng, 5).poses
    assert align(path + 1.0, path, "none") == Pose2()


def test_equals_evo(evo: SimpleNamespace, as_evo: Callable[..., Any], rng: np.random.Generator) -> None:
    reference = make_path(rng, 400)
    noisy = disturb(rng, reference, sigma=0.5)
    ours = align(reference.poses, noisy.poses, "se2")
    rotation, shift, _ = as_evo(noisy, "b").align(as_evo(reference, "a"))
    assert (ours.x, ours.y) == pytest.approx(tuple(shift[:2]), abs=1e-8)
    assert np.sin(ours.theta) == pytest.approx(rotation[1, 0], abs=1e-9)


def test_a_mirrored_path_is_not_turned_over() -> None:
    # evo, in space, would turn the plane upside down and find no error at all.
    path = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    mirrored = path * (1.0, -1.0)
    found = umeyama(mirrored, path)
    assert np.abs(found @ path - mirrored).max() > 0.1


def test_a_straight_line_is_enough_but_a_standing_robot_is_not() -> None:
    line = np.column_stack((np.arange(5.0), np.zeros(5)))
    assert umeyama(line[:, ::-1], line).theta == pytest.approx(np.pi / 2)
    with pytest.raises(EvaluationError, match="needs a path that moves"):
        umeyama(line, np.ones((5, 2)))


def test_names() -> None:
    assert parse_alignment("se3") == "se2"
    assert parse_alignment("origin") == "origin"
    with pytest.raises(EvaluationError, match="'sim3' is unknown; choose one of none, origin, se2"):
        parse_alignment("sim3")
