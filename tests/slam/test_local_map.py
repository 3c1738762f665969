from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.model import IDENTITY, Pose2
from hsloc.slam.local_map import LocalMap

if TYPE_CHECKING:
    from numpy.typing import NDArray


def wall(length: float = 3.0, y: float = 0.0) -> NDArray[np.float64]:
    return np.column_stack((np.linspace(0, length, 60), np.full(60, y)))


def test_it_scores_as_a_field_of_the_same_points_does() -> None:
    drawn = LocalMap(0.05, 0.2, 0.6)
    drawn.add(wall(), saturation_score=2.0)
    whole = LikelihoodField.from_points(wall(), 0.2, 0.05, 0.7, 0.6)
    near = np.random.default_rng(0).uniform((0.0, -0.4), (3.0, 0.4), (200, 2))
    for point in near:
        assert drawn.field.fitness(point[None], IDENTITY) == pytest.approx(
            whole.fitness(point[None], IDENTITY), abs=0.05
        )


def test_growing_changes_nothing_that_was_drawn() -> None:
    grown, whole = LocalMap(0.05, 0.2, 0.6), LocalMap(0.05, 0.2, 0.6)
    parts = [wall(), wall(y=7.0) + np.array((5.0, 0.0)), wall(y=-9.0) - np.array((20.0, 0.0))]
    assert grown.field.fitness(wall(), IDENTITY) == 0.0  # searched before the first point, as after a scan without any
    for part in parts:
        grown.add(part, saturation_score=2.0)
    whole.add(np.concatenate(parts), saturation_score=2.0)
    points = np.random.default_rng(1).uniform((-25, -12), (12, 10), (4000, 2))
    points = np.concatenate((points, np.concatenate(parts) + 0.03))
    for pose in (IDENTITY, Pose2(0.1, -0.2, 0.01)):
        assert grown.field.fitness(points, pose) == pytest.approx(whole.field.fitness(points, pose), abs=1e-6)
    assert whole.field.fitness(np.concatenate(parts), IDENTITY) > 0.9


def test_drawing_again_draws_nothing() -> None:
    drawn = LocalMap(0.05, 0.2, 0.6)
    assert drawn.add(wall(), saturation_score=2.0) == 60
    before = drawn.scores.copy()
    assert drawn.add(wall(), saturation_score=0.8) == 0
    assert drawn.add(np.zeros((0, 2))) == 0
    np.testing.assert_array_equal(drawn.scores, before)
