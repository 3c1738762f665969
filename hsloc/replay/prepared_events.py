"""The events of a log as a run gets them: without the robot itself and those who walk with it, the odometry continued.

The run and the second pass over its log both come here, so that reports show what was matched.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.preprocessing.body_returns import without_beams
from hsloc.preprocessing.companions import WithoutCompanions
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
    `is_mapped`: those who walk with the robot are left out, too; on a given map they do no harm.
    `odometry_correction`: what the odometry is corrected by. `first`: T_odom_base of the first message.
    """

    lidar_only: bool = False
    deskewed: bool = False
    body_beams: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    odometry_correction: OdometryScale | None = None
    first: Pose2 | None = None
    is_mapped: bool = False


class Surroundings:
    """Events whose scans lack what moves with the robot: its body, and those who walk with it.

    To be gone through once; then `warnings` gives who did.
    """

    def __init__(self, events: Iterable[Event], preparation: Preparation) -> None:
        seen = without_beams(events, preparation.body_beams) if preparation.body_beams else events
        followed = preparation.is_mapped and not preparation.lidar_only
        self._companions = WithoutCompanions(seen) if followed else None
        self._seen = self._companions or seen

    def __iter__(self) -> Iterator[Event]:
        return iter(self._seen)

    def warnings(self) -> tuple[RunWarning, ...]:
        """Who walked with the robot."""
        return () if self._companions is None else self._companions.warnings()


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
