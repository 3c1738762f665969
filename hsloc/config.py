"""All parameters of a run, composed of the algorithms' own dataclasses; YAML in and out; unknown keys refused."""

from __future__ import annotations

import dataclasses
import difflib
import json
import typing
from dataclasses import dataclass, field, replace
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from hsloc.errors import ConfigError
from hsloc.localisation.parameters import LocaliserParameters
from hsloc.localisation.place_check import PlaceCheckParameters
from hsloc.matching.exact import Exact
from hsloc.matching.harmony_search import HarmonySearch
from hsloc.matching.hide import Hide
from hsloc.matching.icp import Icp
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.options import MAPPERS, MATCHER_ALIASES, MATCHERS, PRESETS
from hsloc.parameters import LARGEST, NonNegative, OneOf, Parameters, Positive, check, hints, plain
from hsloc.slam.parameters import GraphMapperParameters
from hsloc.slam.point_mapper import PointMapperParameters
from hsloc.yaml_table import load_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from hsloc.matching.match import Matcher
    from hsloc.model.occupancy_grid import OccupancyGrid

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldParameters(Parameters):
    """The likelihood field that scans are matched against."""

    sigma: Positive = 0.2
    """Decay length of a point's score with its distance from the nearest wall [m]; 1 m in [P]."""
    margin: NonNegative = 1.0
    """Margin of the field around the map [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Config(Parameters):
    """Everything that decides a run beside its input and its seed."""

    matcher: Annotated[str, OneOf((*MATCHERS, *MATCHER_ALIASES))] = "hide"
    """Scan matcher that localises; hs is short for harmony_search."""
    hide: Hide = field(default_factory=Hide)
    harmony_search: HarmonySearch = field(default_factory=HarmonySearch)
    icp: Icp = field(default_factory=Icp)
    exact: Exact = field(default_factory=Exact)
    likelihood_field: FieldParameters = field(default_factory=FieldParameters)
    localiser: LocaliserParameters = field(default_factory=LocaliserParameters)
    mapper: Annotated[str, OneOf(MAPPERS)] = "graph"
    """Mapper that builds a map; graph closes loops, point is the point map of [P]."""
    graph_mapper: GraphMapperParameters = field(default_factory=GraphMapperParameters)
    point_mapper: PointMapperParameters = field(default_factory=PointMapperParameters)

    def __post_init__(self) -> None:
        object.__setattr__(self, "matcher", MATCHER_ALIASES.get(self.matcher, self.matcher))
        Parameters.__post_init__(self)

    def make_matcher(self) -> Matcher:
        """The matcher that is chosen."""
        chosen: Matcher = getattr(self, self.matcher)
        return chosen

    def make_field(self, grid: OccupancyGrid) -> LikelihoodField:
        """The field of a map. Raises MapError for a map without an occupied cell, and for one that is too large."""
        return LikelihoodField.from_grid(grid, self.likelihood_field.sigma, self.likelihood_field.margin)


def preset(name: str) -> Config:
    """A named set of parameters.

    `default` is the project's own. `paper` and `paper-literal` localise as [P] does: the matchers' presets of that name
    with the report's budget for localisation, (HRT, NFE) = (4, 20) and NI = 20 improvisations, sigma = 1 m, every scan,
    a window of one standard deviation, and the match is the new pose.
    """
    if name == "default":
        return Config()
    if name not in PRESETS:
        raise ConfigError(f"preset is {name!r}; it must be one of {', '.join(PRESETS)}")
    literal = name == "paper-literal"
    hide = Hide.paper_literal() if literal else Hide.paper()
    harmony_search = HarmonySearch.paper_literal() if literal else HarmonySearch.paper()
    return Config(
        # The budget must count improvisations: 20 evaluations would not even fill the memory.
        hide=replace(hide, improvisations_per_pass=4, budget=20, count_improvisations=True),
        harmony_search=replace(harmony_search, budget=20, count_improvisations=True),
        likelihood_field=FieldParameters(sigma=1.0, margin=3.0),
        localiser=LocaliserParameters(
            update_min_d=0.0,
            update_min_a=0.0,
            min_points=6,
            window_sigmas=1.0,
            refine_first=False,
            fuse=False,
            smooth=False,
            place_check=PlaceCheckParameters(interval=0.0),
        ),
    )


def combined(
    base: Config,
    source: Mapping[str, Any] | str | PathLike[str] | None = None,
    settings: Iterable[str] = (),
    chosen: Mapping[str, str] | None = None,
    warnings: list[str] | None = None,
) -> Config:
    """A configuration made of, in this order: `base`, a table or YAML file, `chosen` keys, and KEY=VALUE `settings`.

    Raises ConfigError. What a ROS 2 parameter file has to warn of is added to `warnings`.
    """
    if isinstance(source, str | PathLike):
        config = load(Path(source), base, warnings)
    else:
        config = from_dict(Config, {} if source is None else source, base)
    if chosen:
        config = replace(config, **typing.cast("Any", dict(chosen)))
    settings = [settings] if isinstance(settings, str) else list(settings)
    if not settings:
        return config
    values = nested(settings, config.matcher)
    try:
        return from_dict(Config, values, config)
    except ConfigError as error:
        raise ConfigError(f"--set: {str(error).removeprefix('config.')}") from error


def nested(settings: Iterable[str], matcher: str) -> dict[str, Any]:
    """KEY=VALUE texts with dotted keys as a table; `matcher.` means the section of the matcher that is chosen."""
    values: dict[str, Any] = {}
    known = [path for path, _ in _leaves(to_dict(Config()))]
    for text in settings:
        key, sign, value = text.partition("=")
        path = tuple(key.strip().split("."))
        if not sign or not all(path):
            raise ConfigError(f"--set {text}: is not KEY=VALUE, such as hide.budget=400")
        parsed = _yaml_value(f"--set {text}", value)
        if path == ("matcher",):
            matcher = MATCHER_ALIASES.get(str(parsed), str(parsed))
        elif path[0] == "matcher":
            path = (matcher, *path[1:])
        if path not in known:
            raise ConfigError(f"--set {text}: there is no parameter {'.'.join(path)}; {_similar(path, known)}")
        _put(values, path, parsed)
    return values


def _similar(path: tuple[str, ...], known: Iterable[tuple[str, ...]]) -> str:
    """Parameters that may be meant: with the same last name, or written nearly so."""
    if path[-1] in _RENAMED:
        return f"since version 0.2 it is called {_RENAMED[path[-1]]}"
    names = [".".join(each) for each in known]
    found = [name for name in names if name.endswith(f".{path[-1]}") or name.startswith(f"{'.'.join(path)}.")]
    found = found or difflib.get_close_matches(".".join(path), names, 3, 0.75)
    return f"did you mean {' or '.join(found[:3])}?" if found else "`hsloc config` lists them"


def differences(config: Config, base: Config) -> list[str]:
    """KEY=VALUE for each parameter in which `config` differs from `base`; `nested` reads them."""
    standard = to_dict(base)
    return [
        f"{'.'.join(path)}={value if isinstance(value, str) else json.dumps(value)}"
        for path, value in _leaves(to_dict(config))
        if value != _get(standard, path)
    ]


def _leaves(values: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _leaves(value, (*path, key))
    else:
        yield path, values


def _yaml_value(where: str, text: str) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise ConfigError(f"{where}: the value is not valid YAML") from error


def to_dict(value: Any) -> Any:
    """A dataclass as plain dictionaries, in the order of its fields."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_dict(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple | list):
        return [to_dict(item) for item in value]
    return value


def from_dict(kind: type[T], values: Any, base: T | None = None, where: str = "config") -> T:
    """A dataclass from plain dictionaries; what is not named keeps the value of `base`, or the default.

    Raises ConfigError for an unknown key or a value of the wrong type, naming it.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} is {values!r}; it must be a table of keys and values")
    types_of = hints(kind)
    names = list(types_of)
    for key in values:
        if key not in names:
            raise ConfigError(f"{where} has the unknown key {key!r}; {_instead(str(key), names)}")
    start = kind() if base is None else base
    changes = {
        key: _convert(types_of[key], value, getattr(start, key), f"{where}.{key}") for key, value in values.items()
    }
    return typing.cast("T", replace(typing.cast("Any", start), **changes))


_RENAMED = {
    "convincing_fraction": "recovery_fitness_ratio",
    "correlated": "correlated_points",
    "crowd": "max_scans_per_view",
    "drawing": "occupancy",
    "hit": "hit_probability",
    "lead": "min_margin",
    "local_matching": "front_end",
    "lost_after": "max_consecutive_rejections",
    "min_lead": "min_margin",
    "min_way": "min_path_length",
    "miss": "miss_probability",
    "most": "max_probability",
    "most_candidates": "max_candidates",
    "partners": "max_partners",
    "place_length": "submap_length",
    "reach": "max_distance or search_radius",
    "refinement": "joint_registration",
    "still": "convergence_tolerance",
    "usual_fraction": "min_fitness_ratio",
}
"""Parameters of version 0.1 by their names in 0.2."""


def _instead(key: str, names: list[str]) -> str:
    """What to write instead of an unknown key."""
    if key in _RENAMED:
        return f"since version 0.2 it is called {_RENAMED[key]}"
    close = difflib.get_close_matches(key, names, 1)
    return f"did you mean {close[0]}?" if close else f"known are {', '.join(names)}"


def _convert(hint: Any, value: Any, base: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast("type[Any]", hint), value, base, where)
    if typing.get_origin(hint) is tuple and isinstance(value, list | tuple):
        return tuple(_convert(typing.get_args(hint)[0], item, None, where) for item in value)
    kind = plain(hint)
    if kind is float and type(value) is int:
        value = float(value) if abs(value) <= LARGEST else value
    if kind is not type(value) and not (kind is float and type(value) is int):
        raise ConfigError(f"{where} is {value!r}; it must be of type {getattr(kind, '__name__', kind)}")
    check(value, hint, where)
    return value


def load(path: Path, base: Config | None = None, warnings: list[str] | None = None) -> Config:
    """A configuration from a YAML file, on top of `base`.

    A ROS 2 parameter file is taken as well (see `from_ros_parameters`); what it has to warn of is added to `warnings`.
    """
    try:
        return from_dict(Config, read_values(path, warnings), base)
    except ConfigError as error:
        raise ConfigError(str(error) if str(error).startswith(f"{path}: ") else f"{path}: {error}") from error


def read_values(path: Path, warnings: list[str] | None = None) -> dict[str, Any]:
    """Keys and values of a YAML or ROS 2 parameter file, as `load` takes them, not yet checked."""
    values = load_table(path, "configuration", may_be_empty=True)
    if is_ros_parameters(values):
        values, ignored = from_ros_parameters(values)
        if warnings is not None:
            warnings += [f"{path}: {text}" for text in ignored]
    return values


_ROS = "ros__parameters"
_ROS_KEYS = {name: ("localiser", name) for name in ("update_min_d", "update_min_a")} | {
    f"alpha{n}": ("localiser", "odometry_noise", f"alpha{n}") for n in range(1, 5)
}
"""Parameters of AMCL that mean the same here, and where they stand."""
_ROS_FLAGS = {
    "scan_topic": "--scan-topic",
    "base_frame_id": "--base-frame",
    "base_frame": "--base-frame",
    "initial_pose": "--initial-pose",
    "random_seed": "--seed",
    "yaml_filename": "--map",
}
"""Parameters that are no matter of the configuration, but of the run."""


def is_ros_parameters(values: Any) -> bool:
    """Whether a YAML document is a ROS 2 parameter file: `node: {ros__parameters: {...}}`, also in namespaces."""
    return isinstance(values, dict) and any(
        isinstance(node, dict) and (_ROS in node or is_ros_parameters(node)) for node in values.values()
    )


def from_ros_parameters(values: dict[str, Any], where: str = "") -> tuple[dict[str, Any], list[str]]:
    """Keys of `Config` from a ROS 2 parameter file, and a line for each node on what was not used.

    Names are those of AMCL, in any node; where several nodes state a parameter, the last counts.
    """
    found: dict[str, Any] = {}
    ignored: list[str] = []
    for name, node in values.items():
        if not isinstance(node, dict):
            ignored.append(f"{where}{name} is ignored")
        elif isinstance(node.get(_ROS), dict):
            unused = []
            for key, value in node[_ROS].items():
                if key in _ROS_KEYS:
                    _put(found, _ROS_KEYS[key], value)
                else:
                    flag = _ROS_FLAGS.get(key)
                    unused.append(f"{key} (give {flag})" if flag else str(key))
            if unused:
                ignored.append(f"parameters of {where}{name} that are ignored: {', '.join(unused)}")
        else:
            inner, more = from_ros_parameters(node, f"{where}{name}/")
            for path in _ROS_KEYS.values():
                value = _get(inner, path)
                if value is not None:
                    _put(found, path, value)
            ignored += more
    return found, ignored


def _put(values: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    for name in path[:-1]:
        values = values.setdefault(name, {})
    values[path[-1]] = value


def _get(values: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        values = values.get(name) if isinstance(values, dict) else None
    return values


def dump(config: Config) -> str:
    """A configuration as YAML, which `load` reads back."""
    return _as_yaml(json.dumps(to_dict(config)))


@lru_cache(maxsize=16)
def _as_yaml(values: str) -> str:
    """JSON as YAML: three files of a run hold its configuration, and ruamel takes 20 ms for each."""
    from io import StringIO

    from ruamel.yaml import YAML

    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    stream = StringIO()
    yaml.dump(json.loads(values), stream)
    return stream.getvalue()
