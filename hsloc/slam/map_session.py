"""What there is when a log has been read, of that log alone or of a saved map and the log that extends it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.estimate import Status
from hsloc.model.pose2 import Pose2, compose_poses, pose_differences, relative_poses
from hsloc.slam.calibration import odometry_chi, odometry_scale
from hsloc.slam.keyscans import KeyScans
from hsloc.slam.loop_matcher import Loop
from hsloc.slam.pose_graph import Edges
from hsloc.slam.slips import without_slips
from hsloc.slam.stated_loops import StatedLoops, stated_places
from hsloc.slam.submaps import UNKNOWN_STEP, Submaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.front_end import LocalMatch
    from hsloc.slam.joint_registration import JointRegistrationParameters
    from hsloc.slam.keyscans import KeyScan
    from hsloc.slam.map_state import MapState
    from hsloc.slam.parameters import GraphMapperParameters
    from hsloc.slam.systematic_errors import SystematicErrors
    from hsloc.slam.trajectory_correction import EventLog

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_ODOMETRY_FLOOR = np.diag((0.01**2, 0.01**2, 0.005**2))
"""Least covariance of an odometry edge (m^2, rad^2). Internal: keeps the equations solvable."""


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """Where the robot left the map that was known: keyscan `second`, before which there is a gap, seen from `first`.

    `covariance` (3, 3) is in the frame of `first`.
    """

    first: int
    second: int
    T_first_second: Pose2
    covariance: F64


LEFT_THE_MAP = "left the known map"
"""The reason of the loop that a tie becomes."""


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
    asserted: tuple[tuple[int, int], ...] = ()
    """Pairs of places that are one, as the user states."""
    forbidden: tuple[tuple[int, int], ...] = ()
    """Pairs of places that are not."""
    ties: tuple[Tie, ...] = ()
    """Where the path has gaps, in the order of the keyscans after them: there the robot was followed on the map."""
    slips: tuple[int, ...] = ()
    """Keyscans before steps in which the wheels slipped, as the scans around them show."""
    joints: tuple[int, ...] = ()
    """Keyscans at which a piece of the path begins that was found on the map of the others alone."""
    after_gaps: tuple[tuple[int, float], ...] = ()
    """Keyscans before which nothing was recorded, and for how many seconds."""
    systematic: SystematicErrors | None = None
    """What was added to the steps; None before the map was refined."""

    @property
    def slipped(self) -> NDArray[np.bool_]:
        """The same for each step, shape (n - 1,)."""
        slipped = np.zeros(len(self.steps), dtype=np.bool_)
        slipped[list(self.slips)] = True
        return slipped

    def believed_steps(self, registration: JointRegistrationParameters) -> Edges:
        """The odometry's steps before the refined map is held against them: next to no weight for those that slipped.

        Nor for those of which a scan that was believed says something else, by more than the gate within which it finds
        the walls it was paired with: standing wheels of a robot that moves say to the centimetre that it does not.
        """
        apart = pose_differences(self.motions[1:], self.steps.measured)
        off = np.hypot(apart[:, 0], apart[:, 1]) + registration.radius * np.abs(apart[:, 2])
        return without_slips(self.steps, self.slipped | (~self.refused[1:] & (off > registration.gates[0])))

    @property
    def chain(self) -> Edges:
        """The front end's steps as edges."""
        return Edges.chain(self.motions[1:], self.covariances[1:], self.refused[1:])

    def stated(self, loops: StatedLoops, first_ns: int) -> MapSession:
        """The same with the loops that the user states, in seconds after `first_ns`. Raises ConfigError."""
        if not loops.asserted and not loops.forbidden:
            return self
        seconds: F64 = np.asarray((self.stamps_ns - first_ns) * 1e-9, dtype=np.float64)
        asserted = stated_places(loops.asserted, seconds, self.places, "--assert-loop")
        forbidden = stated_places(loops.forbidden, seconds, self.places, "--forbid-loop")
        return replace(self, asserted=tuple(asserted), forbidden=tuple(forbidden))

    def on_path(self, poses: F64, covariances: F64, slipped: NDArray[np.bool_]) -> MapSession:
        """The same keyscans on another path: poses (n, 3), with the covariances (n, 3, 3) of its steps."""
        motions = np.concatenate((self.motions[:1], relative_poses(poses[:-1], poses[1:])))
        places = self.places.on_path(poses, motions, covariances)
        slips = tuple(np.flatnonzero(slipped).tolist())
        return replace(self, poses=poses, motions=motions, covariances=covariances, places=places, slips=slips)

    def with_joints(self, poses: F64, joints: list[int], parameters: GraphMapperParameters) -> MapSession:
        """The same keyscans at other poses (n, 3), with nothing known of the steps to the `joints`."""
        gaps = np.zeros(len(poses), dtype=bool)
        gaps[joints] = True
        covariances = np.where(gaps[:, None, None], UNKNOWN_STEP, self.covariances)
        information = np.where(gaps[1:, None, None], np.linalg.inv(UNKNOWN_STEP), self.steps.information)
        length, turn = parameters.loops.submap_length, parameters.front_end.turn_length
        places = Submaps.split_by_path_length(
            poses, self.motions, covariances, length, turn, self.refused, parameters.loops.refused_path_length, gaps
        )
        reference = self.places.reference
        known = tuple(
            between_places(
                int(reference[loop.first]), int(reference[loop.second]), loop.T_first_second, loop.covariance, poses,
                places, loop.reason,
            )
            for loop in self.known
        )  # fmt: skip
        asserted, forbidden = (
            tuple((places.place_of(int(reference[i])), places.place_of(int(reference[j]))) for i, j in pairs)
            for pairs in (self.asserted, self.forbidden)
        )
        return replace(
            self,
            poses=poses,
            covariances=covariances,
            steps=replace(self.steps, information=information),
            places=places,
            known=known,
            asserted=asserted,
            forbidden=forbidden,
            joints=tuple(joints),
        )

    def moved(self, T_map_front: Pose2) -> MapSession:
        """The same in the map's frame."""
        poses = compose_poses(T_map_front.to_array(), self.poses)
        return replace(self, poses=poses, places=replace(self.places, poses=poses))


def from_front_end(
    scans: list[KeyScan],
    stamps_ns: I64,
    local: list[LocalMatch],
    track: EventLog,
    parameters: GraphMapperParameters,
    solved: MapSession | None = None,
    ties: tuple[Tie, ...] = (),
    after_gaps: tuple[tuple[int, float], ...] = (),
) -> MapSession:
    """Of a log with at least one keyscan; those of `solved` come first, at the poses at which they were solved."""
    poses = np.array([found.pose.to_array() for found in local]).reshape(-1, 3)
    motions = np.array([found.motion.to_array() for found in local]).reshape(-1, 3)
    covariances = np.array([found.covariance for found in local]).reshape(-1, 3, 3)
    refused = np.array([found.status is Status.REJECTED or found.is_doubtful for found in local], dtype=bool)
    known: tuple[Loop, ...] = ()
    if solved is not None:
        stamps_ns = np.concatenate((solved.stamps_ns, stamps_ns))
        poses = np.concatenate((solved.poses, poses))
        motions = np.concatenate((solved.motions, motions))
        covariances = np.concatenate((solved.covariances, covariances))
        refused = np.concatenate((solved.refused, refused))
        all_scans = KeyScans.concatenate(solved.scans, KeyScans.from_scans(scans)) if scans else solved.scans
        known = solved.known
    else:
        all_scans = KeyScans.from_scans(scans)
    joints = solved.joints if solved is not None else ()
    gaps = np.zeros(len(poses), dtype=bool)
    gaps[[*(tie.second for tie in ties), *joints]] = True
    # Across a gap the chain says nothing.
    covariances[gaps] = UNKNOWN_STEP
    length, turn = parameters.loops.submap_length, parameters.front_end.turn_length
    places = Submaps.split_by_path_length(
        poses, motions, covariances, length, turn, refused, parameters.loops.refused_path_length, gaps
    )
    # The last place may have grown: what is known of it holds no longer.
    first_place = max(len(solved.places) - 1, 0) if solved is not None else 0
    kept = tuple(loop for loop in known if loop.second < first_place and loop.reason != LEFT_THE_MAP)
    return MapSession(
        scans=all_scans,
        stamps_ns=stamps_ns,
        poses=poses,
        motions=motions,
        covariances=covariances,
        refused=refused,
        steps=_odometry_edges(motions, covariances, refused, track, parameters, gaps),
        places=places,
        known=(*kept, *(_tie_loop(tie, poses, places) for tie in ties)),
        first_place=first_place,
        ties=ties,
        slips=solved.slips if solved is not None else (),
        joints=joints,
        after_gaps=after_gaps,
    )


def _tie_loop(tie: Tie, poses: F64, places: Submaps) -> Loop:
    measured = (tie.first, tie.second, tie.T_first_second, tie.covariance)
    return between_places(*measured, poses, places, LEFT_THE_MAP)


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
        slips=(*old.slips, *(n + step for step in new.slips)),
        after_gaps=tuple((n + keyscan, seconds) for keyscan, seconds in new.after_gaps),
    )


def _loops(state: MapState, places: Submaps) -> tuple[Loop, ...]:
    """The saved loops, moved from their keyscans to the references of the submaps that contain those."""
    saved = state.loops
    return tuple(
        between_places(i, j, Pose2.from_array(measured), np.linalg.inv(information), state.poses, places)
        for (i, j), measured, information in zip(saved.pairs.tolist(), saved.measured, saved.information, strict=True)
    )


def between_places(
    i: int, j: int, T_i_j: Pose2, covariance: F64, poses: F64, places: Submaps, reason: str = "of the saved map"
) -> Loop:
    """What was measured between two keyscans as an accepted loop between the places that contain them."""
    first, second = places.place_of(i), places.place_of(j)
    a, b = (Pose2.from_array(poses[places.reference[place]]) for place in (first, second))
    T_first_second = a.between(Pose2.from_array(poses[i])) @ T_i_j @ Pose2.from_array(poses[j]).between(b)
    nan = float("nan")
    return Loop(first, second, T_first_second, covariance, nan, nan, nan, nan, (0.0, 0.0), True, reason)


def _odometry_edges(
    motions: F64,
    covariances: F64,
    refused: NDArray[np.bool_],
    track: EventLog,
    parameters: GraphMapperParameters,
    gaps: NDArray[np.bool_],
) -> Edges:
    """Steps from keyscan to keyscan by odometry alone, as the scans are compared again; without it, the matches'."""
    if not parameters.use_odometry:
        return Edges.chain(motions[1:], covariances[1:] + _ODOMETRY_FLOOR, refused[1:])
    odometry = track.key_odometry()
    steps = relative_poses(odometry[:-1], odometry[1:])
    noise = parameters.front_end.odometry_noise
    assumed = np.array([noise.covariance(Pose2(*step)) for step in steps.tolist()]).reshape(-1, 3, 3)
    matched = ~(refused[1:] | gaps[1:])
    chi = odometry_chi(steps[matched], motions[1:][matched], assumed[matched])
    covariances = odometry_scale(chi) ** 2 * assumed + _ODOMETRY_FLOOR
    covariances[gaps[1:]] = UNKNOWN_STEP
    return Edges.chain(steps, covariances, refused[1:])
