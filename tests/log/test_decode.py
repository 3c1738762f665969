"""Hand-made decoders against rosbags, and which of the two a channel gets."""

from __future__ import annotations

from contextlib import suppress
from math import inf
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_builders import START, make_scan
from memory import at_most_bytes
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hsloc.errors import LogFormatError
from hsloc.log.container import Channel
from hsloc.log.messages import decode, definitions, encode
from hsloc.log.messages.decoders import FROM_OBJECT, Undecodable, decoder_for, is_decodable, is_known
from hsloc.log.session.scan_geometry import ScanFixes
from hsloc.log.transforms import Transform3
from hsloc.model import OccupancyGrid, Pose2

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
COVARIANCE = np.array([[0.1, 0.01, 0.02], [0.01, 0.2, 0.03], [0.02, 0.03, 0.3]])
POSE = Pose2(1.5, -2.5, 0.75)
GRID = OccupancyGrid(np.arange(-1, 11, dtype=np.int8).reshape(3, 4), 0.05, Pose2(-3, 4, 0.25))
LINKS: list[tuple[str, str, Pose2 | Transform3]] = [
    ("odom", "base_link", POSE),
    ("/base_link", "laser", Transform3((1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0))),
]


def payloads(frame: str, child: str) -> dict[str, bytes]:
    return {
        definitions.LASER_SCAN: encode.laser_scan(make_scan(START), frame, 0.1),
        definitions.ODOMETRY: encode.odometry(START, POSE, COVARIANCE, (1, 0, 2), (frame, child)),
        definitions.TF_MESSAGE: encode.transforms(START, [*LINKS, (frame, child, POSE)]),
        definitions.OCCUPANCY_GRID: encode.occupancy_grid(GRID, START, frame),
        definitions.MULTI_ECHO_LASER_SCAN: multi_echo(frame),
        definitions.POSE_STAMPED: encode.pose_stamped(START, POSE, frame),
        definitions.POSE_WITH_COVARIANCE_STAMPED: encode.pose_with_covariance_stamped(START, POSE, COVARIANCE, frame),
    }


def multi_echo(frame: str, intensities: tuple[list[float], ...] = ()) -> bytes:
    """A scan of which some beams have no echo, and some several."""
    kinds = ROS2.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](START // 10**9, 5), frame)
    echoes = [np.array(values, dtype=np.float32) for values in ([1.5], [], [2.5, 3.5], [4.0])]
    beams = [kinds["sensor_msgs/msg/LaserEcho"](values) for values in echoes]
    strengths = [kinds["sensor_msgs/msg/LaserEcho"](np.array(values, dtype=np.float32)) for values in intensities]
    name = definitions.MULTI_ECHO_LASER_SCAN
    message = kinds[name](header, -1.0, 1.0, 0.5, 0.0, 0.1, 0.05, 12.0, beams, strengths)
    return bytes(ROS2.serialize_cdr(message, name))


def plain(value: Any) -> Any:
    """Something that `==` compares by value."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, repr(value.tolist())
    if isinstance(value, OccupancyGrid):
        return plain(value.cells), value.resolution, value.origin
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    return value


@pytest.mark.parametrize("frame", ["", "m", "map", "odom", "laser", "/base_link"])
@pytest.mark.parametrize("child", ["", "base", "base_link"])
def test_by_hand_and_by_rosbags_give_the_same(frame: str, child: str) -> None:
    for name, data in payloads(frame, child).items():
        by_hand = decode.BY_HAND[name](memoryview(data))
        by_object = FROM_OBJECT[name](ROS2.deserialize_cdr(data, name))
        assert plain(by_hand) == plain(by_object), name


def test_values_come_out_as_they_went_in() -> None:
    data = payloads("/laser", "/base_link")
    scan = decode.laser_scan(data[definitions.LASER_SCAN])
    assert (scan.stamp_ns, scan.frame_id) == (START, "laser")
    assert (scan.angle_min, scan.angle_increment, scan.range_max) == (-1.0, 0.25, 12.0)
    np.testing.assert_array_equal(scan.ranges, make_scan(START).ranges)
    assert scan.intensities is None
    odometry = decode.odometry(data[definitions.ODOMETRY])
    assert (odometry.frame_id, odometry.child_frame_id) == ("laser", "base_link")
    np.testing.assert_allclose(odometry.pose.to_array(), POSE.to_array(), atol=1e-15)
    assert odometry.covariance is not None
    np.testing.assert_array_equal(odometry.covariance, COVARIANCE)
    assert not odometry.covariance.flags.writeable
    link = decode.transforms(data[definitions.TF_MESSAGE])[1]
    assert (link.parent, link.child, link.transform) == ("base_link", "laser", LINKS[1][2])
    grid = decode.occupancy_grid(data[definitions.OCCUPANCY_GRID]).grid
    np.testing.assert_array_equal(grid.cells, GRID.cells)
    assert grid.resolution == 0.05
    np.testing.assert_allclose(grid.origin.to_array(), GRID.origin.to_array(), atol=1e-15)


def test_a_covariance_of_zeros_is_unknown() -> None:
    data = encode.odometry(START, POSE, None, (0, 0, 0), ("odom", "base"))
    assert decode.odometry(data).covariance is None


def test_ranges_do_not_keep_the_chunk_alive() -> None:
    chunk = bytearray(payloads("laser", "")[definitions.LASER_SCAN])
    scan = decode.laser_scan(memoryview(chunk))
    before = scan.ranges.copy()
    chunk[:] = bytes(len(chunk))
    np.testing.assert_array_equal(scan.ranges, before)


@settings(max_examples=300)
@given(data=st.data())
def test_damaged_payloads_raise_bad_payload_or_give_a_value(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(decode.BY_HAND)))
    payload = bytearray(payloads("laser", "base_link")[name])
    for _ in range(data.draw(st.integers(0, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    payload = payload[: data.draw(st.integers(0, len(payload)))]
    decoder = decoder_for(channel(name))
    with at_most_bytes(1 << 20), suppress(Undecodable):
        decoder(memoryview(bytes(payload)))


def test_every_cut_of_a_payload_is_detected() -> None:
    for name, data in payloads("laser", "base_link").items():
        decoder = decoder_for(channel(name))
        needed = {definitions.ODOMETRY: 48 + 288 + 48 + 8, definitions.POSE_WITH_COVARIANCE_STAMPED: 288}
        for size in range(len(data) - needed.get(name, 0)):
            with pytest.raises(Undecodable):
                decoder(data[:size])


# Which decoder


def channel(name: str, text: str | None = None, encoding: str = "ros2msg", message: str = "cdr") -> Channel:
    text = definitions.definition_text(name) if text is None else text
    return Channel(1, "/topic", name, message, encoding, text.encode())


COMMENTED = """# Single scan from a planar laser range-finder
#
# If you have another ranging device with different behavior (e.g. a sonar
# array), please find or create a different message.

std_msgs/Header header # timestamp in the header is the acquisition time of
                             # the first ray in the scan.
float32 angle_min            # start angle of the scan [rad]
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max

float32[] ranges             # range data [m]
float32[] intensities

================================================================================
MSG: std_msgs/msg/Header
# Standard metadata for higher-level stamped data types.
builtin_interfaces/Time stamp
string frame_id

================================================================================
MSG: builtin_interfaces/msg/Time
int32 sec
uint32 nanosec
"""


def test_definitions_as_recorders_write_them_are_known() -> None:
    assert is_known(COMMENTED, definitions.LASER_SCAN)
    for name in definitions.KNOWN_TYPES:
        assert is_known(definitions.definition_text(name), name)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("float32 scan_time", "float64 scan_time"),
        ("float32 scan_time\n", ""),
        ("float32[] intensities", "float32[] intensities\nuint8 flags"),
        ("uint32 nanosec", "uint32 nsec"),
        ("float32[] ranges ", "float32[<=720] ranges"),
        ("std_msgs/Header header", "my_msgs/Header header"),
    ],
)
def test_a_definition_that_differs_in_a_field_is_not_known(old: str, new: str) -> None:
    assert old in COMMENTED
    assert not is_known(COMMENTED.replace(old, new), definitions.LASER_SCAN)


def test_a_changed_definition_is_decoded_by_that_of_the_log() -> None:
    text = COMMENTED.replace("float32 scan_time", "float64 scan_time\nuint8[3] flags").replace(
        "float32[] intensities", "float32[] intensities\nstring note"
    )
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, definitions.LASER_SCAN))
    types = store.types
    message = types["sensor_msgs/msg/LaserScan"](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=5, nanosec=7), frame_id="/laser"
        ),
        angle_min=-1.0,
        angle_max=1.0,
        angle_increment=0.5,
        time_increment=0.0,
        scan_time=0.1,
        flags=np.zeros(3, np.uint8),
        range_min=0.1,
        range_max=9.0,
        ranges=np.array([1.0, inf], np.float32),
        intensities=np.zeros(0, np.float32),
        note="drifted",
    )
    data = store.serialize_cdr(message, definitions.LASER_SCAN)
    scan = decoder_for(channel(definitions.LASER_SCAN, text))(data)
    assert (scan.stamp_ns, scan.frame_id, scan.range_max) == (5_000_000_007, "laser", 9.0)
    assert scan.ranges.tolist() == [1.0, inf]


def test_big_endian_cdr_is_read() -> None:
    for name, data in payloads("laser", "base_link").items():
        big = ROS2.serialize_cdr(ROS2.deserialize_cdr(data, name), name, little_endian=False)
        assert plain(decoder_for(channel(name))(bytes(big))) == plain(decode.BY_HAND[name](data)), name


def test_ros1_payloads_are_read() -> None:
    for name, data in payloads("laser", "base_link").items():
        if name == definitions.TF_MESSAGE:
            continue
        message: Any = ROS2.deserialize_cdr(data, name)
        header = ROS1.types["std_msgs/msg/Header"](seq=3, stamp=message.header.stamp, frame_id="/laser")
        message.header = header
        raw = ROS1.serialize_ros1(message, name)
        text, _ = ROS1.generate_msgdef(name)
        decoder = decoder_for(channel(name.replace("/msg/", "/"), text, "ros1msg", "ros1"))
        assert plain(decoder(raw)) == plain(decode.BY_HAND[name](data)), name
        # Old bags and stripped MCAP files hold no definition: then the standard one is meant.
        assert plain(decoder_for(channel(name, "", "", "ros1"))(raw)) == plain(decode.BY_HAND[name](data))


def test_a_missing_definition_means_the_standard_one() -> None:
    data = payloads("laser", "")[definitions.LASER_SCAN]
    assert decoder_for(channel(definitions.LASER_SCAN, ""))(data).stamp_ns == START


def test_other_encodings_are_not_ours() -> None:
    assert is_decodable(channel(definitions.LASER_SCAN))
    assert not is_decodable(channel("foxglove.LaserScan", "", "protobuf", "protobuf"))
    assert is_decodable(channel(definitions.LASER_SCAN, "{}", "jsonschema", "json"))
    assert not is_decodable(channel(definitions.LASER_SCAN, "", "flatbuffer", "flatbuffer"))


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("string[3000000] x", "ros2msg"),
        ("float64[9999] x", "ros2msg"),
        ("my_msgs/A[4097] x", "ros2msg"),
        ("float32 x\n" * 10_000, "ros2msg"),
        ("module a { const long X = ((1)); };", "ros2idl"),
        ("module a { const long X = 1 << 40000000000; };", "ros2idl"),
        ("module a { struct B { long x[3000000]; }; };", "ros2idl"),
        ("module a { struct B { sequence<long, 3000000> x; }; };", "ros2idl"),
        ("my_msgs/A a\n" + "=" * 80 + "\nMSG: my_msgs/A\nmy_msgs/A a", "ros2msg"),
    ],
)
def test_hostile_definitions_are_refused_without_work(text: str, encoding: str) -> None:
    with at_most_bytes(1 << 20), pytest.raises(LogFormatError, match="/topic: "):
        decoder_for(channel(definitions.LASER_SCAN, text, encoding))


def test_the_strongest_echo_of_each_beam() -> None:
    data = multi_echo("laser", ([7.0], [], [3.0, 9.0], [5.0]))
    message = decode.BY_HAND[definitions.MULTI_ECHO_LASER_SCAN](memoryview(data))
    np.testing.assert_array_equal(message.ranges, np.array((1.5, np.nan, 2.5, 4.0), dtype=np.float32))
    fixed = ScanFixes.parse("echo=strongest").apply(message, None)
    np.testing.assert_array_equal(fixed.ranges, np.array((1.5, np.nan, 3.5, 4.0), dtype=np.float32))
    np.testing.assert_array_equal(fixed.intensities, np.array((7.0, np.nan, 9.0, 5.0), dtype=np.float32))
    assert plain(fixed) == plain(ScanFixes.parse("echo=strongest").apply(by_rosbags(data), None))


def by_rosbags(data: bytes) -> decode.ScanMessage:
    """The slow way."""
    name = definitions.MULTI_ECHO_LASER_SCAN
    found = FROM_OBJECT[name](ROS2.deserialize_cdr(data, name))
    assert isinstance(found, decode.ScanMessage)
    return found
