"""run.mcap: a result as a recording that Lichtblick and Foxglove show without set-up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hsloc.analysis.convergence import ConvergenceSample
from hsloc.analysis.extrinsics_check import MountingCheck
from hsloc.analysis.residuals import Residuals
from hsloc.export.provenance import config_text
from hsloc.log import LogWriter, open_log
from hsloc.model.events import Odometry, PairedScan
from hsloc.model.pose2 import IDENTITY, Pose2
from hsloc.model.trajectory import Trajectory
from hsloc.preprocessing.odometry_resets import ContinuousOdometry
from hsloc.replay.engine import pair
from hsloc.replay.garbage import seldom_collected
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from hsloc.replay.run import Result

_PATH_POSES = 2000
"""A path to look at needs no more poses; viewers slow down."""


@dataclass(frozen=True, slots=True, eq=False)
class Review:
    """What a second look at the scans says: how they fit the map, doubts of mountings, how the search converges."""

    residuals: Residuals
    doubts: list[str]
    convergence: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def write_recording(result: Result, path: Path, progress: Callable[[float], None] | None = None) -> Review:
    """Write map, scans, transforms, poses and the path; returns what the second look at the scans says.

    The scans come from the log, read once more, so that memory does not grow with it. The map is that of the result.
    """
    log = open_log(result.spec.logs, result.spec.reading())
    residuals = Residuals(result.grid)
    check = MountingCheck(result.grid, len(result.diagnostics), len(result.summary.lasers))
    config = result.spec.config
    sample = ConvergenceSample(
        result.grid,
        result.likelihood,
        config.make_matcher(),
        config.likelihood_field.sigma,
        len(result.diagnostics),
    )
    places = _Places(result)
    mountings: set[str] = set()
    start = int(result.trajectory.stamps_ns[0])
    first = None if result.follows_scans else Pose2.from_array(result.odometry.poses[0])
    with LogWriter(path) as writer, seldom_collected():
        writer.metadata("hsloc", {"version": __version__, "seed": str(result.spec.seed)})
        writer.attachment("config.yaml", config_text(result).encode(), "application/yaml")
        writer.occupancy_grid(result.grid, start)
        for event in pair(ContinuousOdometry(log.events()), deskew=result.spec.read.deskew, first=first):
            if isinstance(event, PairedScan):
                scan = event.scan
                if scan.frame_id not in mountings:
                    mountings.add(scan.frame_id)
                    writer.transforms(start, [("base_link", scan.frame_id, scan.T_base_laser)], static=True)
                T_map_base, believed = places.of_scan(event)
                if result.follows_scans:
                    _write_pose(writer, scan.stamp_ns, IDENTITY, T_map_base, T_map_base)
                writer.scan(scan)
                if believed:
                    residuals.add(scan, T_map_base)
                    check.add(scan, T_map_base)
                    sample.add(scan, T_map_base)
            elif isinstance(event, Odometry) and not result.follows_scans:
                T_map_odom, T_map_base = places.of_odometry()
                _write_pose(writer, event.stamp_ns, T_map_odom, event.T_odom_base, T_map_base)
            if progress is not None and places.row % 500 == 0:
                progress(places.row / len(result.trajectory))
        every = max(len(result.trajectory) // _PATH_POSES, 1)
        writer.path(start, Trajectory(result.trajectory.stamps_ns[::every], result.trajectory.poses[::every]))
    return Review(residuals, [*residuals.doubts(), *check.doubts()], sample.curves(config.matcher.upper()))


class _Places:
    """Where the base was at each event, going through the log a second time."""

    def __init__(self, result: Result) -> None:
        self._poses, self._odometry = result.trajectory.poses, result.odometry.poses
        self._localised, self._follows_scans = result.localised, result.follows_scans
        self.row = -1

    def of_odometry(self) -> tuple[Pose2, Pose2]:
        """(T_map_odom, T_map_base) at the next odometry message."""
        self.row += 1
        return self._correction(self.row)

    def of_scan(self, event: PairedScan) -> tuple[Pose2, bool]:
        """T_map_base at the next scan, and whether it is believed.

        Composed with the odometry since the last message: within one message of it the correction hardly changes.
        """
        if self._follows_scans:
            self.row += 1
            return Pose2(*self._poses[self.row].tolist()), True
        row = max(self.row, 0)
        return self._correction(row)[0] @ event.T_odom_base, bool(self._localised[row])

    def _correction(self, row: int) -> tuple[Pose2, Pose2]:
        # In Python's own numbers, which are ten times as fast as numpy's single ones.
        T_map_base = Pose2(*self._poses[row].tolist())
        return T_map_base @ Pose2(*self._odometry[row].tolist()).inverse(), T_map_base


def _write_pose(writer: LogWriter, stamp_ns: int, T_map_odom: Pose2, T_odom_base: Pose2, T_map_base: Pose2) -> None:
    writer.transforms(stamp_ns, [("map", "odom", T_map_odom), ("odom", "base_link", T_odom_base)])
    writer.pose(stamp_ns, T_map_base)
