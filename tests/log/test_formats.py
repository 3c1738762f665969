"""One recording in every format gives one trajectory: the same events, bit for bit."""

from __future__ import annotations

import contextlib
import json
import sys
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import log_formats as formats
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory import at_most_bytes
from paths import RECORDINGS

from hsloc.cli.main import main
from hsloc.errors import LogFormatError
from hsloc.log.container import Channel
from hsloc.log.messages import foxglove
from hsloc.log.messages.decoders import Undecodable, decoder_for
from hsloc.log.reader import open_log
from hsloc.log.session.extrinsics import Extrinsics
from hsloc.log.session.transform_topics import TransformTopics
from hsloc.log.summary import Losses, ReadOptions
from hsloc.log.transforms import Mounting, Transform3
from hsloc.log.writer import LogWriter
from hsloc.model import Odometry, Pose2, Scan
from hsloc.replay.run import Result, run
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from hsloc.model import Event


FORMATS: dict[str, tuple[str, Callable[[Path, Path], Path]]] = {
    "ros1 in MCAP": ("ros1.mcap", formats.ros1_mcap),
    "json in MCAP": ("json.mcap", partial(formats.foxglove_mcap, encoding="json")),
    "protobuf in MCAP": ("protobuf.mcap", partial(formats.foxglove_mcap, encoding="protobuf")),
    "single transforms": ("single.mcap", partial(formats.foxglove_mcap, encoding="protobuf", single_transforms=True)),
    "ROS 2 bag": ("bag2", formats.bag2),
    "ROS 1 bag": ("run.bag", formats.bag1),
    "in three parts": ("parts", partial(formats.split, parts=3)),
}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of a laser that hangs head down, turned by 0.3 rad, with scans between the odometry's stamps."""
    return formats.cut(RECORDINGS / "kidnapped.mcap", tmp_path_factory.mktemp("formats") / "cdr.mcap", 6.0)


@cache
def localised(path: Path) -> Result:
    start = open_log(RECORDINGS / "kidnapped.mcap").initial_pose()
    assert start is not None
    return run(RunRequest(logs=(path,), initial_pose=start[1]))


def values(event: Event) -> tuple[object, ...]:
    """All that an estimator can see of an event, beside limits of range that not every format has."""
    if isinstance(event, Scan):
        points = event.points_base().tobytes()
        return event.stamp_ns, event.ranges.tobytes(), event.angle_min, event.angle_increment, event.frame_id, points
    return event.stamp_ns, event.T_odom_base if isinstance(event, Odometry) else event.T_map_base


@pytest.mark.unmeasured
@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_trajectory(source: Path, name: str) -> None:
    file, convert = FORMATS[name]
    path = source.parent / file
    converted = path if path.exists() else convert(source, path)
    log = open_log(converted)
    assert [values(event) for event in log.events()] == [values(event) for event in open_log(source).events()]
    assert log.losses == Losses()
    assert log.summary.laser_flipped
    assert log.summary.extrinsics == "/tf_static"
    found, expected = localised(converted), localised(source)
    assert len(expected.trajectory) > 140
    assert expected.diagnostics.status.count("matched") > 10
    np.testing.assert_array_equal(found.trajectory.stamps_ns, expected.trajectory.stamps_ns)
    np.testing.assert_array_equal(found.trajectory.poses, expected.trajectory.poses)
    assert found.reference is not None
    np.testing.assert_array_equal(found.reference.poses, expected.reference.poses)


@pytest.mark.parametrize("encoding", ["cdr", "json", "protobuf"])
def test_odometry_may_stand_in_transforms_alone(source: Path, tmp_path: Path, encoding: str) -> None:
    rest = (message for message in formats.messages(source) if message[1].topic != "/odom")
    path = formats.write(tmp_path / "cdr.mcap", rest, source)
    if encoding != "cdr":
        path = formats.foxglove_mcap(path, tmp_path / "other.mcap", encoding)
    log = open_log(path)
    assert (log.summary.odom_topic, log.summary.odom_frame) == ("/tf", "odom")
    found = [values(event) for event in log.events()]
    assert found == [values(event) for event in open_log(source, ReadOptions(odom_topic="tf")).events()]
    assert len(found) > 200


def test_ranges_and_stamps_survive_every_encoding(tmp_path: Path) -> None:
    stamp = 1_700_000_000_123_456_789
    ranges = np.array([0.1, np.float32(1) / 3, 7.0000005, np.inf, np.nan, -np.inf, 0.0, 1e-4], dtype=np.float32)
    scan = Scan(stamp, ranges, -1.1, np.float32(0.1), 0.05, 12.0, intensities=np.arange(8, dtype=np.float32) / 3)  # type: ignore[arg-type]
    with LogWriter(tmp_path / "cdr.mcap") as log:
        log.scan(scan)
        log.odometry(stamp, Pose2(1.0, 2.0, 3.0))
    for encoding in ("json", "protobuf"):
        path = formats.foxglove_mcap(tmp_path / "cdr.mcap", tmp_path / f"{encoding}.mcap", encoding)
        (found,) = (event for event in open_log(path).events() if isinstance(event, Scan))
        assert found.stamp_ns == stamp
        assert found.ranges.tobytes() == ranges.tobytes()
        assert found.intensities is not None
        assert found.intensities.tobytes() == scan.intensities.tobytes()
        assert found.angle_increment == float(np.float32(0.1))
        # Without limits of range in the message, zero is no hit all the same.
        assert found.hits().tolist() == [True, True, True, False, False, False, False, False]


def test_the_pose_of_a_foxglove_scan_is_part_of_its_mounting() -> None:
    message = formats.to_protobuf("foxglove.LaserScan", {"frame_id": "/laser", "ranges": [1.0, 2.0], "end_angle": 1.0})
    message.pose.position.x = 1.0
    message.pose.orientation.x = 1.0  # head down
    scan = decoder_for(channel("foxglove.LaserScan"))(message.SerializeToString())
    assert scan.T_frame_laser == Transform3((1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    mountings = Extrinsics([], TransformTopics(), "base", None)
    mountings._spatial["laser"] = Transform3.from_pose2(Pose2(0.5, 0.25, np.pi / 2))
    mountings._known["laser"] = (Mounting(Pose2(0.5, 0.25, np.pi / 2)), "/tf_static")
    mounting = mountings.of("laser", scan.T_frame_laser)
    assert mounting.flipped
    assert mounting.T_base_laser.to_array() == pytest.approx((0.5, 1.25, np.pi / 2))
    assert not mountings.of("laser").flipped


def channel(name: str, encoding: str = "protobuf", schema: bytes | None = None) -> Channel:
    text = formats.DESCRIPTORS.SerializeToString() if schema is None else schema
    return Channel(1, "/topic", name, encoding, encoding, text)


def test_json_as_people_write_it() -> None:
    decode = decoder_for(channel("foxglove.LaserScan", "json"))
    text = b"""{"timestamp": {"sec": 5, "nsec": 7}, "frame_id": "/laser", "start_angle": -1, "end_angle": 1,
        "ranges": [1, 2.5, null, "Infinity", "NaN"], "more": {}}"""
    scan = decode(text)
    assert (scan.stamp_ns, scan.frame_id, scan.angle_increment) == (5_000_000_007, "laser", 0.5)
    np.testing.assert_array_equal(scan.ranges, np.array([1, 2.5, np.nan, np.inf, np.nan], dtype=np.float32))
    (link,) = decoder_for(channel("foxglove.FrameTransform", "json"))(
        b'{"parent_frame_id": "a", "child_frame_id": "b"}'
    )
    assert (link.stamp_ns, link.parent, link.child, link.transform) == (0, "a", "b", Transform3())


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"7",
        b"[" * 100_000,
        b'{"ranges": "123"}',
        b'{"ranges": {"1": 2}}',
        b'{"ranges": [[1], [2]]}',
        b'{"timestamp": {"sec": 1e99}}',
        b'{"timestamp": {"sec": 99999999999999999999}}',
        b'{"timestamp": {"sec": 1, "nsec": 1000000000}}',
        b'{"timestamp": 7}',
        b'{"frame_id": 7}',
        b'{"frame_id": "' + b"x" * 5000 + b'"}',
        b'{"pose": []}',
        b'{"ranges": [' + b"1," * 3_000_000 + b"1]}",
        b'{"start_angle": ' + b"9" * 5000 + b"}",
        b"\xff\xfe",
    ],
    ids=lambda text: text[:24].decode(errors="replace"),
)
def test_hostile_json_is_undecodable_without_work(text: bytes) -> None:
    decode = decoder_for(channel("foxglove.LaserScan", "json"))
    with at_most_bytes(1 << 20), pytest.raises(Undecodable):
        decode(text)


def test_hostile_protobuf_is_undecodable_without_work() -> None:
    decode = decoder_for(channel("foxglove.FrameTransforms"))
    for data in (b"\x0a\x00" * 20_000, b"\x0a\xff", b"\x0a\x00" * 3_000_000, b"\x0a" * 1000):
        with at_most_bytes(1 << 20), pytest.raises(Undecodable):
            decode(data)


@settings(max_examples=300)
@given(data=st.binary(max_size=200), name=st.sampled_from(sorted(foxglove.TYPES)))
def test_any_protobuf_payload_is_decoded_or_undecodable(data: bytes, name: str) -> None:
    with contextlib.suppress(Undecodable):
        decoder_for(channel(name))(data)


def altered(change: Callable[[Any], None]) -> bytes:
    copy = formats.descriptors()
    change(copy)
    return copy.SerializeToString()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    "schema",
    [
        b"\xff(((",
        altered(lambda files: files.file.pop(0)),
        altered(lambda files: files.file[1].dependency.append("foxglove.proto")),
        altered(lambda files: files.file[0].message_type.pop(3)),
        altered(lambda files: files.file[0].message_type[3].field[0].__setattr__("type_name", ".foxglove.None")),
        altered(lambda files: [files.file.add(name=str(n)) for n in range(300)]),  # type: ignore[arg-type]
    ],
)
def test_definitions_that_cannot_be_used_are_one_line(schema: bytes) -> None:
    with pytest.raises(LogFormatError, match=r"/topic: the definition of foxglove\.LaserScan cannot be used") as caught:
        decoder_for(channel("foxglove.LaserScan", schema=schema))
    assert "\n" not in str(caught.value)


def test_a_definition_with_other_fields_is_undecodable() -> None:
    schema = altered(lambda files: files.file[0].message_type[3].field[5].__setattr__("name", "rangez"))
    with pytest.raises(Undecodable):
        decoder_for(channel("foxglove.LaserScan", schema=schema))(b"")


def test_without_protobuf_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "google.protobuf", None)
    with pytest.raises(LogFormatError, match=r"pip install 'hsloc\[foxglove\]'"):
        decoder_for(channel("foxglove.LaserScan"))


def test_a_log_with_a_localisers_transforms_offers_them_as_reference(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["replay", str(source), "--out", str(first), "-q"]) == 0
    again = ["replay", str(first / "run.mcap"), "--initial-pose=2.6,8.1,1.5707963", "--out", str(second)]
    assert main(again) == 0
    assert (
        "the log has poses to compare with: --truth-topic /pose or /pose_with_covariance or tf"
        in capsys.readouterr().err
    )
    assert not (second / "reference.tum").exists()
    assert main([*again, "--overwrite", "--truth-topic", "tf", "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["matched"] > 100
    assert metrics["ape"]["trans_part"]["rmse"] < 0.01


def test_foxgloves_transforms_are_found_under_any_name(source: Path, tmp_path: Path) -> None:
    def renamed() -> Iterator[formats.Message]:
        for schema, channel, log_time, data in formats.messages(path):
            if channel.topic != "/odom":
                channel.topic = channel.topic.replace("/tf", "/transforms").replace("/transforms_static", "/transforms")
                yield schema, channel, log_time, data

    path = formats.foxglove_mcap(source, tmp_path / "all.mcap", "protobuf")
    log = open_log(formats.write(tmp_path / "renamed.mcap", renamed(), source))
    assert (log.summary.odom_topic, log.summary.base_frame, log.summary.extrinsics) == (
        "/transforms",
        "base_link",
        "/transforms",
    )
    expected = open_log(source, ReadOptions(odom_topic="tf")).events()
    assert [values(event) for event in log.events()] == [values(event) for event in expected]
