"""The graph mapper: SLAM that uses the future.

While the log is read, each scan is matched against the scans just before it. At its end loops are closed between
places, the pose graph is solved, all scans are refined against all that see the same walls, until nothing moves, and
the map is built.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.model.estimate import Estimate, Status
from hsloc.model.events import HELD, Odometry, PairedScan
from hsloc.model.pose2 import IDENTITY
from hsloc.slam.back_end import finish
from hsloc.slam.front_end import FLOOR, FrontEnd
from hsloc.slam.trajectory_correction import EventLog

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.model.events import Scan
    from hsloc.slam.front_end import LocalMatch
    from hsloc.slam.keyscans import KeyScan
    from hsloc.slam.parameters import GraphMapperParameters, Resume
    from hsloc.slam.result import MappingResult

    F64 = NDArray[np.float64]


class Mapper:
    """An `Estimator` that builds its own map; `finish` gives the result of the whole log."""

    def __init__(self, parameters: GraphMapperParameters, rng: Generator, resume: Resume | None = None) -> None:
        self._parameters = parameters
        self._rng = rng
        self._resume = resume
        self._matcher = FrontEnd(parameters.front_end, rng, parameters.use_odometry)
        self._track = EventLog(parameters.front_end.turn_length)
        self._scans: list[KeyScan] = []
        self._stamps: list[int] = []
        self._local: list[LocalMatch] = []
        self._held: list[tuple[int, PairedScan]] = []
        self._T_map_odom = IDENTITY
        self._T_map_key = IDENTITY
        self._T_last_scan = IDENTITY
        self._covariance = np.zeros((3, 3))

    def update(self, event: Odometry | PairedScan) -> Estimate:
        """Take an event; the estimate at its stamp, in the map as it is known so far (it drifts)."""
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
        points = event.points_base()
        found = self._matcher.update(event, points)
        covariance = predict_covariance(self._covariance, self._T_map_key, found.motion, found.covariance)
        T_odom_base = event.T_odom_base if self._parameters.use_odometry else found.pose
        local = self._keep_companions(event, found) if found.is_keyscan else found
        self._held = []  # No later scan carries them: a robot that waits for hours has no keyscans.
        self._track.add(T_odom_base, is_scan=True, is_key=found.is_keyscan)
        if found.is_keyscan:
            self._covariance, self._T_map_key = covariance, found.pose
            self._keep(event.scan, found.scans[0].scan, local)
        self._T_map_odom = found.pose @ T_odom_base.inverse()
        self._T_last_scan = found.pose
        return Estimate(
            event.scan.stamp_ns,
            found.pose,
            found.status,
            covariance,
            found.fitness,
            found.evaluations,
            found.reason,
        )

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

        Raises MapError if no connection with the saved map is found.
        """
        return finish(
            self._scans, np.array(self._stamps, dtype=np.int64), self._local, self._track, self._parameters,
            self._rng, progress, self._resume,
        )  # fmt: skip
