"""Odometry from velocities or wheel angles, summed up: for logs that have no odometry of their own."""

from __future__ import annotations

import re
from math import cos, isfinite, sin
from typing import TYPE_CHECKING

from hsloc.log.messages import definitions
from hsloc.model import IDENTITY, Odometry, Pose2, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hsloc.log.messages.velocities import JointsMessage, VelocityMessage
    from hsloc.log.session.event_builders import Stamped
    from hsloc.log.session.ordering import TopicClock
    from hsloc.log.summary import Losses

_LONGEST_S = 1.0
"""A velocity holds for so long (s) at most: publishers that fall silent do so when the robot stands."""
_LEFT = re.compile(r"(^|[_/.])(left|l|lt)([_/.]|$)|left")
_RIGHT = re.compile(r"(^|[_/.])(right|r|rt)([_/.]|$)|right")


class _Sum:
    """A pose that motions are added to, all of them sound; what runs backwards in time adds nothing."""

    def __init__(self, clock: TopicClock, losses: Losses, T_child_base: Pose2 | None) -> None:
        self.topic = clock.topic
        self.clocks = (clock,)
        self._clock = clock
        self._losses = losses
        self._T_child_base = T_child_base
        self._pose = IDENTITY
        self._last_ns: int | None = None

    def _seconds(self, stamp: int) -> float:
        """Since the latest stamp; 0 where that is not known, too long ago, or still to come."""
        seconds = 0.0 if self._last_ns is None else (stamp - self._last_ns) / 1e9
        if self._last_ns is None or not -_LONGEST_S <= seconds < 0.0:  # a clock that was set back starts anew
            self._last_ns = stamp
        return seconds if 0.0 < seconds <= _LONGEST_S else 0.0

    def _moved(self, stamp: int, forwards: float, left: float, turn: float) -> tuple[Stamped, ...]:
        """Add a motion (m, m, rad) along an arc; the odometry then."""
        middle = self._pose.theta + 0.5 * turn
        c, s = cos(middle), sin(middle)
        x, y = self._pose.x + c * forwards - s * left, self._pose.y + s * forwards + c * left
        self._pose = Pose2(x, y, wrap_angle(self._pose.theta + turn))
        pose = self._pose
        if self._T_child_base is not None:
            pose = self._T_child_base.inverse() @ pose @ self._T_child_base
        return ((self._clock, Odometry(stamp, pose)),)


class VelocityFeed(_Sum):
    """geometry_msgs/TwistStamped and Twist to Odometry: each velocity and the one before, averaged over their time."""

    def __init__(self, clock: TopicClock, losses: Losses, typename: str, T_child_base: Pose2 | None = None) -> None:
        """As `OdometryFeed`."""
        super().__init__(clock, losses, T_child_base)
        self.typename = typename
        self._before: tuple[float, float, float] | None = None

    def events(self, message: VelocityMessage, log_time_ns: int) -> Iterable[Stamped]:
        """One pose."""
        stamp = self._clock.stamp(message.stamp_ns, log_time_ns)
        if stamp is None:
            return ()
        if not message.is_usable:
            self._losses.invalid_messages[self.topic] += 1
            return ()
        now = message.forwards, message.left, message.turn
        before = now if self._before is None else self._before
        self._before = now
        half = 0.5 * self._seconds(stamp)
        forwards, left, turn = (half * (a + b) for a, b in zip(before, now, strict=True))
        return self._moved(stamp, forwards, left, turn)


class WheelFeed(_Sum):
    """sensor_msgs/JointState to Odometry of a differential drive: the angles of its wheels, or their velocities."""

    typename = definitions.JOINT_STATE

    def __init__(
        self, clock: TopicClock, losses: Losses, wheels: tuple[float, float], T_child_base: Pose2 | None = None
    ) -> None:
        """`wheels` are their radius and the track (m)."""
        super().__init__(clock, losses, T_child_base)
        self._radius, self._track = wheels
        self._before: tuple[float, float] | None = None

    def events(self, message: JointsMessage, log_time_ns: int) -> Iterable[Stamped]:
        """One pose; messages of other joints alone give none."""
        sides = wheels_of(message.names)
        if sides is None:
            return ()
        stamp = self._clock.stamp(message.stamp_ns, log_time_ns)
        if stamp is None:
            return ()
        count = len(message.names)
        values = message.positions if len(message.positions) == count else message.velocities
        if len(values) != count or not all(isfinite(values[k]) for side in sides for k in side):
            self._losses.invalid_messages[self.topic] += 1
            return ()
        left, right = (sum(values[k] for k in side) / len(side) for side in sides)
        seconds = self._seconds(stamp)
        if values is message.positions:
            before = (left, right) if self._before is None else self._before
            self._before = left, right
            # Some drivers give angles within one turn; none gives less than two messages for half a turn.
            left, right = wrap_angle(left - before[0]), wrap_angle(right - before[1])
        else:
            left, right = left * seconds, right * seconds
        return self._moved(stamp, 0.5 * self._radius * (left + right), 0.0, self._radius * (right - left) / self._track)


def wheels_of(names: tuple[str, ...]) -> tuple[list[int], list[int]] | None:
    """The joints of the left and of the right wheels, by their names; None where one side has none."""
    wheels = [k for k, name in enumerate(names) if "wheel" in name.lower() and "caster" not in name.lower()]
    left = [k for k in wheels if _LEFT.search(names[k].lower())]
    right = [k for k in wheels if _RIGHT.search(names[k].lower()) and k not in left]
    return (left, right) if left and right else None
