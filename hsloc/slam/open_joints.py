"""Pieces of a path that nothing holds together: found on the map of the others by a search of the whole map.

Where the scans refuse a step and fewer than two loops span it, what odometry says of the step is all there is. The
robot may have been carried, or have turned unseen, by far more than the windows of loops allow for. Each piece before
or after such a step is therefore searched for on the map of the largest one, as a log is that extends a saved map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.relocaliser import Relocaliser, RelocaliserParameters
from hsloc.matching.hide import Hide
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.model.pose2 import IDENTITY, Pose2, compose_poses, relative_poses, wrap_angles
from hsloc.slam.keyscans import KeyScans
from hsloc.slam.loop_closer import LoopCloser
from hsloc.slam.loop_groups import corroborated, open_steps
from hsloc.slam.loop_rounds import close_loops
from hsloc.slam.map_extension import AROUND, LOOKED, loops_of_most, places_on_map
from hsloc.slam.map_session import between_places
from hsloc.slam.occupancy_mapper import build_grid

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.map_session import MapSession
    from hsloc.slam.parameters import GraphMapperParameters
    from hsloc.slam.pose_graph import Edges

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

JOINED = "joins pieces"
"""The reason of a loop by which a piece was found."""
_LEAST_M = 9.0
"""Length of a piece [m] that is searched for: three places."""
_MOST_PIECES = 4
"""Pieces that are searched for, the longest. Internal: time, where the scans of a whole log refuse its steps."""
_ATTEMPTS = 4
"""Places of a piece, evenly chosen, from which the map is searched: it may begin outside of what was drawn."""
_MOST_BOXES = 1_000_000
"""Boxes of poses in a search of the map, about a tenth of a second: what takes more fits badly everywhere."""
_AGREE = 3
"""Minimum number of places that a loop connects: 9 m. Two ends of corridors looked alike over two places."""
_SLIP_M = 1.0
"""Motion [m] that wheels slip by at most."""
_CARRIED_M_S = 2.0
"""Speed [m/s] at which a robot is carried or pushed at most: that of somebody who walks fast."""
_SAME_M, _SAME_RAD = 0.5, 0.2
"""Difference of two places [m, rad] that loops put right by themselves."""
_PAIRED_M, _CONFLICT_M = 0.3, 0.5
"""Distances [m] from the walls of the other pieces up to which a hit is on one, and from which on it is on none."""
_SEEN = 30
"""Hits of a scan on either, without which it says nothing."""
_INCONSISTENT, _INCONSISTENT_M = 0.6, 1.0
"""Part of them on walls below which a scan does not fit, and length [m] of such scans: as of second visits."""


def close_and_join(
    session: MapSession, parameters: GraphMapperParameters, rng: Generator, progress: Callable[[float], None]
) -> tuple[MapSession, F64, list[Loop], Edges]:
    """The session with its loops closed: see `close_loops`; pieces that nothing holds are searched for on the map.

    Those that are not found there are held by loops that look through walls, if several places bear these out and the
    map does not contradict them.
    """
    poses, loops, edges = close_loops(session, parameters, rng, progress)
    # Of a map that is extended, or followed while the log is read, it is known how its parts lie.
    if session.first > 0 or session.ties:
        return session, poses, loops, edges
    joined = _join_pieces(session, poses, loops, parameters, rng)
    if joined is not None:
        again, loops_again, edges_again = close_loops(joined, parameters, rng, progress)
        accepted = [loop for loop in loops_again if loop.accepted]
        held = all(any(_spans(loop, joined, joint) for loop in accepted) for joint in joined.joints)
        if held and _is_likelier(joined, again, poses, parameters):
            return joined, again, loops_again, edges_again
    if corroborated(loops, session.places):
        again, loops_again, edges_again = close_loops(session, parameters, rng, progress, with_corroborated=True)
        pieces = replace(session, joints=tuple(_open_steps(session, loops).tolist()))
        if not _is_contradicted(pieces, again, parameters):
            return session, again, loops_again, edges_again
    return session, poses, loops, edges


def _is_likelier(joined: MapSession, poses: F64, before: F64, parameters: GraphMapperParameters) -> bool:
    """Whether poses (n, 3) with the pieces joined are likelier than those before: nothing speaks against them.

    Robots slip more often than they are carried, and buildings have corridors that look alike. A place that is farther
    from the odometry's than a slip takes the time to carry the robot there, and the odometry's to be wrong.
    """
    joints = np.array(joined.joints)
    # Until it is put down scans are refused.
    fitting = np.append(np.flatnonzero(~joined.refused), len(poses) - 1)
    down = fitting[np.searchsorted(fitting, joints)]
    there, then = relative_poses(poses[joints - 1], poses[down]), relative_poses(before[joints - 1], before[down])
    moved = there - then
    if (np.hypot(moved[:, 0], moved[:, 1]) < _SAME_M).all() and (np.abs(wrap_angles(moved[:, 2])) < _SAME_RAD).all():
        return False
    by_odometry = relative_poses(poses[joints - 1], poses[joints]) - joined.steps.measured[joints - 1]
    far = np.hypot(by_odometry[:, 0], by_odometry[:, 1]) > _SLIP_M
    seconds = (joined.stamps_ns[down] - joined.stamps_ns[joints - 1]) * 1e-9
    if (far & (np.hypot(there[:, 0], there[:, 1]) > _SLIP_M + _CARRIED_M_S * seconds)).any():
        return False
    if far.any() and not _is_contradicted(joined, before, parameters):
        return False
    return not _is_contradicted(joined, poses, parameters)


def _is_contradicted(session: MapSession, poses: F64, parameters: GraphMapperParameters) -> bool:
    """Whether a piece sees walls on what is open ground of the others, for a metre or more of its path."""
    ends = [0, *session.joints, len(poses)]
    for begin, end in pairwise(ends):
        others = np.concatenate((np.arange(begin), np.arange(end, len(poses))))
        grid = _grid_of(session, poses, others, parameters)
        if not grid.occupied().any():
            continue
        field, open_ground = LikelihoodField.from_grid(grid), grid.free()
        inconsistent = 0.0
        for k in range(begin, end):
            points = Pose2.from_array(poses[k]) @ session.scans.hits(k).astype(np.float64)
            cells = np.floor(grid.origin.inverse() @ points / grid.resolution).astype(np.int64)
            inside = (cells >= 0).all(axis=1) & (cells < np.array(open_ground.shape)[::-1]).all(axis=1)
            distance, (u, v) = field.distances(points[inside]), cells[inside].T
            paired = np.count_nonzero(distance <= _PAIRED_M)
            conflict = np.count_nonzero(open_ground[v, u] & (distance > _CONFLICT_M))
            moved = float(np.hypot(*(poses[k, :2] - poses[k - 1, :2]))) if k > begin else 0.0
            is_seen = paired + conflict >= _SEEN
            is_wrong = is_seen and paired < _INCONSISTENT * (paired + conflict)
            inconsistent = inconsistent + moved if is_wrong else 0.0 if is_seen else inconsistent
            if inconsistent > _INCONSISTENT_M:
                return True
    return False


def _grid_of(
    session: MapSession, poses: F64, members: NDArray[np.int64], parameters: GraphMapperParameters
) -> OccupancyGrid:
    scans = KeyScans.from_scans([session.scans.prepared(k) for k in members.tolist()])
    return build_grid(poses[members], scans, parameters.occupancy)


def _spans(loop: Loop, session: MapSession, joint: int) -> bool:
    reference = session.places.reference
    return bool(reference[loop.first] < joint <= reference[loop.second])


@dataclass(slots=True)
class _Pieces:
    """The keyscans `of[k]` of each piece, and where those are on the map of the first that were found."""

    of: list[range]
    T_map_piece: dict[int, Pose2]

    def members(self) -> NDArray[np.int64]:
        """The keyscans of the pieces that were found."""
        found = [np.arange(self.of[k].start, self.of[k].stop) for k in sorted(self.T_map_piece)]
        return np.concatenate(found)


def _join_pieces(
    session: MapSession, poses: F64, loops: list[Loop], parameters: GraphMapperParameters, rng: Generator
) -> MapSession | None:
    """The session with its pieces where they were found, and the loops that say so; None where none was found.

    `poses` (n, 3) are the solved ones, `loops` what was searched for.
    """
    of = _long_pieces(session, poses, loops)
    if len(of) < 2:
        return None
    # Places that end where pieces do: a place must not hold scans of two.
    session = session.with_joints(poses, [piece.start for piece in of[1:]], parameters)
    pieces = _Pieces(of, {int(np.argmax([len(piece) for piece in of])): IDENTITY})
    known: list[Loop] = []
    while True:
        more = _next_piece(session, poses, pieces, parameters, rng)
        if not more:
            break
        known += more
    if not known:
        return None
    # What lies between goes with the piece before it; the first keyscan stays where it is.
    moved, T_map_piece, joints = poses.copy(), IDENTITY, []
    found = sorted(pieces.T_map_piece)
    for k in found:
        T_map_piece = pieces.T_map_piece[k]
        begin = 0 if k == found[0] else of[k].start
        moved[begin:] = compose_poses(T_map_piece.to_array(), poses[begin:])
        joints += [begin] if begin else []
    back = Pose2.from_array(poses[0]) @ Pose2.from_array(moved[0]).inverse()
    moved = compose_poses(back.to_array(), moved)
    joined = session.with_joints(moved, joints, parameters)
    reference, places = session.places.reference, joined.places
    of_keyscans = [
        between_places(
            int(reference[loop.first]), int(reference[loop.second]), loop.T_first_second, loop.covariance, moved,
            places, JOINED,
        )
        for loop in known
    ]  # fmt: skip
    return replace(joined, known=(*joined.known, *of_keyscans))


def _open_steps(session: MapSession, loops: list[Loop]) -> I64:
    """Keyscans at which runs of steps begin that the scans refused and only odometry holds."""
    ends = [(loop.first, loop.second) for loop in loops if loop.accepted]
    is_open = open_steps(session.refused, session.places.reference[np.array(ends, dtype=np.int64).reshape(-1, 2)])
    # A run of refused steps begins where the robot was carried: until there is a new local map nothing fits.
    return np.flatnonzero(is_open & ~np.concatenate(([False], is_open[:-1])))


def _long_pieces(session: MapSession, poses: F64, loops: list[Loop]) -> list[range]:
    """Keyscans between steps that only odometry holds, of pieces long enough, in the order of time."""
    starts = np.unique(np.concatenate(([0], _open_steps(session, loops), [len(poses)])))
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))
    pieces = [range(a, b) for a, b in pairwise(starts.tolist())]
    length = {piece: float(way[piece.stop - 1] - way[piece.start]) for piece in pieces}
    long = sorted((p for p in pieces if length[p] >= _LEAST_M), key=lambda piece: -length[piece])[:_MOST_PIECES]
    return sorted(long, key=lambda piece: piece.start)


def _next_piece(
    session: MapSession, poses: F64, pieces: _Pieces, parameters: GraphMapperParameters, rng: Generator
) -> list[Loop]:
    """Find one more piece, the longest first: the loops that say so, none where none was found."""
    left = [k for k in range(len(pieces.of)) if k not in pieces.T_map_piece]
    if not left:
        return []
    members = pieces.members()
    at = poses.copy()
    for k, T_map_piece in pieces.T_map_piece.items():
        rows = slice(pieces.of[k].start, pieces.of[k].stop)
        at[rows] = compose_poses(T_map_piece.to_array(), poses[rows])
    grid = _grid_of(session, at, members, parameters)
    if not grid.occupied().any():
        return []
    noise = parameters.front_end.odometry_noise
    field = LikelihoodField.from_grid(grid)
    relocaliser = Relocaliser(grid, field, Hide(), RelocaliserParameters(search_boxes=_MOST_BOXES), noise, rng)
    for k in sorted(left, key=lambda k: -len(pieces.of[k])):
        piece = pieces.of[k]
        starts = session.places.start
        starts = starts[(starts >= piece.start) & (starts < piece.stop)]
        begins = starts[np.unique(np.linspace(0, len(starts) - 1, _ATTEMPTS).astype(np.int64))]
        tried = [range(begin, min(begin + LOOKED, piece.stop)) for begin in begins.tolist()]
        for T_map_piece, scan in places_on_map(session.scans, poses, tried, relocaliser):
            at[piece.start : piece.stop] = compose_poses(T_map_piece.to_array(), poses[piece.start : piece.stop])
            loops = _verified(session, at, members, piece, scan, parameters, rng)
            if loops:
                pieces.T_map_piece[k] = T_map_piece
                return loops
    return []


def _verified(
    session: MapSession,
    poses: F64,
    members: NDArray[np.int64],
    piece: range,
    scan: int,
    parameters: GraphMapperParameters,
    rng: Generator,
) -> list[Loop]:
    """Accepted loops between the places around a keyscan and those of the members; none if too few are."""
    places = replace(session.places, poses=poses)
    closer = LoopCloser(places, session.scans, parameters.loops, rng, forbidden=session.forbidden)
    among = np.flatnonzero(np.isin(places.reference, members))
    of_piece = np.flatnonzero((places.reference >= piece.start) & (places.reference < piece.stop))
    near = of_piece[np.abs(of_piece - places.place_of(scan)) <= AROUND].tolist()
    return [replace(loop, reason=JOINED) for loop in loops_of_most(closer, near, _AGREE, among)]
