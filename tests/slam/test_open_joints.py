"""A robot that is carried while it maps, and one that is not but drives into a room like the first."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rooms import L_SHAPE, beside, seen

from hsloc.config import Config
from hsloc.model.pose2 import Pose2, compose_poses, relative_poses, wrap_angles
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.map_session import MapSession
from hsloc.slam.open_joints import JOINED, close_and_join
from hsloc.slam.pose_graph import Edges, compose_steps
from hsloc.slam.submaps import Submaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

STEP_M = 0.2
WALLS = 2.0 * L_SHAPE
MOTION_SIGMA = np.diag((0.01**2, 0.01**2, 0.002**2))


def line(begin: tuple[float, float], end: tuple[float, float]) -> NDArray[np.float64]:
    """Poses (n, 3) along a line, looking ahead."""
    way = np.subtract(end, begin)
    count = round(float(np.hypot(*way)) / STEP_M)
    places = np.asarray(begin) + np.linspace(0.0, 1.0, count, endpoint=False)[:, None] * way
    return np.column_stack((places, np.full(count, np.arctan2(way[1], way[0]))))


def session(
    true: NDArray[np.float64],
    cut: int,
    odometry_at_cut: tuple[float, float, float],
    walls: object,
    seconds: float = 30.0,
) -> MapSession:
    """A drive whose step to keyscan `cut` the scans refuse: it takes `seconds`, and odometry says `odometry_at_cut`."""
    n = len(true)
    scans = [KeyScan.of(seen(np.asarray(walls), Pose2.from_array(pose), Pose2(), 0.0).scan) for pose in true]
    motions = np.concatenate((np.zeros((1, 3)), relative_poses(true[:-1], true[1:])))
    motions[cut] = odometry_at_cut
    covariances = np.broadcast_to(MOTION_SIGMA, (n, 3, 3)).copy()
    covariances[cut] += np.diag((0.3**2, 0.3**2, 0.3**2))
    refused = np.zeros(n, dtype=bool)
    refused[cut] = True
    poses = compose_poses(true[0], compose_steps(motions[1:]))
    places = Submaps.split_by_path_length(poses, motions, covariances, 3.0, 0.3, refused, 5.0)
    steps = Edges.chain(motions[1:], covariances[1:], refused[1:])
    stamps = np.arange(n) * 200_000_000
    stamps[cut:] += round(seconds * 1e9)
    return MapSession(KeyScans.from_scans(scans), stamps, poses, motions, covariances, refused, steps, places)


def joined(log: MapSession) -> tuple[MapSession, NDArray[np.float64], int]:
    """The session and its poses with loops closed, and the number of loops by which a piece was found."""
    found, poses, loops, _ = close_and_join(log, Config().graph_mapper, np.random.default_rng(0), lambda part: None)
    return found, poses, sum(loop.reason == JOINED for loop in loops)


FIRST = line((2.0, 3.0), (14.0, 3.0))


@pytest.mark.parametrize("is_carried", [True, False], ids=["carried", "turned unseen"])
def test_a_piece_that_nothing_holds_is_found_on_the_map_of_the_other(is_carried: bool) -> None:
    """Odometry counts nothing of a robot that is carried 12 m, or of a turn by 80 deg."""
    if is_carried:
        second = np.concatenate((line((4.0, 12.5), (4.0, 3.0)), line((4.0, 3.0), (10.0, 3.0))))
        at_cut = (0.0, 0.0, 0.0)
    else:
        second = line((13.8, 3.0), (2.0, 3.2))
        at_cut = (0.0, 0.0, np.pi - np.radians(80.0))
    true = np.concatenate((FIRST, second))
    found, poses, loops = joined(session(true, len(FIRST), at_cut, WALLS))
    assert found.joints == (len(FIRST),)
    assert loops >= 2
    assert np.abs(poses[0] - true[0]).max() < 1e-9, "the frame stays that of the first scan"
    error = poses - true
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.1
    assert np.abs(wrap_angles(error[:, 2])).max() < 0.02


def test_a_room_like_the_first_stays_where_odometry_has_it() -> None:
    """The whole map holds one place where the second room fits: the first. Nothing speaks against two rooms."""
    true = np.concatenate((FIRST, FIRST + np.array((30.0, 0.0, 0.0))))
    at_cut = tuple(relative_poses(true[len(FIRST) - 1 : len(FIRST)], true[len(FIRST) : len(FIRST) + 1])[0])
    found, poses, loops = joined(session(true, len(FIRST), at_cut, beside(WALLS, 30.0)))
    assert (found.joints, loops) == ((), 0)
    assert np.hypot(*(poses - true)[:, :2].T).max() < 0.1


def test_a_piece_is_not_found_where_the_user_says_that_it_is_elsewhere() -> None:
    """The places of stated loops get other numbers as pieces become places of their own."""
    second = np.concatenate((line((4.0, 12.5), (4.0, 3.0)), line((4.0, 3.0), (10.0, 3.0))))
    log = session(np.concatenate((FIRST, second)), len(FIRST), (0.0, 0.0, 0.0), WALLS)
    cut = log.places.place_of(len(FIRST))
    pairs = tuple((i, j) for i in range(cut + 1) for j in range(cut, len(log.places)))
    found, _, loops = joined(replace(log, forbidden=pairs))
    assert (found.joints, loops) == ((), 0)


def test_a_robot_is_not_carried_12_m_in_a_second() -> None:
    true = np.concatenate((FIRST, line((4.0, 12.5), (4.0, 3.0)), line((4.0, 3.0), (10.0, 3.0))))
    found, _, loops = joined(session(true, len(FIRST), (0.0, 0.0, 0.0), WALLS, seconds=1.0))
    assert (found.joints, loops) == ((), 0)
