"""ROS logs: from containers of messages to events."""

from __future__ import annotations

import heapq
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.log import definitions
from hsloc.log.decoders import Undecodable, canonical_type, decoder_for, is_decodable
from hsloc.log.feeds import MAP_FRAME, OdometryFeed, PoseFeed, ScanFeed, TransformFeed
from hsloc.log.frames import BASE_FRAMES, Mountings, read_links
from hsloc.log.ordering import KIND_ODOMETRY, KIND_SCAN, KIND_TRUTH, Reorder, TopicClock
from hsloc.log.summary import LogSummary, Losses, ReadOptions, TopicSummary
from hsloc.log.topics import TF, choose_topics, has_name, is_truth_name, of_type
from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from hsloc.log.container import Channel, Container
    from hsloc.log.decoders import Decoder
    from hsloc.log.feeds import Feed
    from hsloc.model import Event, OccupancyGrid

INITIAL_POSE = "hsloc.initial_pose"
"""Metadata record with x, y, theta (m, m, rad) and, if it is not the first stamp, stamp_ns."""
CONVERTED = "hsloc.convert"
"""Metadata record of a converted log; `order` = `log` says that the order of the log is the true one."""

_LINKS_AT_OPENING = 2000
_STAMPS_AT_OPENING = 100
_SAME_CLOCK_NS = 3600 * 1_000_000_000
_CLOCKS_APART_NS = 5_000_000_000


class First(NamedTuple):
    """The first message of a topic that has a stamp, and when the topic started by the log's clock."""

    message: Any
    stamp_ns: int
    log_time_ns: int
    start_log_ns: int
    starts_unstamped: bool

    @property
    def shares_log_clock(self) -> bool:
        """Whether a missing stamp may be replaced by the log time."""
        return self.stamp_ns == 0 or abs(self.stamp_ns - self.log_time_ns) < _SAME_CLOCK_NS

    @property
    def origin_ns(self) -> int:
        """The stamp of the topic's first event."""
        return self.start_log_ns if self.starts_unstamped and self.shares_log_clock else self.stamp_ns


class RosSource:
    """Events of a recording that may be split into several files.

    Raises TopicError where the topics cannot be chosen, LogFormatError where a chosen one cannot be decoded.
    """

    def __init__(self, containers: Sequence[Container], options: ReadOptions) -> None:
        self._containers = containers
        self._options = options
        self._warnings = [warning for container in containers for warning in container.warnings]
        self._decoders: dict[tuple[int, int], Decoder] = {}
        self._active = [
            channel
            for container in containers
            for channel in container.channels.values()
            if (statistics := container.statistics.get(channel.id)) is not None and statistics.count
        ]
        links = {(link.parent, link.child) for link in read_links(containers, TF, _LINKS_AT_OPENING)}
        self._tf_frames = _odometry_frames(links, options.base_frame)
        self._has_map_to_odom = any(parent == MAP_FRAME for parent, _ in links)
        where = str(containers[0].path)
        if len(containers) > 1:
            where += f" and {len(containers) - 1} more"
        self._choice = choose_topics(where, self._active, options, self._tf_frames is not None)
        self._warnings += self._choice.problems
        self._scan = self._first(self._choice.scan, definitions.LASER_SCAN)
        self._odom = self._first(self._choice.odom, definitions.ODOMETRY)
        self._truth = self._first_truth()
        self._mountings = Mountings(containers, self._base_frame(), options.laser_pose)
        self._T_child_base = self._child_to_base()
        self.losses_at_opening = _added(container.losses_at_opening for container in containers)
        self.summary = self._summarise()

    # What is in the log

    def _channels(self, topic: str, typename: str | None = None) -> Iterator[tuple[int, Channel]]:
        """(number of the container, channel) of a topic, those that can be decoded."""
        for number, container in enumerate(self._containers):
            for channel in container.channels.values():
                if has_name(channel, topic) and is_decodable(channel):
                    kind = canonical_type(channel.typename)
                    if typename is None or kind == typename:
                        yield number, channel

    def _decoder(self, number: int, channel: Channel) -> Decoder:
        key = (number, channel.id)
        if key not in self._decoders:
            self._decoders[key] = decoder_for(channel)
        return self._decoders[key]

    def _messages(self, topic: str, typename: str | None = None) -> Iterator[tuple[int, Any]]:
        """(log time, message) of one topic, file by file; what cannot be decoded is passed over."""
        chosen: dict[int, dict[int, Decoder]] = {}
        for number, channel in self._channels(topic, typename):
            chosen.setdefault(number, {})[channel.id] = self._decoder(number, channel)
        for number, decoders in chosen.items():
            for log_time, _, channel_id, data in self._containers[number].messages(decoders.keys(), Losses()):
                try:
                    yield log_time, decoders[channel_id](data)
                except Undecodable:
                    continue

    def _first(self, topic: str | None, typename: str | None) -> First | None:
        """The first message of a topic; the first one with a stamp, if that is soon."""
        if topic is None or topic == TF:
            return None
        first: First | None = None
        for count, (log_time, message) in enumerate(self._messages(topic, typename)):
            stamp = message.stamp_ns
            start, unstamped = (first[3], first[4]) if first is not None else (log_time, stamp == 0 < log_time)
            first = First(message, stamp, log_time, start, unstamped)
            if stamp != 0 or count >= _STAMPS_AT_OPENING:
                break
        return first

    def _first_truth(self) -> First | None:
        topic = self._choice.truth
        if topic is None or topic == TF:
            return None
        kinds = {canonical_type(channel.typename) for _, channel in self._channels(topic)}
        self._truth_type = next((kind for kind in _TRUTH_KINDS if kind in kinds), definitions.ODOMETRY)
        return self._first(topic, self._truth_type)

    def _base_frame(self) -> str | None:
        if self._options.base_frame is not None:
            return self._options.base_frame
        if self._odom is not None and self._odom.message.child_frame_id:
            return str(self._odom.message.child_frame_id)
        return self._tf_frames[1] if self._tf_frames else None

    def _child_to_base(self) -> Pose2 | None:
        """From the frame of the odometry messages to the base that the user named, where they differ."""
        child = self._odom.message.child_frame_id if self._odom is not None else ""
        base = self._options.base_frame
        if not child or base is None or child == base:
            return None
        transform = self._mountings.between(child, base)
        if transform is None:
            self._warnings.append(
                f"no transform from {child}, which the odometry speaks of, to {base}: they are taken to be one"
            )
            return None
        return transform.to_pose2()

    def _summarise(self) -> LogSummary:
        statistics = self._topics()
        scan_frame = self._scan.message.frame_id if self._scan is not None else None
        mounting, extrinsics = self._mountings.found(scan_frame or "")
        if self._scan is None:
            self._mountings.warnings.clear()
            extrinsics = "identity"
        converted = any(c.metadata.get(CONVERTED, {}).get("order") == "log" for c in self._containers)
        self._warn_of_clocks()
        starts = [topic.first_ns for topic in statistics if topic.first_ns is not None]
        ends = [topic.last_ns for topic in statistics if topic.last_ns is not None]
        formats = list(dict.fromkeys(container.format for container in self._containers))
        return LogSummary(
            paths=tuple(container.path for container in self._containers),
            format=" + ".join(formats),
            profile=self._containers[0].profile,
            start_ns=min(starts, default=0),
            end_ns=max(ends, default=0),
            origin_ns=self._origin(in_log_time=converted),
            topics=tuple(statistics),
            scan_topic=self._choice.scan,
            odom_topic=self._choice.odom,
            truth_topic=self._choice.truth,
            reference_candidates=self._candidates(),
            odom_frame=self._odom_frame(),
            base_frame=self._mountings.base_frame,
            laser_frame=scan_frame,
            T_base_laser=mounting.T_base_laser,
            laser_flipped=mounting.flipped,
            extrinsics=extrinsics,
            order="log" if converted else "stamp",
            metadata={name: dict(v) for c in self._containers for name, v in c.metadata.items()},
            warnings=tuple(dict.fromkeys(self._warnings + self._mountings.warnings)),
        )

    def _topics(self) -> list[TopicSummary]:
        """Statistics by topic and type, over all files."""
        merged: dict[tuple[str, str, str], list[Any]] = {}
        for container in self._containers:
            for channel in container.channels.values():
                key = (channel.topic, canonical_type(channel.typename), channel.message_encoding)
                statistics = container.statistics.get(channel.id)
                merged.setdefault(key, []).extend([statistics] if statistics else [])
        found = []
        for (topic, typename, encoding), parts in sorted(merged.items()):
            parts = sorted((p for p in parts if p.count), key=lambda part: part.first_ns)
            gaps = [part.largest_gap_ns for part in parts]
            gaps += [max(b.first_ns - a.last_ns, 0) for a, b in pairwise(parts)]
            first, last = (parts[0].first_ns, max(p.last_ns for p in parts)) if parts else (None, None)
            count, gap = sum(part.count for part in parts), max(gaps, default=0) / 1e9
            found.append(TopicSummary(topic, typename, encoding, count, first, last, gap))
        return found

    def _candidates(self) -> tuple[str, ...]:
        poses = [topic for typename in _TRUTH_KINDS[1:] for topic in of_type(self._active, typename)]
        truths = [topic for topic in of_type(self._active, definitions.ODOMETRY) if is_truth_name(topic)]
        return tuple(dict.fromkeys(truths + sorted(poses) + (["tf"] if self._has_map_to_odom else [])))

    def _odom_frame(self) -> str | None:
        if self._odom is not None:
            return self._odom.message.frame_id or None
        return self._tf_frames[0] if self._choice.odom == TF and self._tf_frames else None

    def _origin(self, in_log_time: bool) -> int:
        """The first effective stamp."""
        stamps = []
        for first, topic in ((self._scan, self._choice.scan), (self._odom, self._choice.odom)):
            if first is not None:
                stamps.append(first.start_log_ns if in_log_time else first.origin_ns)
            elif topic == TF:
                stamps += self._first_transform(in_log_time)
        if not stamps and self._truth is not None:
            stamps.append(self._truth.start_log_ns if in_log_time else self._truth.origin_ns)
        return min(stamps, default=0)

    def _first_transform(self, in_log_time: bool) -> list[int]:
        for log_time, message in self._messages(TF, definitions.TF_MESSAGE):
            for link in message:
                if (link.parent, link.child) == self._tf_frames:
                    return [log_time if in_log_time or not link.stamp_ns else link.stamp_ns]
        return []

    def _warn_of_clocks(self) -> None:
        delays = [
            (first.stamp_ns - first.log_time_ns, topic)
            for first, topic in ((self._scan, self._choice.scan), (self._odom, self._choice.odom))
            if first is not None and first.stamp_ns
        ]
        if len(delays) == 2 and abs(delays[0][0] - delays[1][0]) > _CLOCKS_APART_NS:
            seconds = (delays[0][0] - delays[1][0]) / 1e9
            self._warnings.append(
                f"the stamps of {delays[0][1]} and {delays[1][1]} are {seconds:.1f} s apart, measured by the log's "
                "clock: they may be of different clocks"
            )

    # Events

    def events(self, losses: Losses) -> Iterator[tuple[int, Event]]:
        """As `Source.events`."""
        feeds = self._feeds(losses)
        by_log = self.summary.order == "log"
        reorder = Reorder([clock for feed in feeds for clock in feed.clocks], losses)
        for log_time, (feed, decoder), data in self._stream(feeds, losses):
            try:
                message = decoder(data)
            except Undecodable as error:
                losses.undecodable_messages[feed.topic] += 1
                losses.note(f"{feed.topic}: a message cannot be decoded ({error})")
                continue
            for clock, event in feed.events(message, log_time):
                if by_log:
                    clock.effective(event.stamp_ns, log_time)  # counts stamps that run backwards
                    yield log_time, event
                elif reorder.push(clock, event, log_time):
                    yield from reorder.ready()
        yield from reorder.rest()

    def _clock(self, topic: str, kind: int, first: First | None, losses: Losses) -> TopicClock:
        return TopicClock(topic, kind, losses, first is None or first.shares_log_clock)

    def _feeds(self, losses: Losses) -> list[Feed]:
        choice = self._choice
        feeds: list[Feed] = []
        tf_odometry = tf_truth = None
        if choice.odom == TF:
            tf_odometry = self._clock(TF, KIND_ODOMETRY, None, losses)
        elif choice.odom is not None:
            clock = self._clock(choice.odom, KIND_ODOMETRY, self._odom, losses)
            feeds.append(OdometryFeed(clock, losses, is_truth=False, T_child_base=self._T_child_base))
        if choice.scan is not None:
            clock = self._clock(choice.scan, KIND_SCAN, self._scan, losses)
            feeds.append(ScanFeed(clock, self._mountings, losses))
        if choice.truth == TF:
            tf_truth = self._clock(TF, KIND_TRUTH, None, losses)
        elif choice.truth is not None:
            clock = self._clock(choice.truth, KIND_TRUTH, self._truth, losses)
            if self._truth_type == definitions.ODOMETRY:
                feeds.append(OdometryFeed(clock, losses, is_truth=True))
            else:
                feeds.append(PoseFeed(clock, losses, self._truth_type))
        if tf_odometry is not None or tf_truth is not None:
            frames = self._tf_frames or (None, self._mountings.base_frame or BASE_FRAMES[0])
            feeds.append(TransformFeed(TF, frames, tf_odometry, tf_truth, losses))
        return feeds

    def _stream(
        self, feeds: Sequence[Feed], losses: Losses
    ) -> Iterator[tuple[int, tuple[Feed, Decoder], memoryview | bytes]]:
        """Raw messages of all files in the order of the log, each with its feed and decoder."""
        routes: list[dict[int, tuple[Feed, Decoder]]] = [{} for _ in self._containers]
        for feed in feeds:
            for number, channel in self._channels(feed.topic, feed.typename):
                routes[number][channel.id] = (feed, self._decoder(number, channel))
        streams = [
            _routed(container, routes[number], losses)
            for number, container in enumerate(self._containers)
            if routes[number]
        ]
        return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=itemgetter(0))

    # What else a log may hold

    def map(self) -> OccupancyGrid | None:
        """The last map of /map, or of the only topic with maps."""
        topics = of_type(self._active, definitions.OCCUPANCY_GRID)
        named = [t for t in topics if t.lstrip("/") == "map"] or [t for t in topics if t.endswith("/map")] or topics
        if not named or (len(named) > 1 and len(topics) > 1):
            return None
        grid = None
        for _, message in self._messages(named[0], definitions.OCCUPANCY_GRID):
            grid = message.grid
        return grid

    def initial_pose(self) -> tuple[int, Pose2] | None:
        """The first message on /initialpose, else the metadata record `hsloc.initial_pose`."""
        for log_time, message in self._messages("/initialpose", definitions.POSE_WITH_COVARIANCE_STAMPED):
            return message.stamp_ns or log_time, message.pose
        values = self.summary.metadata.get(INITIAL_POSE)
        if values is None:
            return None
        try:
            pose = Pose2(float(values["x"]), float(values["y"]), float(values["theta"]))
            stamp = int(values.get("stamp_ns", self.summary.origin_ns))
        except (KeyError, ValueError):
            return None
        return (stamp, pose) if pose.is_finite() else None

    def verify(self) -> Losses:
        """As `Source.verify`."""
        return _added(container.verify() for container in self._containers)


_TRUTH_KINDS = (definitions.ODOMETRY, definitions.POSE_STAMPED, definitions.POSE_WITH_COVARIANCE_STAMPED)


def _routed(
    container: Container, routes: dict[int, tuple[Feed, Decoder]], losses: Losses
) -> Iterator[tuple[int, tuple[Feed, Decoder], memoryview | bytes]]:
    for log_time, _, channel, data in container.messages(routes.keys(), losses):
        yield log_time, routes[channel], data


def _odometry_frames(links: set[tuple[str, str]], base: str | None) -> tuple[str, str] | None:
    """(odometry frame, base frame) of a dynamic link that is odometry, if there is one."""
    children = sorted(child for parent, child in links if parent == "odom" and child != MAP_FRAME)
    wanted = [name for name in ((base,) if base is not None else BASE_FRAMES) if name in children]
    if wanted:
        return "odom", wanted[0]
    return ("odom", children[0]) if len(children) == 1 and base is None else None


def _added(parts: Iterable[Losses]) -> Losses:
    total = Losses()
    for part in parts:
        total.add(part)
    return total
