"""Which topics to read: scans, odometry and, where there is one, the truth."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.errors import TopicError
from hsloc.log.messages import definitions
from hsloc.log.messages.decoders import canonical_type, is_decodable
from hsloc.log.session.transform_topics import is_static_topic, is_transform_topic, namespace
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hsloc.log.container import Channel
    from hsloc.log.summary import ReadOptions

TF, TF_STATIC = "/tf", "/tf_static"
TF_NAMES = ("tf", "/tf")
"""How a user names transforms in place of a topic."""
ODOMETRY_TYPES = (*definitions.VELOCITY_TYPES, definitions.JOINT_STATE)
"""What odometry can be made of."""
TRUTH_TYPES = (definitions.ODOMETRY, definitions.POSE_STAMPED, definitions.POSE_WITH_COVARIANCE_STAMPED)
_TRUTH_NAME = re.compile(r"ground_?truth|(^|/)truth($|/)|(^|/)gt($|/)")
_ODOMETRY_NAME = re.compile(r"(^|/)odom(etry)?($|/)")
SCAN_TYPES = (definitions.LASER_SCAN, definitions.MULTI_ECHO_LASER_SCAN, definitions.POINT_CLOUD2)
"""What scans are made of, the plainest first."""
_ECHOES = ("first", "most_intense", "last")
"""Names under which drivers publish the echoes of one laser, the one to read first."""
_LISTED = 12


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


def of_type(channels: Sequence[Channel], typename: str) -> list[str]:
    """Topics of a type that can be decoded, sorted."""
    return sorted({c.topic for c in channels if canonical_type(c.typename) == typename and is_decodable(c)})


def names_transforms(channels: Sequence[Channel], name: str | None) -> str | None:
    """The topic of transforms that a user names in place of odometry, as the log has it; `/tf` for `tf`."""
    if name is None:
        return None
    if name in TF_NAMES:
        return TF
    found = sorted({c.topic for c in channels if has_name(c, name) and is_transform_topic(c)})
    return found[0] if found and not is_static_topic(found[0]) else None


def choose_topics(
    where: str, channels: Sequence[Channel], options: ReadOptions, tf_has_odometry: bool
) -> TopicSelection:
    """Take the topics that the options name, else the only ones of their type.

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
        candidates = _odometry_candidates(channels if named else others, named, options.wheels is not None)
        if not named and tf_has_odometry and not candidates:
            choice.odom = TF
        elif not (named or candidates) and (velocities := _velocities(others)):
            choice.odom = velocities[0]
            choice.warnings.append(
                RunWarning(
                    WarningCode.ODOMETRY_FROM_VELOCITIES,
                    f"there is no odometry; it is made of the velocities on {choice.odom}",
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
                options.require_odometry,
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
        echoes = [topic for topic in candidates if topic.rpartition("/")[2] in _ECHOES]
        if len(echoes) == len(candidates) and len({namespace(topic) for topic in echoes}) == 1:
            first_echo = min(echoes, key=lambda topic: _ECHOES.index(topic.rpartition("/")[2]))
            warnings.append(
                RunWarning(
                    WarningCode.SCAN_ECHOES,
                    f"{', '.join(echoes)} are echoes of one laser; {first_echo} is used",
                    "choose with --scan-topic",
                )
            )
            names = [first_echo]
    chosen = [_pick(where, channels, "scan", first, candidates, name, options.require_scan, warnings) for name in names]
    return {topic: kinds[topic] for topic in chosen if topic is not None}


def _velocities(channels: Sequence[Channel]) -> list[str]:
    """Topics of velocities that were measured, by their names: what is commanded is not what was driven."""
    types = (definitions.TWIST_STAMPED, definitions.TWIST_WITH_COVARIANCE_STAMPED)
    return [topic for kind in types for topic in of_type(channels, kind) if "cmd" not in topic.lower()]


def _odometry_candidates(channels: Sequence[Channel], named: bool, wheels: bool) -> list[str]:
    """Topics of odometry; poses count if they are named, or if their name speaks and nothing else is there.

    Velocities count if they are named, joint states where the size of the `wheels` is known, and then alone.
    """
    joints = of_type(channels, definitions.JOINT_STATE) if wheels else []
    if joints and not named:
        return joints
    found = of_type(channels, definitions.ODOMETRY)
    poses = [topic for typename in TRUTH_TYPES[1:] for topic in of_type(channels, typename)]
    if named:
        velocities = [topic for typename in definitions.VELOCITY_TYPES for topic in of_type(channels, typename)]
        return found + sorted(poses) + sorted(velocities) + joints
    return found or sorted(topic for topic in poses if _ODOMETRY_NAME.search(topic))


def _pick(
    where: str,
    channels: Sequence[Channel],
    kind: str,
    typename: str,
    candidates: list[str],
    named: str | None,
    required: bool,
    warnings: list[RunWarning],
) -> str | None:
    flag = f"--{kind}-topic"
    if named is not None:
        found = [topic for topic in candidates if topic.lstrip("/") == named.lstrip("/")]
        if found:
            return found[0]
        raise TopicError(_not_there(where, channels, named, typename, candidates, flag))
    if len(candidates) == 1:
        return candidates[0]
    what = {"scan": "scan", "odom": "odometry"}[kind]
    if candidates:
        listing = ", ".join(candidates[:_LISTED])
        remedy = f"choose with {flag} {candidates[0]}"
        remedy += f", or take all with {flag} {','.join(candidates[:_LISTED])}" if kind == "scan" else ""
        text = f"{where}: {len(candidates)} {what} topics ({listing})"
        warning = RunWarning(WarningCode.TOPIC_AMBIGUOUS, text, remedy)
    else:
        remedy = "motion can be estimated from the scans alone: --no-odom" if kind == "odom" and required else ""
        if remedy and of_type(channels, definitions.JOINT_STATE):
            remedy += "; or it is made of joint states with --wheels RADIUS,TRACK"
        if kind == "scan" and of_type(channels, definitions.POINT_CLOUD2):
            remedy = (
                "point clouds are read as scans with --slice LOW,HIGH, the heights above the base [m] between which "
                "walls are seen"
            )
        text = f"{where}: no {what} topic ({typename}); the log holds {listed(channels)}"
        warning = RunWarning(WarningCode.TOPIC_MISSING, text, remedy)
    if required:
        raise TopicError(str(warning))
    warnings.append(warning)
    return None


def _not_there(
    where: str, channels: Sequence[Channel], named: str, typename: str, candidates: list[str], flag: str
) -> str:
    other = next((c for c in channels if has_name(c, named)), None)
    if other is not None:
        trouble = f"{named} is {other.typename or 'of no type'} ({other.message_encoding}), not {typename}"
    else:
        trouble = f"no topic {named}"
    if other is not None and canonical_type(other.typename) == definitions.JOINT_STATE:
        return f"{where}: odometry is made of {named} with the size of the wheels: --wheels RADIUS,TRACK"
    remedy = f"{flag} may be {', '.join(candidates[:_LISTED])}" if candidates else f"it holds {listed(channels)}"
    return f"{where}: {trouble}; {remedy}"


def _truth(where: str, channels: Sequence[Channel], options: ReadOptions) -> str | None:
    candidates = sorted({topic for typename in TRUTH_TYPES for topic in of_type(channels, typename)})
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


def listed(channels: Sequence[Channel]) -> str:
    """Topics with their types, for a message."""
    names = sorted({f"{c.topic} ({c.typename or c.message_encoding})" for c in channels})
    if not names:
        return "no messages"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
