"""The mounting of the laser, as FLASER lines of CARMEN state it or do not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions
from hsloc.model import IDENTITY, Pose2, Scan
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def laser_lines(mountings: Sequence[Pose2], turn: float = 0.1) -> list[str]:
    """FLASER lines of a robot that drives in a circle, with its laser's pose by these mountings."""
    lines, robot = [], Pose2(3.0, -2.0, 0.4)
    for k, mounting in enumerate(mountings):
        robot = robot @ Pose2(0.2, 0.0, turn)
        laser = robot @ mounting
        numbers = " ".join(f"{value:.3f}" for each in (laser, robot) for value in each.to_array())
        lines.append(f"FLASER 4 1 2 3 4 {numbers} {k} host 1.5")
    return lines


@pytest.mark.parametrize("mounting", [Pose2(0.78, 0.0, 0.0), Pose2(-0.1, 0.05, 0.3)])
def test_laser_lines_that_all_state_one_mounting_are_believed(tmp_path: Path, mounting: Pose2) -> None:
    path = tmp_path / "log.clf"
    path.write_text("\n".join(laser_lines([mounting] * 40)))
    log = open_log(path)
    assert log.summary.extrinsics == "file format"
    assert not log.summary.warnings
    assert log.summary.T_base_laser.to_array() == pytest.approx(mounting.to_array(), abs=0.002)
    assert {event.T_base_laser for event in log.events() if isinstance(event, Scan)} == {log.summary.T_base_laser}
    given = open_log(path, ReadOptions(laser_pose=Pose2(0.2, 0.0, 0.0)))
    assert (given.summary.extrinsics, given.summary.T_base_laser) == ("option", Pose2(0.2, 0.0, 0.0))


@pytest.mark.parametrize(
    "lines",
    [
        laser_lines([Pose2(0.01 * k, 0.0, 0.0) for k in range(40)]),  # a mapper's correction
        laser_lines([Pose2(0.3, 0.0, 0.0)] * 10),
        laser_lines([Pose2(0.3, 0.0, 0.0)] * 40, turn=0.0),
        laser_lines([IDENTITY] * 40),
        [" ".join([*line.split()[:6], "nan", *line.split()[7:]]) for line in laser_lines([IDENTITY] * 40)],
    ],
)
def test_other_laser_lines_state_no_mounting(tmp_path: Path, lines: Sequence[str]) -> None:
    path = tmp_path / "log.clf"
    path.write_text("\n".join(lines))
    log = open_log(path)
    assert (log.summary.extrinsics, log.summary.T_base_laser) == ("identity", IDENTITY)
    assert [warning.code for warning in log.summary.warnings] == [WarningCode.EXTRINSICS_ASSUMED]
    assert {event.T_base_laser for event in log.events() if isinstance(event, Scan)} == {IDENTITY}
