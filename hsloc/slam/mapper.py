"""The graph mapper: SLAM that uses the future.

While the log is read, each scan is matched against the scans just before it. At its end loops are closed between
places, the pose graph is solved, all scans are refined against all that see the same walls, until nothing moves, and
the map is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.motion import predict_covariance
from hsloc.model.estimate import Estimate, Status
from hsloc.model.events import HELD, Odometry, PairedScan
from hsloc.model.pose2 import IDENTITY
from hsloc.slam.drawing import DrawingParameters
from hsloc.slam.keyscans import KeyScan
from hsloc.slam.local_matching import FLOOR, LocalMatcher, LocalMatchingParameters
from hsloc.slam.loop_closer import LoopParameters
from hsloc.slam.refinement import RefinementParameters
from hsloc.slam.track import Track

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.model.events import Scan
    from hsloc.model.pose2 import Pose2
    from hsloc.slam.local_matching import LocalMatch
    from hsloc.slam.result import MappingResult
    from hsloc.slam.state import MapState

    F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphMapperParameters:
    """All of the graph mapper's, one default for all logs."""

    local_matching: LocalMatchingParameters = field(default_factory=LocalMatchingParameters)
    loops: LoopParameters = field(default_factory=LoopParameters)
    refinement: RefinementParameters = field(default_factory=RefinementParameters)
    drawing: DrawingParameters = field(default_factory=DrawingParameters)
    use_odometry: bool = True
    """Otherwise a constant velocity predicts, and the log's odometry is not looked at."""
    passes: int = 3
    """The whole log is gone over again at most so often, until nothing moves."""


@dataclass(frozen=True, slots=True)
class Resume:
    """A saved map to go on from, and where in it the log begins, if that is known."""

    state: MapState
    T_map_first: Pose2 | None = None


class Mapper:
    """An `Estimator` that draws its own map; `finish` tells what the whole log knows."""

    def __init__(self, parameters: GraphMapperParameters, rng: Generator, resume: Resume | None = None) -> None:
        self._parameters = parameters
        self._rng = rng
        self._resume = resume
        self._matcher = LocalMatcher(parameters.local_matching, rng, parameters.use_odometry)
        self._track = Track(parameters.local_matching.turn_length)
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
            # Without odometry the message tells nothing: it stands where the last scan stood.
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
            self._keep(event.scan, local)
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

    def _keep(self, scan: Scan, local: LocalMatch) -> None:
        self._scans.append(KeyScan.of(scan))
        self._stamps.append(scan.stamp_ns)
        self._local.append(local)

    def _keep_companions(self, event: PairedScan, found: LocalMatch) -> LocalMatch:
        """Make the companions of a keyscan keyscans before it; the keyscan's match, seen from the last of them.

        From scan to scan of one cloud the odometry tells the motion: each keeps its own beams, for each has an origin.
        """
        numbers = {id(held.scan): number for number, held in self._held}
        motion, covariance = found.motion, found.covariance
        previous = event
        for companion in event.companions:
            self._track.make_key(numbers[id(companion.scan)])
            place = event.to(companion)
            motion = found.motion @ place if previous is event else previous.to(companion)
            self._keep(companion.scan, replace(found, pose=found.pose @ place, motion=motion, covariance=covariance))
            previous, motion, covariance = companion, companion.to(event), FLOOR
        return replace(found, motion=motion, covariance=covariance)

    def finish(self, progress: Callable[[float], None] | None = None) -> MappingResult:
        """Close loops, refine, draw; `progress` is told parts from 0 to 1. May be called once, at the end.

        Raises MapError if no connection with the saved map is found.
        """
        from hsloc.slam.second_pass import finish

        return finish(
            self._scans, np.array(self._stamps, dtype=np.int64), self._local, self._track, self._parameters,
            self._rng, progress, self._resume,
        )  # fmt: skip
