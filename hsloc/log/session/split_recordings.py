"""Whether several files are parts of one run: they follow each other, or hold different topics of the same time.

Files of different drives would be interleaved by time into a robot that is in two places at once. They show
in one topic recorded in two files at the same time, or in odometry that is elsewhere when the next file goes on.
"""

from __future__ import annotations

from collections import deque
from itertools import combinations, islice, pairwise
from math import hypot
from typing import TYPE_CHECKING, NamedTuple

from hsloc.errors import LogError
from hsloc.log.messages.decode import OdometryMessage, PoseMessage
from hsloc.log.messages.decoders import Undecodable, decoder_for, is_decodable
from hsloc.log.summary import NANOSECONDS, Losses, PartSummary
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from hsloc.log.container import Channel, Container, RawMessage
    from hsloc.log.messages.decoders import Decoder
    from hsloc.model import Pose2

SAME_TIME_NS = 2 * NANOSECONDS
"""So long may two parts of one run overlap: a recorder that splits its files writes some messages late."""
SHORT_PART = 0.5
"""Or so large a part of the shorter one, whichever is less."""
EDGE_NS = NANOSECONDS // 2
"""But so long they always may: the last part may be hardly more than what was written late."""
GAP_NS = 60 * NANOSECONDS
"""A longer time without scan or odometry between two parts is a warning."""
POSSIBLE_SPEED, LIKELY_SPEED = 15.0, 2.0
"""m/s; faster between two parts no robot moves, and few robots with a lidar faster than the second."""
POSSIBLE_JUMP, LIKELY_JUMP = 2.0, 1.0
"""Metres besides: odometry may be late, and wheels slip."""
_RESET, _AWAY = 0.01, 0.5
"""Odometry within this distance of zero [m] was reset, if it was farther away a second before."""
_ENDS = 200
"""Messages looked at on either end of a part."""

_ANOTHER_RUN = "if that is another run, replay each file by itself"


class _Edge(NamedTuple):
    """Odometry at one end of a part."""

    log_time_ns: int
    pose: Pose2


def check_parts(
    containers: Sequence[Container],
    scan_topics: Iterable[str],
    odometry: Collection[str],
    tf_frames: tuple[str, str] | None,
) -> tuple[tuple[PartSummary, ...], list[RunWarning]]:
    """The files in the order of time, and warnings where they may not be parts of one run.

    `odometry` are the topics that carry it, `tf_frames` its frames where these are transforms. Raises LogError for
    files that are not parts of one run.
    """
    topics = [*odometry, *scan_topics]
    found = [(part, container) for container in containers if (part := _span(container, topics)) is not None]
    found.sort(key=lambda entry: (entry[0].start_ns, entry[0].end_ns))
    parts = tuple(part for part, _ in found)
    if len(found) < 2:
        return parts, []
    for topic in topics:
        spans = [span for _, container in found if (span := _span(container, [topic])) is not None]
        for a, b in combinations(spans, 2):
            _refuse_same_time(a, b, topic)
    return parts, _gaps(parts) + _jumps(found, odometry, tf_frames)


def _span(container: Container, topics: Sequence[str]) -> PartSummary | None:
    """Log times of these topics in a file; None where it has no messages of them.

    Of these alone: recorders that split their files may repeat /tf_static and /map with the time of the beginning.
    """
    statistics = [
        container.statistics[channel.id]
        for channel in container.channels.values()
        if channel.id in container.statistics and _is_one_of(channel, topics)
    ]
    firsts = [item.first_ns for item in statistics if item.count and item.first_ns is not None]
    lasts = [item.last_ns for item in statistics if item.count and item.last_ns is not None]
    return PartSummary(container.path, min(firsts), max(lasts)) if firsts and lasts else None


def _is_one_of(channel: Channel, topics: Collection[str]) -> bool:
    """Whether a channel's topic is one of these, with or without the leading slash that ROS 1 leaves out."""
    return channel.topic.lstrip("/") in {topic.lstrip("/") for topic in topics}


def _refuse_same_time(a: PartSummary, b: PartSummary, topic: str) -> None:
    overlap = min(a.end_ns, b.end_ns) - max(a.start_ns, b.start_ns)
    shorter = min(a.end_ns - a.start_ns, b.end_ns - b.start_ns)
    if overlap > max(EDGE_NS, min(SAME_TIME_NS, SHORT_PART * shorter)):
        raise LogError(
            f"{a.path} and {b.path}: both hold {topic} of the same {overlap / NANOSECONDS:.1f} s, so they are of two "
            f"drives, or of two recorders of one; run each by itself, or all with `hsloc sweep {a.path} {b.path}`"
        )


def _gaps(parts: Sequence[PartSummary]) -> list[RunWarning]:
    warnings = []
    last = parts[0]
    for part in parts[1:]:
        gap = part.start_ns - last.end_ns
        if gap > GAP_NS:
            warnings.append(
                RunWarning(
                    WarningCode.PARTS_GAP, f"{part.path} begins {_duration(gap)} after {last.path} ends", _ANOTHER_RUN
                )
            )
        last = max(last, part, key=lambda item: item.end_ns)
    return warnings


def _duration(nanoseconds: int) -> str:
    minutes, seconds = divmod(nanoseconds // NANOSECONDS, 60)
    if minutes < 60:
        return f"{minutes} min {seconds:02d} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours < 48 else f"{hours // 24} days"


def _jumps(
    found: Sequence[tuple[PartSummary, Container]], odometry: Collection[str], tf_frames: tuple[str, str] | None
) -> list[RunWarning]:
    ends = [(part, *_edges(container, odometry, tf_frames)) for part, container in found]
    known = [(part, first, last) for part, first, last in ends if first is not None and last is not None]
    return [
        warning
        for (before, _, end), (after, begin, _) in pairwise(sorted(known, key=lambda entry: entry[1].log_time_ns))
        for warning in _jump(before, end, after, begin)
    ]


def _jump(a: PartSummary, end: _Edge, b: PartSummary, begin: _Edge) -> list[RunWarning]:
    """What the odometry says to one part following the other."""
    # Where the edges overlap, too, the robot was at both ends within that time.
    seconds = abs(begin.log_time_ns - end.log_time_ns) / NANOSECONDS
    way = hypot(begin.pose.x - end.pose.x, begin.pose.y - end.pose.y)
    if hypot(begin.pose.x, begin.pose.y) < _RESET and hypot(end.pose.x, end.pose.y) > _AWAY:
        return [
            RunWarning(
                WarningCode.PARTS_ODOMETRY_RESET, f"the odometry starts again from zero with {b.path}", _ANOTHER_RUN
            )
        ]
    what = f"the odometry is {way:.1f} m away when {b.path} goes on, {seconds:.1f} s from the end of {a.path}"
    if way > POSSIBLE_JUMP + POSSIBLE_SPEED * seconds:
        raise LogError(
            f"{what}, so they are not parts of one run; run each by itself, or all with `hsloc sweep {a.path} {b.path}`"
        )
    if way > LIKELY_JUMP + LIKELY_SPEED * seconds:
        return [RunWarning(WarningCode.PARTS_ODOMETRY_JUMP, what, _ANOTHER_RUN)]
    return []


def _edges(
    container: Container, odometry: Collection[str], tf_frames: tuple[str, str] | None
) -> tuple[_Edge | None, _Edge | None]:
    """The first and the last odometry of a file. All of the topic is read, but little of it decoded."""
    decoders = {
        channel.id: decoder_for(channel)
        for channel in container.channels.values()
        if _is_one_of(channel, odometry) and is_decodable(channel)
    }
    messages = container.messages(decoders.keys(), Losses())
    # Copies: a view would hold on to the chunk that it is part of.
    head = [(*message[:3], bytes(message[3])) for message in islice(messages, _ENDS)]
    tail = deque(((*message[:3], bytes(message[3])) for message in messages), maxlen=_ENDS)
    first = next(_odometry(decoders, head, tf_frames), None)
    last = next(_odometry(decoders, [*reversed(tail), *reversed(head)], tf_frames), None)
    return first, last


def _odometry(
    decoders: dict[int, Decoder], messages: Iterable[RawMessage], tf_frames: tuple[str, str] | None
) -> Iterator[_Edge]:
    """Odometry among messages, by the log's times."""
    for log_time, _, channel, data in messages:
        try:
            message = decoders[channel](data)
        except Undecodable:
            continue
        if not isinstance(message, list):
            if isinstance(message, OdometryMessage | PoseMessage):
                yield _Edge(log_time, message.pose)
            continue
        for link in message:
            if (link.parent, link.child) == tf_frames:
                yield _Edge(log_time, link.transform.normalised().to_pose2())
