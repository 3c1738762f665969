"""Closing loops, and once more without those that tear the path.

Between corridors that look alike many loops agree with each other and are wrong together. The path is then torn at one
step that the front end had doubts of, a slip, by more than the robot can drive.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.slam.jumps import jumps, tears
from hsloc.slam.loop_closer import LoopCloser, loop_edges
from hsloc.slam.pose_graph import Edges, compose_steps, solve_edges

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.map_session import MapSession
    from hsloc.slam.parameters import GraphMapperParameters

    F64 = NDArray[np.float64]

_MOST_ROUNDS = 4
"""Times that loops are closed: what is torn then is a failed map."""


def close_loops(
    session: MapSession, parameters: GraphMapperParameters, rng: Generator, progress: Callable[[float], None]
) -> tuple[F64, list[Loop], Edges]:
    """Poses (n, 3) of the keyscans with all loops closed, the loops, and those accepted as edges between keyscans."""
    p, places, forbidden = parameters.loops, session.places, session.forbidden
    odometry = compose_steps(session.steps.measured) if parameters.use_odometry else None
    for rounds_left in range(_MOST_ROUNDS - 1, -1, -1):
        closer = LoopCloser(
            places, session.scans, p, rng, session.known, session.first_place, session.asserted, forbidden
        )
        closer.close(progress)
        edges = loop_edges(closer.accepted, places.reference, p.robust)
        poses = solve_edges(places.expand(closer.poses), Edges.concatenate([session.chain, edges]))
        # Across the gap between two logs nothing was driven.
        found = [] if session.ties or rounds_left == 0 else jumps(session.stamps_ns, poses, odometry)
        torn = tears(found, poses, odometry)
        across = _across(closer.accepted, places.reference, torn)
        believed = {*session.asserted, *((loop.first, loop.second) for loop in session.known)}
        tearing = [pair for pair in across if pair not in believed]
        if not tearing:
            break
        forbidden = (*forbidden, *tearing)
    return poses, closer.loops, edges


def _across(loops: list[Loop], reference: NDArray[np.int64], torn: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The pairs of places of the loops that go across a torn stretch of keyscans."""
    return [
        (loop.first, loop.second)
        for loop in loops
        if any(reference[loop.first] <= first and last <= reference[loop.second] for first, last in torn)
    ]
