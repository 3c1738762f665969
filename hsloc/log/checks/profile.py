"""Recording profiles: what a team asks of every recording, as a YAML file that `hsloc check --profile` enforces.

::

    topics:
      /scan: {type: sensor_msgs/msg/LaserScan, rate: [8, 12], max_gap: 0.5, frame: laser}
      /odom: {rate: [20, 60], child_frame: base_link}
      /camera: {required: false, max_gap: 1}
    transforms: [odom -> base_link, base_link -> laser]
    max_offset: 0.03
    duration: [10, 3600]

Rates in Hz as [least, most], gaps, offset and duration in seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING, Any

from hsloc.errors import ConfigError
from hsloc.log.messages.definitions import long_name
from hsloc.yaml_table import is_number, load_table

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from hsloc.log.checks.checker import CheckReport
    from hsloc.log.summary import LogSummary, TopicSummary

Range = tuple[float, float]
_TOPIC = ("type", "rate", "max_gap", "frame", "child_frame", "required")
_KEYS = ("topics", "transforms", "max_offset", "duration")


@dataclass(frozen=True, slots=True)
class TopicProfile:
    """What is asked of a topic; None where nothing is. `rate` in Hz, `max_gap` in seconds."""

    typename: str | None = None
    rate: Range | None = None
    max_gap: float | None = None
    frame: str | None = None
    child_frame: str | None = None
    required: bool = True


@dataclass(frozen=True, slots=True)
class Profile:
    """What is asked of a recording.

    `transforms` are pairs (parent, child) of frames between which a transform must be known, over any others.
    `max_offset` (s) bounds the offset between the stamps of scans and odometry, `duration` (s) the recording.
    """

    topics: Mapping[str, TopicProfile] = field(default_factory=dict)
    transforms: tuple[tuple[str, str], ...] = ()
    max_offset: float | None = None
    duration: Range | None = None


def read_profile(path: Path) -> Profile:
    """Read a profile. Raises ConfigError that names the file and the key."""
    values = load_table(path, "profile")
    _known(path, "the profile", values, _KEYS)
    topics = values.get("topics") or {}
    transforms = values.get("transforms") or []
    if not isinstance(topics, dict) or not isinstance(transforms, list):
        raise ConfigError(f"{path}: topics must be a table by topic, transforms a list of `parent -> child`")
    pairs = []
    for each in transforms:
        parent, arrow, child = (part.strip() for part in str(each).partition("->"))
        if not (parent and arrow and child):
            raise ConfigError(f"{path}: transforms: {each!r} must be `parent -> child`")
        pairs.append((parent.lstrip("/"), child.lstrip("/")))
    return Profile(
        {str(name): _topic(path, str(name), each or {}) for name, each in topics.items()},
        tuple(pairs),
        _number(path, "max_offset", values.get("max_offset")),
        _range(path, "duration", values.get("duration")),
    )


def violations(profile: Profile, summary: LogSummary, report: CheckReport, offsets_s: Mapping[str, float]) -> list[str]:
    """One line for each thing that a recording does not keep; `offsets_s` are those of scan topics that are known."""
    found = []
    by_name: dict[str, list[TopicSummary]] = {}
    for topic in summary.topics:
        by_name.setdefault(topic.topic.lstrip("/"), []).append(topic)
    for name, asked in profile.topics.items():
        there = [topic for topic in by_name.get(name.lstrip("/"), []) if topic.count]
        if there:
            found += [f"{name}: {line}" for line in _of_topic(asked, there, report.frames.get(there[0].topic))]
        elif asked.required:
            found.append(f"{name}: is not in the recording, or has no message")
    for parent, child in profile.transforms:
        if not _are_connected(parent, child, report.parents):
            found.append(f"transform {parent} -> {child}: is not in the recording")
    if profile.max_offset is not None:
        found += [
            f"{topic}: stamps are {offset:+.3f} s off those of the odometry, not at most {profile.max_offset:g} s"
            for topic, offset in offsets_s.items()
            if abs(offset) > profile.max_offset
        ]
    if profile.duration is not None and not profile.duration[0] <= summary.duration_s <= profile.duration[1]:
        found.append(f"the recording lasts {summary.duration_s:.1f} s, not {_text(profile.duration)} s")
    return found


def _of_topic(asked: TopicProfile, there: list[TopicSummary], frames: tuple[str, str] | None) -> list[str]:
    first = there[0]
    lines = []
    if asked.typename is not None and asked.typename not in (topic.typename for topic in there):
        lines.append(f"type is {first.typename}, not {asked.typename}")
    if asked.rate is not None and not asked.rate[0] <= first.rate_hz <= asked.rate[1]:
        lines.append(f"rate is {first.rate_hz:.2f} Hz, not {_text(asked.rate)} Hz")
    if asked.max_gap is not None and first.largest_gap_s > asked.max_gap:
        lines.append(f"the largest gap is {first.largest_gap_s:.3f} s, not at most {asked.max_gap:g} s")
    for what, wanted, number in (("frame", asked.frame, 0), ("child frame", asked.child_frame, 1)):
        has = "" if frames is None else frames[number]
        if wanted is not None and has != wanted.lstrip("/"):
            lines.append(f"{what} is {has or 'not stated'}, not {wanted}")
    return lines


def _are_connected(first: str, second: str, parents: Mapping[str, str]) -> bool:
    """Whether both frames hang on one tree."""

    def root(frame: str) -> str:
        seen = set()
        while frame in parents and frame not in seen:
            seen.add(frame)
            frame = parents[frame]
        return frame

    known = {*parents, *parents.values()}
    return first in known and second in known and root(first) == root(second)


def _topic(path: Path, name: str, values: Any) -> TopicProfile:
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: {name} must be a table of {', '.join(_TOPIC)}")
    _known(path, name, values, _TOPIC)
    texts = {key: values.get(key) for key in ("type", "frame", "child_frame")}
    for key, value in texts.items():
        if value is not None and not isinstance(value, str):
            raise ConfigError(f"{path}: {name}: {key} is {value!r}; it must be a text")
    required = values.get("required", True)
    if not isinstance(required, bool):
        raise ConfigError(f"{path}: {name}: required is {required!r}; it must be true or false")
    typename = None if texts["type"] is None else long_name(texts["type"])
    rate = _range(path, f"{name}: rate", values.get("rate"))
    gap = _number(path, f"{name}: max_gap", values.get("max_gap"))
    return TopicProfile(typename, rate, gap, texts["frame"], texts["child_frame"], required)


def _known(path: Path, where: str, values: dict[str, Any], keys: tuple[str, ...]) -> None:
    for key in values:
        if key not in keys:
            raise ConfigError(f"{path}: {where} has no key {key!r}; there are {', '.join(keys)}")


def _number(path: Path, where: str, value: Any) -> float | None:
    if value is None:
        return None
    if not is_number(value) or value < 0.0:
        raise ConfigError(f"{path}: {where} is {value!r}; it must be a number of 0 or more")
    return float(value)


def _range(path: Path, where: str, value: Any) -> Range | None:
    """[least, most], or one number, the least."""
    if value is None:
        return None
    numbers = [_number(path, where, each) for each in (value if isinstance(value, list) else [value])]
    low, high = (numbers[0], numbers[1]) if len(numbers) == 2 else (numbers[0] if numbers else None, inf)
    if len(numbers) not in (1, 2) or low is None or high is None or low > high:
        raise ConfigError(f"{path}: {where} is {value!r}; it must be [least, most], or the least alone")
    return low, high


def _text(limits: Range) -> str:
    return f"at least {limits[0]:g}" if limits[1] == inf else f"{limits[0]:g} to {limits[1]:g}"
