"""Odometry from velocities, wheels and inertial measurement units, for logs that have none."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from log_builders import SECOND, START, make_scan
from log_formats import ROS2, messages, write
from mcap.records import Channel, Schema

from hsloc.errors import ConfigError, TopicError
from hsloc.log import LogWriter, ReadOptions, convert_log, open_log
from hsloc.log.messages import definitions, odometry_kinds
from hsloc.log.messages.odometry_kinds import ImuMessage, ImuMotion, VelocityMessage, wheels_of
from hsloc.log.session.event_builders import MotionFeed
from hsloc.log.session.ordering import KIND_ODOMETRY, TopicClock
from hsloc.log.summary import Losses
from hsloc.log.transforms import Transform3
from hsloc.model import Heading, Odometry, Pose2

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


def imu(stamp: int) -> Any:
    vector, none = KINDS["geometry_msgs/msg/Vector3"], np.zeros(9)
    rates, unset = vector(0.0, 0.0, TURN), KINDS["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 0.0)
    return KINDS[definitions.IMU](header(stamp), unset, none, rates, none, vector(0.0, 0.0, 9.81), none)


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
        is_joints, is_imu = (typename == each for each in (definitions.JOINT_STATE, definitions.IMU))
        for k in range(41):
            stamp = START + k * SECOND // 20
            content = joints(stamp, by_position) if is_joints else imu(stamp) if is_imu else velocity(typename, stamp)
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
@pytest.mark.parametrize("typename", [kind.typename for kind in odometry_kinds.VELOCITY_KINDS])
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
    kind = odometry_kinds.VELOCITY_KINDS[0]
    clock = TopicClock("/velocity", KIND_ODOMETRY, losses)
    feed = MotionFeed(clock, losses, kind, odometry_kinds.VelocityMotion())
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
    with pytest.raises(TopicError, match=r"--no-odom; or velocities, .* not commanded: --odom-topic /cmd_vel"):
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


@pytest.mark.parametrize("text", [True, False])
def test_an_imu_gives_headings_where_there_is_no_odometry_and_conversion_keeps_them(tmp_path: Path, text: bool) -> None:
    log = open_log(write_log(tmp_path / "run.mcap", "/imu/data", definitions.IMU, text=text))
    assert (log.summary.odom_topic, log.summary.heading_topic) == (None, "/imu/data")
    assert any("rotations are predicted by /imu/data" in str(warning) for warning in log.summary.warnings)
    convert_log(log, tmp_path / "converted.mcap")
    for each in (log, open_log(tmp_path / "converted.mcap")):
        headings = [event for event in each.events() if isinstance(event, Heading)]
        assert not any(isinstance(event, Odometry) for event in each.events())
        assert len(headings) == 41
        assert headings[-1].theta - headings[0].theta == pytest.approx(2.0 * TURN)


def test_odometry_counts_before_an_imu(tmp_path: Path) -> None:
    parts = [write_log(tmp_path / "a.mcap", "/imu", definitions.IMU)]
    with LogWriter(tmp_path / "b.mcap") as log:
        for k in range(20):
            log.odometry(START + k * SECOND // 10, Pose2(0.1 * k, 0.0, 0.0))
    summary = open_log([*parts, tmp_path / "b.mcap"]).summary
    assert (summary.odom_topic, summary.heading_topic) == ("/odom", None)


UPSIDE_DOWN = Transform3(rotation=(1.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("rates", "orientation", "mounting", "turn"),
    [
        ((0.0, 0.0, 0.3), None, Transform3(), 0.03),
        ((0.0, 0.0, 0.3), None, UPSIDE_DOWN, -0.03),
        ((0.0, 0.3, 0.0), None, Transform3(rotation=(0.5**0.5, 0.0, 0.0, 0.5**0.5)), 0.03),  # lies on its side
        ((0.0, 0.0, 0.0), (0.0, 0.0, np.sin(0.05), np.cos(0.05)), Transform3(), 0.1),  # a silent gyroscope
        (None, (0.0, 0.0, np.sin(0.05), np.cos(0.05)), UPSIDE_DOWN, 0.1),
        (None, None, Transform3(), None),
        ((np.nan, 0.0, 0.1), None, Transform3(), None),
    ],
)
def test_the_heading_of_an_imu(rates: Any, orientation: Any, mounting: Transform3, turn: float | None) -> None:
    motion = ImuMotion(lambda _: mounting)
    start = None if orientation is None else (0.0, 0.0, 0.0, 1.0)
    motion.step(ImuMessage(1, "odom", "", "imu", rates, start), 0.0)
    step = motion.step(ImuMessage(2, "odom", "", "imu", rates, orientation), 0.1)
    assert step is None if turn is None else step == pytest.approx((0.0, 0.0, turn))
