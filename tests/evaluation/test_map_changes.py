"""What changed between two maps, and `hsloc diff`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from hsloc.cli.main import main
from hsloc.evaluation.maps import map_changes
from hsloc.maps import save_map
from hsloc.model import OccupancyGrid, Pose2

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def room(*things: tuple[int, int, int, int]) -> OccupancyGrid:
    """5 x 4 m in cells of 5 cm, with boxes (row, column, height, width) in it; unknown beyond the walls."""
    cells = np.full((100, 120), -1, dtype=np.int8)
    cells[10:90, 10:110] = 0
    cells[10, 10:110] = cells[89, 10:110] = cells[10:90, 10] = cells[10:90, 109] = 100
    for row, column, height, width in things:
        cells[row : row + height, column : column + width] = 100
    return OccupancyGrid(cells, 0.05, Pose2(-1.0, 2.0, 0.0))


def test_what_appeared_and_what_vanished_is_found_with_place_and_size() -> None:
    table, cupboard, cup = (40, 40, 8, 16), (60, 80, 10, 6), (30, 90, 2, 2)
    found = map_changes(room(table), room(cupboard, cup))
    assert [change.kind for change in found.changes] == ["vanished", "appeared"]
    gone, new = found.changes
    assert (gone.cells, new.cells) == (128, 60)
    np.testing.assert_allclose((gone.size, gone.x, gone.y), (0.8, -1.0 + 48 * 0.05, 2.0 + 44 * 0.05))
    assert found.shared == 1.0
    assert len(map_changes(room(table), room(table, cup), min_size=0.05).changes) == 1
    assert map_changes(room(table), room(table)).changes == ()


def test_a_map_in_another_frame_is_moved_and_what_is_unknown_is_no_change() -> None:
    second = room((40, 40, 8, 16))
    pose = Pose2(3.0, -1.0, 0.7)
    turned = OccupancyGrid(second.cells, second.resolution, pose.inverse() @ second.origin)
    assert map_changes(room(), turned, pose).changes[0].kind == "appeared"
    assert len(map_changes(room(), turned, pose).changes) == 1
    cells = second.cells.copy()
    cells[:, 50:] = -1
    half = OccupancyGrid(cells, second.resolution, second.origin)
    assert all(change.x < 1.6 for change in map_changes(room(), half).changes)
    assert map_changes(room(), half).shared < 0.5


def test_the_command_lists_changes_and_draws_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, grid in (("before", room((40, 40, 8, 16))), ("after", room())):
        (tmp_path / name).mkdir()
        save_map(grid, tmp_path / name)
    names = [str(tmp_path / name / "map.yaml") for name in ("before", "after")]
    assert main(["diff", *names, "--png", str(tmp_path / "changes.png")]) == 0
    out = capsys.readouterr().out
    assert "appeared: 0, vanished: 1" in out
    assert "known in both maps: 100 %" in out
    assert (tmp_path / "changes.png").stat().st_size > 100
    assert main(["diff", *names, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["changes"][0]["kind"] == "vanished"
    assert main(["diff", names[0], str(tmp_path / "none.yaml")]) == 1
    assert "none.yaml" in capsys.readouterr().err


def test_of_maps_that_hardly_agree_is_warned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """However little of the first map the second knows: what neither says anything about is no agreement."""
    small = room()
    cells = np.full((100, 400), -1, dtype=np.int8)
    cells[:, :120] = small.cells
    cells[10:90, 150:390] = 0
    cells[10:90:4, 150:390] = 100
    moved = OccupancyGrid(small.cells, small.resolution, small.origin @ Pose2(0.7, 0.4, 0.0))
    for name, grid in (("large", OccupancyGrid(cells, 0.05, small.origin)), ("same", small), ("moved", moved)):
        (tmp_path / name).mkdir()
        save_map(grid, tmp_path / name)
    large, same, other = (str(tmp_path / name / "map.yaml") for name in ("large", "same", "moved"))
    assert main(["diff", large, same]) == 0
    assert capsys.readouterr().err == ""
    assert main(["diff", large, other]) == 0
    assert "is it the same building" in capsys.readouterr().err
