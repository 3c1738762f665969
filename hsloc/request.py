"""What to run: one description, whatever door it comes by."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from os import fsencode
from typing import TYPE_CHECKING

from hsloc.config import Config
from hsloc.errors import ConfigError
from hsloc.log import ReadOptions

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.model.pose2 import Pose2
    from hsloc.slam.parameters import GraphMapperParameters

_LONGEST_S = 1e9
"""No log takes so many seconds; in nanoseconds it fits 64 bits."""
MODES = ("auto", "localise", "slam")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest:
    """What to run. The same spec on the same files gives the same result, bit for bit.

    With `resume`, the results of an earlier mapping run, that run's map is extended: the new map and trajectory are in
    its frame. `mode` is "localise", "slam" or "auto": localise if there is a map, `map_path` or the log's own, else
    draw one.
    With `no_odometry` the log's odometry is not looked at (slam alone). The start is `initial_pose`, else the one
    that the log states for the time of the first event, else unknown; with `unknown_start` it is unknown whatever the
    log states. `labels` are the names of the logs in reports, where the files' own names say nothing.
    `reference` names poses to compare with, see `hsloc.replay.references`; otherwise they are the log's truth.
    """

    logs: tuple[Path, ...]
    map_path: Path | None = None
    resume: Path | None = None
    config: Config = field(default_factory=Config)
    read: ReadOptions = field(default_factory=ReadOptions)
    initial_pose: Pose2 | None = None
    unknown_start: bool = False
    seed: int = 0
    preset: str = "default"
    labels: tuple[str, ...] = ()
    mode: str = "auto"
    no_odometry: bool = False
    reference: str | None = None

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError(f"mode is {self.mode!r}; it must be one of {', '.join(MODES)}")
        if self.no_odometry and (self.mode == "localise" or self.map_path is not None):
            raise ConfigError(
                "a robot on a given map is followed with odometry; leave out --no-odom or use --mode slam"
            )
        if self.resume is not None and (self.mode == "localise" or self.map_path is not None):
            raise ConfigError("a map is either localised in (--map) or extended (--resume); leave out one of them")
        if self.resume is not None and self.config.mapper != "graph":
            raise ConfigError(
                f"a map is extended by the graph mapper; leave out --resume or --mapper {self.config.mapper}"
            )
        if self.no_odometry and self.read.deskew:
            raise ConfigError("scans are deskewed with odometry; leave out --no-odom or --deskew")
        if self.reference is not None and self.read.truth_topic is not None:
            raise ConfigError(
                "--reference and --truth-topic both name the poses to compare with; leave out one of them"
            )
        _check_window(self.read.start_s, self.read.end_s)
        if len({path.resolve() for path in self.logs}) < len(self.logs):
            raise ConfigError(f"{self.logs[0]}: a log is named twice; several logs must be parts of one run")

    def mapping(self) -> GraphMapperParameters:
        """The graph mapper's parameters as this run uses them."""
        return replace(self.config.graph_mapper, use_odometry=not self.no_odometry)

    def reading(self) -> ReadOptions:
        """How this run reads its logs, each time it does: odometry may be missing where it is not looked at."""
        return replace(self.read, require_odometry=not self.no_odometry)

    def names(self) -> tuple[str, ...]:
        """What to call the logs in reports; of a name that is no text (UTF-8) the odd bytes as `\\xfc`."""
        return self.labels or tuple(fsencode(path.name).decode("utf-8", "backslashreplace") for path in self.logs)


def _check_window(start: float | None, end: float | None) -> None:
    for name, value in (("--start", start), ("--end", end)):
        if value is not None and not abs(value) <= _LONGEST_S:
            raise ConfigError(f"{name} is {value}; it must be a number of seconds into the log")
    if end is not None and end <= max(start or 0.0, 0.0):
        begin = "the beginning of the log" if start is None else f"--start {start:g}"
        raise ConfigError(f"--end is {end:g}; it must be later than {begin}")
