"""hsloc: where was the robot? Offline localisation and mapping for recorded 2D-lidar logs.

::

    import hsloc

    result = hsloc.run("run.mcap", map="map.yaml", seed=1)
    result.trajectory.poses  # (n, 3): x, y (m), theta (rad)
    hsloc.write_results(result, "results/run")

Importing the package is cheap: names are imported when they are first used, so that `hsloc --help` answers at once.
What is listed in `__all__` is the public interface; it keeps its meaning within a minor version.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.lazy import lazy_names
from hsloc.version import __version__

if TYPE_CHECKING:
    from hsloc.analysis.analyse import analyse
    from hsloc.config import Config, preset
    from hsloc.errors import (
        ConfigError,
        EvaluationError,
        HslocError,
        LogError,
        LogFormatError,
        MapError,
        OutputError,
        TopicError,
    )
    from hsloc.evaluation import evaluate, read_tum, write_tum
    from hsloc.export.results_folder import write_results
    from hsloc.localisation.localiser import Localiser
    from hsloc.localisation.parameters import LocaliserParameters
    from hsloc.log import ReadOptions, open_log
    from hsloc.maps import load_map, save_map
    from hsloc.matching import HarmonySearch, Hide, Icp, LikelihoodField, Match, Matcher, Window
    from hsloc.model import Estimate, OccupancyGrid, Odometry, Pose2, Scan, Status, Trajectory
    from hsloc.replay.progress import Progress
    from hsloc.replay.run import Result, run
    from hsloc.request import RunRequest
    from hsloc.run_metrics import RunMetrics

_MODULES = {
    "hsloc.analysis.analyse": ("analyse",),
    "hsloc.config": ("Config", "preset"),
    "hsloc.errors": (
        "ConfigError", "EvaluationError", "HslocError", "LogError", "LogFormatError", "MapError", "OutputError",
        "TopicError",
    ),
    "hsloc.evaluation": ("evaluate", "read_tum", "write_tum"),
    "hsloc.export.results_folder": ("write_results",),
    "hsloc.localisation.localiser": ("Localiser",),
    "hsloc.localisation.parameters": ("LocaliserParameters",),
    "hsloc.log": ("ReadOptions", "open_log"),
    "hsloc.maps": ("load_map", "save_map"),
    "hsloc.matching": ("HarmonySearch", "Hide", "Icp", "LikelihoodField", "Match", "Matcher", "Window"),
    "hsloc.model": ("Estimate", "OccupancyGrid", "Odometry", "Pose2", "Scan", "Status", "Trajectory"),
    "hsloc.replay.progress": ("Progress",),
    "hsloc.replay.run": ("Result", "run"),
    "hsloc.request": ("RunRequest",),
    "hsloc.run_metrics": ("RunMetrics",),
}  # fmt: skip
__getattr__, __dir__ = lazy_names(__name__, {name: module for module, names in _MODULES.items() for name in names})

__all__ = [
    "Config",
    "ConfigError",
    "Estimate",
    "EvaluationError",
    "HarmonySearch",
    "Hide",
    "HslocError",
    "Icp",
    "LikelihoodField",
    "Localiser",
    "LocaliserParameters",
    "LogError",
    "LogFormatError",
    "MapError",
    "Match",
    "Matcher",
    "OccupancyGrid",
    "Odometry",
    "OutputError",
    "Pose2",
    "Progress",
    "ReadOptions",
    "Result",
    "RunMetrics",
    "RunRequest",
    "Scan",
    "Status",
    "TopicError",
    "Trajectory",
    "Window",
    "__version__",
    "analyse",
    "evaluate",
    "load_map",
    "open_log",
    "preset",
    "read_tum",
    "run",
    "save_map",
    "write_results",
    "write_tum",
]
