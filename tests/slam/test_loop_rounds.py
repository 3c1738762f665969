"""Loops between rooms that look alike, which agree with each other and tear the path."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from room_scans import room_scan

from hsloc.config import Config
from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.loop_matcher import Loop
from hsloc.slam.loop_rounds import close_loops, unusual
from hsloc.slam.map_session import MapSession
from hsloc.slam.pose_graph import Edges
from hsloc.slam.submaps import Submaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

IN_ROOM, IN_CORRIDOR = 22, 14
N = 2 * IN_ROOM + IN_CORRIDOR


def session(apart_s: float) -> tuple[MapSession, NDArray[np.float64]]:
    """A drive through a room, along a corridor and through a room like the first, and the true poses.

    The front end has doubts of the step into the second room, `apart_s` seconds long.
    """
    x = 0.2 * np.arange(N)
    true = np.column_stack((x, np.zeros((N, 2))))
    in_room = np.concatenate((1.0 + x[:IN_ROOM], np.full(IN_CORRIDOR, 3.0), 1.0 + x[:IN_ROOM]))
    kept = []
    for k in range(N):
        place = Pose2(float(in_room[k]), 2.0, 0.0)
        scan = room_scan(place, beams=271, noise=0.01, seed=k)
        if IN_ROOM <= k < N - IN_ROOM:  # the corridor has no end in sight
            bare = np.abs((place @ scan.points_base())[:, 1] - 2.0) > 1.9
            scan = replace(scan, ranges=np.where(bare, scan.ranges, np.nan).astype(np.float32))
        kept.append(KeyScan.of(scan))
    motions = np.concatenate((np.zeros((1, 3)), relative_poses(true[:-1], true[1:])))
    covariances = np.broadcast_to(np.diag((0.01**2, 0.01**2, 0.002**2)), (N, 3, 3)).copy()
    refused = np.zeros(N, dtype=bool)
    refused[N - IN_ROOM] = True
    covariances[N - IN_ROOM, 0, 0] = 3.0**2
    places = Submaps.split_by_path_length(true, motions, covariances, 1.0, 0.3)
    steps = Edges.chain(motions[1:], covariances[1:])
    stamps = np.arange(N) * 200_000_000
    stamps[N - IN_ROOM :] += round((apart_s - 0.2) * 1e9)
    return MapSession(KeyScans.from_scans(kept), stamps, true, motions, covariances, refused, steps, places), true


@pytest.mark.parametrize(("apart_s", "torn"), [(0.2, False), (30.0, True)])
def test_loops_that_tear_the_path_by_more_than_the_robot_drives_are_closed_without(apart_s: float, torn: bool) -> None:
    """In half a minute it may have driven back, and nothing says that it did not."""
    log, true = session(apart_s)
    mapper = Config().graph_mapper
    wide = replace(mapper, loops=replace(mapper.loops, min_path_length=4.0, drift=0.5))
    poses, loops, edges = close_loops(log, wide, np.random.default_rng(0), lambda part: None)
    far = np.abs(poses[:, 0] - true[:, 0]).max()
    assert far > 5.0 if torn else far < 0.05
    assert len(edges) == sum(loop.accepted for loop in loops) > 0


def looped(off: tuple[float, float], *, laps: int = 12, refused: int | None = None) -> tuple[MapSession, list[Loop]]:
    """Drives to and fro, ten keyscans of a metre each; a loop from each to the next, the last one off by (x, theta)."""
    n = 10 * laps + 1
    x = np.abs((np.arange(n) + 10) % 20 - 10).astype(np.float64)
    true = np.column_stack((x, np.zeros((n, 2))))
    motions = np.concatenate((np.zeros((1, 3)), relative_poses(true[:-1], true[1:])))
    covariances = np.broadcast_to(np.diag((0.1**2, 0.1**2, 0.05**2)), (n, 3, 3)).copy()  # more than the path is off by
    doubted = np.zeros(n, dtype=bool)
    doubted[[] if refused is None else refused] = True
    places = Submaps.split_by_path_length(true, motions, covariances, 1.0, 0.3, doubted)
    nothing = KeyScans.from_scans([KeyScan.of(room_scan(Pose2(3.0, 2.0, 0.0)))])
    log = MapSession(
        nothing, np.arange(n), true, motions, covariances, doubted, Edges.chain(motions[1:], covariances[1:]), places
    )
    loops = []
    for lap in range(1, laps):
        first, second = places.place_of(10 * lap - 8), places.place_of(10 * lap + 8)
        a, b = (Pose2.from_array(true[places.reference[place]]) for place in (first, second))
        wrong = Pose2(off[0], 0.0, off[1]) if lap == laps - 1 else Pose2(0.02, 0.0, 0.002)
        small, nan = np.diag((0.01**2, 0.01**2, 0.002**2)), float("nan")
        loops.append(Loop(first, second, a.between(b) @ wrong, small, nan, nan, nan, nan, (0.0, 0.0), True))
    return log, loops


def test_a_loop_that_is_far_farther_from_the_path_than_the_others_is_wrong() -> None:
    """Three standard deviations of the path, which are too large: the others show by how much."""
    log, loops = looped((3.0, 0.0))
    assert unusual(loops, log.places) == [(loops[-1].first, loops[-1].second)]
    for off in (0.3, 1.5):  # as far as wheels slip
        log, loops = looped((off, 0.0))
        assert unusual(loops, log.places) == []
    log, loops = looped((3.0, 0.0), refused=105)
    assert unusual(loops, log.places) == [], "a scan refused a step there"
    log, loops = looped((3.0, 0.0), laps=10)
    assert unusual(loops, log.places) == [], "few loops do not show how well the path is known"
    assert unusual([], log.places) == []
