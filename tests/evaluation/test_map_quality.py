from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.dataclass_json import to_json
from hsloc.errors import EvaluationError
from hsloc.evaluation.maps import compare_maps, crispness
from hsloc.model import OccupancyGrid, Pose2


def picture(text: str, resolution: float = 0.05) -> OccupancyGrid:
    """A map from a drawing: # is a wall, . is free, ? is unknown; the last line is the lowest."""
    lines = text.split()
    values = {"#": 100, ".": 0, "?": -1}
    cells = np.array([[values[letter] for letter in line] for line in reversed(lines)], dtype=np.int8)
    return OccupancyGrid(cells, resolution)


def walls(*columns: int, height: int = 80, width: int = 40, resolution: float = 0.05) -> OccupancyGrid:
    """Walls that run from top to bottom."""
    cells = np.zeros((height, width), dtype=np.int8)
    cells[:, list(columns)] = 100
    return OccupancyGrid(cells, resolution)


def test_a_wall_reads_its_own_thickness() -> None:
    for columns in ((20,), (20, 21), (19, 20, 21)):
        result = crispness(walls(*columns))
        # At both ends of the wall the cloud is short, but just as wide.
        assert result.wall_thickness_median == pytest.approx(0.05 * len(columns), rel=0.1 if len(columns) > 1 else 1e-9)
        assert result.occupied_cells == 80 * len(columns)


def test_a_doubled_wall_is_less_crisp_than_a_single_one() -> None:
    single, double = crispness(walls(20)), crispness(walls(20, 24))
    assert double.wall_thickness_median > 2.5 * single.wall_thickness_median
    assert double.mean_map_entropy > single.mean_map_entropy
    # Walls farther apart than the radius are two walls.
    apart = crispness(walls(5, 30))
    assert apart.wall_thickness_median == pytest.approx(single.wall_thickness_median)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.4))
def test_the_cloud_of_each_cell_is_what_numpy_computes(seed: Any, radius: Any) -> None:
    rng = np.random.default_rng(seed)
    grid = OccupancyGrid(np.where(rng.random((9, 12)) < 0.3, 100, 0).astype(np.int8), 0.1)
    centres = grid.centres(grid.occupied())
    if len(centres) == 0:
        assert crispness(grid, radius=radius).occupied_cells == 0
        return
    thickness, entropy = [], []
    cells = np.argwhere(grid.occupied())
    for cell in cells:
        near = cells[((cells - cell) ** 2).sum(axis=1) <= (radius / 0.1) ** 2] * 0.1
        covariance = np.cov(near.T, bias=True).reshape(2, 2) if len(near) > 1 else np.zeros((2, 2))
        covariance = covariance + np.eye(2) * 0.1**2 / 12
        thickness.append(np.sqrt(12 * np.linalg.eigvalsh(covariance)[0]))
        entropy.append(0.5 * np.log(np.linalg.det(2 * np.pi * np.e * covariance)))
    result = crispness(grid, radius=radius)
    assert result.wall_thickness_mean == pytest.approx(np.mean(thickness))
    assert result.wall_thickness_p95 == pytest.approx(np.percentile(thickness, 95))
    assert result.mean_map_entropy == pytest.approx(np.mean(entropy))


def test_occupancy_entropy() -> None:
    assert crispness(walls(20)).occupancy_entropy == 0.0
    cells = np.full((5, 5), 50, dtype=np.int8)
    cells[2, 2] = 100
    cells[0, 0] = -1
    result = crispness(OccupancyGrid(cells, 1.0), radius=1.0)
    assert result.occupancy_entropy == pytest.approx(4 / 5)


def test_a_map_without_walls() -> None:
    empty = picture("... ...")
    assert to_json(crispness(empty))["wall_thickness_median"] is None
    with pytest.raises(EvaluationError, match="true map holds no occupied cell"):
        compare_maps(walls(3), empty)
    result = to_json(compare_maps(empty, walls(3)))
    assert (result["precision"], result["recall"], result["map_cells"]) == (None, 0.0, 0)


def test_comparison_by_hand() -> None:
    truth = picture("#.... #.... #....")
    ours = picture(".#... .#... ...#.")
    result = compare_maps(ours, truth, tolerance=0.05)
    assert (result.precision, result.recall) == pytest.approx((2 / 3, 2 / 3))
    assert result.f1 == pytest.approx(2 / 3)
    assert result.mean_distance_to_truth == pytest.approx(0.25 / 3)
    assert result.mean_distance_from_truth == pytest.approx((0.05 + 0.05 + 0.05 * 2**0.5) / 3)
    assert (result.map_cells, result.true_cells) == (3, 3)


def test_a_map_agrees_with_itself_wherever_it_lies() -> None:
    grid = picture("##..# .#?.# .####")
    result = compare_maps(grid, grid, tolerance=0.0)
    assert (result.precision, result.recall, result.f1) == (1.0, 1.0, 1.0)
    turn = Pose2(3.0, -1.0, 0.7)
    moved = OccupancyGrid(grid.cells, grid.resolution, turn)
    assert compare_maps(grid, moved, tolerance=0.01, T_truth_map=turn).f1 == 1.0
    assert compare_maps(grid, moved, tolerance=0.01).f1 == 0.0


def test_a_negative_tolerance() -> None:
    with pytest.raises(EvaluationError, match="must not be negative"):
        compare_maps(walls(3), walls(3), tolerance=-0.1)
