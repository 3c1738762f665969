"""Feeds: from a decoded message of a chosen topic to events of the model."""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, isfinite, pi, sin
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from hsloc.log.messages import definitions
from hsloc.log.messages.point_cloud import slice_of
from hsloc.log.range_codes import NoReturnCode
from hsloc.log.session.ordering import Arrivals
from hsloc.log.session.scan_geometry import ScanFixes, ScanSurvey, TurnAssembler
from hsloc.log.session.transform_topics import is_map_frame
from hsloc.log.transforms import Transform3, states_rotation
from hsloc.model import IDENTITY, Heading, Odometry, Pose2, Scan, Truth, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from hsloc.log.messages.cdr_batch_decode import PoseColumns
    from hsloc.log.messages.decode import LinkMessage, OdometryMessage, PoseMessage, ScanMessage
    from hsloc.log.messages.odometry_kind import Motion, OdometryKind
    from hsloc.log.messages.point_cloud import CloudMessage
    from hsloc.log.session.extrinsics import Extrinsics
    from hsloc.log.session.ordering import TopicClock
    from hsloc.log.summary import Losses
    from hsloc.model import Event

    Stamped = tuple[TopicClock, Event]

_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
_LONGEST_S = 1.0
"""A velocity holds for this long (s) at most: publishers that fall silent do so when the robot stands."""
GAP_METRES = 0.3
"""Longest way (m) over which orientations may be missing: headings between are interpolated over it."""
MAX_ABS = 1e7
"""Coordinates beyond (metres) are taken for damage; the Earth's circumference is 4e7."""


class Feed(Protocol):
    """Turns messages into events. What holds no usable values is counted as invalid and gives nothing."""

    @property
    def topic(self) -> str: ...  # noqa: D102
    @property
    def typename(self) -> str: ...  # noqa: D102
    @property
    def clocks(self) -> tuple[TopicClock, ...]: ...  # noqa: D102

    def events(self, message: Any, log_time_ns: int) -> Iterable[Stamped]:
        """The events of one message."""
        ...


def is_usable(pose: Pose2) -> bool:
    """Whether a pose is finite and on this planet."""
    return pose.is_finite() and abs(pose.x) < MAX_ABS and abs(pose.y) < MAX_ABS


class ScanFeed:
    """sensor_msgs/LaserScan to Scan, with the laser's mounting."""

    typename = definitions.LASER_SCAN

    def __init__(
        self,
        clock: TopicClock,
        mountings: Extrinsics,
        losses: Losses,
        deskew: bool = False,
        fixes: ScanFixes | None = None,
        survey: ScanSurvey | None = None,
    ) -> None:
        """With `deskew`, a scan that does not say how long a beam takes gets an even part of its duration.

        `fixes` are overridden fields, `survey` is what the first scans of the topic say.
        """
        self._fixes = ScanFixes() if fixes is None else fixes
        self._survey = ScanSurvey() if survey is None else survey
        # A code that is not proved yet is searched for again: the scans of the survey come again.
        code = self._survey.no_return
        self._code = replace(code) if code.is_known else NoReturnCode()
        self._turns = TurnAssembler(self._survey) if self._survey.segments > 1 else None
        self.topic = clock.topic
        self.clocks = (clock,)
        self._clock = clock
        self._mountings = mountings
        self._losses = losses
        self._deskew = deskew

    def events(self, message: ScanMessage, log_time_ns: int) -> Iterable[Stamped]:
        """One scan; of a segment the turn that it completes, if it does."""
        stamp = self._clock.stamp(message.stamp_ns, log_time_ns)
        if stamp is None:
            return ()
        before_ns = message.stamp_ns
        message = self._fixes.apply(message, self._survey.interval_s)
        stamp += message.stamp_ns - before_ns
        if self._turns is None:
            return self._scan(message, stamp)
        turns = self._turns.add(message._replace(stamp_ns=stamp))
        return [event for turn in turns for event in self._scan(turn, turn.stamp_ns)]

    def _scan(self, message: ScanMessage, stamp: int) -> tuple[Stamped, ...]:
        _, frame, angle_min, increment, time_increment, range_min, range_max, ranges, intensities, *_ = message
        if (
            not (isfinite(angle_min) and isfinite(increment) and range_max > 0.0)
            or abs(angle_min) > 1e3
            or abs(increment) > 1e3
            or (increment == 0.0 and len(ranges) > 2)  # all beams in one direction: no scan of a place
        ):
            self._losses.invalid_messages[self.topic] += 1
            self._losses.note(f"{self.topic}: {_why_unusable(increment, range_max)}")
            return ()
        self._code.learn(ranges, increment, (range_min, range_max))
        ranges = self._code.apply(ranges)
        mounting = self._mountings.of(frame, message.T_frame_laser)
        if mounting.flipped:
            angle_min, increment = -angle_min, -increment
        if not isfinite(time_increment):
            time_increment = 0.0
        if self._deskew and self._survey.sweep_is_wrong and self._survey.interval_s is not None:
            time_increment = self._survey.interval_s * abs(increment) / (2.0 * pi)
        elif self._deskew and time_increment == 0.0 and isfinite(message.scan_time):
            time_increment = message.scan_time / max(len(ranges), 1)
        scan = Scan(
            stamp,
            ranges,
            angle_min,
            increment,
            range_min if isfinite(range_min) else 0.0,
            range_max,
            time_increment,
            mounting.T_base_laser,
            frame,
            intensities,
        )
        return ((self._clock, scan),)


def _why_unusable(increment: float, range_max: float) -> str:
    """Which field makes a scan unusable, and what corrects it."""
    if increment == 0.0:
        return "angle_increment is 0; --scan-fix increment=angles takes that of angle_max, increment=RADIANS any other"
    if not range_max > 0.0:
        return f"range_max is {range_max:g}; --scan-fix range_max=METRES corrects it"
    return "the angles are no numbers; --scan-fix increment=RADIANS overrides the increment"


class CloudFeed:
    """sensor_msgs/PointCloud2 to Scan: what a slice of the cloud shows."""

    typename = definitions.POINT_CLOUD2
    _is_noted = False

    def __init__(self, clock: TopicClock, mountings: Extrinsics, losses: Losses, heights: tuple[float, float]) -> None:
        """`heights` above the base (m) between which points are taken."""
        self.topic = clock.topic
        self.clocks = (clock,)
        self._clock = clock
        self._mountings = mountings
        self._losses = losses
        self._heights = heights

    def events(self, message: CloudMessage, log_time_ns: int) -> Iterable[Stamped]:
        """One scan."""
        stamp = self._clock.stamp(message.stamp_ns, log_time_ns)
        if stamp is None:
            return ()
        T_base_lidar = self._mountings.in_space(message.frame_id)
        found = slice_of(message, T_base_lidar, *self._heights)
        if len(message.points) and not np.isfinite(found.ranges).any():
            self._note_empty(message, T_base_lidar)
        x, y, _ = T_base_lidar.translation
        scan = Scan(
            stamp,
            found.ranges,
            found.angle_min,
            found.angle_increment,
            found.range_min,
            found.range_max,
            0.0,
            Pose2(x, y, 0.0),
            message.frame_id,
        )
        return ((self._clock, scan),)

    def _note_empty(self, message: CloudMessage, T_base_lidar: Transform3) -> None:
        """Say once how high the points are, where none lies in the slice."""
        if self._is_noted:
            return
        self._is_noted = True
        heights = [
            T_base_lidar.rotate(point)[2] for point in message.points[:: max(len(message.points) // 500, 1)].tolist()
        ]
        low, high = (float(value) + T_base_lidar.translation[2] for value in np.nanpercentile(heights, (5, 95)))
        wanted = "{:g} and {:g}".format(*self._heights)
        self._losses.note(
            f"{self.topic}: a cloud has no point between {wanted} m above the base; its points are {low:.2f} to "
            f"{high:.2f} m high: choose others with --slice LOW,HIGH"
        )


class HeadingGaps:
    """Which messages without an orientation to leave out: those near one that had it, as some drivers lose single ones.

    Those farther on are passed on: there the orientation is gone for good.
    """

    def __init__(self) -> None:
        self._at: Pose2 | None = None

    def is_gap(self, pose: Pose2, has_heading: bool) -> bool:
        """Whether to leave out the topic's next message."""
        if has_heading:
            self._at = pose
            return False
        return self._at is not None and hypot(pose.x - self._at.x, pose.y - self._at.y) <= GAP_METRES


class OdometryFeed:
    """Messages with a pose to Odometry, or to Truth; the covariance of all but nav_msgs/Odometry is unknown."""

    def __init__(
        self, clock: TopicClock, losses: Losses, typename: str, is_truth: bool, T_child_base: Pose2 | None = None
    ) -> None:
        """`T_child_base` leads from the frame that the messages speak of to the base, where these differ."""
        self.topic = clock.topic
        self.typename = typename
        self.clocks = (clock,)
        self._clock = clock
        self._losses = losses
        self.is_truth = is_truth
        self._T_child_base = T_child_base
        self._gaps = HeadingGaps()

    def events(self, message: OdometryMessage | PoseMessage, log_time_ns: int) -> Iterable[Stamped]:
        """One pose."""
        stamp = self._clock.stamp(message.stamp_ns, log_time_ns)
        if stamp is None:
            return ()
        pose = message.pose
        has_heading = isfinite(pose.theta) and states_rotation(getattr(message, "quaternion", _NO_ROTATION))
        if not (self.is_truth or isfinite(pose.theta)):
            pose = Pose2(pose.x, pose.y, 0.0)
        if not is_usable(pose):
            self._losses.invalid_messages[self.topic] += 1
            self._losses.note(f"{self.topic}: poses hold NaN or infinity, or are beyond {MAX_ABS:g} m")
            return ()
        place = pose
        pose = pose if self._T_child_base is None else pose @ self._T_child_base
        if self.is_truth:
            return ((self._clock, Truth(stamp, pose)),)
        if not has_heading:
            self._losses.orientations_unset[self.topic] += 1
        if self._gaps.is_gap(place, has_heading):
            return ()
        return ((self._clock, Odometry(stamp, pose, message.covariance, has_heading)),)

    def arrivals(self, columns: PoseColumns, places: Sequence[int], log_times: Sequence[int]) -> Arrivals | None:
        """The events of many messages at once, as `events` gives them; None where one needs a closer look."""
        x, y, theta = columns.x, columns.y, columns.theta
        with np.errstate(invalid="ignore"):
            usable = (np.abs(x) < MAX_ABS) & (np.abs(y) < MAX_ABS) & np.isfinite(theta)
        if not (usable.all() and columns.stamps_ns.all() and columns.has_headings):
            return None
        stamps = list(log_times) if self._clock.by_log else columns.stamps_ns.tolist()
        if self._clock.offset_ns:
            stamps = [stamp + self._clock.offset_ns for stamp in stamps]
        poses: Iterable[Pose2] = map(Pose2, x.tolist(), y.tolist(), theta)
        self._gaps.is_gap(Pose2(float(x[-1]), float(y[-1]), 0.0), has_heading=True)
        T_child_base = self._T_child_base
        if T_child_base is not None:
            poses = [pose @ T_child_base for pose in poses]
        if self.is_truth:
            return Arrivals(self._clock, places, log_times, stamps, list(map(Truth, stamps, poses)))
        events = list(map(Odometry, stamps, poses, columns.covariances))
        return Arrivals(self._clock, places, log_times, stamps, events)


class MotionFeed:
    """Motions of any `OdometryKind`, summed up to Odometry, or to Heading where the kind has no position.

    What runs backwards in time adds nothing.
    """

    def __init__(
        self, clock: TopicClock, losses: Losses, kind: OdometryKind, motion: Motion, T_child_base: Pose2 | None = None
    ) -> None:
        """`T_child_base` as of `OdometryFeed`."""
        self.topic = clock.topic
        self.typename = kind.typename
        self.clocks = (clock,)
        self._clock = clock
        self._losses = losses
        self._has_position = kind.has_position
        self._motion = motion
        self._T_child_base = T_child_base
        self._pose = IDENTITY
        self._last_ns: int | None = None

    def events(self, message: Any, log_time_ns: int) -> Iterable[Stamped]:
        """One pose or heading; messages that are not about the motion give none."""
        if not self._motion.concerns(message):
            return ()
        stamp = self._clock.stamp(message.stamp_ns, log_time_ns)
        if stamp is None:
            return ()
        seconds = 0.0 if self._last_ns is None else (stamp - self._last_ns) / 1e9
        step = self._motion.step(message, seconds if 0.0 < seconds <= _LONGEST_S else 0.0)
        if step is None:
            self._losses.invalid_messages[self.topic] += 1
            return ()
        if self._last_ns is None or not -_LONGEST_S <= seconds < 0.0:  # a clock that was set back starts again
            self._last_ns = stamp
        self._pose = _along_arc(self._pose, *step)
        if not self._has_position:
            return ((self._clock, Heading(stamp, self._pose.theta)),)
        pose = self._pose
        if self._T_child_base is not None:
            pose = self._T_child_base.inverse() @ pose @ self._T_child_base
        return ((self._clock, Odometry(stamp, pose)),)


def _along_arc(pose: Pose2, forwards: float, left: float, turn: float) -> Pose2:
    """A pose after a motion (m, m, rad)."""
    middle = pose.theta + 0.5 * turn
    c, s = cos(middle), sin(middle)
    return Pose2(pose.x + c * forwards - s * left, pose.y + s * forwards + c * left, wrap_angle(pose.theta + turn))


class TransformFeed:
    """tf2_msgs/TFMessage to Odometry (odom -> base) and Truth (map -> odom -> base), as asked for."""

    typename = definitions.TF_MESSAGE

    def __init__(
        self,
        topic: str,
        frames: tuple[str | None, str],
        odometry: TopicClock | None,
        truth: TopicClock | None,
        losses: Losses,
        T_child_base: Pose2 | None = None,
    ) -> None:
        """`frames` are the odometry's (None where the map is the base's parent) and its child's."""
        self.topic = topic
        self.clocks = tuple(clock for clock in (odometry, truth) if clock is not None)
        self._odom_frame, self._base_frame = frames
        self._odometry = odometry
        self._truth = truth
        self._losses = losses
        self._T_child_base = T_child_base
        self._T_map_odom: Transform3 | None = None
        self._gaps = HeadingGaps()

    def events(self, message: list[LinkMessage], log_time_ns: int) -> Iterable[Stamped]:
        """Events of the links that matter."""
        found: list[Stamped] = []
        for link in message:
            if is_map_frame(link.parent) and link.child == self._odom_frame:
                self._T_map_odom = link.transform.normalised()
            elif is_map_frame(link.child) and link.parent == self._odom_frame:  # some localisers publish the inverse
                self._T_map_odom = link.transform.normalised().inverse()
            elif link.child == self._base_frame and (
                is_map_frame(link.parent) if self._odom_frame is None else link.parent == self._odom_frame
            ):
                found += self._base(link, log_time_ns)
        return found

    def _base(self, link: LinkMessage, log_time_ns: int) -> Iterable[Stamped]:
        transform = link.transform.normalised()
        if self._T_child_base is not None:
            transform = transform @ Transform3.from_pose2(self._T_child_base)
        pose = transform.to_pose2()
        if not is_usable(pose):
            self._losses.invalid_messages[self.topic] += 1
            return
        if self._odometry is not None:
            stamp = self._odometry.stamp(link.stamp_ns, log_time_ns)
            if stamp is not None:
                has_heading = states_rotation(link.transform.rotation)
                if not has_heading:
                    self._losses.orientations_unset[self.topic] += 1
                if not self._gaps.is_gap(pose, has_heading):
                    yield self._odometry, Odometry(stamp, pose, None, has_heading)
        if self._truth is None:
            return
        stamp = self._truth.stamp(link.stamp_ns, log_time_ns)
        if stamp is None:
            return
        if self._odom_frame is None:
            yield self._truth, Truth(stamp, pose)
        elif self._T_map_odom is not None:
            T_map_base = (self._T_map_odom @ transform).to_pose2()
            if is_usable(T_map_base):
                yield self._truth, Truth(stamp, T_map_base)
