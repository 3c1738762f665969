"""The small picture of a result: where walls and paths are drawn in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image
from report_parts import NOTHING

from hsloc.model import OccupancyGrid, Pose2, Trajectory
from hsloc.report.data import ReportParts, prepare
from hsloc.report.map_image import THUMBNAIL, draw_thumbnail, shown_extent

if TYPE_CHECKING:
    from pathlib import Path

BLUE, PURPLE, WALL, FREE, GROUND = (0, 114, 178), (204, 121, 167), (48, 54, 61), (255, 255, 255), (236, 239, 242)


def drawn(tmp_path: Path, **parts: Any) -> Any:
    """The picture, and a function that gives the colour at a point of the map."""
    given = ReportParts(title="", **parts)
    draw_thumbnail(tmp_path / "a.png", given)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == THUMBNAIL
        pixels = np.asarray(image.convert("RGB")).astype(int)
    extent = shown_extent(prepare(given), parts.get("grid"), None).widened(THUMBNAIL[0] / THUMBNAIL[1])

    def is_at(x: float, y: float, colour: tuple[int, int, int]) -> bool:
        column = (x - extent.x0) / extent.width * THUMBNAIL[0]
        row = (extent.y1 - y) / extent.height * THUMBNAIL[1]
        return bool(np.abs(pixels[int(row), int(column)] - colour).max() < 40)

    return is_at


@pytest.mark.parametrize("origin", [Pose2(-3.0, -2.0, 0.0), Pose2(10.0, 5.0, 0.7), Pose2(0.0, 0.0, -2.0)])
@pytest.mark.parametrize("resolution", [0.02, 0.1, 0.5])
def test_walls_free_space_and_path_are_where_they_are(tmp_path: Path, origin: Pose2, resolution: float) -> None:
    sides = int(4.0 / resolution), int(6.0 / resolution)
    cells = np.zeros(sides, dtype=np.int8)
    wall, corner = int(1.0 / resolution), int(5.0 / resolution)
    cells[wall] = 100
    cells[int(3.0 / resolution) :, corner:] = -1
    at = [
        origin @ np.array(point)
        for point in ((1.0, 2.0), (4.0, 2.0), (3.0, 0.5), (2.0, 1.0 + resolution / 2), (5.7, 3.7))
    ]
    ends = np.array([[*at[0], 0.0], [*at[1], 0.0]])
    trajectory = Trajectory(np.array([0, 10**9]), ends)
    grid = OccupancyGrid(cells, resolution, origin)
    for known, colour in ((True, BLUE), (False, PURPLE)):
        is_at = drawn(tmp_path, trajectory=trajectory, grid=grid, localised=np.full(2, known))
        middle = (at[0] + at[1]) / 2.0
        assert is_at(*middle, colour)
        assert is_at(*at[2], FREE)
        assert is_at(*at[4], GROUND)
        if resolution > 0.1:  # a pixel is some 8 cm: a thinner wall is a lighter line
            assert is_at(*at[3], WALL)
        else:
            assert not is_at(*at[3], FREE)


def test_no_map_no_pose_and_a_path_that_stands_still(tmp_path: Path) -> None:
    standing = Trajectory(np.arange(3) * 10**9, np.tile([2.0, -1.0, 0.3], (3, 1)))
    assert drawn(tmp_path, trajectory=standing)(2.0, -1.0, BLUE)
    unknown = OccupancyGrid(np.full((9, 9), -1, dtype=np.int8), 0.1)
    assert drawn(tmp_path, trajectory=NOTHING, grid=unknown)(0.0, 0.0, GROUND)
    assert drawn(tmp_path, trajectory=NOTHING)(0.0, 0.0, FREE)
    first = (tmp_path / "a.png").read_bytes()
    drawn(tmp_path, trajectory=NOTHING)
    assert (tmp_path / "a.png").read_bytes() == first
