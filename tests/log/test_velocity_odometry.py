"""Odometry from velocities and wheels, for logs that have none."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from log_builders import SECOND, START, make_scan
from log_formats import ROS2, messages, write
from mcap.records import Channel, Schema

from hsloc.errors import ConfigError, TopicError
from hsloc.log import LogWriter, ReadOptions, open_log
from hsloc.log.messages import definitions
from hsloc.log.messages.velocities import VelocityMessage
from hsloc.log.session.ordering import KIND_ODOMETRY, TopicClock
from hsloc.log.session.velocity_odometry import VelocityFeed, wheels_of
from hsloc.log.summary import Losses
from hsloc.model import Odometry

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from log_formats import Message

KINDS = ROS2.types
FORWARDS, TURN, RADIUS, TRACK = 0.5, 0.25, 0.1, 0.4
"""A circle of 2 m at 0.5 m/s."""


def header(stamp: int) -> Any:
    return KINDS["std_msgs/msg/Header"](
        KINDS["builtin_interfaces/msg/Time"](stamp // SECOND, stamp % SECOND), "base_link"
    )


def twist() -> Any:
    vector = KINDS["geometry_msgs/msg/Vector3"]
    return KINDS[definitions.TWIST](vector(FORWARDS, 0.0, 0.0), vector(0.0, 0.0, TURN))


def velocity(name: str, stamp: int) -> Any:
    if name == definitions.TWIST:
        return twist()
    if name == definitions.TWIST_STAMPED:
        return KINDS[name](header(stamp), twist())
    covariance = KINDS["geometry_msgs/msg/TwistWithCovariance"](twist(), np.zeros(36))
    return KINDS[name](header(stamp), covariance)


def joints(stamp: int, by_position: bool) -> Any:
    speeds = np.array([(FORWARDS - 0.5 * TURN * TRACK) / RADIUS, 9.0, (FORWARDS + 0.5 * TURN * TRACK) / RADIUS])
    angles = (speeds * (stamp - START) / SECOND + pi) % (2.0 * pi) - pi
    none = np.zeros(0)
    names = ["wheel_left_joint", "arm", "wheel_right_joint"]
    values = (angles, none, none) if by_position else (none, speeds, none)
    return KINDS[definitions.JOINT_STATE](header(stamp), names, *values)


def write_log(path: Path, topic: str, typename: str, by_position: bool = True, text: bool = True) -> Path:
    """Two seconds of scans and of the topic at 20 Hz."""
    scans = path.with_suffix(".scans")
    with LogWriter(scans) as log:
        for k in range(20):
            log.scan(make_scan(START + k * SECOND // 10))

    def items() -> Iterator[Message]:
        schema = Schema(
            id=0,
            name=typename,
            encoding="ros2msg" if text else "",
            data=definitions.definition_text(typename).encode() if text else b"",
        )
        channel = Channel(id=0, topic=topic, message_encoding="cdr", metadata={}, schema_id=0)
        is_joints = typename == definitions.JOINT_STATE
        for k in range(41):
            stamp = START + k * SECOND // 20
            content = joints(stamp, by_position) if is_joints else velocity(typename, stamp)
            yield schema, channel, stamp, bytes(ROS2.serialize_cdr(content, typename))
        yield from messages(scans)

    return write(path, items())


def assert_circle(path: Path, options: ReadOptions) -> None:
    log = open_log(path, options)
    for _ in range(2):  # again from the start
        poses = [event.T_odom_base for event in log.events() if isinstance(event, Odometry)]
        assert len(poses) == 41
        np.testing.assert_allclose(poses[-1].to_array(), (2.0 * np.sin(0.5), 2.0 - 2.0 * np.cos(0.5), 0.5), atol=1e-3)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("typename", definitions.VELOCITY_TYPES)
def test_velocities_are_summed_up(tmp_path: Path, typename: str, text: bool) -> None:
    path = write_log(tmp_path / "run.mcap", "/velocity", typename, text=text)
    assert_circle(path, ReadOptions(odom_topic="/velocity"))


@pytest.mark.parametrize(
    ("seconds", "metres"),
    [
        ((1.0, 1.1, 1.05, 1.15), 0.15),  # one message is late
        ((5.0, 5.1, 1.0, 1.1), 0.2),  # the clock was set back
    ],
)
def test_time_that_runs_backwards_is_counted_once(seconds: tuple[float, ...], metres: float) -> None:
    losses = Losses()
    feed = VelocityFeed(TopicClock("/velocity", KIND_ODOMETRY, losses), losses, definitions.TWIST_STAMPED)
    poses = []
    for second in seconds:
        stamp = round(second * SECOND)
        ((_, event),) = feed.events(VelocityMessage(stamp, "odom", "base_link", 1.0, 0.0, 0.0), stamp)
        assert isinstance(event, Odometry)
        poses.append(event.T_odom_base.x)
    assert poses[-1] == pytest.approx(metres)


def test_measured_velocities_are_used_where_there_is_no_odometry_and_named(tmp_path: Path) -> None:
    log = write_log(tmp_path / "run.mcap", "/wheel_twist", definitions.TWIST_STAMPED)
    assert_circle(log, ReadOptions())
    assert "odometry_from_velocities" in [warning.code for warning in open_log(log).summary.warnings]
    with pytest.raises(TopicError, match="--no-odom"):
        open_log(write_log(tmp_path / "cmd.mcap", "/cmd_vel", definitions.TWIST_STAMPED))


@pytest.mark.parametrize("by_position", [True, False])
def test_wheels_are_summed_up_where_their_size_is_known(tmp_path: Path, by_position: bool) -> None:
    path = write_log(tmp_path / "run.mcap", "/joint_states", definitions.JOINT_STATE, by_position)
    assert_circle(path, ReadOptions(wheels=f"{RADIUS},{TRACK}"))
    for options in (ReadOptions(), ReadOptions(odom_topic="/joint_states")):
        with pytest.raises(TopicError, match="--wheels RADIUS,TRACK"):
            open_log(path, options)


@pytest.mark.parametrize("text", ["1", "0,1", "a,b", "1,2,3", "nan,1", "-1,1"])
def test_wheels_that_are_none(text: str) -> None:
    with pytest.raises(ConfigError, match="RADIUS,TRACK"):
        ReadOptions(wheels=text)


@pytest.mark.parametrize(
    ("names", "sides"),
    [
        (("left_wheel", "right_wheel"), ([0], [1])),
        (("wheel_r", "wheel_l"), ([1], [0])),
        (("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel"), ([0, 1], [2, 3])),
        (("caster_wheel_left", "arm"), None),
    ],
)
def test_the_sides_of_wheels_by_their_names(names: tuple[str, ...], sides: Any) -> None:
    assert wheels_of(names) == sides
