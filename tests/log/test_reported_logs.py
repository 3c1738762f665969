"""Kinds of logs from public reports that were misread or refused: files, encodings, transforms, frames of maps."""

from __future__ import annotations

import gzip
import json
import shutil
import sqlite3
import tarfile
import zipfile
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import log_formats
import numpy as np
import pytest
import zstandard
from log_builders import MOUNTING, START, describe, make_scan, scan_payloads, write_raw, write_run

from hsloc.errors import LogError, LogFormatError
from hsloc.log import LogWriter, ReadOptions, check_log, convert_log, open_log
from hsloc.log.messages import definitions
from hsloc.log.summary import Losses
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("reported") / "run.mcap")


@pytest.fixture(scope="module")
def expected(plain: Path) -> list[tuple[str, int, float]]:
    return events_of(plain)


@pytest.fixture(scope="module")
def db3(plain: Path) -> Path:
    (found,) = log_formats.bag2(plain, plain.with_name("bag2")).glob("*.db3")
    return found


@pytest.fixture(scope="module")
def bag(plain: Path) -> Path:
    return log_formats.bag1(plain, plain.with_name("run.bag"))


def events_of(path: Path | list[Path], **options: Any) -> list[tuple[str, int, float]]:
    log = open_log(path, ReadOptions(**options))
    found = [describe(event) for event in log.events()]
    assert not log.losses.data_lost, log.losses.lines()
    return found


# Files.


@pytest.mark.parametrize("name", ["x.bag.active", "X.BAG", "x.bag.1", "noext", "x.db3", "run #3.mcap", "a%20?b.txt"])
@pytest.mark.parametrize("which", ["bag", "db3", "plain"])
def test_the_kind_of_a_file_is_what_it_holds(
    request: pytest.FixtureRequest, tmp_path: Path, expected: list[Any], which: str, name: str
) -> None:
    target = tmp_path / "folder #1 %41" / name
    target.parent.mkdir()
    shutil.copy(request.getfixturevalue(which), target)
    assert events_of(target) == expected
    assert open_log(target).summary.paths == (target,)


def _zip(source: Path, target: Path) -> None:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(source, f"bag/{source.name}")
        archive.writestr("bag/metadata.yaml", "rosbag2_bagfile_information: {}")


def _tar(source: Path, target: Path) -> None:
    with tarfile.open(target, "w:gz") as archive:
        archive.add(source, f"bag/{source.name}")


def _gzip(source: Path, target: Path) -> None:
    target.write_bytes(gzip.compress(source.read_bytes()))


def _zstd(source: Path, target: Path) -> None:
    target.write_bytes(zstandard.compress(source.read_bytes()))


@pytest.mark.parametrize(
    ("pack", "ending"), [(_gzip, ".gz"), (_zstd, ".zstd"), (_zstd, ""), (_zip, ".zip"), (_tar, ".tgz")]
)
@pytest.mark.parametrize("which", ["bag", "db3", "plain"])
def test_packed_logs_are_unpacked(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    expected: list[Any],
    which: str,
    pack: Callable[[Path, Path], None],
    ending: str,
) -> None:
    source: Path = request.getfixturevalue(which)
    target = tmp_path / f"{source.name}{ending}"
    pack(source, target)
    log = open_log(target)
    assert [describe(event) for event in log.events()] == expected
    assert log.summary.paths == (target,)
    assert len(log.sha256()) == 64


def test_a_folder_of_packed_files_is_a_recording(tmp_path: Path, db3: Path, expected: list[Any]) -> None:
    _zstd(db3, tmp_path / "bag_0.db3.zstd")
    assert events_of(tmp_path) == expected
    shutil.copy(db3, tmp_path / "bag_0.db3")
    assert events_of(tmp_path) == expected, "a part that is there packed and unpacked is one part"


def test_damaged_packing_is_one_line(tmp_path: Path, plain: Path) -> None:
    for pack, name in ((_gzip, "a.mcap.gz"), (_zstd, "a.mcap.zst"), (_zip, "a.zip")):
        pack(plain, tmp_path / name)
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) // 2])
        with pytest.raises((LogFormatError, LogError), match=f"{name}: "):
            open_log(tmp_path / name)


def test_messages_compressed_one_by_one_are_read(tmp_path: Path, plain: Path, expected: list[Any]) -> None:
    (named,) = log_formats.bag2(plain, tmp_path / "bag", "MESSAGE").glob("*.db3*")
    assert events_of(tmp_path / "bag") == expected
    assert events_of(named) == expected
    items = [(s, c, t, zstandard.compress(data)) for s, c, t, data in log_formats.messages(plain)]
    assert events_of(log_formats.write(tmp_path / "messages.mcap", items)) == expected


def test_the_write_ahead_log_of_a_database_is_read_and_nothing_beside_it_changes(
    tmp_path: Path, db3: Path, expected: list[Any]
) -> None:
    live = tmp_path / "live.db3"
    with sqlite3.connect(db3) as source, sqlite3.connect(live) as target:
        source.backup(target)
        target.execute("PRAGMA journal_mode = WAL")
        target.execute("PRAGMA wal_autocheckpoint = 0")
        rows = target.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
        target.execute("DELETE FROM messages WHERE id > ?", (len(rows) // 2,))
        target.commit()
        target.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        target.executemany(
            "INSERT INTO messages (id, topic_id, timestamp, data) VALUES (?, ?, ?, ?)", rows[len(rows) // 2 :]
        )
        target.commit()
        copied = tmp_path / "copied"
        copied.mkdir()
        for name in ("live.db3", "live.db3-wal"):
            shutil.copy(tmp_path / name, copied / name)
    before = {path.name: path.read_bytes() for path in copied.iterdir()}
    assert events_of(copied / "live.db3") == expected
    assert events_of(copied) == expected
    assert {path.name: path.read_bytes() for path in copied.iterdir()} == before


# Times and encodings.


@pytest.mark.parametrize("wrong", [2**64 - 5, 2**63 + 7, 0, START + 10**9 * SECOND])
def test_a_few_impossible_log_times_leave_the_order_alone(tmp_path: Path, plain: Path, wrong: int) -> None:
    items = list(log_formats.messages(plain))
    for number in (30, 71, 110):
        schema, channel, _, data = items[number]
        items[number] = (schema, channel, wrong, data)
    log = open_log(log_formats.write(tmp_path / "times.mcap", items))
    assert [describe(event) for event in log.events()] == events_of(plain)
    everything = log.verify().log_times_repaired
    assert everything == 3 >= log.losses.log_times_repaired > 0
    assert log.losses.stamps_backwards == {}
    assert log.summary.duration_s == pytest.approx(open_log(plain).summary.duration_s, abs=0.2)


def test_log_times_of_a_database_that_overflowed_leave_the_order_alone(
    tmp_path: Path, db3: Path, expected: list[Any]
) -> None:
    path = tmp_path / "times.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as bag:
        bag.execute("UPDATE messages SET timestamp = -17 WHERE id IN (40, 80)")
    log = open_log(path)
    assert [describe(event) for event in log.events()] == expected
    assert log.losses.log_times_repaired == 2


@pytest.mark.parametrize("text", ["sensor_msgs/msg/LaserScan", "LaserScan", "main"])
def test_an_incomplete_definition_of_a_standard_type_is_replaced_and_named(tmp_path: Path, text: str) -> None:
    full = definitions.definition_text(definitions.LASER_SCAN)
    schema = (definitions.LASER_SCAN, "ros2msg", (full.partition("=" * 80)[0] if text == "main" else text).encode())
    log = open_log(write_raw(tmp_path / "a.mcap", scan_payloads(5), schema=schema), ReadOptions(require_odometry=False))
    assert len(list(log.events())) == 5
    assert any("/scan" in str(warning) and "incomplete" in str(warning) for warning in log.summary.warnings)


def test_a_definition_that_contradicts_the_standard_one_is_not_replaced(tmp_path: Path) -> None:
    schema = (definitions.LASER_SCAN, "ros2msg", b"std_msgs/Header header\nfloat32 other\n")
    with pytest.raises(LogFormatError, match="cannot be used"):
        open_log(write_raw(tmp_path / "a.mcap", scan_payloads(5), schema=schema), ReadOptions(require_odometry=False))


@pytest.mark.parametrize("layout", [4, 8])
def test_xcdr2_is_read_whether_it_is_laid_out_so_or_only_labelled(
    tmp_path: Path, plain: Path, expected: list[Any], layout: int
) -> None:
    items = []
    for schema, channel, log_time, data in log_formats.messages(plain):
        payload = _aligned_to_four(schema.name, data) if layout == 4 else data
        items.append((schema, channel, log_time, b"\x00\x07\x00\x00" + payload[4:]))
    assert events_of(log_formats.write(tmp_path / "xcdr2.mcap", items)) == expected


def _aligned_to_four(typename: str, data: bytes) -> bytes:
    """The message with its doubles aligned to four bytes: the padding before the first double is left out."""
    if typename == definitions.LASER_SCAN:
        return data
    tail = {definitions.ODOMETRY: 680, definitions.TF_MESSAGE: 56}[typename]
    head = data[:-tail]
    return head[:-4] + data[-tail:] if head.endswith(b"\0" * 4) and _padded(head) else data


def _padded(head: bytes) -> bool:
    """Whether four of the zeros that end a head are padding: the string before ends with one zero."""
    return len(head.rstrip(b"\0")) + 1 <= len(head) - 4


@pytest.mark.parametrize(("identifier", "name"), [(b"\x00\x03", "PL_CDR"), (b"\x00\x09", "delimited XCDR2")])
def test_encodings_that_are_not_read_are_named(tmp_path: Path, identifier: bytes, name: str) -> None:
    messages = [(topic, time, identifier + data[2:]) for topic, time, data in scan_payloads(5)]
    log = open_log(write_raw(tmp_path / "a.mcap", messages), ReadOptions(require_odometry=False, require_scan=False))
    assert list(log.events()) == []
    assert name in " ".join(log.losses.reasons)


def test_ros_messages_as_json_are_read(tmp_path: Path, plain: Path, expected: list[Any]) -> None:
    items = []
    for schema, channel, log_time, data in log_formats.messages(plain):
        message = log_formats.ROS2.deserialize_cdr(data, schema.name)
        schema.encoding, schema.data, channel.message_encoding = "jsonschema", b"{}", "json"
        items.append((schema, channel, log_time, json.dumps(_plain(message)).encode()))
    assert events_of(log_formats.write(tmp_path / "json.mcap", items)) == expected


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [None if not np.isfinite(item) else float(item) for item in value]
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    return value


# Transforms.


def assert_alike(a: Pose2, b: Pose2) -> None:
    np.testing.assert_allclose(a.to_array(), b.to_array(), atol=1e-9)


def write_robot(
    path: Path, space: str, prefix: str = "", odom: str = "odom", topic: bool = True, mounting: Pose2 = MOUNTING
) -> Path:
    """A run whose topics are in a namespace, and whose frames may have a prefix."""
    with LogWriter(path) as log:
        _add_robot(log, space, prefix, odom, topic, MOUNTING)
    return path


def _add_robot(log: LogWriter, space: str, prefix: str, odom: str, topic: bool, mounting: Pose2) -> None:
    base, laser = f"{prefix}base_link", f"{prefix}laser"
    log.transforms(START, [(base, laser, mounting)], static=True, topic=f"{space}/tf_static")
    for number in range(30):
        stamp = START + number * SECOND // 10
        pose = Pose2(0.1 * number, 0.0, 0.0)
        log.transforms(stamp, [(f"{prefix}{odom}", base, pose)], topic=f"{space}/tf")
        if topic:
            log.odometry(stamp, pose, topic=f"{space}/odom", frame_id=f"{prefix}{odom}", child_frame_id=base)
        log.scan(make_scan(stamp + SECOND // 100, number), frame_id=laser, topic=f"{space}/scan")


@pytest.mark.parametrize("prefix", ["", "robot1/"])
@pytest.mark.parametrize("odom", ["odom", "odom_combined"])
@pytest.mark.parametrize("topic", [True, False])
@pytest.mark.parametrize("space", ["/robot1", "/fleet/robot1", ""])
def test_transforms_are_found_in_any_namespace_with_any_prefix(
    tmp_path: Path, space: str, prefix: str, odom: str, topic: bool
) -> None:
    log = open_log(write_robot(tmp_path / "a.mcap", space, prefix, odom, topic))
    assert_alike(log.summary.T_base_laser, MOUNTING)
    assert log.summary.extrinsics == f"{space}/tf_static"
    assert log.summary.odom_topic == (f"{space}/odom" if topic else f"{space}/tf")
    assert log.summary.warnings == ()
    assert sum(kind == "odometry" for kind, *_ in map(describe, log.events())) == 30


def test_of_two_robots_the_one_whose_scans_are_read_counts(tmp_path: Path) -> None:
    other = Pose2(-0.3, 0.1, 1.0)
    with LogWriter(tmp_path / "two.mcap") as log:
        _add_robot(log, "/robot1", "", "odom", False, MOUNTING)
        _add_robot(log, "/robot2", "", "odom", False, other)
    for name, mounting in (("/robot1", MOUNTING), ("/robot2", other)):
        found = open_log(tmp_path / "two.mcap", ReadOptions(scan_topic=f"{name}/scan"))
        assert_alike(found.summary.T_base_laser, mounting)
        assert found.summary.odom_topic == f"{name}/tf"


def test_transforms_can_be_named_in_place_of_an_odometry_topic(tmp_path: Path) -> None:
    path = write_robot(tmp_path / "a.mcap", "/robot1")
    log = open_log(path, ReadOptions(odom_topic="/robot1/tf", base_frame="base_link"))
    assert log.summary.odom_topic == "/robot1/tf"
    assert sum(kind == "odometry" for kind, *_ in map(describe, log.events())) == 30


def test_static_transforms_stated_twice_are_both_named(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with LogWriter(path) as log:
        log.transforms(START, [("base_link", "laser", Pose2(0.18, 0.0, 0.0))], static=True)
        _add_robot(log, "", "", "odom", True, Pose2(0.0, 0.0, 0.0))
    (warning,) = open_log(path).summary.warnings
    for part in ("0.180,0.000,0.000", "0.000,0.000,0.000", "--laser-pose"):
        assert part in str(warning)
    assert any("0.180,0.000,0.000" in finding.text for finding in check_log(open_log(path)).findings)


def test_a_frame_with_two_parents_is_looked_up_by_the_one_that_leads_to_the_base(tmp_path: Path) -> None:
    path = tmp_path / "parents.mcap"
    with LogWriter(path) as log:
        _add_robot(log, "", "", "odom", True, MOUNTING)
        log.transforms(START + SECOND, [("camera_mount", "laser", Pose2(5.0, 0.0, 0.0))], static=True)
    summary = open_log(path).summary
    assert_alike(summary.T_base_laser, MOUNTING)
    assert any("camera_mount" in str(warning) for warning in summary.warnings)


def test_a_mounting_that_was_assumed_stays_an_assumption_after_conversion(tmp_path: Path) -> None:
    source = write_run(tmp_path / "a.mcap", mounting=None)
    convert_log(open_log(source), tmp_path / "b.mcap")
    for path in (source, tmp_path / "b.mcap"):
        log = open_log(path)
        assert log.summary.extrinsics == "identity"
        assert any("--laser-pose" in str(warning) for warning in log.summary.warnings)
        assert any(finding.code == "no_extrinsic" for finding in check_log(log).findings)
    assert events_of(source) == events_of(tmp_path / "b.mcap")


# Frames of maps.

GRID = OccupancyGrid(np.zeros((4, 6), dtype=np.int8), 0.05, Pose2(1.0, 2.0, 0.0))


@pytest.mark.parametrize(
    ("topic", "frame", "is_map"),
    [
        ("/map", "map", True),
        ("/robot1/map", "robot1/map", True),
        ("/floor_plan", "map", True),
        ("/local_costmap/costmap", "odom", False),
        ("/global_costmap/costmap", "map", False),
        ("/grid", "odom", False),
    ],
)
def test_a_costmap_is_no_map(tmp_path: Path, topic: str, frame: str, is_map: bool) -> None:
    path = tmp_path / "map.mcap"
    with LogWriter(path) as log:
        _add_robot(log, "", "", "odom", True, MOUNTING)
        log.occupancy_grid(GRID, START, topic=topic, frame_id=frame)
    log_ = open_log(path)
    assert (log_.map() is not None) is is_map
    assert any(topic in str(warning) for warning in log_.summary.warnings) is not is_map


@pytest.mark.parametrize("transform", [True, False])
def test_a_start_pose_in_the_frame_of_the_odometry_is_moved_or_left_out(tmp_path: Path, transform: bool) -> None:
    T_map_odom = Pose2(3.0, 4.0, 0.5)
    path = tmp_path / "start.mcap"
    with LogWriter(path) as log:
        if transform:
            log.transforms(START, [("map", "odom", T_map_odom)])
        _add_robot(log, "", "", "odom", True, MOUNTING)
        log.pose_with_covariance(START + SECOND, Pose2(1.0, 0.0, 0.0), topic="/initialpose", frame_id="odom")
    found = open_log(path)
    if transform:
        start = found.initial_pose()
        assert start is not None
        assert np.allclose(start[1].to_array(), (T_map_odom @ Pose2(1.0, 0.0, 0.0)).to_array())
    else:
        assert found.initial_pose() is None
        assert any("frame odom" in str(warning) for warning in found.summary.warnings)


def test_orientations_of_zeros_are_counted(tmp_path: Path, plain: Path) -> None:
    def zeroed(number: int, name: str, data: bytes) -> bytes:
        if name != definitions.ODOMETRY or number >= 40:
            return data
        pose = len(data) - 680
        return data[: pose + 24] + bytes(32) + data[pose + 56 :]

    items = [(s, c, t, zeroed(n, s.name, data)) for n, (s, c, t, data) in enumerate(log_formats.messages(plain))]
    log = open_log(log_formats.write(tmp_path / "zeros.mcap", items))
    events = list(log.events())
    assert (
        sum(not getattr(event, "has_heading", True) for event in events) == log.losses.orientations_unset["/odom"] > 5
    )
    assert replace_losses(log.losses) == Losses()


def replace_losses(losses: Losses) -> Losses:
    """The losses but for the count of unset orientations."""
    return replace(losses, orientations_unset=Losses().orientations_unset)
