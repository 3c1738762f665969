"""Scans beside their place: found by what they and the scans around look through, and put back.

Where wheels slip, or the search takes a wrong optimum, one scan or two may be registered beside their place, and stay
there: the refinement's gates are narrower than that. The scans before and after them are right. From where these and
the odometry have them they are registered again, and stay where most of their points agree.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import Pose2, rotated
from hsloc.model.verdict import spans_of
from hsloc.slam.pair_sums import summed_at
from hsloc.slam.refinement import near_the_end, refine_map, silent
from hsloc.slam.scan_registration import MovingScan, StoredScans, register_onto

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.kernels.point_to_line import ScanArrays
    from hsloc.slam.joint_registration import Registration
    from hsloc.slam.map_session import MapSession
    from hsloc.slam.parameters import GraphMapperParameters
    from hsloc.slam.pose_graph import Edges

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]
    Bools = NDArray[np.bool_]

_STRAY = 0.8
"""Consistency of a refused scan with all scans around it below which it is beside its place: simulated ones that were
0.3 to 0.6 m off had 0.74 to 0.79, and of the right steps of five real logs 95 of 100 have 0.82 and more."""
_SEEN = 60.0
"""Points that a scan and those around it could see of each other, without which its consistency says nothing."""
_LONGEST = 5
"""Keyscans in a row that are put back: more are a part of the path, not beside it."""
_AROUND = 3
"""Keyscans before and after that they are registered onto."""
_FOUND_M = 0.15
"""Distance [m] up to which the refinement finds a place by itself: its last gate."""
_SLIP = np.diag((0.3**2, 0.3**2, 0.3**2))
"""Covariance (m^2, rad^2) that is added to the odometry's: it may have slipped there."""


def put_back(
    refined: Registration, session: MapSession, scans: ScanArrays, edges: Edges, parameters: GraphMapperParameters
) -> tuple[Registration, int]:
    """The refined map with its stray scans in their place, and the number of passes; as it is if that is no better."""
    n = len(refined.poses)
    stray = _stray(refined, session.refused)
    poses = refined.poses.copy()
    for first, last in spans_of(stray):
        if first > 0 and last < n - 1 and last - first < _LONGEST:
            around = [*range(max(first - _AROUND, 0), first), *range(last + 1, min(last + 1 + _AROUND, n))]
            still = [(poses[k], MovingScan.of(session.scans.prepared(k))) for k in around if not stray[k]]
            for k in range(first, last + 1):
                poses[k] = _placed(session, refined.poses, still, (first, k, last))
    moved = (poses != refined.poses).any(axis=1)
    if not moved.any():
        return refined, 0
    again, passes = refine_map(poses, scans, edges, near_the_end(parameters), silent, refined)
    is_better = _agreement(again)[moved].sum() > _agreement(refined)[moved].sum()
    return (again if is_better else refined), passes


def _stray(refined: Registration, refused: Bools) -> Bools:
    """Which keyscans (n,) are beside their place: refused ones, and those next to them that are as inconsistent."""
    stray = np.zeros(len(refused), dtype=np.bool_)
    for first, last in spans_of(inconsistent(len(refused), refined.pairs, refined.counts)):
        stray[first : last + 1] = refused[first : last + 1].any()
    return stray


def inconsistent(n: int, pairs: I64, counts: F64) -> Bools:
    """Which keyscans (n,) do not fit those around; `counts` (m, 5) of the pairs (m, 2) as in `pair_terms`."""
    paired, conflict = (summed_at(n, pairs, counts[:, k]) for k in (0, 1))
    return np.asarray((paired + conflict >= _SEEN) & (paired < _STRAY * (paired + conflict)), dtype=np.bool_)


def _placed(session: MapSession, poses: F64, still: list[tuple[F64, MovingScan]], run: tuple[int, int, int]) -> F64:
    """The pose (3,) of keyscan k of a run (first, k, last), of where it is and where the odometry has it the best."""
    first, k, last = run
    steps = [Pose2.from_array(step) for step in session.steps.measured[first - 1 : last + 1]]
    forward, backward = Pose2.from_array(poses[first - 1]), Pose2.from_array(poses[last + 1])
    for step in steps[: k - first + 1]:
        forward = forward @ step
    for step in reversed(steps[k - first + 1 :]):
        backward = backward @ step.inverse()
    covariance = np.linalg.inv(session.steps.information[first - 1 : k]).sum(axis=0) + _SLIP
    scan, stored = (MovingScan.of(session.scans.prepared(k)),), StoredScans()
    here = Pose2.from_array(poses[k])
    found = [
        register_onto(still, scan, start, forward, rotated(covariance, poses[first - 1, 2]), stored)
        for start in (here, forward, backward)
    ]
    best = max(found, key=lambda each: each.agreement).pose
    return best.to_array() if best.distance(here) > _FOUND_M else poses[k]


def _agreement(refined: Registration) -> F64:
    """Points of each keyscan (n,) and its partners on walls of each other, less those where they looked through."""
    return summed_at(len(refined.poses), refined.pairs, refined.counts[:, 0] - refined.counts[:, 1])
