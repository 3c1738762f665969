"""ROS logs: from containers of messages to events."""

from __future__ import annotations

import heapq
from operator import itemgetter
from typing import TYPE_CHECKING

from hsloc.log import definitions
from hsloc.log.decoders import Undecodable, canonical_type, is_decodable
from hsloc.log.feeds import OdometryFeed, PoseFeed, ScanFeed, TransformFeed
from hsloc.log.frames import BASE_FRAMES
from hsloc.log.ordering import KIND_ODOMETRY, KIND_SCAN, KIND_TRUTH, Reorder, TopicClock
from hsloc.log.ros_survey import First, Survey
from hsloc.log.source import Observation
from hsloc.log.summary import Losses
from hsloc.log.topics import TF, of_type
from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from hsloc.log.container import Container
    from hsloc.log.decoders import Decoder
    from hsloc.log.feeds import Feed
    from hsloc.log.summary import ReadOptions
    from hsloc.model import Event, OccupancyGrid

INITIAL_POSE = "hsloc.initial_pose"
"""Metadata record with x, y, theta (m, m, rad) and, if it is not the first stamp, stamp_ns."""


class RosSource:
    """Events of a recording that may be split into several files.

    Raises TopicError where the topics cannot be chosen, LogFormatError where a chosen one cannot be decoded.
    """

    def __init__(self, containers: Sequence[Container], options: ReadOptions) -> None:
        self._containers = containers
        self._survey = Survey(containers, options)
        self.summary = self._survey.summary
        self.losses_at_opening = _added(container.losses_at_opening for container in containers)

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

    def observations(self, losses: Losses) -> Iterator[Observation]:
        """As `Source.observations`."""
        kinds = (definitions.LASER_SCAN, definitions.ODOMETRY, definitions.TF_MESSAGE)
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
            tf_odometry = _clock(TF, KIND_ODOMETRY, None, losses)
        elif choice.odom is not None:
            clock = _clock(choice.odom, KIND_ODOMETRY, survey.odom, losses)
            feeds.append(_pose_feed(clock, losses, survey.odom_type, False, survey.T_child_base))
        for topic, first in survey.scans.items():
            clock = _clock(topic, KIND_SCAN, first, losses)
            feeds.append(ScanFeed(clock, survey.mountings, losses, survey.options.deskew))
        if choice.truth == TF:
            tf_truth = _clock(TF, KIND_TRUTH, None, losses)
        elif choice.truth is not None:
            clock = _clock(choice.truth, KIND_TRUTH, survey.truth, losses)
            feeds.append(_pose_feed(clock, losses, survey.truth_type, True, survey.T_truth_base))
        if tf_odometry is not None or tf_truth is not None:
            frames = survey.tf_frames or (None, survey.mountings.base_frame or BASE_FRAMES[0])
            feeds.append(TransformFeed(TF, frames, tf_odometry, tf_truth, losses, survey.T_child_base))
        return feeds

    def _stream(
        self, feeds: Sequence[Feed], losses: Losses
    ) -> Iterator[tuple[int, tuple[Feed, Decoder], memoryview | bytes]]:
        """Raw messages of all files in the order of the log, each with its feed and decoder."""
        routes: list[dict[int, tuple[Feed, Decoder]]] = [{} for _ in self._containers]
        for feed in feeds:
            for number, channel in self._survey.channels(feed.topic, feed.typename):
                routes[number][channel.id] = (feed, self._survey.decoder(number, channel))
        streams = [
            _routed(container, routes[number], losses)
            for number, container in enumerate(self._containers)
            if routes[number]
        ]
        return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=itemgetter(0))

    def map(self) -> OccupancyGrid | None:
        """The last map of /map, or of the only topic with maps."""
        topics = of_type(self._survey.active, definitions.OCCUPANCY_GRID)
        named = [t for t in topics if t.lstrip("/") == "map"] or [t for t in topics if t.endswith("/map")] or topics
        if not named or (len(named) > 1 and len(topics) > 1):
            return None
        grid = None
        for _, message in self._survey.messages(named[0], definitions.OCCUPANCY_GRID):
            grid = message.grid
        return grid

    def initial_pose(self) -> tuple[int, Pose2] | None:
        """The first message on /initialpose, else the metadata record `hsloc.initial_pose`."""
        for log_time, message in self._survey.messages("/initialpose", definitions.POSE_WITH_COVARIANCE_STAMPED):
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


def _routed(
    container: Container, routes: dict[int, tuple[Feed, Decoder]], losses: Losses
) -> Iterator[tuple[int, tuple[Feed, Decoder], memoryview | bytes]]:
    for log_time, _, channel, data in container.messages(routes.keys(), losses):
        yield log_time, routes[channel], data


def _pose_feed(
    clock: TopicClock, losses: Losses, typename: str, is_truth: bool, T_child_base: Pose2 | None
) -> OdometryFeed:
    if typename == definitions.ODOMETRY:
        return OdometryFeed(clock, losses, is_truth, T_child_base)
    return PoseFeed(clock, losses, typename, is_truth, T_child_base)


def _clock(topic: str, kind: int, first: First | None, losses: Losses) -> TopicClock:
    return TopicClock(topic, kind, losses, first is None or first.shares_log_clock)


def _added(parts: Iterable[Losses]) -> Losses:
    total = Losses()
    for part in parts:
        total.add(part)
    return total
