"""What changed since a map was made, as the scans of a run show it, and what the results say of it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from math import pi
from typing import TYPE_CHECKING

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.analysis import map_changes
from hsloc.analysis.map_changes import HIDDEN, MapChangeFinder, SeenChanges, with_changes
from hsloc.analysis.quality import change_warnings
from hsloc.evaluation.maps import MOST_GONE, MapChange
from hsloc.export.results_folder import write_results
from hsloc.localisation.states import StateRows
from hsloc.maps import load_map, save_map
from hsloc.model import OccupancyGrid, Pose2, Scan, Trajectory
from hsloc.model.estimate import State
from hsloc.replay.run import run
from hsloc.simulation.built_in import built_in
from hsloc.warnings import WarningCode

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.export.results_folder import WrittenResults

SIDE, BEAMS = 100, 720
LASER = Pose2(0.1, 0.0, 0.0)


def room(*things: tuple[int, int, int, int]) -> OccupancyGrid:
    """5 x 5 m in cells of 5 cm within walls of two cells, with boxes (row, column, height, width) in it."""
    cells = np.zeros((SIDE, SIDE), dtype=np.int8)
    cells[:2], cells[-2:], cells[:, :2], cells[:, -2:] = 100, 100, 100, 100
    for row, column, height, width in things:
        cells[row : row + height, column : column + width] = 100
    return OccupancyGrid(cells, 0.05, Pose2(-1.0, 2.0, 0.3))


def seen_from(truth: OccupancyGrid, pose: Pose2, seconds: float) -> Scan:
    """What a lidar sees: the first occupied cell along each beam, in steps of a millimetre."""
    laser = truth.origin.inverse() @ pose @ LASER
    angles = laser.theta + np.arange(BEAMS) * 2.0 * pi / BEAMS
    reach = np.arange(0.05, 8.0, 0.001)
    u = ((laser.x + np.cos(angles)[:, None] * reach) / truth.resolution).astype(np.int64)
    v = ((laser.y + np.sin(angles)[:, None] * reach) / truth.resolution).astype(np.int64)
    hit = truth.occupied()[np.clip(v, 0, SIDE - 1), np.clip(u, 0, SIDE - 1)]
    ranges = np.where(hit.any(axis=1), reach[hit.argmax(axis=1)], np.inf).astype(np.float32)
    return Scan(round(seconds * 1e9), ranges, 0.0, 2.0 * pi / BEAMS, 0.05, 8.0, frame_id="laser", T_base_laser=LASER)


def around(grid: OccupancyGrid, n: int = 16) -> list[Pose2]:
    """Poses on a circle of 1.2 m around the middle of the room, 0.47 m apart."""
    turns = np.arange(n) * 2.0 * pi / n
    return [grid.origin @ Pose2(2.5 + 1.2 * np.cos(a), 2.5 + 1.2 * np.sin(a), a) for a in turns.tolist()]


def found_in(given: OccupancyGrid, truths: list[OccupancyGrid]) -> SeenChanges | None:
    """By one scan from each place, a second after another, of the room as it then was."""
    finder = MapChangeFinder(given)
    for k, (truth, pose) in enumerate(zip(truths, around(given, len(truths)), strict=True)):
        scan = seen_from(truth, pose, float(k))
        finder.add(scan, scan.points_base(), pose)
    return finder.changes()


def test_a_room_as_it_was_has_no_changes() -> None:
    grid = room((60, 70, 10, 10))
    found = found_in(grid, [grid] * 16)
    assert found is not None
    assert (found.changes, found.gone, found.hidden.max()) == ((), 0.0, 0.0)
    assert (found.layer.cells == -1).all()


def test_a_thing_that_came_and_one_that_went_are_found_where_they_are_and_when() -> None:
    table, shelf = (45, 45, 10, 10), (80, 40, 8, 20)
    given, truth = room(table), room(shelf)
    found = found_in(given, [truth] * 16)
    assert found is not None
    by_kind = {each.kind: each for each in found.changes}
    assert [each.kind for each in found.changes] == ["appeared", "vanished"], "the larger first"
    for kind, (row, column, height, width) in (("vanished", table), ("appeared", shelf)):
        middle = given.origin @ (np.array((column + 0.5 * width, row + 0.5 * height)) * given.resolution)
        assert np.hypot(by_kind[kind].x - middle[0], by_kind[kind].y - middle[1]) < 0.25
    assert by_kind["vanished"].cells == 100
    inside = np.zeros((SIDE, SIDE), dtype=np.bool_)
    inside[80:88, 40:60] = True
    assert found.layer.occupied()[inside].any()
    assert not found.layer.occupied()[~inside].any()
    assert found.spans_ns.tolist() == [[0, 15_000_000_000]] * 2
    assert 0.02 < found.hidden.mean() < 0.2
    walls = 2 * 2 * SIDE + 2 * 2 * (SIDE - 4)
    assert found.gone == pytest.approx(100 / (walls / 2 + 100), rel=0.2), "of each wall the inner row is seen"


def test_what_stood_there_a_while_is_no_change_and_what_came_late_has_its_time() -> None:
    box = (30, 30, 10, 10)
    given, with_box = room(), room(box)
    passing = found_in(given, [with_box if k in {3, 4, 5} else given for k in range(16)])
    assert passing is not None
    assert passing.changes == ()
    late = found_in(given, [given] * 3 + [with_box] * 13)
    assert late is not None
    (change,) = late.changes
    assert change.kind == "appeared"
    assert late.spans_ns.tolist() == [[3_000_000_000, 15_000_000_000]]


def test_a_wall_along_which_beams_graze_is_not_gone() -> None:
    """Beams within 9 deg of the direction of a wall pass through it: it may be there, beside them."""
    given = room((48, 60, 3, 30))
    finder = MapChangeFinder(given)
    for k in range(12):
        pose = given.origin @ Pose2(0.3 + 0.1 * k, 2.42, 0.0)
        scan = seen_from(room(), pose, 3.0 * k)
        points = scan.points_base()
        finder.add(scan, points[np.abs(np.arctan2(points[:, 1], points[:, 0] - LASER.x)) < 0.15], pose)
    found = finder.changes()
    assert found is not None
    assert found.changes == ()


def test_scans_that_are_kept_are_bounded_and_spread_over_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_changes, "_MOST_SCANS", 10)
    given, truth = room(), room((60, 60, 10, 10))
    finder = MapChangeFinder(given)
    for k in range(100):
        pose = around(given)[k % 16]
        scan = seen_from(truth, pose, float(k))
        finder.add(scan, scan.points_base(), pose)
    found = finder.changes()
    assert found is not None
    assert len(found.stamps_ns) <= 10
    assert np.ptp(found.stamps_ns) > 0.8 * 99e9
    assert len(found.changes) == 1


def test_scans_at_rest_are_not_new_witnesses() -> None:
    grid = room()
    finder = MapChangeFinder(grid)
    scan = seen_from(room((60, 60, 10, 10)), around(grid)[0], 0.0)
    for k in range(20):
        finder.add(replace(scan, stamp_ns=k * 100_000_000), scan.points_base(), around(grid)[0])
    assert finder.changes() is None, "one scan in 2 s"


def changes_with(hidden: list[float], gone: float) -> SeenChanges:
    grid = room()
    stamps = np.arange(len(hidden), dtype=np.int64) * 1_000_000_000
    thing = MapChange(kind="appeared", x=1.0, y=2.0, size=0.5, cells=10)
    return SeenChanges((thing,), np.array([[0, 1_000_000_000]]), stamps, np.array(hidden), gone, grid)


@pytest.mark.parametrize(
    ("hidden", "gone", "text"),
    [
        (
            [0.0, HIDDEN, HIDDEN, HIDDEN, 0.0],
            0.0,
            "20 % of the beams and more end at things that it lacks, from 1.0 to 3.0 s",
        ),
        ([0.0] * 5, MOST_GONE, "20 % of its walls that were seen are gone"),
        ([0.0, HIDDEN, HIDDEN, 0.0, HIDDEN], 0.9 * MOST_GONE, ""),
    ],
)
def test_a_map_that_is_out_of_date_is_warned_of(hidden: list[float], gone: float, text: str) -> None:
    trajectory = Trajectory(np.array([0], dtype=np.int64), np.zeros((1, 3)))
    found = change_warnings(changes_with(hidden, gone), trajectory)
    assert [each.text for each in found] == ([f"the map has changed: {text}"] if text else [])
    assert all(each.code == WarningCode.MAP_CHANGED for each in found)
    assert change_warnings(None, trajectory) == []


def test_poses_say_where_the_map_has_changed() -> None:
    stamps = np.arange(6, dtype=np.int64) * 1_000_000_000
    states = (*[State.LOCALISED] * 3, State.LOST, State.LOCALISED, State.LOCALISED)
    rows = StateRows(states, np.ones(6), np.zeros((6, 3)), np.ones(6), ("", "", "by the odometry alone", "", "", ""))
    found = with_changes(rows, stamps, changes_with([0.0, 0.2, 0.3, 0.4, 0.3, 0.1], 0.0))
    text = "the map has changed here: {} % of the beams end at things that it lacks"
    both = f"by the odometry alone; {text.format(30)}"
    assert found.reason == ("", text.format(20), both, "", text.format(30), "")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[WrittenResults, Path]:
    """The office on a map without one of its tables, and with a box in a room that is free."""
    folder = tmp_path_factory.mktemp("changes")
    world = built_in("office")
    grid = world.occupancy_grid(0.05)
    cells = grid.cells.copy()
    cells[round(3.6 / 0.05) : round(5.1 / 0.05), round(22.4 / 0.05) : round(25.4 / 0.05)] = 0
    cells[round(9.1 / 0.05) : round(9.7 / 0.05), round(2.0 / 0.05) : round(2.6 / 0.05)] = 100
    map_path = save_map(replace(grid, cells=cells), folder / "given")
    result = run(RECORDINGS / "office.mcap", map=map_path, initial_pose=world.start())
    return write_results(result, folder / "out"), folder / "out"


def test_results_list_the_changes_and_have_them_as_a_map(results: tuple[WrittenResults, Path]) -> None:
    written, folder = results
    with (folder / "changes.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows] == ["appeared", "vanished"]
    for row, (x, y) in zip(rows, ((23.9, 4.2), (2.3, 9.3)), strict=True):
        assert np.hypot(float(row["x"]) - x, float(row["y"]) - y) < 0.6
        assert float(row["first"]) < float(row["last"])
    layer, given = load_map(folder / "changes.yaml"), load_map(folder.parent / "given.yaml")
    assert (layer.cells.shape, layer.resolution, layer.origin) == (given.cells.shape, given.resolution, given.origin)
    assert layer.occupied().sum() == int(rows[0]["cells"])
    assert layer.free().sum() == int(rows[1]["cells"])
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    changes = metrics["map"]["changes"]
    assert (changes["appeared"], changes["vanished"]) == (1, 1)
    assert metrics["verdict"] == "good"
    assert "map_changed" not in [each["code"] for each in metrics["warnings"]]
    marks = {mark["status"]: mark for mark in written.view.values["marks"]}
    assert marks["appeared"]["x"] == [float(f"{float(rows[0]['x']):.3f}")]
    assert "on the map, but gone; shown by scans from" in marks["vanished"]["reason"][0]


def test_the_recording_has_the_changed_cells_as_markers(results: tuple[WrittenResults, Path]) -> None:
    from mcap.reader import make_reader

    with (results[1] / "run.mcap").open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages(topics=["/map_changes"])}
    assert topics == {"/map_changes"}


def test_the_right_map_has_no_changes(tmp_path: Path) -> None:
    result = run(RECORDINGS / "office.mcap", end_s=40.0)
    written = write_results(result, tmp_path / "out")
    changes = written.metrics.map.changes
    assert changes is not None
    assert (changes.appeared, changes.vanished) == (0, 0)
    assert not (tmp_path / "out" / "changes.csv").exists()
