"""What there is when a log has been read, of that log alone or of a saved map and the log that extends it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.estimate import Status
from hsloc.model.pose2 import Pose2, compose_poses, relative_poses
from hsloc.slam.front_end import odometry_chi, odometry_scale
from hsloc.slam.keyscans import KeyScans
from hsloc.slam.loop_matcher import Loop
from hsloc.slam.pose_graph import Edges
from hsloc.slam.submaps import UNKNOWN_STEP, Submaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.front_end import LocalMatch
    from hsloc.slam.keyscans import KeyScan
    from hsloc.slam.map_state import MapState
    from hsloc.slam.parameters import GraphMapperParameters
    from hsloc.slam.trajectory_correction import EventLog

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_ODOMETRY_FLOOR = np.diag((0.01**2, 0.01**2, 0.005**2))
"""Least covariance of an odometry edge (m^2, rad^2). Internal: keeps the equations solvable."""


@dataclass(frozen=True, slots=True, eq=False)
class MapSession:
    """Keyscans at `poses` (n, 3), not yet corrected, and what was measured between them.

    `motions` (n, 3) and `covariances` (n, 3, 3) lead to each keyscan from the one before, by the front end;
    `refused` (n,): by odometry alone, or doubtful. `steps` (n - 1) are for the refinement. `known` loops are
    believed already. Keyscans from `first` on, and places from `first_place` on, are those of the log that was
    read.
    """

    scans: KeyScans
    stamps_ns: I64
    poses: F64
    motions: F64
    covariances: F64
    refused: NDArray[np.bool_]
    steps: Edges
    places: Submaps
    known: tuple[Loop, ...] = ()
    first: int = 0
    first_place: int = 0

    @property
    def chain(self) -> Edges:
        """The front end's steps as edges."""
        return Edges.chain(self.motions[1:], self.covariances[1:], self.refused[1:])

    def moved(self, T_map_front: Pose2) -> MapSession:
        """The same in the map's frame."""
        poses = compose_poses(T_map_front.to_array(), self.poses)
        return replace(self, poses=poses, places=replace(self.places, poses=poses))


def from_front_end(
    scans: list[KeyScan], stamps_ns: I64, local: list[LocalMatch], track: EventLog, parameters: GraphMapperParameters
) -> MapSession:
    """Of a log with at least one keyscan."""
    poses = np.array([found.pose.to_array() for found in local])
    motions = np.array([found.motion.to_array() for found in local])
    covariances = np.array([found.covariance for found in local])
    refused = np.array([found.status is Status.REJECTED or found.is_doubtful for found in local], dtype=bool)
    length, turn = parameters.loops.submap_length, parameters.front_end.turn_length
    return MapSession(
        scans=KeyScans.from_scans(scans),
        stamps_ns=stamps_ns,
        poses=poses,
        motions=motions,
        covariances=covariances,
        refused=refused,
        steps=_odometry_edges(motions, covariances, refused, track, parameters),
        places=Submaps.split_by_path_length(
            poses, motions, covariances, length, turn, refused, parameters.loops.refused_path_length
        ),
    )


def from_map_state(state: MapState, parameters: GraphMapperParameters) -> MapSession:
    """Of a saved map. What was refined is what is measured: the graph holds the old map in its shape."""
    motions = np.concatenate((np.zeros((1, 3)), relative_poses(state.poses[:-1], state.poses[1:])))
    length, turn = parameters.loops.submap_length, parameters.front_end.turn_length
    places = Submaps.split_by_path_length(
        state.poses, motions, state.covariances, length, turn, state.refused, parameters.loops.refused_path_length
    )
    return MapSession(
        scans=state.scans,
        stamps_ns=state.stamps_ns,
        poses=state.poses,
        motions=motions,
        covariances=state.covariances,
        refused=state.refused,
        steps=state.steps,
        places=places,
        known=_loops(state, places),
    )


def concatenate(old: MapSession, new: MapSession) -> MapSession:
    """The old map and a further log, which is in the map's frame."""
    n, m = len(old.poses), len(old.places)
    seam = relative_poses(old.poses[None, -1], new.poses[None, 0])
    unknown = Edges(
        np.array([[n - 1, n]]),
        seam,
        np.asarray(np.linalg.inv(UNKNOWN_STEP)[None], dtype=np.float64),
        np.array([np.inf]),
    )
    later = replace(new.steps, pairs=new.steps.pairs + n)
    return MapSession(
        scans=KeyScans.concatenate(old.scans, new.scans),
        stamps_ns=np.concatenate((old.stamps_ns, new.stamps_ns)),
        poses=np.concatenate((old.poses, new.poses)),
        motions=np.concatenate((old.motions, seam, new.motions[1:])),
        covariances=np.concatenate((old.covariances, UNKNOWN_STEP[None], new.covariances[1:])),
        refused=np.concatenate((old.refused, [False], new.refused[1:])),
        steps=Edges.concatenate([old.steps, unknown, later]),
        places=Submaps.concatenate(old.places, new.places),
        known=(*old.known, *(replace(loop, first=loop.first + m, second=loop.second + m) for loop in new.known)),
        first=n,
        first_place=m,
    )


def _loops(state: MapState, places: Submaps) -> tuple[Loop, ...]:
    """The saved loops, moved from their keyscans to the references of the submaps that contain those."""
    owner = np.repeat(np.arange(len(places)), np.diff(places.start))
    loops = []
    nan = float("nan")
    for (i, j), measured, information in zip(
        state.loops.pairs.tolist(), state.loops.measured, state.loops.information, strict=True
    ):
        first, second = int(owner[i]), int(owner[j])
        a, b = (Pose2.from_array(state.poses[places.reference[place]]) for place in (first, second))
        at_i, at_j = Pose2.from_array(state.poses[i]), Pose2.from_array(state.poses[j])
        T_first_second = a.between(at_i) @ Pose2.from_array(measured) @ at_j.between(b)
        covariance: F64 = np.asarray(np.linalg.inv(information), dtype=np.float64)
        loops.append(
            Loop(first, second, T_first_second, covariance, nan, nan, nan, nan, (0.0, 0.0), True, "of the saved map")
        )
    return tuple(loops)


def _odometry_edges(
    motions: F64, covariances: F64, refused: NDArray[np.bool_], track: EventLog, parameters: GraphMapperParameters
) -> Edges:
    """Steps from keyscan to keyscan by odometry alone, as the scans are compared again; without it, the matches'."""
    if not parameters.use_odometry:
        return Edges.chain(motions[1:], covariances[1:] + _ODOMETRY_FLOOR, refused[1:])
    odometry = track.key_odometry()
    steps = relative_poses(odometry[:-1], odometry[1:])
    noise = parameters.front_end.odometry_noise
    chi = [
        odometry_chi(Pose2.from_array(step), Pose2.from_array(motion), noise)
        for step, motion, no in zip(steps, motions[1:], refused[1:], strict=True)
        if not no
    ]
    scale = odometry_scale(chi)
    floored = [scale**2 * noise.covariance(Pose2.from_array(step)) + _ODOMETRY_FLOOR for step in steps]
    return Edges.chain(steps, np.array(floored).reshape(-1, 3, 3), refused[1:])
