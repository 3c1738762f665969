"""The events of a log as a run gets them: body beams left out, odometry continued and corrected, scans watched.

The run and the second pass over its log both come here, so that reports show what was matched.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.preprocessing.body_returns import without_beams
from hsloc.preprocessing.odometry import ContinuousOdometry
from hsloc.preprocessing.scans import ScanWatch

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from hsloc.localisation.odometry_scale import OdometryScale
    from hsloc.log import LogSummary
    from hsloc.model.events import Event
    from hsloc.model.pose2 import Pose2
    from hsloc.warnings import RunWarning


@dataclass(frozen=True, slots=True, eq=False)
class Preparation:
    """What is done with the events of a log before they are matched.

    `lidar_only`: no odometry of the log is used. `deskewed`: beams are moved to where the robot was when each was
    measured. `body_beams`: beams (n,) that see the robot itself and are left out, by the frame of a laser.
    `odometry_correction`: what the odometry is corrected by. `first`: T_odom_base of the first message.
    """

    lidar_only: bool = False
    deskewed: bool = False
    body_beams: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    odometry_correction: OdometryScale | None = None
    first: Pose2 | None = None

    def without_body(self, events: Iterable[Event]) -> Iterable[Event]:
        """Events whose scans lack the beams that see the robot."""
        return without_beams(events, self.body_beams) if self.body_beams else events


class PreparedEvents:
    """Events with the odometry continued over its resets and corrected, their scans watched.

    To be gone through once; then `warnings` gives what was found. Without a summary, topics are not named.
    """

    def __init__(self, events: Iterable[Event], preparation: Preparation, summary: LogSummary | None = None) -> None:
        odom_topic, scan_topic = (None, None) if summary is None else (summary.odom_topic, summary.scan_topic)
        self._continued = ContinuousOdometry(events, odom_topic)
        self._watch = ScanWatch(self._continued, scan_topic)
        self._preparation = preparation

    def __iter__(self) -> Iterator[Event]:
        watched = self._continued if self._preparation.lidar_only else self._watch
        correction = self._preparation.odometry_correction
        return iter(watched if correction is None else correction.applied(watched))

    def warnings(self) -> tuple[RunWarning, ...]:
        """What was found about the odometry and the scans."""
        return (*self._continued.warnings(), *self._watch.warnings())
