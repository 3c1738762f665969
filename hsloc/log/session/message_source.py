"""ROS logs: from containers of messages to events."""

from __future__ import annotations

import heapq
from collections import defaultdict
from math import inf
from operator import itemgetter
from typing import TYPE_CHECKING

from hsloc.errors import TopicError
from hsloc.log.container import in_runs
from hsloc.log.messages import definitions
from hsloc.log.messages.decoders import Undecodable, canonical_type, column_decoder_for, is_decodable
from hsloc.log.no_log import COPY_AGAIN
from hsloc.log.session.event_builders import CloudFeed, MotionFeed, OdometryFeed, ScanFeed, TransformFeed
from hsloc.log.session.log_session import FirstMessage, LogSession
from hsloc.log.session.ordering import KIND_ODOMETRY, KIND_SCAN, KIND_TRUTH, Arrivals, Reorder, TopicClock, one_by_one
from hsloc.log.session.topic_selection import TF
from hsloc.log.session.transform_topics import BASE_FRAMES
from hsloc.log.source import Observation
from hsloc.log.summary import NANOSECONDS, Losses
from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from hsloc.log.container import Channel, Container, RawMessage
    from hsloc.log.messages.cdr_batch_decode import ColumnDecoder
    from hsloc.log.messages.decoders import Decoder
    from hsloc.log.session.event_builders import Feed
    from hsloc.log.summary import ReadOptions
    from hsloc.model import Event, OccupancyGrid

_CHANNELS = 1 << 32
"""More channels than a file can have."""
_FIRST_BATCH = 16
"""Messages of the first batch. Internal: small, so that the first event is there at once."""
_CUT_BATCH = 64
"""Messages of a batch where the end of a log is left out. Internal: damage behind the end is not read."""
_BATCH = 1024
"""Messages that are decoded together. Internal: time alone, the events are the same."""

INITIAL_POSE = "hsloc.initial_pose"
"""Metadata record with x, y, theta (m, m, rad) and, if it is not the first stamp, stamp_ns."""


class RosSource:
    """Events of a recording that may be split into several files.

    Raises TopicError where the topics cannot be chosen, LogFormatError where a chosen one cannot be decoded.
    """

    def __init__(self, containers: Sequence[Container], options: ReadOptions) -> None:
        self._containers = containers
        self.losses_at_opening = _added(container.losses_at_opening for container in containers)
        try:
            self._survey = LogSession(containers, options)
        except TopicError as error:
            lost = ", ".join(self.losses_at_opening.lines())
            if not lost:
                raise
            raise TopicError(f"{error}; {lost}: {COPY_AGAIN}") from None
        self.summary = self._survey.summary

    def events(self, losses: Losses) -> Iterator[tuple[int, Event]]:
        """As `Source.events`."""
        feeds = self._feeds(losses)
        reorder = Reorder([clock for feed in feeds for clock in feed.clocks], losses)
        routes = self._routes(feeds)
        size = _BATCH if self._survey.options.end_s is None else _CUT_BATCH
        for batch in _batches(self._stream(routes, losses), size):
            arrivals = [
                found
                for route, places in _by_route(batch, routes)
                for found in route.read([batch[place] for place in places], places, losses)
            ]
            if self.summary.order == "log":
                for _, clock, log_time, event in one_by_one(arrivals):
                    clock.effective(event.stamp_ns, log_time)  # counts stamps that run backwards
                    yield log_time, event
            else:
                reorder.take(arrivals, len(batch))
                yield from reorder.ready()
        yield from reorder.rest()

    def observations(self, losses: Losses) -> Iterator[Observation]:
        """As `Source.observations`."""
        scans = (definitions.LASER_SCAN, definitions.MULTI_ECHO_LASER_SCAN)
        kinds = (*scans, definitions.ODOMETRY, definitions.TF_MESSAGE)
        for number, container in enumerate(self._containers):
            chosen = {
                channel.id: (channel.topic, self._survey.decoder(number, channel))
                for channel in container.channels.values()
                if is_decodable(channel) and canonical_type(channel.typename) in kinds
            }
            for log_time, _, channel_id, data in container.messages(chosen.keys(), losses):
                topic, decoder = chosen[channel_id]
                try:
                    yield Observation(topic, log_time, decoder(data))
                except Undecodable as error:
                    losses.undecodable_messages[topic] += 1
                    losses.note(f"{topic}: a message cannot be decoded ({error})")

    def _feeds(self, losses: Losses) -> list[Feed]:
        survey = self._survey
        choice = survey.choice
        feeds: list[Feed] = []
        tf_odometry = tf_truth = None
        if choice.odom == TF:
            tf_odometry = self._clock(TF, KIND_ODOMETRY, None, losses)
        elif choice.odom is not None:
            clock = self._clock(choice.odom, KIND_ODOMETRY, survey.odom, losses)
            kind = survey.odom_kind
            if kind.motion is None:
                feeds.append(OdometryFeed(clock, losses, kind.typename, False, survey.T_child_base))
            else:
                motion = kind.motion(survey.options, survey.mountings.of_frame)
                feeds.append(MotionFeed(clock, losses, kind, motion, survey.T_child_base))
        for topic, first in survey.scans.items():
            clock = self._clock(topic, KIND_SCAN, first, losses)
            if survey.scan_types[topic] == definitions.POINT_CLOUD2:
                feeds.append(CloudFeed(clock, survey.mountings, losses, survey.options.heights() or (-inf, inf)))
                continue
            feed = ScanFeed(clock, survey.mountings, losses, survey.options.deskew, survey.fixes, survey.surveys[topic])
            feed.typename = survey.scan_types[topic]
            feeds.append(feed)
        if choice.truth == TF:
            tf_truth = self._clock(TF, KIND_TRUTH, None, losses)
        elif choice.truth is not None:
            clock = self._clock(choice.truth, KIND_TRUTH, survey.truth, losses)
            feeds.append(OdometryFeed(clock, losses, survey.truth_kind.typename, True, survey.T_truth_base))
        if tf_odometry is not None or tf_truth is not None:
            frames = survey.tf_frames or (None, survey.mountings.base_frame or BASE_FRAMES[0])
            feeds.append(TransformFeed(TF, frames, tf_odometry, tf_truth, losses, survey.T_child_base))
        return feeds

    def _clock(self, topic: str, kind: int, first: FirstMessage | None, losses: Losses) -> TopicClock:
        """The clock of a topic, with what the user says of it."""
        options = self._survey.options
        names = {
            topic.lstrip("/"),
            *(name.lstrip("/") for name in (self._survey.transforms.dynamic if topic == TF else ())),
        }
        offsets = options.offsets_s()
        offset_s = sum(seconds for name, seconds in offsets.items() if name in names)
        shares = first is None or first.shares_log_clock
        return TopicClock(topic, kind, losses, shares, round(offset_s * NANOSECONDS), options.stamps == "log")

    def _routes(self, feeds: Sequence[Feed]) -> dict[int, Route]:
        """The route of each channel that is read, by its key in `_stream`: one for all channels of a feed."""
        routes: dict[int, Route] = {}
        for feed in feeds:
            channels = {
                _key(number, channel.id): (channel, self._survey.decoder(number, channel))
                for number, channel in self._survey.channels(feed.topic, feed.typename)
            }
            routes.update(dict.fromkeys(channels, Route(feed, channels)))
        return routes

    def _stream(self, routes: Iterable[int], losses: Losses) -> Iterator[list[RawMessage]]:
        """Raw messages of all files in the order of the log, with the key of their channel."""
        wanted: dict[int, list[int]] = {}
        for key in routes:
            number, channel = divmod(key, _CHANNELS)
            wanted.setdefault(number, []).append(channel)
        if [*wanted] == [0]:
            return self._containers[0].runs(wanted[0], losses)
        streams = [_keyed(self._containers[number], number, channels, losses) for number, channels in wanted.items()]
        return in_runs(heapq.merge(*streams, key=itemgetter(0)), _CUT_BATCH)

    def map(self) -> OccupancyGrid | None:
        """The last map of /map, or of the only topic with maps."""
        named = self._survey.maps
        if not named or (len(named) > 1 and named[0].rpartition("/")[2] != "map"):
            return None
        grid = None
        for _, message in self._survey.messages(named[0], definitions.OCCUPANCY_GRID):
            grid = message.grid
        return grid

    def initial_pose(self) -> tuple[int, Pose2] | None:
        """The first usable message on /initialpose, else the metadata record `hsloc.initial_pose`."""
        if self._survey.initial_pose is not None:
            return self._survey.initial_pose
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


def _key(number: int, channel: int) -> int:
    return number * _CHANNELS + channel


def _keyed(container: Container, number: int, channels: Sequence[int], losses: Losses) -> Iterator[RawMessage]:
    for log_time, position, channel, data in container.messages(channels, losses):
        yield log_time, position, _key(number, channel), data


def _batches(runs: Iterator[list[RawMessage]], most: int) -> Iterator[list[RawMessage]]:
    """Messages in short lists; a very short one first, for those who want to see the beginning alone."""
    size = min(_FIRST_BATCH, most)
    for run in runs:
        at = 0
        while at < len(run):
            yield run[at : at + size]
            at += size
            size = most


def _by_route(batch: list[RawMessage], routes: Mapping[int, Route]) -> Iterable[tuple[Route, list[int]]]:
    """The places in a batch of the messages of each route, in the order of the log."""
    found: defaultdict[Route, list[int]] = defaultdict(list)
    for place, message in enumerate(batch):
        found[routes[message[2]]].append(place)
    return found.items()


def _added(parts: Iterable[Losses]) -> Losses:
    total = Losses()
    for part in parts:
        total.add(part)
    return total


_FEW = 4
"""Number of messages up to which they are decoded one by one. Internal: time alone, the events are the same."""


class Route:
    """A feed, and the channels that lead to it with their decoders.

    A feed that keeps something from one message to the next (`TransformFeed`) must see them in the order of the log,
    whichever of the topic's channels they come by: each publisher may have its own.
    """

    def __init__(self, feed: Feed, channels: Mapping[int, tuple[Channel, Decoder]]) -> None:
        """The channels by the keys that messages carry."""
        self._feed = feed
        self._decoders = {key: decoder for key, (_, decoder) in channels.items()}
        self._columns: dict[int, ColumnDecoder] = {}
        if isinstance(feed, OdometryFeed):
            found = ((key, column_decoder_for(channel)) for key, (channel, _) in channels.items())
            self._columns = {key: decoder for key, decoder in found if decoder is not None}

    def read(self, messages: Sequence[RawMessage], places: Sequence[int], losses: Losses) -> Sequence[Arrivals]:
        """The events of messages, which have these places in their batch; what cannot be decoded is counted."""
        if self._columns and isinstance(self._feed, OdometryFeed) and len(messages) > _FEW:
            first = messages[0][2]
            decoder = self._columns.get(first)
            if decoder is not None and all(message[2] == first for message in messages):
                columns = decoder([message[3] for message in messages], covariances=not self._feed.is_truth)
                if columns is not None:
                    arrivals = self._feed.arrivals(columns, places, [message[0] for message in messages])
                    if arrivals is not None:
                        return (arrivals,)
        return self._one_by_one(messages, places, losses)

    def _one_by_one(self, messages: Sequence[RawMessage], places: Sequence[int], losses: Losses) -> Sequence[Arrivals]:
        found: dict[TopicClock, list[tuple[int, int, int, Event]]] = {}
        feed, decoders = self._feed, self._decoders
        for place, (log_time, _, key, data) in zip(places, messages, strict=True):
            try:
                message = decoders[key](data)
            except Undecodable as error:
                losses.undecodable_messages[feed.topic] += 1
                losses.note(f"{feed.topic}: a message cannot be decoded ({error})")
                continue
            for clock, event in feed.events(message, log_time):
                found.setdefault(clock, []).append((place, log_time, event.stamp_ns, event))
        return [Arrivals(clock, *zip(*rows, strict=True)) for clock, rows in found.items()]
