"""Which topics to read: scans, odometry and, where there is one, the truth."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from math import hypot
from typing import TYPE_CHECKING

from hsloc.errors import TopicError
from hsloc.log.messages import definitions
from hsloc.log.messages.decoders import canonical_type, is_decodable, is_read
from hsloc.log.messages.odometry_kind import Rank
from hsloc.log.messages.odometry_kinds import ODOMETRY_KINDS, POSE_TYPES, kind_among
from hsloc.log.session.transform_topics import is_odometry_frame, is_static_topic, is_transform_topic, namespace
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    from hsloc.log.container import Channel
    from hsloc.log.messages.decode import GridMessage
    from hsloc.log.messages.odometry_kind import OdometryKind
    from hsloc.log.session.transform_topics import TransformTopics
    from hsloc.log.summary import ReadOptions

TF, TF_STATIC = "/tf", "/tf_static"
TF_NAMES = ("tf", "/tf")
"""How a user names transforms in place of a topic."""
_TRUTH_NAME = re.compile(r"ground_?truth|(^|/)truth($|/)|(^|/)gt($|/)")
SCAN_TYPES = (definitions.LASER_SCAN, definitions.MULTI_ECHO_LASER_SCAN, definitions.POINT_CLOUD2)
"""What scans are made of, the plainest first."""
_ECHOES = ("first", "1st", "most_intense", "2nd", "last", "3rd")
"""Names under which drivers publish the echoes of one laser, the one to read first."""
_CLOUDS = re.compile(r"/(PointCloud|CustomMsg|VelodyneScan|\w*Packet\w*)$")
"""Types of point clouds that are not read: of old ROS 1, of Livox, and raw packets."""
_LISTED = 12
_ROLLING_PLACES = 4
_COMPARED_CELLS = 50_000_000
"""Cells of a topic of grids that are looked at. Internal: a large map that is published every second costs time."""


@dataclass(slots=True)
class TopicSelection:
    """Topics to read; `TF` stands for transforms in place of a topic. `warnings` are what stood in the way."""

    scans: tuple[str, ...] = ()
    odom: str | None = None
    truth: str | None = None
    warnings: list[RunWarning] = field(default_factory=list)


def has_name(channel: Channel, name: str) -> bool:
    """Whether a channel's topic is the name, with or without the leading slash that ROS 1 leaves out."""
    return channel.topic.lstrip("/") == name.lstrip("/")


def of_type(channels: Sequence[Channel], *typenames: str) -> list[str]:
    """Topics of some types that can be decoded, sorted."""
    return sorted({c.topic for c in channels if canonical_type(c.typename) in typenames and is_decodable(c)})


def names_transforms(channels: Sequence[Channel], name: str | None) -> str | None:
    """The topic of transforms that a user names in place of odometry, as the log has it; `/tf` for `tf`."""
    if name is None:
        return None
    if name in TF_NAMES:
        return TF
    found = sorted({c.topic for c in channels if has_name(c, name) and is_transform_topic(c)})
    return found[0] if found and not is_static_topic(found[0]) else None


def choose_topics(
    where: str, channels: Sequence[Channel], options: ReadOptions, transforms: TransformTopics
) -> TopicSelection:
    """Take the topics that the options name, else the only ones of their type.

    A log whose odometry is a static transform is read without: a run goes by its scans alone.

    `channels` are those that have messages. Raises TopicError, naming the candidates and the flag to choose with,
    where a required topic is missing or ambiguous, and always where a named one does not exist.
    """
    choice = TopicSelection()
    choice.truth = _truth(where, channels, options)
    choice.scans = tuple(choose_scans(where, channels, options, choice.warnings))
    if names_transforms(channels, options.odom_topic) is not None:
        choice.odom = TF
    else:
        others = [c for c in channels if c.topic != choice.truth and not is_truth_name(c.topic)]
        named = options.odom_topic is not None
        rank, candidates = _odometry_candidates(channels if named else others, options)
        own = {namespace(topic) for topic in choice.scans}
        near = [topic for topic in candidates if {namespace(topic)} == own != {""}]
        candidates = near if len(near) == 1 and not named else candidates  # of several robots the one with these scans
        if not named and transforms.odometry is not None and rank > Rank.TRANSFORMS:
            choice.odom = TF
        elif not (named or candidates) and transforms.fixed_odometry is not None:
            parent, child = transforms.fixed_odometry
            text = f"the odometry is ignored: {parent} -> {child} is a static transform, which does not move"
            remedy = _remedy_of_none("odom", channels, options)
            choice.warnings.append(RunWarning(WarningCode.ODOMETRY_UNUSABLE, text, remedy))
        elif not named and candidates and (says := _kind_on(others, candidates[0]).says):
            choice.odom = candidates[0]
            choice.warnings.append(
                RunWarning(
                    WarningCode.ODOMETRY_FROM_VELOCITIES,
                    says.format(choice.odom),
                    "choose another topic with --odom-topic, or go by the scans alone: --no-odom",
                )
            )
        else:
            choice.odom = _pick(
                where,
                channels,
                "odom",
                definitions.ODOMETRY,
                candidates,
                options.odom_topic,
                options,
                choice.warnings,
            )
    if choice.truth is not None and choice.truth == choice.odom != TF:
        if options.truth_topic is not None:
            raise TopicError(f"{where}: {choice.odom} cannot be both odometry and truth; leave out --truth-topic")
        choice.truth = None
    return choice


def is_truth_name(topic: str) -> bool:
    """Whether a topic's name says that it holds the truth."""
    return _TRUTH_NAME.search(topic) is not None


def choose_scans(
    where: str, channels: Sequence[Channel], options: ReadOptions, warnings: list[RunWarning]
) -> dict[str, str]:
    """The scan topics with their types: the only one, or those that are named, separated by commas.

    Plain scans come first; several echoes or clouds of points are read where there are no others, or if they are named.
    """
    types = [kind for kind in SCAN_TYPES if kind != definitions.POINT_CLOUD2 or options.slice is not None]
    by_type = {kind: of_type(channels, kind) for kind in types}
    kinds = {topic: kind for kind in reversed(types) for topic in by_type[kind]}
    first = next((kind for kind in types if by_type[kind]), definitions.LASER_SCAN)
    candidates = by_type[first]
    names: list[str | None] = [None]
    if options.scan_topic is not None:
        names = [*dict.fromkeys(name.strip() for name in options.scan_topic.split(","))]
        candidates = sorted(kinds)
    elif len(candidates) > 1:
        echoes = [topic for topic in candidates if _echo(topic) in _ECHOES]
        if len(echoes) == len(candidates) and len({namespace(topic) for topic in echoes}) == 1:
            first_echo = min(echoes, key=lambda topic: _ECHOES.index(_echo(topic)))
            warnings.append(
                RunWarning(
                    WarningCode.SCAN_ECHOES,
                    f"{', '.join(echoes)} are echoes of one laser; {first_echo} is used",
                    "choose with --scan-topic",
                )
            )
            names = [first_echo]
    chosen = [_pick(where, channels, "scan", first, candidates, name, options, warnings) for name in names]
    return {topic: kinds[topic] for topic in chosen if topic is not None}


def _echo(topic: str) -> str:
    """The last part of a topic's name, without `scan_` before it."""
    return topic.rpartition("/")[2].removeprefix("scan_")


def choose_maps(
    topics: Sequence[str], messages: Callable[[str], Iterator[tuple[int, GridMessage]]], robot: Collection[str | None]
) -> tuple[list[str], dict[str, str], set[str]]:
    """Of topics of grids those of maps, the best first; what the others are; and the frames of the maps.

    A costmap is no map: it is inflated, and a local one rolls along with the robot, mostly in the frame of its
    odometry. `robot` are frames that are fixed to the robot.
    """
    maps, others, frames = [], {}, set()
    for topic in topics:
        grids = (message for _, message in messages(topic))
        first = next(grids, None)
        if first is None:
            continue
        if "costmap" in topic:
            others[topic] = "is a costmap, not a map"
        elif is_odometry_frame(first.frame_id) or first.frame_id in robot:
            others[topic] = f"is in the frame {first.frame_id}, as a local costmap is"
        elif _rolls(first, grids):
            others[topic] = "moves along with the robot, as a local costmap does"
        else:
            maps.append(topic)
            frames.add(first.frame_id)
    maps.sort(key=lambda topic: (topic.lstrip("/") != "map", not topic.endswith("/map"), topic))
    return maps, others, frames


def _rolls(first: GridMessage, others: Iterator[GridMessage]) -> bool:
    """Whether a grid keeps its size and moves; one that a mapper builds moves only as it grows.

    Another map of the same size may be loaded once, so that it takes several places.
    """
    size, places = first.grid.cells.shape, [first.grid.origin]
    left = _COMPARED_CELLS
    for message in others:
        grid = message.grid
        left -= grid.cells.size
        if grid.cells.shape != size or left < 0:
            return False
        if all(hypot(grid.origin.x - place.x, grid.origin.y - place.y) > grid.resolution for place in places):
            places.append(grid.origin)
        if len(places) >= _ROLLING_PLACES:
            return True
    return False


def _odometry_candidates(channels: Sequence[Channel], options: ReadOptions) -> tuple[Rank, list[str]]:
    """Topics of the lowest rank that the log has, and this; where the user names one, all that can be read."""
    found: dict[Rank, list[str]] = {}
    for kind in ODOMETRY_KINDS:
        for topic in () if kind.missing(options) else of_type(channels, kind.typename):
            found.setdefault(kind.rank_of(topic), []).append(topic)
    if options.odom_topic is not None:
        return Rank.NEVER, [topic for _, topics in sorted(found.items()) for topic in topics]
    rank = min(found, default=Rank.NEVER)
    return rank, [] if rank is Rank.NEVER else found[rank]


def _kind_on(channels: Sequence[Channel], topic: str) -> OdometryKind:
    """The kind that is read of a topic, one of the candidates."""
    return kind_among({canonical_type(c.typename) for c in channels if c.topic == topic})


def _pick(
    where: str,
    channels: Sequence[Channel],
    kind: str,
    typename: str,
    candidates: list[str],
    named: str | None,
    options: ReadOptions,
    warnings: list[RunWarning],
) -> str | None:
    flag = f"--{kind}-topic"
    required = options.require_odometry if kind == "odom" else options.require_scan
    if named is not None:
        found = [topic for topic in candidates if topic.lstrip("/") == named.lstrip("/")]
        if found:
            return found[0]
        raise TopicError(_not_there(where, channels, named, typename, candidates, flag, options))
    if len(candidates) == 1:
        return candidates[0]
    what = {"scan": "scan", "odom": "odometry"}[kind]
    if candidates:
        text = f"{where}: {len(candidates)} {what} topics ({', '.join(candidates[:_LISTED])})"
        warning = RunWarning(WarningCode.TOPIC_AMBIGUOUS, text, _remedy_of_several(kind, flag, candidates, channels))
    else:
        text = f"{where}: no {what} topic ({typename}); the log holds {listed(channels)}"
        warning = RunWarning(WarningCode.TOPIC_MISSING, text, _remedy_of_none(kind, channels, options))
    if required:
        raise TopicError(str(warning))
    warnings.append(warning)
    return None


def _remedy_of_several(kind: str, flag: str, candidates: Sequence[str], channels: Sequence[Channel]) -> str:
    remedy = f"choose with {flag} {candidates[0]}"
    if kind == "odom":
        return remedy
    made = next(((a, b) for a in candidates for b in candidates if b.startswith(f"{a}_")), None)
    if made is not None:
        return f"{remedy}; {made[1]} may be made of {made[0]}, and no laser of its own"
    robots = {namespace(topic) for topic in of_type(channels, definitions.ODOMETRY) if not is_truth_name(topic)}
    if len({namespace(topic) for topic in candidates} & (robots - {""})) > 1:
        return f"{remedy}; they are of several robots, whose odometry has the same namespaces"
    return f"{remedy}, or take all with {flag} {','.join(candidates[:_LISTED])}"


_NO_ODOMETRY = ("initialpose", "amcl_pose", "goal_pose", "goal")
"""Last names of topics whose poses are stated by hand, or jump as a localiser does."""


def _remedy_of_none(kind: str, channels: Sequence[Channel], options: ReadOptions) -> str:
    unread = sorted({encoding for c in channels if (encoding := _unread_encoding(c))})
    if unread:
        return f"messages encoded as {', '.join(unread)} are not read: record or convert them as cdr"
    if kind == "scan":
        if of_type(channels, definitions.POINT_CLOUD2):
            return (
                "point clouds are read as scans with --slice LOW,HIGH, the heights above the base [m] between which "
                "walls are seen"
            )
        cloud = next((c for c in channels if _CLOUDS.search(c.typename)), None)
        return "" if cloud is None else f"convert {cloud.topic} to PointCloud2, which is read with --slice LOW,HIGH"
    if not options.require_odometry:
        return ""
    remedy = "motion can be estimated from the scans alone: --no-odom"
    moving = sorted({c.topic for c in channels if is_transform_topic(c) and not is_static_topic(c.topic)})
    if moving:
        remedy += f"; or it is in the transforms: --odom-topic {moving[0]}"
    poses = [t for t in of_type(channels, *POSE_TYPES[1:]) if t.rpartition("/")[2] not in _NO_ODOMETRY]
    if poses:
        remedy += f"; or it is the poses of --odom-topic {poses[0]}"
    velocities = of_type(channels, definitions.TWIST, definitions.TWIST_STAMPED)
    if velocities:
        remedy += f"; or velocities, if they are measured and not commanded: --odom-topic {velocities[0]}"
    for other in ODOMETRY_KINDS:
        if other.missing(options) and (topics := of_type(channels, other.typename)):
            remedy += f"; or it is made of {topics[0]} with {other.missing(options)}"
    return remedy


def _not_there(
    where: str,
    channels: Sequence[Channel],
    named: str,
    typename: str,
    candidates: list[str],
    flag: str,
    options: ReadOptions,
) -> str:
    other = next((c for c in channels if has_name(c, named)), None)
    if other is not None:
        trouble = f"{named} is {other.typename or 'of no type'} ({other.message_encoding}), not {typename}"
    else:
        trouble = f"no topic {named}"
    missing = "" if other is None else kind_among({canonical_type(other.typename)}).missing(options)
    if missing:
        return f"{where}: odometry is made of {named} with {missing}"
    remedy = f"{flag} may be {', '.join(candidates[:_LISTED])}" if candidates else f"it holds {listed(channels)}"
    return f"{where}: {trouble}; {remedy}"


def _truth(where: str, channels: Sequence[Channel], options: ReadOptions) -> str | None:
    candidates = of_type(channels, *POSE_TYPES)
    named = options.truth_topic
    if named is None:
        speaking = [topic for topic in candidates if is_truth_name(topic)]
        return speaking[0] if speaking else None
    if named in TF_NAMES:
        return TF
    found = [topic for topic in candidates if topic.lstrip("/") == named.lstrip("/")]
    if found:
        return found[0]
    remedy = ", ".join([*candidates, "tf"][:_LISTED])
    raise TopicError(f"{where}: no topic {named} to take as truth; --truth-topic may be {remedy}")


def check_offsets(
    where: str, channels: Sequence[Channel], read: Sequence[str], options: ReadOptions
) -> list[RunWarning]:
    """A warning for each topic of `--time-offset` that is not among the ones that are read.

    Raises TopicError for one that the log does not have.
    """
    found = []
    for name in replace(options, calibration=None).offsets_s():
        if any(topic.lstrip("/") == name for topic in read):
            continue
        given = f"--time-offset {options.time_offset}"
        there = ", ".join(read)
        if not any(has_name(channel, name) for channel in channels):
            raise TopicError(f"{where}: no topic {name} that {given} could move; of this log {there} are read")
        text = f"{given}: /{name} is not read, so that its offset has no effect; {there} are read"
        remedy = "name one of these, or have the topic read by --scan-topic or --odom-topic"
        found.append(RunWarning(WarningCode.TIME_OFFSET_UNUSED, text, remedy))
    return found


def _unread_encoding(channel: Channel) -> str:
    """The encoding of messages whose type is read, where it is one that is not; else empty."""
    return channel.message_encoding or "nothing" if is_read(channel) and not is_decodable(channel) else ""


def _spelt(channel: Channel) -> str:
    """Type and encoding; the type alone where the encoding is one that is read."""
    name, encoding = channel.typename or channel.message_encoding, _unread_encoding(channel)
    return f"{name}, encoded as {encoding}" if encoding else name


def listed(channels: Sequence[Channel]) -> str:
    """Topics with their types, for a message."""
    names = sorted({f"{c.topic} ({_spelt(c)})" for c in channels})
    if not names:
        return "no messages"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
