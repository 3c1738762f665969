"""Scans beside their place: found by what they and the scans around look through, and put back.

Where wheels slip, or the search takes a wrong optimum, scans may be registered beside their place, and stay there: the
refinement's gates are narrower than that. The scans before and after them are right. From where these and the odometry
have it a single scan is registered again, and stays where most of its points agree. Of several in a row one after the
other is registered onto those that have their place, from both ends inwards, the one that agrees best first. There the
odometry may say anything: encoders that do not know the direction count backwards as forwards (Freiburg 079, where the
robot drives back 3 m, and runs of 4 to 18 keyscans were 1 to 1.7 m off after small changes of the log).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.pose2 import IDENTITY, Pose2, rotated
from hsloc.model.verdict import spans_of
from hsloc.slam.pair_sums import summed_at
from hsloc.slam.refinement import near_the_end, refine_map, silent
from hsloc.slam.scan_registration import MovingScan, ScanRegistration, StoredScans, register_onto

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
_LONGEST, _LONGEST_M = 30, 6.0
"""Keyscans in a row, and their path by the odometry [m], that are put back: more is a part of the map."""
_STEP_M = 0.5
"""Longest step [m] in such a run: from none, or from one the other way round, the registration has to get there. Scans
of sparse logs are metres apart, and what they agree with then may be another wall (ACES, every fourth scan)."""
_AROUND = 3
"""Keyscans before and after that they are registered onto; runs with fewer between them are one run."""
_ANYWHERE = np.diag((1.0, 1.0, 0.5**2))
"""Covariance (m^2, rad^2) of a step in such a run about no translation at all: keyscans are some decimetres apart."""
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
    for first, last in _joined(spans_of(stray)):
        if first == 0 or last == n - 1 or last - first >= _LONGEST:
            continue
        steps = np.hypot(*session.steps.measured[first - 1 : last + 1, :2].T)
        if first == last:
            poses[first] = _placed(session, refined.poses, stray, first)
        elif steps.max() <= _STEP_M and steps.sum() <= _LONGEST_M:
            poses[first : last + 1] = _placed_in_turn(session, refined.poses, first, last)
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


def _joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Spans (first, last) with fewer than `_AROUND` keyscans between them as one: these have no place to start from."""
    found: list[tuple[int, int]] = []
    for first, last in spans:
        if found and first - found[-1][1] <= _AROUND:
            found[-1] = (found[-1][0], last)
        else:
            found.append((first, last))
    return found


def _placed(session: MapSession, poses: F64, stray: Bools, k: int) -> F64:
    """The pose (3,) of keyscan k, of where it is and where the odometry has it from both sides the best."""
    around = [*range(max(k - _AROUND, 0), k), *range(k + 1, min(k + 1 + _AROUND, len(poses)))]
    still = [(poses[j], MovingScan.of(session.scans.prepared(j))) for j in around if not stray[j]]
    step, next_step = (Pose2.from_array(each) for each in session.steps.measured[k - 1 : k + 1])
    forward, backward = Pose2.from_array(poses[k - 1]) @ step, Pose2.from_array(poses[k + 1]) @ next_step.inverse()
    covariance = np.linalg.inv(session.steps.information[k - 1]) + _SLIP
    scan, stored = (MovingScan.of(session.scans.prepared(k)),), StoredScans()
    here = Pose2.from_array(poses[k])
    found = [
        register_onto(still, scan, start, forward, rotated(covariance, poses[k - 1, 2]), stored)
        for start in (here, forward, backward)
    ]
    best = max(found, key=lambda each: each.agreement).pose
    return best.to_array() if best.distance(here) > _FOUND_M else poses[k]


def _placed_in_turn(session: MapSession, poses: F64, first: int, last: int) -> F64:
    """Poses (n, 3) of the keyscans from `first` to `last`, each registered onto the nearest that have their place."""
    around = range(max(first - _AROUND, 0), min(last + 1 + _AROUND, len(poses)))
    scans = {k: MovingScan.of(session.scans.prepared(k)) for k in around}
    placed, stored = poses.copy(), StoredScans()
    ends, found = {1: first - 1, -1: last + 1}, dict[int, ScanRegistration]()
    while ends[-1] - ends[1] > 1:
        for side, end in ends.items():
            if side not in found:  # what was found on the other side still holds
                found[side] = _beside(session, placed, scans, (end, side), stored)
        side = max(ends, key=lambda each: found[each].agreement)
        ends[side] += side
        placed[ends[side]] = found.pop(side).pose.to_array()
    near = np.hypot(*(placed - poses)[first : last + 1, :2].T) <= _FOUND_M
    return np.where(near[:, None], poses[first : last + 1], placed[first : last + 1])


def _beside(
    session: MapSession, poses: F64, scans: dict[int, MovingScan], at: tuple[int, int], stored: StoredScans
) -> ScanRegistration:
    """The keyscan on one `side` (1 or -1) of the keyscan `end`, which has its place: the best of several starts.

    These are a step as the odometry has it, none, the last one again, and that of the odometry the other way round.
    """
    end, side = at
    k = end + side
    near = [j for j in range(end, end - side * _AROUND, -side) if 0 <= j < len(poses)]
    still = [(poses[j], scans[j]) for j in near]
    step = Pose2.from_array(session.steps.measured[min(end, k)])
    step = step if side > 0 else step.inverse()
    here, turn = Pose2.from_array(poses[end]), Pose2(0.0, 0.0, step.theta)
    starts = [step, IDENTITY, turn, Pose2(-step.x, -step.y, step.theta)]
    if len(near) > 1:
        starts.append(Pose2.from_array(poses[near[1]]).between(here))
    found = [register_onto(still, (scans[k],), here @ start, here @ turn, _ANYWHERE, stored) for start in starts]
    return max(found, key=lambda each: each.agreement)


def _agreement(refined: Registration) -> F64:
    """Points of each keyscan (n,) and its partners on walls of each other, less those where they looked through."""
    return summed_at(len(refined.poses), refined.pairs, refined.counts[:, 0] - refined.counts[:, 1])
