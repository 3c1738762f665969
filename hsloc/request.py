"""What to run: one description, whatever offers it. Its options are listed in `hsloc.options`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.config import Config, combined, differences, preset
from hsloc.errors import ConfigError
from hsloc.log import ReadOptions, read_calibration
from hsloc.model.pose2 import Pose2, wrap_angle
from hsloc.options import ALIGNMENTS, BY_NAME, MATCHERS, MODES, OPTIONS, PRESETS, VERDICTS, merged
from hsloc.slam.stated_loops import StatedLoops

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hsloc.matching.match import Matcher
    from hsloc.options import Option
    from hsloc.slam.parameters import GraphMapperParameters

_LONGEST_S = 1e9
"""No log is as long as this [s]; in nanoseconds it fits 64 bits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest:
    """What to run. The same request on the same files gives the same result, bit for bit.

    With `resume`, the results of an earlier mapping run, that run's map is extended: the new map and trajectory are in
    its frame. With `align_to`, a floor plan or another map, a map is built in the frame of that. `mode` is "localise",
    "slam" or "auto": localise if there is a map, `map_path` or the log's own, else build one. With `no_odometry` the
    log's odometry is not read: motion is estimated from the scans. The start is
    `initial_pose`, else the one that the log states for the time of the first event, else unknown; with `unknown_start`
    it is unknown whatever the log states. `reference` names poses to compare with, see `hsloc.replay.references`;
    otherwise they are those in the log. `alignment` and `relations` are for the evaluation. `own_matcher` is used
    instead of the one that `config` names. `calibration` is a file of `hsloc calibrate`. `assert_loop` and
    `forbid_loop` are pairs of times, see `hsloc.slam.stated_loops`. `min_localised`, `max_ape`, `max_warnings` and
    `fail_if` are limits that the result must keep, see `hsloc.analysis.quality`. `labels` are the names of the logs in
    reports; with `bare_names` no folder is written into the results, so that they are the same wherever the files are.
    """

    logs: tuple[Path, ...]
    map_path: Path | None = None
    resume: Path | None = None
    align_to: Path | None = None
    config: Config = field(default_factory=Config)
    read: ReadOptions = field(default_factory=ReadOptions)
    initial_pose: Pose2 | None = None
    unknown_start: bool = False
    seed: int = 0
    preset: str = "default"
    labels: tuple[str, ...] = ()
    mode: str = "auto"
    assert_loop: str | None = None
    forbid_loop: str | None = None
    no_odometry: bool = False
    reference: str | None = None
    alignment: str | None = None
    relations: Path | None = None
    calibration: Path | None = None
    own_matcher: Matcher | None = None
    min_localised: float | None = None
    max_ape: float | None = None
    max_warnings: int | None = None
    fail_if: str | None = None
    bare_names: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.logs, str | os.PathLike):
            object.__setattr__(self, "logs", (self.logs,))
        object.__setattr__(self, "logs", tuple(Path(log) for log in self.logs))
        for name in ("map_path", "resume", "align_to", "relations", "calibration"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, Path(getattr(self, name)))
        if self.own_matcher is not None and not callable(getattr(self.own_matcher, "match", None)):
            raise ConfigError(
                f"matcher is {self.own_matcher!r:.80}; it must be one of {', '.join(MATCHERS)}, or an object with the "
                "method match(points, field, window, rng) of hsloc.Matcher"
            )
        for name, choices in (("mode", MODES), ("alignment", ALIGNMENTS), ("preset", PRESETS), ("fail_if", VERDICTS)):
            value = getattr(self, name)
            if value is not None and value not in choices:
                raise ConfigError(f"{name} is {value!r}; it must be one of {', '.join(choices)}")
        for option in OPTIONS:
            if option.place in ("run", "check"):
                _check_bounds(option, getattr(self, option.target))
        if self.resume is not None and (self.mode == "localise" or self.map_path is not None):
            raise ConfigError("a map is either localised in (--map) or extended (--resume); leave out one of them")
        if self.resume is not None and self.config.mapper != "graph":
            raise ConfigError(
                f"a map is extended by the graph mapper; leave out --resume or --mapper {self.config.mapper}"
            )
        if self.align_to is not None and (
            self.resume is not None or self.mode == "localise" or self.config.mapper != "graph"
        ):
            raise ConfigError(
                "a map that the graph mapper builds is aligned to a plan; leave out --align-to, or --resume, "
                "--mode localise and --mapper"
            )
        is_stated = StatedLoops.parsed(self.assert_loop, self.forbid_loop) != StatedLoops()
        if is_stated and (self.resume is not None or self.mode == "localise" or self.config.mapper != "graph"):
            raise ConfigError(
                "loops are stated for the graph mapper and one log; leave out --assert-loop and --forbid-loop, or "
                "--resume, --mode localise and --mapper"
            )
        if self.no_odometry and self.read.deskew:
            raise ConfigError("scans are deskewed with odometry; leave out --no-odom or --deskew")
        if self.initial_pose is not None and self.unknown_start:
            raise ConfigError("the start is either given (--initial-pose) or unknown (--unknown-start)")
        if self.reference is not None and self.read.truth_topic is not None:
            raise ConfigError(
                "--reference and --truth-topic both name the poses to compare with; leave out one of them"
            )
        _check_window(self.read.start_s, self.read.end_s)
        if len({path.resolve() for path in self.logs}) < len(self.logs):
            raise ConfigError(f"{self.logs[0]}: a log is named twice; several logs must be parts of one run")

    @staticmethod
    def from_values(
        logs: Sequence[str | os.PathLike[str]], values: Mapping[str, Any], warnings: list[str] | None = None
    ) -> RunRequest:
        """From options by their names, in plain data: paths and poses may be texts and lists; None is the default.

        `config` is a Config, a table of parameters, or a YAML file, whose warnings are added to `warnings`. `matcher`
        is a name or a Matcher. Raises ConfigError for an option that does not exist, naming the nearest.
        """
        values = {name: value for name, value in merged(values).items() if value is not None}
        matcher = values.get("matcher")
        if matcher is not None and not isinstance(matcher, str):
            values["own_matcher"] = values.pop("matcher")
        settings = [*values.get("set", ()), *(["localiser.certify=true"] if values.get("certify") else [])]
        config = values.get("config")
        if not isinstance(config, Config):
            config = combined(
                preset(values.get("preset", "default")),
                config,
                settings,
                {name: values[name] for name in ("matcher", "mapper") if name in values},
                warnings,
            )
        elif settings or "matcher" in values or "mapper" in values:
            config = combined(config, None, settings, {n: values[n] for n in ("matcher", "mapper") if n in values})
        run: dict[str, Any] = {"logs": tuple(Path(log) for log in logs), "config": config}
        read: dict[str, Any] = {}
        for name, value in values.items():
            if name in _BESIDE:
                run[name] = value
                continue
            option = BY_NAME.get(name)
            if option is None:
                raise ConfigError(f"no option is called {name!r}{_nearest(name)}")
            if option.place != "config":
                (read if option.place == "read" else run)[option.target] = _converted(option, value)
        if "read" in values:
            run["read"] = replace(values["read"], **read)
        else:
            run["read"] = ReadOptions(**read)
        return RunRequest(**run)

    def to_values(self) -> dict[str, Any]:
        """The options by their names that `from_values` reads back, in plain data, files as they were named.

        `config` is left out: `set` gives all parameters that differ from the preset.
        """
        found: dict[str, Any] = {}
        for option in OPTIONS:
            if option.place != "config":
                owner: Any = self.read if option.place == "read" else self
                value = getattr(owner, option.target, None)
                found[option.name] = _plain(value, self.bare_names)
        base = preset(self.preset)
        found |= {name: getattr(self.config, name) for name in ("matcher", "mapper")}
        base = replace(base, matcher=self.config.matcher, mapper=self.config.mapper)
        found["set"] = differences(self.config, base)
        found["reference"] = self.reference_name
        return found

    @property
    def reference_name(self) -> str | None:
        """What the reference is called in reports."""
        if self.reference is not None and self.bare_names and Path(self.reference).exists():
            return Path(self.reference).name
        return self.reference

    @property
    def matcher(self) -> Matcher:
        """The scan matcher."""
        return self.config.make_matcher() if self.own_matcher is None else self.own_matcher

    @property
    def matcher_name(self) -> str:
        """What the scan matcher is called in reports."""
        return self.config.matcher if self.own_matcher is None else type(self.own_matcher).__name__

    def mapping(self) -> GraphMapperParameters:
        """The graph mapper's parameters as this run uses them."""
        return replace(self.config.graph_mapper, use_odometry=not self.no_odometry)

    def reading(self) -> ReadOptions:
        """How this run reads its logs, each time it does: odometry may be missing where it is not looked at."""
        calibration = self.read.calibration if self.calibration is None else read_calibration(self.calibration)
        return replace(self.read, require_odometry=not self.no_odometry, calibration=calibration)

    def names(self) -> tuple[str, ...]:
        """What to call the logs in reports; of a name that is no text (UTF-8) the odd bytes as `\\xfc`."""
        return self.labels or tuple(os.fsencode(path.name).decode("utf-8", "backslashreplace") for path in self.logs)

    def paths(self) -> tuple[str, ...]:
        """The logs as they were named on the command line."""
        return tuple(path.name if self.bare_names else os.fspath(path) for path in self.logs)


_BESIDE = ("read", "labels", "own_matcher", "bare_names")
"""Fields of a request that are no option of a command line."""


def _converted(option: Option, value: Any) -> Any:
    """A value of plain data as the dataclass has it."""
    if option.kind == "path":
        return _typed(option, value, (str, os.PathLike), "a path", Path)
    if option.kind == "pose":
        return value if isinstance(value, Pose2) else _pose(option, value)
    if option.kind == "topics" and isinstance(value, list | tuple):
        return ",".join(value)
    if option.kind in ("text", "topics", "choice"):
        return _typed(option, value, (str, os.PathLike), "a text", os.fspath)
    if option.kind == "switch":
        return _typed(option, value, (bool,), "true or false", bool)
    kind, what = ((int,), "a whole number") if option.kind == "whole" else ((int, float), "a number")
    if isinstance(value, bool):
        raise ConfigError(f"{option.name} is {value!r}; it must be {what}")
    return _typed(option, value, kind, what, kind[-1])


def _typed(option: Option, value: Any, kinds: tuple[type, ...], what: str, convert: Any) -> Any:
    if not isinstance(value, kinds):
        raise ConfigError(f"{option.name} is {value!r}; it must be {what}")
    return convert(value)


def _pose(option: Option, value: Any) -> Pose2:
    try:
        x, y, yaw = (float(number) for number in value)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{option.name} is {value!r}; it must be x, y [m], yaw [rad]") from error
    return Pose2(x, y, wrap_angle(yaw))


def _plain(value: Any, bare_names: bool) -> Any:
    if isinstance(value, Pose2):
        return [value.x, value.y, value.theta]
    if isinstance(value, Path):
        return value.name if bare_names else os.fspath(value)
    return value


def _nearest(name: str) -> str:
    import difflib

    close = difflib.get_close_matches(name, [*BY_NAME, *_BESIDE], 1)
    return f"; did you mean {close[0]}?" if close else f"; they are {', '.join(BY_NAME)}"


def _check_bounds(option: Option, value: Any) -> None:
    if option.kind not in ("number", "whole") or value is None:
        return
    least = 0 if option.kind == "whole" else option.least
    if isinstance(value, bool) or value != value or (least is not None and value < least):
        raise ConfigError(f"{option.flag} is {value}; it must be a number of {least:g} or more")
    if option.most is not None and value > option.most:
        raise ConfigError(f"{option.flag} is {value}; it must be at most {option.most:.16g}")


def _check_window(start: float | None, end: float | None) -> None:
    for name, value in (("--start", start), ("--end", end)):
        if value is not None and not abs(value) <= _LONGEST_S:
            raise ConfigError(f"{name} is {value}; it must be a number of seconds into the log")
    if end is not None and end <= max(start or 0.0, 0.0):
        begin = "the beginning of the log" if start is None else f"--start {start:g}"
        raise ConfigError(f"--end is {end:g}; it must be later than {begin}")
