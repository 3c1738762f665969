"""A layout for Lichtblick and Foxglove beside run.mcap: map, scans and paths, curves over time, warnings."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

LAYOUT_FILE = "lichtblick.json"
_PATHS = {"/path": "#0072b2ff", "/reference_path": "#333333ff", "/odometry_path": "#d55e00ff"}


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
                    **{name: {"visible": True, "type": "line", "gradient": [ink, ink]} for name, ink in _PATHS.items()},
                },
            },
            "Plot!variance": {
                "title": "Variance of the position [m²]",
                "paths": [_series(f"/pose_with_covariance.pose.covariance[{k}]", label) for k, label in _VARIANCES],
                "showXAxisLabels": True,
                "showYAxisLabels": True,
                "showLegend": True,
                "xAxisVal": "timestamp",
                "isSynced": True,
            },
            "RosOut!log": {"searchTerms": [], "minLogLevel": 1},
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 5.0},
        "layout": {
            "first": "3D!map",
            "second": {"first": "Plot!variance", "second": "RosOut!log", "direction": "row", "splitPercentage": 60},
            "direction": "column",
            "splitPercentage": 72,
        },
    }


_VARIANCES = ((0, "x"), (7, "y"))
"""Entries of the 6 x 6 covariance of a pose in ROS."""


def _series(path: str, label: str) -> dict[str, Any]:
    return {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def write_layout(path: Path) -> None:
    """Write the layout."""
    path.write_text(json.dumps(layout(), indent=2) + "\n", encoding="utf-8")
