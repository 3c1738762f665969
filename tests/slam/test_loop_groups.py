"""Loops that look through walls and bear each other out: a path that goes out, and comes back 3 m beside itself."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.slam.loop_groups import corroborated
from hsloc.slam.loop_matcher import Loop
from hsloc.slam.submaps import Submaps

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

N = 30
REFUSED = 15
NAN = float("nan")


def path(refused: int | None = REFUSED) -> tuple[Submaps, NDArray[np.float64]]:
    """Places of a metre each and their true poses: 15 m ahead, and back; where the robot turned the wheels slipped."""
    back = np.arange(N) >= REFUSED
    x = np.where(back, 2.0 * REFUSED - np.arange(N), np.arange(N)).astype(np.float64)
    true = np.column_stack((x, np.zeros(N), np.where(back, np.pi, 0.0)))
    found = true.copy()
    found[REFUSED:, 1] += 3.0
    motions = np.concatenate((np.zeros((1, 3)), relative_poses(found[:-1], found[1:])))
    covariances = np.broadcast_to(np.diag((0.02**2, 0.02**2, 0.004**2)), (N, 3, 3)).copy()
    doubted = np.zeros(N, dtype=bool)
    if refused is not None:
        doubted[refused] = True
    return Submaps.split_by_path_length(found, motions, covariances, 1.0, 0.0, doubted), true


def loop(true: NDArray[np.float64], places: Submaps, first: int, second: int, off: float = 0.0) -> Loop:
    """A loop that was refused for looking through walls, `off` metres along the corridor."""
    i, j = places.reference[[first, second]]
    motion = Pose2.from_array(relative_poses(true[None, i], true[None, j])[0])
    pose = replace(motion, x=motion.x + off)
    covariance = np.diag((0.05**2, 0.05**2, 0.01**2))
    return Loop(
        first, second, pose, covariance, 0.4, NAN, 0.1, 0.3, (5.0, 0.2), False, "looks through", centre=Pose2(0, 0, 0)
    )


@pytest.fixture
def found() -> tuple[Submaps, Callable[..., Loop]]:
    places, true = path()
    return places, lambda first, second, off=0.0: loop(true, places, first, second, off)


def pairs(loops: list[Loop]) -> list[tuple[int, int]]:
    return [(each.first, each.second) for each in loops]


def test_three_places_that_lead_to_one_pose_bear_each_other_out(found: tuple[Submaps, Callable[..., Loop]]) -> None:
    places, at = found
    assert places.uncertain.sum() == 1
    three = [at(8, 22), at(7, 23), at(5, 25)]
    assert corroborated(three, places) == three
    assert corroborated(three[:2], places) == []
    assert corroborated([*three[:2], at(5, 25, 0.5)], places) == [], "the third leads elsewhere"
    assert pairs(corroborated([*three, at(6, 24, 0.5)], places)) == pairs(three)
    assert corroborated([at(8, 22), at(7, 22), at(9, 22)], places) == [], "all of one place"
    assert corroborated([at(9, 21), at(5, 25), at(1, 29)], places) == [], "too far from each other"
    assert corroborated([*three[:2], replace(three[2], centre=None)], places) == [], "refused for something else"


def test_a_path_that_is_known_is_not_bent(found: tuple[Submaps, Callable[..., Loop]]) -> None:
    places, at = found
    three = [at(8, 22), at(7, 23), at(5, 25)]
    accepted = [replace(at(k, 30 - k), accepted=True, centre=None) for k in (1, 3)]
    assert corroborated([*three, accepted[0]], places) == three, "a single loop shares out the errors of what it spans"
    assert corroborated([*three, *accepted], places) == []
    pieces = replace(places, piece=(np.arange(N) >= REFUSED).astype(np.int64))
    assert corroborated(three, pieces) == [], "found by a search of the whole map"
    certain, _ = path(refused=None)
    assert corroborated(three, certain) == []
