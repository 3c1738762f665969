"""What a ROS log holds, and what of it is read: found out once, when it is opened."""

from __future__ import annotations

from functools import cached_property
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.log.messages import definitions, foxglove
from hsloc.log.messages.decoders import Undecodable, canonical_type, decoder_for, is_decodable
from hsloc.log.messages.odometry_kinds import POSE_TYPES, kind_among
from hsloc.log.session.extrinsics import Extrinsics, KnownMountings
from hsloc.log.session.scan_geometry import ScanFixes, ScanSurvey, survey
from hsloc.log.session.split_recordings import check_parts
from hsloc.log.session.topic_selection import (
    TF,
    check_offsets,
    choose_maps,
    choose_scans,
    choose_topics,
    has_name,
    is_truth_name,
    names_transforms,
    of_type,
)
from hsloc.log.session.transform_topics import BASE_FRAMES, choose_transforms, is_map_frame
from hsloc.log.summary import LONGEST_OFFSET_S, LaserSummary, LogSummary, Losses, ReadOptions, TopicSummary
from hsloc.model import IDENTITY
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hsloc.log.container import Channel, Container
    from hsloc.log.messages.decoders import Decoder
    from hsloc.log.messages.odometry_kind import OdometryKind
    from hsloc.model import Pose2

CONVERTED = "hsloc.convert"
"""Metadata record of a converted log; `order` = `log` says that the order of the log is the true one."""

_STAMPS_AT_OPENING = 100
_SCANS_AT_OPENING = 60
_SAME_CLOCK_NS = 3600 * 1_000_000_000
_CLOCKS_APART_NS = 5_000_000_000


class FirstMessage(NamedTuple):
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


class LogSession:
    """Topics, their first messages, the laser's mounting, and a summary of it all.

    `active` are the channels that have messages; `T_child_base` leads from the frame that the odometry speaks of to
    the base, where the user named another. Raises as `RosSource`.
    """

    def __init__(self, containers: Sequence[Container], options: ReadOptions) -> None:
        self.containers = containers
        self.options = options
        self._warnings: list[RunWarning] = [warning for container in containers for warning in container.warnings]
        self._decoders: dict[tuple[int, int], Decoder] = {}
        self.active = [
            channel
            for container in containers
            for channel in container.channels.values()
            if (statistics := container.statistics.get(channel.id)) is not None and statistics.count
        ]
        where = str(containers[0].path)
        if len(containers) > 1:
            where += f" and {len(containers) - 1} more"
        scans = choose_scans(where, self.active, options, [])
        self.scan_types = scans
        self.scans = {topic: self._first(topic, kind) for topic, kind in scans.items()}
        frames = [(topic, first.message.frame_id) for topic, first in self.scans.items() if first is not None]
        self.transforms = choose_transforms(
            containers, frames, options.base_frame, names_transforms(self.active, options.odom_topic)
        )
        self._warnings += self.transforms.warnings
        self.tf_frames = self.transforms.odometry
        self.choice = choose_topics(where, self.active, options, self.transforms)
        self._warnings += self.choice.warnings
        odom = self.choice.odom
        transforms = self.transforms.dynamic if TF in (odom, self.choice.truth) else ()
        named = (*scans, *(each for each in (odom, self.choice.truth) if each), *transforms)
        self._warnings += check_offsets(where, self.active, tuple(dict.fromkeys(named)), options)
        self._parts, of_parts = check_parts(
            containers,
            self.choice.scans,
            () if odom is None else self.transforms.dynamic if odom == TF else (odom,),
            self.tf_frames if odom == TF else None,
        )
        self._warnings += of_parts
        self.fixes = ScanFixes.parse(options.scan_fix)
        self.surveys = {topic: self._survey(topic) for topic in scans}
        self.odom_kind = self._kind(self.choice.odom)
        self.odom = self._first(self.choice.odom, self.odom_kind.typename)
        self.truth_kind = self._kind(self.choice.truth)
        self.truth = self._first(self.choice.truth, self.truth_kind.typename)
        assumed = {
            frame for c in containers for frame in c.metadata.get(CONVERTED, {}).get("assumed_mountings", "").split(",")
        }
        known = KnownMountings.of(options, frames)
        self.mountings = Extrinsics(containers, self.transforms, self._base_frame(), options.laser_pose, assumed, known)
        self.T_child_base = self._child_to_base()
        # A truth that speaks of the same frame as the odometry moves with it.
        truth_child = getattr(self.truth.message, "child_frame_id", None) if self.truth is not None else None
        self.T_truth_base = self.T_child_base if truth_child in (self.odometry_child, "") else None
        self.summary = self._summarise()

    def channels(self, topic: str, typename: str | None = None) -> Iterator[tuple[int, Channel]]:
        """(number of the container, channel) of a topic, those that can be decoded."""
        for number, container in enumerate(self.containers):
            for channel in container.channels.values():
                meant = channel.topic in self.transforms.dynamic if topic == TF else has_name(channel, topic)
                if meant and is_decodable(channel):
                    kind = canonical_type(channel.typename)
                    if typename is None or kind == typename:
                        yield number, channel

    def decoder(self, number: int, channel: Channel) -> Decoder:
        """The decoder of a channel of a container; made once. Raises LogFormatError."""
        key = (number, channel.id)
        if key not in self._decoders:
            self._decoders[key] = decoder_for(channel, self._warnings)
        return self._decoders[key]

    def messages(self, topic: str, typename: str | None = None) -> Iterator[tuple[int, Any]]:
        """(log time, message) of one topic, file by file; what cannot be decoded is passed over."""
        chosen: dict[int, dict[int, Decoder]] = {}
        for number, channel in self.channels(topic, typename):
            chosen.setdefault(number, {})[channel.id] = self.decoder(number, channel)
        for number, decoders in chosen.items():
            for log_time, _, channel_id, data in self.containers[number].messages(decoders.keys(), Losses()):
                try:
                    yield log_time, decoders[channel_id](data)
                except Undecodable:
                    continue

    def _first(self, topic: str | None, typename: str | None) -> FirstMessage | None:
        """The first message of a topic; the first one with a stamp, if that is soon."""
        if topic is None or topic == TF:
            return None
        first: FirstMessage | None = None
        for count, (log_time, message) in enumerate(self.messages(topic, typename)):
            stamp = message.stamp_ns
            start, unstamped = (first[3], first[4]) if first is not None else (log_time, stamp == 0 < log_time)
            first = FirstMessage(message, stamp, log_time, start, unstamped)
            if stamp != 0 or count >= _STAMPS_AT_OPENING:
                break
        return first

    def _kind(self, topic: str | None) -> OdometryKind:
        """The kind of odometry that a topic holds; that of poses where it holds none."""
        return kind_among({canonical_type(channel.typename) for _, channel in self.channels(topic)} if topic else ())

    def _survey(self, topic: str) -> ScanSurvey:
        """A look at the first scans of a topic, with what the user overrides."""
        kind = self.scan_types[topic]
        if kind == definitions.POINT_CLOUD2:
            return ScanSurvey()
        first = [message for _, message in islice(self.messages(topic, kind), _SCANS_AT_OPENING)]
        found = survey(first)
        if self.fixes != ScanFixes():
            interval = found.interval_s
            found = survey(self.fixes.apply(message, interval) for message in first)
        self._warnings += [RunWarning(p.code, f"{topic}: {p.text}", p.remedy) for p in found.problems]
        if found.segments > 1:
            self._warnings.append(
                RunWarning(
                    WarningCode.SCAN_SEGMENTS,
                    f"{topic}: a turn comes in {found.segments} segments, which are joined and deskewed",
                    "record the topic of whole turns if the driver has one",
                )
            )
        return found

    @property
    def odometry_child(self) -> str | None:
        """The frame whose pose the odometry gives."""
        if self.odom is not None:
            return str(getattr(self.odom.message, "child_frame_id", "")) or None
        return self.tf_frames[1] if self.choice.odom == TF and self.tf_frames else None

    def _base_frame(self) -> str | None:
        child = self.odometry_child
        if self.options.base_frame is not None or child is not None:
            return self.options.base_frame or child
        return self.tf_frames[1] if self.tf_frames else None

    def _child_to_base(self) -> Pose2 | None:
        """From the frame that the odometry speaks of to the base that the user named, where they differ."""
        child, base = self.odometry_child, self.options.base_frame
        if base is not None:
            self.mountings.require(base, [child, *(f.message.frame_id for f in self.scans.values() if f)])
        if not child or base is None or child == base:
            return None
        transform = self.mountings.between(child, base)
        if transform is None:
            self._warnings.append(
                RunWarning(
                    WarningCode.ODOMETRY_FRAME_ASSUMED,
                    f"no transform from {child}, the odometry's child frame, to {base}: they are assumed to be the "
                    "same",
                )
            )
            return None
        return transform.to_pose2()

    def _summarise(self) -> LogSummary:
        statistics = self._topics()
        lasers = [self._laser(topic, first) for topic, first in self.scans.items() if first is not None]
        if len(lasers) > 1 and self.options.laser_pose is not None:
            self._warnings.append(
                RunWarning(WarningCode.LASER_POSE_SHARED, f"--laser-pose is used for all {len(lasers)} lasers")
            )
        laser = lasers[0] if lasers else LaserSummary("", "", IDENTITY, False, "identity")
        converted = any(c.metadata.get(CONVERTED, {}).get("order") == "log" for c in self.containers)
        self._warn_of_clocks()
        robot = {*BASE_FRAMES, self.odometry_child, *(laser.frame for laser in lasers)}
        grids = of_type(self.active, definitions.OCCUPANCY_GRID)
        self.maps, others, self._map_frames = choose_maps(grids, self.messages, robot)
        self.initial_pose = self.find_initial_pose()
        if others and not self.maps:
            text = "; ".join(f"{topic} {why}" for topic, why in others.items())
            remedy = "give a map with --map"
            self._warnings.append(RunWarning(WarningCode.MAP_IS_COSTMAP, f"{text}: it is not used", remedy))
        starts = [topic.first_ns for topic in statistics if topic.first_ns is not None]
        ends = [topic.last_ns for topic in statistics if topic.last_ns is not None]
        formats = list(dict.fromkeys(container.format for container in self.containers))
        return LogSummary(
            paths=tuple(container.path for container in self.containers),
            format=" + ".join(formats),
            profile=self.containers[0].profile,
            start_ns=min(starts, default=0),
            end_ns=max(ends, default=0),
            origin_ns=self._origin(in_log_time=converted),
            topics=tuple(statistics),
            scan_topic=",".join(self.choice.scans) or None,
            odom_topic=self._odometry_topic() if self.odom_kind.has_position else None,
            heading_topic=None if self.odom_kind.has_position else self.choice.odom,
            truth_topic=self.choice.truth,
            reference_candidates=self._candidates(),
            odom_frame=self._odom_frame(),
            base_frame=self.mountings.base_frame,
            laser_frame=laser.frame if lasers else None,
            T_base_laser=laser.T_base_laser,
            laser_flipped=laser.flipped,
            extrinsics=laser.extrinsics,
            lasers=tuple(lasers),
            parts=self._parts,
            order="log" if converted else "stamp",
            clocks_apart_s=self._clocks_apart_s,
            segments=max((found.segments for found in self.surveys.values()), default=1),
            metadata={name: dict(v) for c in self.containers for name, v in c.metadata.items()},
            warnings=tuple(dict.fromkeys(self._warnings + self.mountings.warnings)),
        )

    def _laser(self, topic: str, first: FirstMessage) -> LaserSummary:
        frame = first.message.frame_id
        extrinsics = self.mountings.found(frame)[1]
        mounting = self.mountings.of(frame, getattr(first.message, "T_frame_laser", None))
        others = self.mountings.alternatives(frame)
        return LaserSummary(topic, frame, mounting.T_base_laser, mounting.flipped, extrinsics, others)

    def _topics(self) -> list[TopicSummary]:
        """Statistics by topic and type, over all files."""
        merged: dict[tuple[str, str, str], list[Any]] = {}
        for container in self.containers:
            for channel in container.channels.values():
                name = channel.typename
                kind = name if name.startswith(foxglove.PREFIX) else canonical_type(name)
                key = (channel.topic, kind, channel.message_encoding)
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
        poses = [topic for topic in of_type(self.active, *POSE_TYPES[1:]) if topic != self.choice.odom]
        truths = [topic for topic in of_type(self.active, definitions.ODOMETRY) if is_truth_name(topic)]
        return tuple(dict.fromkeys(truths + poses + (["tf"] if self.transforms.has_map_to_odometry else [])))

    def _odometry_topic(self) -> str | None:
        """The topic of the odometry, that of the transforms where these are it."""
        if self.choice.odom != TF:
            return self.choice.odom
        return ",".join(sorted(self.transforms.dynamic)) or TF

    def find_initial_pose(self) -> tuple[int, Pose2] | None:
        """(stamp in ns, pose in the map) of the first message on /initialpose that can be used.

        RViz publishes the pose in its fixed frame: one in the odometry's frame is moved to the map where a transform
        says how, and is left out otherwise.
        """
        topic = definitions.POSE_WITH_COVARIANCE_STAMPED
        names = [t for t in of_type(self.active, topic) if t.strip("/").rpartition("/")[2] == "initialpose"]
        for name in names[:1]:
            for log_time, message in self.messages(name, topic):
                frame, stamp = message.frame_id, message.stamp_ns or log_time
                if not frame or is_map_frame(frame) or frame in self._map_frames:
                    return stamp, message.pose
                T_map_frame = self._map_to(frame, log_time)
                if T_map_frame is not None:
                    return stamp, T_map_frame @ message.pose
                self._warnings.append(
                    RunWarning(
                        WarningCode.START_FRAME,
                        f"{name} gives a pose in the frame {frame}, not in the map's, and no transform leads there: it "
                        "is not used",
                        "give the start with --initial-pose x,y,yaw",
                    )
                )
        return None

    def _map_to(self, frame: str, log_time_ns: int) -> Pose2 | None:
        """T_map_frame as it was last published before a time of the log."""
        found = None
        for log_time, links in self.messages(TF, definitions.TF_MESSAGE):
            if log_time > log_time_ns and found is not None:
                break
            for link in links:
                if (is_map_frame(link.parent) or link.parent in self._map_frames) and link.child == frame:
                    found = link.transform.normalised().to_pose2()
        return found

    def _odom_frame(self) -> str | None:
        if self.odom is not None:
            return self.odom.message.frame_id or None
        return self.tf_frames[0] if self.choice.odom == TF and self.tf_frames else None

    def _origin(self, in_log_time: bool) -> int:
        """The first effective stamp."""
        firsts = [first for first in (*self.scans.values(), self.odom) if first is not None]
        stamps = [first.start_log_ns if in_log_time else first.origin_ns for first in firsts]
        if self._first_link is not None:
            log_time, stamp = self._first_link
            stamps.append(log_time if in_log_time or not stamp else stamp)
        if not stamps and self.truth is not None:
            stamps.append(self.truth.start_log_ns if in_log_time else self.truth.origin_ns)
        return min(stamps, default=0)

    @cached_property
    def _first_link(self) -> tuple[int, int] | None:
        """(log time, stamp) of the first transform that is odometry, where transforms are."""
        for log_time, message in self.messages(TF, definitions.TF_MESSAGE) if self.choice.odom == TF else ():
            for link in message:
                if (link.parent, link.child) == self.tf_frames:
                    return log_time, link.stamp_ns
        return None

    def _warn_of_clocks(self) -> None:
        self._clocks_apart_s = 0.0
        odom = self._first_link if self.odom is None else (self.odom.log_time_ns, self.odom.stamp_ns)
        if odom is None or not odom[1] or self.options.stamps == "log":
            return
        for topic, first in self.scans.items():
            if first is None or not first.stamp_ns:
                continue
            stamps, log_times = first.stamp_ns - odom[1], first.log_time_ns - odom[0]
            if abs(stamps) < _SAME_CLOCK_NS < abs(log_times):  # It is the log's times that are wrong.
                continue
            apart = stamps - log_times
            if abs(apart) / 1e9 > abs(self._clocks_apart_s):
                self._clocks_apart_s = apart / 1e9
            if abs(apart) > _CLOCKS_APART_NS:
                self._warnings.append(
                    RunWarning(
                        WarningCode.CLOCKS_APART,
                        f"the stamps of {topic} and {self.choice.odom} are {apart / 1e9:.1f} s apart, measured by the "
                        "log's clock: they may come from different clocks",
                        "try --time-offset auto, or --stamps log"
                        if abs(apart) <= LONGEST_OFFSET_S * 1e9
                        else "--stamps log takes the times at which messages were recorded",
                    )
                )
