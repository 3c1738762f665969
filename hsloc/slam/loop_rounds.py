"""Closing loops, and once more without those that tear the path, or bend it as no other loop does.

Between corridors that look alike many loops agree with each other and are wrong together. The path is then torn at one
step that the front end had doubts of, a slip, by more than the robot can drive. Or it is bent evenly over a stretch in
which the scans agreed at each step: how well such stretches are known the other loops show.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import mahalanobis_distances, pose_differences
from hsloc.slam.jumps import jumps, tears
from hsloc.slam.loop_closer import LoopCloser, loop_edges
from hsloc.slam.pose_graph import Edges, compose_steps, solve_edges
from hsloc.slam.slips import motions_by_steps

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.map_session import MapSession
    from hsloc.slam.parameters import GraphMapperParameters
    from hsloc.slam.submaps import Submaps

    F64 = NDArray[np.float64]

_MOST_ROUNDS = 4
"""Times that loops are closed: what is torn then is a failed map."""
_LEAST_LOOPS = 10
"""Loops that show how well the path is known."""
_UNUSUAL = 8.0
"""Factor to the median distance of the loops from the path, in its standard deviations, from which on one is wrong. Two
distances of three degrees of freedom, as of loops that all span the same stretch and one that spans another, differ by
this factor in 1 of 300 cases (F distribution); how large the standard deviations are does not matter."""
_BEYOND_SLIPS_M = 2.0
"""Distance [m] of such a loop from the path: beyond two slips."""


def close_loops(
    session: MapSession,
    parameters: GraphMapperParameters,
    rng: Generator,
    progress: Callable[[float], None],
    with_corroborated: bool = False,
) -> tuple[F64, list[Loop], Edges]:
    """Poses (n, 3) of the keyscans with all loops closed, the loops, and those accepted as edges between keyscans.

    `with_corroborated` as in `LoopCloser.close`.
    """
    p, places, forbidden = parameters.loops, session.places, session.forbidden
    odometry = compose_steps(session.steps.measured) if parameters.use_odometry else None
    for rounds_left in range(_MOST_ROUNDS - 1, -1, -1):
        closer = LoopCloser(
            places, session.scans, p, rng, session.known, session.first_place, session.asserted, forbidden
        )
        closer.close(progress, with_corroborated)
        edges = loop_edges(closer.accepted, places.reference, p.robust)
        poses = solve_edges(places.expand(closer.poses), Edges.concatenate([session.chain, edges]))
        # Across the gap between two logs nothing was driven.
        found = [] if session.ties or rounds_left == 0 else jumps(session.stamps_ns, poses, odometry)
        torn = tears(found, poses, odometry)
        wrong = _across(closer.accepted, places.reference, torn)
        if rounds_left > 0:
            wrong += unusual(closer.accepted, places)
        believed = {*session.asserted, *((loop.first, loop.second) for loop in session.known)}
        wrong = [pair for pair in wrong if pair not in believed]
        if not wrong:
            break
        forbidden = (*forbidden, *wrong)
    return poses, closer.loops, edges


def _across(loops: list[Loop], reference: NDArray[np.int64], torn: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The pairs of places of the loops that go across a torn stretch of keyscans."""
    return [
        (loop.first, loop.second)
        for loop in loops
        if any(reference[loop.first] <= first and last <= reference[loop.second] for first, last in torn)
    ]


def unusual(loops: list[Loop], places: Submaps) -> list[tuple[int, int]]:
    """The pairs of places of the loops that lie far farther from the path than the others.

    Only stretches in which no scan refused a step: elsewhere a slip may be as large.
    """
    refused = np.concatenate(([0], np.cumsum(places.uncertain)))
    certain = [loop for loop in loops if loop.first < loop.second and refused[loop.first] == refused[loop.second]]
    if len(certain) < _LEAST_LOOPS:
        return []
    pairs = [(loop.first, loop.second) for loop in certain]
    motions, covariances = motions_by_steps(places.steps, places.covariances, np.array(pairs, dtype=np.int64))
    off = pose_differences(np.array([loop.T_first_second.to_array() for loop in certain]), motions)
    distances = mahalanobis_distances(off, covariances + np.array([loop.covariance for loop in certain]))
    is_far = (distances > _UNUSUAL * np.median(distances)) & (np.hypot(off[:, 0], off[:, 1]) > _BEYOND_SLIPS_M)
    return [pair for pair, far in zip(pairs, is_far, strict=True) if far]
