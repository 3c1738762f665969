"""Trajectories as other tools write them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.errors import EvaluationError
from hsloc.model.pose2 import wrap_angles
from hsloc.trajectory_io.reader import LoadedTrajectory, read_trajectory

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

N = 40
S = np.arange(N, dtype=np.float64) * 0.2
PATH = np.column_stack((3.0 * np.sin(S), 3.0 * (1.0 - np.cos(S)), wrap_angles(S)))
"""A circle, driven forwards, one pose every 100 ms."""
STAMPS = 1_700_000_000_000_000_000 + np.arange(N) * 100_000_000


def written(path: Path, lines: list[str], head: str = "") -> LoadedTrajectory:
    path.write_text("".join(f"{line}\n" for line in ([head] if head else []) + lines))
    return read_trajectory(path)


def check(found: LoadedTrajectory, poses: NDArray[np.float64] = PATH) -> str:
    """The poses are right; returns the reader's notes about them."""
    np.testing.assert_array_equal(found.trajectory.stamps_ns, STAMPS)
    np.testing.assert_allclose(found.trajectory.poses[:, :2], poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap_angles(found.trajectory.poses[:, 2] - poses[:, 2]), 0.0, atol=1e-9)
    return " ".join(str(warning) for warning in found.warnings)


def seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


@pytest.mark.parametrize(("unit", "factor"), [("ns", 1), ("us", 10**3), ("ms", 10**6)])
def test_stamps_in_any_unit(tmp_path: Path, unit: str, factor: int) -> None:
    lines = [f"{stamp // factor} {x!r} {y!r} {theta!r}" for stamp, (x, y, theta) in rows()]
    assert f"stamps are read as {unit}" in check(written(tmp_path / "a.txt", lines))


def rows() -> list[tuple[int, list[float]]]:
    return [(int(stamp), pose.tolist()) for stamp, pose in zip(STAMPS, PATH, strict=True)]


def test_ros_messages_as_csv(tmp_path: Path) -> None:
    """As `rostopic echo -p` writes them, and with seconds and nanoseconds in columns of their own."""
    q = [(math.sin(theta / 2.0), math.cos(theta / 2.0)) for _, (_, _, theta) in rows()]
    tails = [f"{x!r},{y!r},0,0,0,{a!r},{b!r}" for (_, (x, y, _)), (a, b) in zip(rows(), q, strict=True)]
    pose = ",".join(f"pose.position.{axis}" for axis in "xyz")
    pose += "," + ",".join(f"pose.orientation.{axis}" for axis in "xyzw")
    field = "field." + pose.replace(",", ",field.")
    stamps = [stamp for stamp, _ in rows()]
    lines = [f"{stamp + 7},{stamp},map,{tail}" for stamp, tail in zip(stamps, tails, strict=True)]
    head = f"%time,field.header.stamp,field.header.frame_id,{field}"
    assert "read as ns" in check(written(tmp_path / "a.csv", lines, head))
    lines = [f"{stamp // 10**9},{stamp % 10**9},{tail}" for stamp, tail in zip(stamps, tails, strict=True)]
    for names in ("header.stamp.sec,header.stamp.nanosec", "sec,nsec"):
        assert check(written(tmp_path / "b.csv", lines, f"{names},{pose}")) == ""
    with pytest.raises(EvaluationError, match=r"line 2: .* are no seconds and nanoseconds"):
        written(tmp_path / "b.csv", [f"1.5,3,{tails[0]}"], f"sec,nsec,{pose}")


def test_headings_in_degrees_are_known_by_the_direction_of_motion(tmp_path: Path) -> None:
    lines = [f"{seconds(stamp)} {x!r} {y!r} {math.degrees(theta)!r}" for stamp, (x, y, theta) in rows()]
    assert "only as degrees" in check(written(tmp_path / "a.txt", lines))
    assert "degrees" not in check(
        written(tmp_path / "b.csv", [line.replace(" ", ",") for line in lines], "t,x,y,yaw_deg")
    )


def test_stamps_with_too_few_digits_are_warned_of(tmp_path: Path) -> None:
    lines = [f"{stamp // 10**9} {x!r} {y!r} {theta!r}" for stamp, (x, y, theta) in rows()]
    assert "different stamps" in " ".join(str(each) for each in written(tmp_path / "a.txt", lines).warnings)


def test_kitti_of_a_robot_and_of_a_camera(tmp_path: Path) -> None:
    robot, camera = [], []
    for _, (x, y, theta) in rows():
        c, s = np.cos(theta), np.sin(theta)
        robot.append(" ".join(map(repr, map(float, (c, -s, 0, x, s, c, 0, y, 0, 0, 1, 0)))))
        # The camera's x is to the right (-y of the robot), its z ahead (x of the robot).
        camera.append(" ".join(map(repr, map(float, (c, 0, -s, -y, 0, 1, 0, 0, s, 0, c, x)))))
    (tmp_path / "times.txt").write_text("".join(f"{seconds(int(stamp))}\n" for stamp in STAMPS))
    assert check(written(tmp_path / "robot.txt", robot)) == ""
    assert "camera" in check(written(tmp_path / "camera.txt", camera))


@pytest.mark.parametrize(
    ("times", "line", "match"),
    [
        (None, "1 0 0 0 0 1 0 0 0 0 1 0", r"have no stamps.*poses_times\.txt"),
        ("1.0\n2.0\n", "1 0 0 0 0 1 0 0 0 0 1 0", "2 stamps for the 1 poses"),
        ("soon\n", "1 0 0 0 0 1 0 0 0 0 1 0", "not a stamp"),
        ("1.0\n", "1 0 0 0 0 1 0 0 0 0 one 0", "line 1"),
    ],
)
def test_kitti_that_cannot_be_read(tmp_path: Path, times: str | None, line: str, match: str) -> None:
    if times is not None:
        (tmp_path / "poses_times.txt").write_text(times)
    with pytest.raises(EvaluationError, match=match):
        written(tmp_path / "poses.txt", [line])
