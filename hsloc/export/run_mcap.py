"""run.mcap: a run as a recording, and the layout for Lichtblick and Foxglove that shows it."""

from __future__ import annotations

import json
import time
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.export.provenance import config_text
from hsloc.log import LogWriter, Marker
from hsloc.model.events import PairedScan
from hsloc.model.pose2 import IDENTITY, Pose2, compose_poses
from hsloc.model.trajectory import Trajectory
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray

    from hsloc.analysis.analyse import Analysis
    from hsloc.analysis.map_changes import SeenChanges
    from hsloc.analysis.second_pass import PosedEvent
    from hsloc.model.verdict import VerdictReason
    from hsloc.replay.run import Result

_PATH_POSES = 2000
"""A path to look at needs no more poses; viewers slow down."""

_INFO, _WARN = 20, 30
"""Levels of rcl_interfaces/Log."""

LAYOUT_FILE = "lichtblick.json"
_PATHS = {"/path": "#0072b2ff", "/reference_path": "#333333ff", "/odometry_path": "#d55e00ff"}
_VARIANCES = ((0, "x"), (7, "y"))
"""Entries of the 6 x 6 covariance of a pose in ROS."""
_GREEN, _VERMILLION = (0.0, 0.62, 0.45, 1.0), (0.84, 0.37, 0.0, 0.6)
_LINE_M, _TEXT_M = 0.04, 0.4
_MOST_PLACES = 50
"""Places of a reason that are marked; of more the first."""


def _thinned(path: Trajectory) -> Trajectory:
    every = max(len(path) // _PATH_POSES, 1)
    return Trajectory(path.stamps_ns[::every], path.poses[::every])


class RunRecording:
    """Writes map, scans, transforms, poses and the path of a result; the events come from a second pass over the log.

    Also, where they are known, covariance and fitness of each scan, states, errors, loops, and what the verdict names.

    A context manager: the file is complete when it ends. `seconds` is the time spent in writing.
    """

    def __init__(self, result: Result, path: Path) -> None:
        self._result = result
        self._start = int(result.trajectory.stamps_ns[0])
        self._mountings: set[str] = set()
        self._scans = 0
        self._fitness: list[float] = result.diagnostics.fitness.tolist()
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
            self._writer.path(self._start, _thinned(trajectory))
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
            if (covariance := self._covariance(self._scans)) is not None:
                self._writer.pose_with_covariance(scan.stamp_ns, posed.T_map_base, covariance, "/pose_with_covariance")
            fitness = self._fitness[self._scans]
            if isfinite(fitness):
                self._writer.number(scan.stamp_ns, fitness, "/fitness")
            self._scans += 1
        else:
            self._write_pose(event.stamp_ns, posed.T_map_odom, event.T_odom_base, posed.T_map_base)
        self.seconds += time.perf_counter() - begin

    def add_analysis(self, analysis: Analysis) -> None:
        """Write reference and odometry as paths in the frame of the map, and warnings and verdict as log messages."""
        begin = time.perf_counter()
        reference, comparison = self._result.reference, analysis.comparison
        if reference is not None and len(reference):
            if comparison is not None:
                T_map_reference = comparison.T_reference_estimate.inverse().to_array()
                reference = Trajectory(reference.stamps_ns, compose_poses(T_map_reference, reference.poses))
            self._writer.path(self._start, _thinned(reference), "/reference_path")
        if analysis.odometry is not None:
            self._writer.path(self._start, _thinned(analysis.odometry), "/odometry_path")
        metrics = analysis.metrics
        for reason in metrics.verdict_reasons:
            for begin_s, _ in reason.times or ((0.0, 0.0),):
                self._writer.log(self._start + round(begin_s * 1e9), _WARN, f"{reason.code}: {reason.text}")
        for warning in metrics.warnings:
            self._writer.log(self._start, _WARN, f"{warning.code}: {warning}")
        self._writer.log(self._start, _INFO, f"verdict: {metrics.verdict}")
        if comparison is not None:
            every = max(len(comparison.pairs) // _PATH_POSES, 1)
            stamps = comparison.pairs.stamps_ns[::every].tolist()
            for values, topic in (
                (comparison.errors.trans_part, "/error"),
                (comparison.errors.angle_deg, "/error_deg"),
            ):
                for stamp_ns, value in zip(stamps, values[::every].tolist(), strict=True):
                    self._writer.number(stamp_ns, value, topic)
        self._write_states()
        self._write_markers(metrics.verdict_reasons)
        if analysis.map_changes is not None:
            self._write_changes(analysis.map_changes)
        self.seconds += time.perf_counter() - begin

    def _write_pose(self, stamp_ns: int, T_map_odom: Pose2, T_odom_base: Pose2, T_map_base: Pose2) -> None:
        self._writer.transforms(stamp_ns, [("map", "odom", T_map_odom), ("odom", "base_link", T_odom_base)])
        self._writer.pose(stamp_ns, T_map_base)

    def _write_states(self) -> None:
        """Each time the state of the robot changes."""
        if self._result.states is None:
            return
        before = None
        stamps = self._result.trajectory.stamps_ns.tolist()
        for stamp_ns, state in zip(stamps, self._result.states.state, strict=True):
            if state != before:
                self._writer.text(stamp_ns, str(state), "/state")
            before = state

    def _write_markers(self, reasons: Sequence[VerdictReason]) -> None:
        """Loops between the poses that they join, and places of the verdict's reasons, by their codes."""
        mapping = self._result.mapping
        if mapping is not None and mapping.loops:
            lines = mapping.keyscan_poses[mapping.loop_ends(), :2]
            accepted = np.array([loop.accepted for loop in mapping.loops])
            kinds = (("accepted", accepted, _GREEN), ("refused", ~accepted, _VERMILLION))
            found = [Marker(name, lines[rows].reshape(-1, 2), ink, _LINE_M) for name, rows, ink in kinds]
            self._writer.markers(self._start, found, "/loops")
        places = [
            Marker(reason.code, np.array([place]), _VERMILLION, _TEXT_M, reason.code)
            for reason in reasons
            for place in reason.places[:_MOST_PLACES]
        ]
        if places:
            self._writer.markers(self._start, places, "/places_to_check")

    def _write_changes(self, changes: SeenChanges) -> None:
        """The cells in which something appeared, and vanished, since the map was made."""
        layer = changes.layer
        kinds = (("appeared", layer.occupied(), _GREEN), ("vanished", layer.free(), _VERMILLION))
        found = [Marker(name, layer.centres(cells), ink, layer.resolution) for name, cells, ink in kinds if cells.any()]
        if found:
            self._writer.markers(self._start, found, "/map_changes")

    def _covariance(self, row: int) -> NDArray[np.float64] | None:
        """Covariance (3, 3) of the pose at a scan, in the order of the log; None where it is not known."""
        result = self._result
        if result.mapping is not None:
            return np.asarray(result.mapping.scan_covariances[row])
        covariance: NDArray[np.float64] = result.diagnostics.covariance[row]
        return covariance if np.isfinite(covariance).all() else None


def layout() -> dict[str, Any]:
    """The layout, as "Import layout from file" of these viewers takes it; it is the same for every run."""
    return {
        "configById": {
            "3D!map": {
                "followMode": "follow-none",
                "followTf": "map",
                "cameraState": {"perspective": False, "distance": 40.0, "phi": 0.0, "thetaOffset": 90.0},
                "topics": {
                    "/map": {"visible": True, "colorMode": "map", "frameLocked": True},
                    "/scan": {"visible": True, "colorMode": "flat", "flatColor": "#009e73ff", "pointSize": 3},
                    "/pose_with_covariance": {"visible": True, "type": "arrow", "showCovariance": True},
                    "/loops": {"visible": True, "namespaces": {"refused": {"visible": False}}},
                    "/places_to_check": {"visible": True},
                    "/map_changes": {"visible": True},
                    **{name: {"visible": True, "type": "line", "gradient": [ink, ink]} for name, ink in _PATHS.items()},
                },
            },
            "Plot!variance": _plot(
                "Variance of the position [m²]",
                *(_series(f"/pose_with_covariance.pose.covariance[{k}]", label) for k, label in _VARIANCES),
            ),
            "Plot!quality": _plot(
                "Fitness, and error where there is a reference [m]",
                _series("/fitness.data", "fitness"),
                _series("/error.data", "error"),
            ),
            "RosOut!log": {"searchTerms": [], "minLogLevel": 1},
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 5.0},
        "layout": {
            "first": "3D!map",
            "second": {
                "first": {
                    "first": "Plot!quality",
                    "second": "Plot!variance",
                    "direction": "row",
                    "splitPercentage": 50,
                },
                "second": "RosOut!log",
                "direction": "row",
                "splitPercentage": 65,
            },
            "direction": "column",
            "splitPercentage": 72,
        },
    }


def _plot(title: str, *series: dict[str, Any]) -> dict[str, Any]:
    return {
        "title": title,
        "paths": list(series),
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "xAxisVal": "timestamp",
        "isSynced": True,
    }


def _series(path: str, label: str) -> dict[str, Any]:
    return {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def write_layout(path: Path) -> None:
    """Write the layout."""
    path.write_text(json.dumps(layout(), indent=2) + "\n", encoding="utf-8")
