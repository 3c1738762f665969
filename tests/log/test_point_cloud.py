"""Point clouds: the bytes of a message, and the scan that is a slice of it."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from log_builders import SECOND, START, write_raw
from rosbags.typesys import Stores, get_typestore

from hsloc.errors import ConfigError, TopicError
from hsloc.log import check_log
from hsloc.log.messages.point_cloud import BEAMS, CloudMessage, object_point_cloud, point_cloud, slice_of
from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions
from hsloc.log.transforms import Transform3
from hsloc.model import Scan

if TYPE_CHECKING:
    from pathlib import Path

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPE = "sensor_msgs/msg/PointCloud2"
KINDS = {"f4": 7, "f8": 8, "i2": 3}


def message(points: Any, kind: str = "f4", *, big: bool = False, names: str = "xyz", stamp_ns: int = START) -> Any:
    """A cloud whose points have an intensity before, and padding behind, the coordinates."""
    Field, Time = STORE.types["sensor_msgs/msg/PointField"], STORE.types["builtin_interfaces/msg/Time"]
    Header = STORE.types["std_msgs/msg/Header"]
    size = int(kind[1])
    layout = np.dtype(
        {
            "names": ["intensity", *names],
            "formats": ["u1", *[(">" if big else "<") + kind] * len(names)],
            "offsets": [0, *(4 + size * k for k in range(len(names)))],
            "itemsize": 4 + size * len(names) + 5,
        }
    )
    rows = np.zeros(len(points), layout)
    for k, name in enumerate(names):
        rows[name] = np.asarray(points)[:, k]
    fields = [Field("intensity", 0, 2, 1), *(Field(name, layout.fields[name][1], KINDS[kind], 1) for name in names)]
    header = Header(Time(stamp_ns // SECOND, stamp_ns % SECOND), "lidar")
    data = np.frombuffer(rows.tobytes(), np.uint8)
    return STORE.types[TYPE](header, 1, len(points), fields, big, layout.itemsize, data.nbytes, data, True)


def payload(cloud: Any) -> bytes:
    return bytes(STORE.serialize_cdr(cloud, TYPE))


@pytest.mark.parametrize(("kind", "big"), [("f4", False), ("f4", True), ("f8", False), ("i2", False)])
def test_points_come_out_as_they_went_in(kind: str, big: bool, rng: Any) -> None:
    points = rng.integers(-20, 20, (50, 3)).astype(np.float64)
    cloud = message(points, kind, big=big)
    for found in (point_cloud(payload(cloud)), object_point_cloud(cloud)):
        assert (found.stamp_ns, found.frame_id) == (START, "lidar")
        assert found.points.dtype == np.float32
        np.testing.assert_array_equal(found.points, points.astype(np.float32))


def test_a_cloud_that_cannot_be_understood_is_refused() -> None:
    with pytest.raises(ValueError, match="without x, y, z"):
        point_cloud(payload(message([[1.0, 2.0]], names="xy")))
    cloud = message([[1.0, 2.0, 3.0]])
    cloud.fields[1].datatype = 77
    with pytest.raises(ValueError, match="unknown layout"):
        point_cloud(payload(cloud))
    with pytest.raises(ValueError, match="more points than the message holds"):
        point_cloud(payload(message(np.ones((40, 3))))[:-200])


def test_a_slice_is_the_nearest_point_of_each_direction_between_two_heights() -> None:
    points = [
        (3.0, 0.003, 0.0),  # at 0.5 m above the base: in the slice, but behind the next
        (2.0, 0.002, 0.1),
        (1.0, 0.01, 0.9),  # above the slice
        (0.0, 4.0, -0.2),
        (-5.0, -0.01, -0.6),  # the floor
        (np.nan, 1.0, 0.0),
        (0.01, 0.0, 0.0),  # the housing
    ]
    lidar = Transform3((0.3, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    scan = slice_of(CloudMessage(START, "lidar", np.array(points, dtype=np.float32)), lidar, 0.2, 1.0)
    assert len(scan.ranges) == BEAMS
    assert scan.angle_min == pytest.approx(-pi + pi / BEAMS)
    hits = np.flatnonzero(np.isfinite(scan.ranges))
    np.testing.assert_allclose(scan.ranges[hits], [2.0, 4.0], atol=1e-3)
    np.testing.assert_allclose(scan.angle_min + hits * scan.angle_increment, [0.001, pi / 2], atol=2 * pi / BEAMS)
    assert np.isnan(np.delete(scan.ranges, hits)).all()


def test_a_lidar_on_its_side_is_turned_upright() -> None:
    """Rolled by 90 degrees, its y axis points up: what it sees there is at that height, not at that place."""
    lidar = Transform3((0.0, 0.0, 1.0), (2**-0.5, 0.0, 0.0, 2**-0.5))
    cloud = CloudMessage(START, "lidar", np.array([(2.0, 3.0, 0.0), (2.0, 0.0, 3.0)], dtype=np.float32))
    scan = slice_of(cloud, lidar, 0.5, 1.5)
    (hit,) = np.flatnonzero(np.isfinite(scan.ranges))
    assert scan.ranges[hit] == pytest.approx(13**0.5, abs=1e-4)
    assert scan.angle_min + hit * scan.angle_increment == pytest.approx(np.arctan2(-3.0, 2.0), abs=2 * pi / BEAMS)


def test_a_log_of_clouds_is_read_as_scans(tmp_path: Path) -> None:
    around = np.linspace(-pi, pi, 400, endpoint=False)
    wall = np.column_stack((2.0 * np.cos(around), 2.0 * np.sin(around), np.full(400, 0.5)))
    stamps = [START + k * SECOND // 10 for k in range(5)]
    text = STORE.generate_msgdef(TYPE, ros_version=2)[0].encode()
    path = write_raw(
        tmp_path / "cloud.mcap",
        [("/points", stamp, payload(message(wall, stamp_ns=stamp))) for stamp in stamps],
        schema=(TYPE, "ros2msg", text),
    )
    with pytest.raises(TopicError, match="--slice"):
        open_log(path, ReadOptions(require_odometry=False))
    with pytest.raises(ConfigError, match="two heights"):
        open_log(path, ReadOptions(require_odometry=False, slice="1"))
    above = open_log(path, ReadOptions(require_odometry=False, slice="20,21"))
    assert list(above.events())
    assert "no point between 20 and 21 m" in " ".join(above.losses.reasons)
    log = open_log(path, ReadOptions(require_odometry=False, slice="0.2,1.0"))
    scans = [event for event in log.events() if isinstance(event, Scan)]
    assert [scan.stamp_ns for scan in scans] == stamps
    for scan in scans:
        hits = scan.ranges[np.isfinite(scan.ranges)]
        assert len(hits) == 400
        np.testing.assert_allclose(hits, 2.0, atol=1e-5)
    assert not [finding for finding in check_log(log).findings if finding.code == "no_scan"]
    unread = open_log(path, ReadOptions(require_odometry=False, require_scan=False))
    (finding,) = [finding for finding in check_log(unread).findings if finding.code == "no_scan"]
    assert "--slice" in finding.remedy
