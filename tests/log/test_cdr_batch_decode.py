"""Many poses at once: to the last bit what the message-wise decoders make of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_builders import SECOND, START, write_run
from mcap.writer import Writer

from hsloc.log.messages import cdr_batch_decode as columns
from hsloc.log.messages import decode, definitions, encode
from hsloc.log.reader import open_log
from hsloc.log.session import message_source as ros_source
from hsloc.log.session import message_source as route
from hsloc.log.summary import ReadOptions
from hsloc.log.writer import LogWriter
from hsloc.model import Odometry, Pose2, Scan, Truth

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def as_rows(found: columns.PoseColumns) -> list[Any]:
    covariances = [None if c is None else c.tobytes() for c in found.covariances]
    return list(
        zip(found.stamps_ns.tolist(), found.x.tolist(), found.y.tolist(), found.theta, covariances, strict=True)
    )


def one_by_one(name: str, payloads: Sequence[bytes]) -> list[Any]:
    messages = [decode.BY_HAND[name](payload) for payload in payloads]
    return [
        (m.stamp_ns, m.pose.x, m.pose.y, m.pose.theta, None if m.covariance is None else m.covariance.tobytes())
        for m in messages
    ]


def numbers(data: st.DataObject, payload: bytearray, at: int, count: int) -> None:
    """Overwrite some doubles with anything a double can be."""
    for k in range(count):
        if data.draw(st.booleans()):
            value = data.draw(st.floats(allow_nan=False) | st.sampled_from((0.0, -0.0, 1.0, 1e308)))
            payload[at + 8 * k : at + 8 * k + 8] = np.float64(value).tobytes()


@settings(max_examples=100)
@given(data=st.data(), name=st.sampled_from(sorted(columns.BY_HAND)), frame=st.sampled_from(("", "odom", "/map")))
def test_columns_are_the_messages_to_the_last_bit(data: st.DataObject, name: str, frame: str) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    payloads = []
    for n in range(data.draw(st.integers(1, 6))):
        pose = Pose2(*rng.normal(size=3))
        covariance = data.draw(st.sampled_from((None, np.eye(3), np.diag(rng.random(3)))))
        payload = bytearray(
            encode.odometry(START + n, pose, covariance, (0, 0, 0), (frame, "base_link"))
            if name == definitions.ODOMETRY
            else encode.pose_stamped(START + n, pose, frame)
            if name == definitions.POSE_STAMPED
            else encode.pose_with_covariance_stamped(START + n, pose, covariance, frame)
        )
        at = decode.odometry_pose_at(payload) if name == definitions.ODOMETRY else decode.stamped_pose_at(payload)  # type: ignore[arg-type]
        numbers(data, payload, at, 7)
        payloads.append(bytes(payload))
    found = columns.BY_HAND[name](payloads, covariances=True)
    assert found is not None
    assert repr(as_rows(found)) == repr(one_by_one(name, payloads))  # nan is not nan


@pytest.mark.parametrize(
    "odd",
    [
        encode.odometry(START, Pose2(), None, (0, 0, 0), ("odom", "other_link")),
        encode.odometry(START, Pose2(), None, (0, 0, 0), ("odam", "base_link")),
        b"\x00\x00" + encode.odometry(START, Pose2(), None, (0, 0, 0), ("odom", "base_link"))[2:],
        encode.odometry(START, Pose2(), None, (0, 0, 0), ("odom", "base_link"))[:-400],
        b"",
    ],
    ids=["another length", "another name", "big endian", "cut in the covariance", "empty"],
)
@pytest.mark.parametrize("place", [0, 1])
def test_messages_that_are_not_alike_are_left_to_the_decoders(odd: bytes, place: int) -> None:
    payloads = [encode.odometry(START + n, Pose2(n, 0, 0), None, (0, 0, 0), ("odom", "base_link")) for n in range(3)]
    payloads[place] = odd
    assert columns.odometry(payloads) is None


def test_no_covariance_and_one_for_all() -> None:
    names = ("odom", "base_link")
    none = columns.odometry([encode.odometry(n, Pose2(), None, (0, 0, 0), names) for n in range(3)])
    same = columns.odometry([encode.odometry(n, Pose2(), np.eye(3), (0, 0, 0), names) for n in range(3)])
    assert none is not None
    assert same is not None
    assert list(none.covariances) == [None] * 3
    assert same.covariances[0] is same.covariances[2]


def events_of(path: Path) -> list[Any]:
    found: list[Any] = []
    for event in open_log(path).events():
        if isinstance(event, Scan):
            found.append((event.stamp_ns, event.ranges.tobytes()))
        elif isinstance(event, Odometry):
            covariance = None if event.covariance is None else event.covariance.tobytes()
            found.append((event.stamp_ns, event.T_odom_base, covariance))
        else:
            assert isinstance(event, Truth)
            found.append((event.stamp_ns, event.T_map_base))
    return found


@pytest.mark.parametrize("batch", [1, 7, 100, 5000])
@pytest.mark.parametrize("by_columns", [True, False])
def test_events_do_not_depend_on_how_they_are_batched(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, batch: int, by_columns: bool
) -> None:
    path = write_run(tmp_path / "run.mcap", scans=60, truth=True, chunk_size=20_000)
    expected = events_of(path)
    assert len(expected) == 60 * 4
    monkeypatch.setattr(ros_source, "_BATCH", batch)
    monkeypatch.setattr(route, "_FEW", 0 if by_columns else 10**9)
    assert events_of(path) == expected


@pytest.mark.parametrize("batch", [1, 1024])
def test_transforms_of_two_publishers_are_taken_in_the_order_of_the_log(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, batch: int
) -> None:
    """As in a ROS 1 bag, where each publisher of /tf has a channel: the localiser's, and the base's."""
    monkeypatch.setattr(ros_source, "_BATCH", batch)
    definition = definitions.definition_text(definitions.TF_MESSAGE).encode()
    path = tmp_path / "two.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(definitions.TF_MESSAGE, "ros2msg", definition)
        base, localiser = (writer.register_channel("/tf", "cdr", schema) for _ in range(2))
        for n in range(200):
            stamp = START + n * SECOND // 50
            if n % 10 == 0:
                moved = encode.transforms(stamp, [("map", "odom", Pose2(float(n), 0.0, 0.0))])
                writer.add_message(localiser, stamp, moved, stamp)
            writer.add_message(base, stamp + 1, encode.transforms(stamp, [("odom", "base_link", Pose2())]), stamp + 1)
        writer.finish()  # type: ignore[no-untyped-call]
    log = open_log(path, ReadOptions(require_scan=False, truth_topic="/tf"))
    found = [event.T_map_base.x for event in log.events() if isinstance(event, Truth)]
    assert found == [float(n - n % 10) for n in range(200)]


def test_unusable_and_unstamped_poses_among_usable_ones(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    with LogWriter(path) as log:
        for n in range(200):
            stamp = START + n * SECOND // 20
            pose = Pose2(1e9 if n == 50 else float("nan") if n == 70 else float(n), 0.0, 0.0)
            log.odometry(0 if n == 90 else stamp, pose, log_time_ns=stamp)
    log_read = open_log(path, ReadOptions(require_scan=False))
    xs = [event.T_odom_base.x for event in log_read.events() if isinstance(event, Odometry)]
    assert xs == [float(n) for n in range(200) if n not in (50, 70)]
    assert log_read.losses.invalid_messages == {"/odom": 2}
    assert log_read.losses.stamps_zero == {"/odom": 1}
