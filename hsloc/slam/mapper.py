"""The graph mapper: SLAM that uses the future.

While the log is read, each scan is matched against the scans just before it. At its end loops are closed between
places, the pose graph is solved, all scans are refined against all that see the same walls, until nothing moves, and
the map is built. A long log is solved before its end, too: where the robot has been often enough, scans are localised
on the solved map and add nothing to it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.model.estimate import Estimate, Status
from hsloc.model.events import HELD, Odometry, PairedScan
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.slam.back_end import finish, solve
from hsloc.slam.calibration import FLOOR
from hsloc.slam.front_end import FrontEnd
from hsloc.slam.known_map import KnownMap
from hsloc.slam.map_session import MapSession, Tie, from_front_end
from hsloc.slam.record_gaps import RecordGaps
from hsloc.slam.stated_loops import StatedLoops
from hsloc.slam.trajectory_correction import EventLog

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator

    from hsloc.model.events import Scan
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.slam.front_end import LocalMatch
    from hsloc.slam.keyscans import KeyScan
    from hsloc.slam.known_map import Anchor
    from hsloc.slam.parameters import GraphMapperParameters, Resume
    from hsloc.slam.result import MappingResult


class Mapper:
    """An `Estimator` that builds its own map; `finish` gives the result of the whole log."""

    def __init__(
        self,
        parameters: GraphMapperParameters,
        rng: Generator,
        resume: Resume | None = None,
        stated_loops: StatedLoops | None = None,
        plan: OccupancyGrid | None = None,
    ) -> None:
        self._parameters = parameters
        self._rng = rng
        self._resume = resume
        self._plan = plan
        self._stated_loops = StatedLoops() if stated_loops is None else stated_loops
        self._first_ns: int | None = None
        self._gaps = RecordGaps()
        self._after_gaps: list[tuple[int, float]] = []
        self._matcher = FrontEnd(parameters.front_end, rng, parameters.use_odometry)
        self._track = EventLog(parameters.front_end.turn_length)
        self._scans: list[KeyScan] = []
        self._stamps: list[int] = []
        self._local: list[LocalMatch] = []
        self._solved: MapSession | None = None
        self._ties: list[Tie] = []
        self._since_solved = 0
        self._held: list[tuple[int, PairedScan]] = []
        self._T_map_odom = IDENTITY
        self._T_map_key = IDENTITY
        self._T_last_scan = IDENTITY

    def update(self, event: Odometry | PairedScan) -> Estimate:
        """Take an event; the estimate at its stamp, in the map as it is known so far (it drifts)."""
        stamp_ns = event.stamp_ns if isinstance(event, Odometry) else event.scan.stamp_ns
        self._gaps.add(stamp_ns)
        if self._first_ns is None:
            self._first_ns = stamp_ns
        if isinstance(event, Odometry):
            # Without odometry the message gives no motion: the pose is that of the last scan.
            T_odom_base = event.T_odom_base if self._parameters.use_odometry else self._T_last_scan
            self._track.add(T_odom_base, is_scan=False)
            return Estimate(event.stamp_ns, self._T_map_odom @ T_odom_base, Status.PREDICTED)
        if event.is_held:
            self._held.append((len(self._track), event))
            self._track.add(event.T_odom_base, is_scan=True)
            pose = self._T_map_odom @ event.T_odom_base
            return Estimate(event.scan.stamp_ns, pose, Status.PREDICTED, reason=HELD)
        covariance = self._matcher.covariance
        found = self._matcher.update(event)
        if found.is_keyscan or found.anchor is not None:
            covariance = self._matcher.covariance
        else:
            covariance = predict_covariance(covariance, self._T_map_key, found.motion, found.covariance)
        T_odom_base = event.T_odom_base if self._parameters.use_odometry else found.pose
        first_new = len(self._local)
        if found.is_keyscan:
            found = self._doubted_after_gap(found)
        local = self._keep_companions(event, found) if found.is_keyscan else found
        self._held = []  # No later scan carries them: a robot that waits for hours has no keyscans.
        self._track.add(T_odom_base, is_scan=True, is_key=found.is_keyscan)
        if found.is_keyscan:
            self._T_map_key = found.pose
            self._keep(event.scan, found.scans[0].scan, local)
            if found.anchor is not None:
                self._tie(found.anchor, first_new)
        elif found.anchor is not None:
            self._T_map_key = found.pose
            self._track.anchor(found.anchor)
        self._T_map_odom = found.pose @ T_odom_base.inverse()
        self._T_last_scan = found.pose
        self._since_solved += found.is_keyscan or found.anchor is not None
        if found.is_keyscan and self._is_to_be_solved():
            self._solve()
        return Estimate(
            event.scan.stamp_ns,
            found.pose,
            found.status,
            covariance,
            found.fitness,
            found.evaluations,
            found.reason,
        )

    def _doubted_after_gap(self, found: LocalMatch) -> LocalMatch:
        """The match of a keyscan, doubtful if nothing was recorded for long since the one before; the gap is noted."""
        seconds = self._gaps.take()
        keyscan = len(self._local) + (len(self._solved.poses) if self._solved is not None else 0)
        if seconds == 0.0 or keyscan == 0:
            return found
        self._after_gaps.append((keyscan, seconds))
        return replace(found, is_doubtful=True)

    def _tie(self, anchor: Anchor, first_new: int) -> None:
        """Note where the log left the known map: at the keyscan of that number since it was solved."""
        assert self._solved is not None
        T_key_scan = Pose2.from_array(self._solved.poses[anchor.keyscan]).between(self._local[first_new].pose)
        self._ties.append(Tie(anchor.keyscan, len(self._solved.poses) + first_new, T_key_scan, anchor.covariance))

    def _is_to_be_solved(self) -> bool:
        """Whether the map is to be solved now, so that the time for it grows with the log, not with its square."""
        stated = bool(self._stated_loops.asserted or self._stated_loops.forbidden)
        if self._resume is not None or not self._parameters.use_odometry or stated:
            return False
        if self._solved is None:
            return len(self._scans) >= self._parameters.solve_after
        return self._matcher.is_far_from_known_map and self._since_solved >= len(self._solved.poses)

    def _solve(self) -> None:
        """Solve the map so far, and go on in its frame."""
        session = self._session()
        assert session is not None
        solved = solve(session, self._parameters, self._rng)
        T_map_key = Pose2.from_array(solved.poses[-1])
        T_new_old = T_map_key @ self._T_map_key.inverse()
        self._solved, self._since_solved = solved, 0
        self._scans, self._stamps, self._local = [], [], []
        known = KnownMap(solved.scans, solved.poses, self._parameters.front_end.local_range)
        self._matcher.go_on(known, T_map_key)
        self._T_map_key, self._T_map_odom = T_map_key, T_new_old @ self._T_map_odom
        self._T_last_scan = T_map_key

    def _session(self) -> MapSession | None:
        """All keyscans so far, None without one."""
        if not self._scans and self._solved is None:
            return None
        session = from_front_end(
            self._scans, np.array(self._stamps, dtype=np.int64), self._local, self._track, self._parameters,
            self._solved, tuple(self._ties), tuple(self._after_gaps),
        )  # fmt: skip
        return session.stated(self._stated_loops, self._first_ns or 0)

    def _keep(self, scan: Scan, prepared: KeyScan, local: LocalMatch) -> None:
        self._scans.append(prepared)
        self._stamps.append(scan.stamp_ns)
        # What is prepared need not live as long as the match.
        self._local.append(replace(local, scans=()))

    def _keep_companions(self, event: PairedScan, found: LocalMatch) -> LocalMatch:
        """Make the companions of a keyscan keyscans before it; the keyscan's match, seen from the last of them.

        Between the scans of one cloud the motion is the odometry's: each keeps its own beams, for each has an origin.
        """
        numbers = {id(held.scan): number for number, held in self._held}
        motion, covariance = found.motion, found.covariance
        previous = event
        for companion, moving in zip(event.companions, found.scans[1:], strict=True):
            self._track.make_key(numbers[id(companion.scan)])
            place = event.to(companion)
            motion = found.motion @ place if previous is event else previous.to(companion)
            self._keep(
                companion.scan,
                moving.scan,
                replace(found, pose=found.pose @ place, motion=motion, covariance=covariance),
            )
            previous, motion, covariance = companion, companion.to(event), FLOOR
        return replace(found, motion=motion, covariance=covariance)

    def finish(self, progress: Callable[[float], None] | None = None) -> MappingResult:
        """Close loops, refine, build the map, once at the end; `progress` is called with parts from 0 to 1.

        With a floor plan, the map is in its frame if it fits one place of it only.

        Raises MapError if no connection with the saved map is found.
        """
        return finish(self._session(), self._track, self._parameters, self._rng, progress, self._resume, self._plan)
