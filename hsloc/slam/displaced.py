"""Steps of the front end that the scans before and after them deny: slips that bare walls hid.

In a corridor nearly all points lie on its side walls, and agree wherever along it a scan is put: a step that slipped
passes for one with few points in conflict, and in the refinement those are outliers. Only walls across the corridor
show it: door frames, pillars, its end. So the scans before and after each stretch are held against each other by these
alone. Where they disagree as found, and agree in one displaced place and no other, the stretch is measured again there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.registration import Prior, RegistrationParameters, Scene, displaced_agreement, register
from hsloc.model.pose2 import relative_poses
from hsloc.slam.pose_graph import Edges, solve_edges
from hsloc.slam.slips import stretch_ends

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.kernels.point_to_line import ScanArrays
    from hsloc.slam.map_session import MapSession

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]
    _Measured = tuple[int, int, F64, F64]

_GROUP = 3
"""Keyscans before and after a stretch that are compared: few, as a slip may go on among them."""
_GATE_M = 0.15
"""Distance [m] of a point to a wall up to which they agree: the gate of the refinement."""
_SCALE_M = 0.05
"""Scale [m] of the weight of that distance: so, too."""
_DISPLACEMENTS = np.linspace(-1.3, 1.3, 53)
"""Displacements [m] that are tried, beyond the largest slip of 1 m."""
_AS_FOUND = np.zeros(1)
_HARM_M = 0.25
"""Displacement [m] from which on a stretch is measured again: less the refinement finds by itself (its first gate is
0.3 m), and the map is not wrong by it."""
_APART_M = 0.275
"""Distance [m] of another displacement: beyond what a wall's weight reaches."""
_TELLING = 1.0
"""Points on walls across, of one scan in another, without which these say nothing."""
_AGREES = 0.4
"""Agreement from which on two groups of scans may be at one place."""
_DENIED = 0.2
"""Agreement below which they are not where they were found: displaced by a slip that matters, walls are looked through
(-1) or meet nothing (0), and a few meet others by chance."""
_BETTER = 0.4
"""Difference of two agreements that is not due to people, or to doors that were opened."""
_LEAST, _ALONE, _GAIN = 0.2, 0.2, 0.6
"""The same two for groups that see other faces of the walls and agree in few points where they belong, if they agree
there by so much more than as they were found: then walls were looked through. On 30 random drives, 20 of them with
slips, ten of ten wrong stretches that this chose were put right to 0.1 m, and none of 735 right ones was chosen."""
_REGISTRATION = RegistrationParameters((0.3, 0.2, 0.15), 0.33, 1.0 / (0.02**2 * 20.0 * _GROUP), np.inf, 8)
"""As in the front end; each wall is seen by all scans of a group, so that their points count once."""
_START = np.linalg.inv(np.diag((0.1**2, 0.1**2, 0.05**2)))
"""Information of the place at which the registration begins (1/m^2, 1/rad^2): two displacements that are tried."""
_CONSISTENT = 0.9
"""Consistency of the registered groups, as is asked of a loop."""
_SLIPPED_M = 0.3
"""Standard deviation [m] of a step that may have slipped, along the walls that did not show it."""
_MOVED_M = 0.01
"""Change [m] of a step from which on its wheels slipped: the least standard deviation of a step of the odometry."""
_MENDED_M = 0.05
"""Standard deviation [m] of such a step where the whole stretch was measured again, but not how much was due to it."""


def mended(session: MapSession, scans: ScanArrays) -> MapSession:
    """The session with the steps that the scans around them deny as these have them; the others stay as they are."""
    poses, chain = session.poses, session.chain
    walls = _walls(poses, scans)
    found, slipped, axes = _displaced(poses, stretch_ends(chain, session.covariances[1:]), walls, scans)
    if not found:
        return session
    steps = np.flatnonzero(slipped)
    for step in steps.tolist():
        # Where one step can be measured by itself it is known which of them slipped: of scans before it some may have.
        groups = np.array([step]), np.array([step + 1])
        place = _only_place(poses, groups, axes[step], scans)
        measured = _registered(poses, groups, place * axes[step], scans) if place is not None else None
        if measured is not None:
            found.append((step, step + 1, *measured))
    loose = session.covariances.copy()
    loose[steps + 1] += _SLIPPED_M**2 * _along(axes[steps], poses[steps, 2])
    path = solve_edges(poses, Edges.concatenate([Edges.chain(session.motions[1:], loose[1:]), _edges(found)]))
    moved = relative_poses(path[:-1], path[1:]) - session.motions[1:]
    slipped &= np.hypot(moved[:, 0], moved[:, 1]) > _MOVED_M
    steps = np.flatnonzero(slipped)
    covariances = session.covariances.copy()
    covariances[steps + 1] += _MENDED_M**2 * _along(axes[steps], poses[steps, 2])
    return session.on_path(path, covariances, slipped | session.slipped)


def _displaced(poses: F64, ends: I64, walls: F64, scans: ScanArrays) -> tuple[list[_Measured], NDArray[np.bool_], F64]:
    """Stretches that are displaced; the steps (n - 1,) in which they may have slipped, and the direction (n - 1, 2)."""
    slipped, cleared = np.zeros((2, len(poses) - 1), dtype=np.bool_)
    axes = np.zeros((len(poses) - 1, 2))
    found: list[_Measured] = []
    for first, last in ends.tolist():
        groups = np.arange(max(first - _GROUP + 1, 0), first + 1), np.arange(last, min(last + _GROUP, len(poses)))
        axis = _bare(walls[groups[0]].sum(axis=0) + walls[groups[1]].sum(axis=0))
        agreement, judged = _agreement(poses, groups, _AS_FOUND, axis, scans)[:, 0]
        cleared[first:last] |= agreement > _AGREES
        if agreement > _DENIED or judged < _TELLING:
            continue
        place = _only_place(poses, groups, axis, scans, agreement)
        if place is None or abs(place) < _HARM_M:
            continue
        measured = _registered(poses, groups, place * axis, scans)
        if measured is not None:
            found.append((first, last, *measured))
            slipped[first:last] = True
            axes[first:last] = axis
    # None of the steps slipped that lie in another stretch which agrees as it was found.
    return found, slipped & ~cleared if (slipped & ~cleared).any() else slipped, axes


def _edges(measured: list[_Measured]) -> Edges:
    first, last, motions, information = (np.array(part) for part in zip(*measured, strict=True))
    return Edges(np.column_stack((first, last)), motions, information, np.full(len(measured), np.inf))


def _agreement(poses: F64, groups: tuple[I64, I64], displacements: F64, axis: F64, scans: ScanArrays) -> F64:
    """Agreement, and points by which it is judged, (2, m), with the second group displaced (m,) along `axis` (2,).

    Only walls across count; the points are those of one scan in another. Where they are too few the agreement is less.
    """
    sums = np.empty((len(displacements), 2))
    tried, direction = displacements[:, None] * axis, (float(axis[0]), float(axis[1]))
    displaced_agreement(poses, groups, tried, direction, scans, _GATE_M, _SCALE_M, sums)
    agreement, judged = sums.T / (2.0 * len(groups[0]) * len(groups[1]))
    return np.stack((agreement / np.maximum(judged, _TELLING), judged))


def _only_place(
    poses: F64, groups: tuple[I64, I64], axis: F64, scans: ScanArrays, found: float = np.inf
) -> float | None:
    """The displacement (m) at which two groups agree, if they do in no other; `found`: agreement as they were found."""
    agreement, _ = _agreement(poses, groups, _DISPLACEMENTS, axis, scans)
    best = int(np.argmax(agreement))
    apart = np.abs(_DISPLACEMENTS - _DISPLACEMENTS[best]) >= _APART_M
    least, better = (_LEAST, _ALONE) if agreement[best] >= found + _GAIN else (_AGREES, _BETTER)
    is_only = agreement[best] >= max(least, float(agreement[apart].max()) + better)
    return float(_DISPLACEMENTS[best]) if is_only else None


def _registered(poses: F64, groups: tuple[I64, I64], offset: F64, scans: ScanArrays) -> tuple[F64, F64] | None:
    """The last keyscan of a stretch seen from its first, with information (3, 3), from an offset (2,) in the map on."""
    before, after = groups
    first, last = before[-1:], after[:1]
    moving = relative_poses(poses[last.repeat(len(after))], poses[after])
    scene = Scene(len(before), np.concatenate((poses[before], moving)), np.concatenate(groups), scans)
    pose, information, counts = poses[last[0]].copy(), np.zeros((3, 3)), np.zeros(5)
    pose[:2] += offset
    register(pose, scene, Prior(pose.copy(), _START), _REGISTRATION, information, counts)
    if counts[0] < _CONSISTENT * (counts[0] + counts[1]):
        return None
    c, s = np.cos(poses[first[0], 2]), np.sin(poses[first[0], 2])
    turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    seen = relative_poses(poses[first], pose[None])[0]
    return seen, turn.T @ (information + 1e-3 * np.eye(3)) @ turn


def _walls(poses: F64, scans: ScanArrays) -> F64:
    """Sum (n, 2, 2) of n n^T over the normals of the chosen hits of each keyscan, in the map."""
    starts = scans.chosen_start
    owner = np.repeat(np.arange(len(poses)), np.diff(starts))
    normals = scans.normals[scans.start[owner] + scans.chosen_hits].astype(np.float64)
    c, s = np.cos(poses[owner, 2]), np.sin(poses[owner, 2])
    x, y = c * normals[:, 0] - s * normals[:, 1], s * normals[:, 0] + c * normals[:, 1]
    sums = np.column_stack([np.bincount(owner, weights=w, minlength=len(poses)) for w in (x * x, x * y, x * y, y * y)])
    return np.asarray(sums.reshape(-1, 2, 2), dtype=np.float64)


def _bare(sums: F64) -> F64:
    """The direction (2,) which the fewest walls stand across."""
    return np.asarray(np.linalg.eigh(sums)[1][:, 0], dtype=np.float64)


def _along(axes: F64, headings: F64) -> F64:
    """a a^T (m, 3, 3) of directions (m, 2) in the map, in frames with these headings (m,)."""
    c, s = np.cos(headings), np.sin(headings)
    along = np.column_stack((c * axes[:, 0] + s * axes[:, 1], c * axes[:, 1] - s * axes[:, 0], np.zeros(len(axes))))
    return np.asarray(along[:, :, None] * along[:, None, :], dtype=np.float64)
