"""Any readable log as MCAP of ROS 2 messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hsloc.errors import LogFormatError
from hsloc.log.session.log_session import CONVERTED
from hsloc.log.session.message_source import INITIAL_POSE
from hsloc.log.transforms import laser_mounting
from hsloc.log.writer import LogWriter
from hsloc.model import IDENTITY, Heading, Odometry, Scan

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hsloc.log.reader import Log
    from hsloc.log.summary import Losses
    from hsloc.model import Event, Pose2

PROGRESS_EVERY = 500
"""Messages between two reports of progress."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """What was written, and what the input lost."""

    path: Path
    scans: int
    odometry: int
    truths: int
    has_map: bool
    losses: Losses

    @property
    def stamps_backwards(self) -> int:
        """Messages whose stamp is smaller than that of the message before on the same topic."""
        return sum(self.losses.stamps_backwards.values())


def convert_log(log: Log, target: Path, progress: Callable[[int], None] | None = None) -> Conversion:
    """Write a log's events to an MCAP file: /scan, /odom or /imu, /tf, /tf_static, and /ground_truth and /map.

    Header stamps are kept as they are, also where they run backwards; log times are their running maximum, so that
    the file is in order. A metadata record says that its order is that of the source, and `open_log` gives the same
    events from both. `progress` is called with the latest stamp (ns) every few hundred events.

    Raises OutputError where the target cannot be written, LogError where the log has no events.
    """
    with LogWriter(target) as writer:
        conversion = _Conversion(log, writer)
        for number, event in enumerate(log.events()):
            conversion.write(event)
            if progress is not None and number % PROGRESS_EVERY == 0:
                progress(event.stamp_ns)
        if not conversion.scans and not conversion.odometry:
            raise LogFormatError(f"{log.summary.paths[0]}: holds neither scans nor odometry to convert")
    return Conversion(
        target, conversion.scans, conversion.odometry, conversion.truths, conversion.has_map, log.losses.copy()
    )


class _Conversion:
    """The state of one conversion."""

    def __init__(self, log: Log, writer: LogWriter) -> None:
        self.scans = self.odometry = self.truths = 0
        self.has_map = False
        self._log = log
        self._writer = writer
        summary = log.summary
        self._odom_frame = summary.odom_frame or "odom"
        self._base_frame = summary.base_frame or "base_link"
        self._log_time: int | None = None
        self._frames: dict[str, str] = {}
        source = {"order": "log", "format": summary.format, "source": summary.paths[0].name, "sha256": log.sha256()}
        # A mounting that had to be assumed is written, for viewers, but stays an assumption.
        frames = [laser.frame or "laser" for laser in summary.lasers if laser.extrinsics == "identity"]
        if not summary.lasers and summary.extrinsics == "identity":
            frames = [summary.laser_frame or "laser"]
        if frames:
            source["assumed_mountings"] = ",".join(frames)
        writer.metadata(CONVERTED, source)

    def write(self, event: Event) -> None:
        """Write an event; what belongs to the whole log goes before the first."""
        if self._log_time is None:
            self._log_time = max(event.stamp_ns, 0)
            self._start()
        self._log_time = max(self._log_time, event.stamp_ns)
        if isinstance(event, Scan):
            self._scan(event)
        elif isinstance(event, Odometry):
            self._odometry(event)
        elif isinstance(event, Heading):
            self._writer.heading(event.stamp_ns, event.theta, self._base_frame, self._log_time)
        else:
            self.truths += 1
            self._writer.odometry(
                event.stamp_ns,
                event.T_map_base,
                topic="/ground_truth",
                frame_id="map",
                child_frame_id=self._base_frame,
                log_time_ns=self._log_time,
            )

    def _start(self) -> None:
        start = self._log.initial_pose()
        if start is not None:
            stamp, pose = start
            values = {"x": repr(pose.x), "y": repr(pose.y), "theta": repr(pose.theta), "stamp_ns": str(stamp)}
            self._writer.metadata(INITIAL_POSE, values)
        grid = self._log.map()
        if grid is not None and self._log_time is not None:
            self.has_map = True
            self._writer.occupancy_grid(grid, self._log_time)

    def _odometry(self, event: Odometry) -> None:
        self.odometry += 1
        self._writer.odometry(
            event.stamp_ns,
            event.T_odom_base,
            frame_id=self._odom_frame,
            child_frame_id=self._base_frame,
            covariance=event.covariance,
            log_time_ns=self._log_time,
        )
        link = (self._odom_frame, self._base_frame, event.T_odom_base)
        self._writer.transforms(event.stamp_ns, [link], log_time_ns=self._log_time)

    def _scan(self, scan: Scan) -> None:
        self.scans += 1
        if scan.frame_id not in self._frames:
            self._frames[scan.frame_id] = self._mount(scan)
        self._writer.scan(scan, frame_id=self._frames[scan.frame_id], log_time_ns=self._log_time)

    def _mount(self, scan: Scan) -> str:
        """Write the mounting of a scan's frame; returns the frame's name in the file."""
        frame = scan.frame_id or "laser"
        if frame == self._base_frame:
            if scan.T_base_laser == IDENTITY:
                return frame
            frame = "laser"
        for pose in (*self._other_mountings(scan), scan.T_base_laser):
            links = [(self._base_frame, frame, pose)]
            self._writer.transforms(scan.stamp_ns, links, static=True, log_time_ns=self._log_time)
        return frame

    def _other_mountings(self, scan: Scan) -> list[Pose2]:
        """Those that the log states beside the one that was used, for whoever reads the file to decide or be warned.

        One that is upside down against it would need other scans, and is left out.
        """
        lasers = [laser for laser in self._log.summary.lasers if laser.frame == scan.frame_id]
        stated = [(laser.flipped, laser_mounting(each)) for laser in lasers for each in laser.alternatives]
        poses = [mounting.T_base_laser for flipped, mounting in stated if mounting.flipped == flipped]
        return [pose for pose in poses if pose != scan.T_base_laser]
