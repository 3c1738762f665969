"""run.mcap: a result as a recording that Lichtblick and Foxglove show without set-up."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from hsloc.export.provenance import config_text
from hsloc.log import LogWriter
from hsloc.model.events import PairedScan
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.model.trajectory import Trajectory
from hsloc.version import __version__

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from hsloc.analysis import PosedEvent
    from hsloc.replay.run import Result

_PATH_POSES = 2000
"""A path to look at needs no more poses; viewers slow down."""


class RunRecording:
    """Writes map, scans, transforms, poses and the path of a result; the events come from a second pass over the log.

    Of a map that was built also the covariance of the pose of each scan.

    A context manager: the file is complete when it ends. `seconds` is the time spent in writing.
    """

    def __init__(self, result: Result, path: Path) -> None:
        self._result = result
        self._start = int(result.trajectory.stamps_ns[0])
        self._mountings: set[str] = set()
        self._scans = 0
        self._writer = LogWriter(path)
        self.seconds = 0.0

    def __enter__(self) -> RunRecording:
        begin = time.perf_counter()
        try:
            self._writer.metadata("hsloc", {"version": __version__, "seed": str(self._result.request.seed)})
            self._writer.attachment("config.yaml", config_text(self._result).encode(), "application/yaml")
            self._writer.occupancy_grid(self._result.grid, self._start)
        except BaseException:
            self._writer.abort()
            raise
        self.seconds += time.perf_counter() - begin
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        begin = time.perf_counter()
        trajectory = self._result.trajectory
        if error is None:
            every = max(len(trajectory) // _PATH_POSES, 1)
            self._writer.path(self._start, Trajectory(trajectory.stamps_ns[::every], trajectory.poses[::every]))
        self._writer.__exit__(kind, error, trace)
        self.seconds += time.perf_counter() - begin

    def add(self, posed: PosedEvent) -> None:
        """Write a scan, or the poses at an odometry message; without odometry those at each scan."""
        begin = time.perf_counter()
        event = posed.event
        if isinstance(event, PairedScan):
            scan = event.scan
            if scan.frame_id not in self._mountings:
                self._mountings.add(scan.frame_id)
                self._writer.transforms(self._start, [("base_link", scan.frame_id, scan.T_base_laser)], static=True)
            if self._result.follows_scans:
                self._write_pose(scan.stamp_ns, IDENTITY, posed.T_map_base, posed.T_map_base)
            self._writer.scan(scan)
            if self._result.mapping is not None:
                covariance = self._result.mapping.scan_covariances[self._scans]
                self._writer.pose_with_covariance(scan.stamp_ns, posed.T_map_base, covariance, "/pose_with_covariance")
            self._scans += 1
        else:
            self._write_pose(event.stamp_ns, posed.T_map_odom, event.T_odom_base, posed.T_map_base)
        self.seconds += time.perf_counter() - begin

    def _write_pose(self, stamp_ns: int, T_map_odom: Pose2, T_odom_base: Pose2, T_map_base: Pose2) -> None:
        self._writer.transforms(stamp_ns, [("map", "odom", T_map_odom), ("odom", "base_link", T_odom_base)])
        self._writer.pose(stamp_ns, T_map_base)
