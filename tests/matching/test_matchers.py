"""What every matcher must do, and how exactly the default does it."""

from __future__ import annotations

from dataclasses import replace
from math import radians
from typing import TYPE_CHECKING, Any

import naive
import numpy as np
import pytest

from hsloc.errors import ConfigError, MapError
from hsloc.matching import HarmonySearch, Hide, Icp, LikelihoodField, StopReason, Window
from hsloc.matching.icp import rigid_motion
from hsloc.model import OccupancyGrid, Pose2, wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

ALL = [Hide(), HarmonySearch(), Icp()]
SEARCHES = [Hide(), HarmonySearch(), Hide.paper(), HarmonySearch.paper(), Hide.paper_literal()]


@pytest.fixture(scope="module")
def scene() -> tuple[LikelihoodField, NDArray[np.float64]]:
    grid, walls = naive.room()
    return LikelihoodField.from_grid(grid), walls


def error(found: Pose2, true: Pose2) -> tuple[float, float]:
    return true.distance(found), abs(wrap_angle(found.theta - true.theta))


@pytest.mark.parametrize("matcher", ALL, ids=lambda m: type(m).__name__)
def test_finds_the_pose_of_a_scan_in_a_room(
    scene: tuple[LikelihoodField, NDArray[np.float64]], matcher: HarmonySearch | Hide | Icp
) -> None:
    field, walls = scene
    true = Pose2(1.3, 0.4, 0.7)
    window = Window(Pose2(1.4, 0.32, 0.66), 0.2, 0.2, 0.1)
    match = matcher.match(naive.scan_points(walls, true), field, window, np.random.default_rng(0))
    metres, angle = error(match.pose, true)
    assert metres < 0.01
    assert angle < radians(0.2)
    assert match.fitness > 0.95
    assert match.evaluations > 0
    assert np.linalg.eigvalsh(match.covariance).min() > 0.0


@pytest.mark.parametrize("matcher", SEARCHES, ids=str)
def test_the_pose_lies_in_the_window_and_the_same_seed_gives_the_same_match(
    scene: tuple[LikelihoodField, NDArray[np.float64]], matcher: HarmonySearch | Hide
) -> None:
    field, walls = scene
    points = naive.scan_points(walls, Pose2(1.3, 0.4, 0.7))
    window = Window(Pose2(2.0, 1.2, -3.1), 0.4, 0.3, 0.2)
    first, second = (matcher.match(points, field, window, np.random.default_rng(4)) for _ in range(2))
    # The box is kept in cells; a pose on its border may be off by the rounding.
    assert Window(window.centre, 0.4 + 1e-9, 0.3 + 1e-9, 0.2 + 1e-9).contains(first.pose)
    assert first.pose == second.pose
    assert first.evaluations == second.evaluations
    assert np.array_equal(first.covariance, second.covariance)


def test_walls_through_the_centres_of_cells_are_found_without_half_a_cell_of_bias(
    scene: tuple[LikelihoodField, NDArray[np.float64]],
) -> None:
    field, walls = scene
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(15):
        true = Pose2(rng.uniform(0.0, 2.5), rng.uniform(-1.0, 3.0), rng.uniform(-3.0, 3.0))
        start = Pose2(true.x + rng.uniform(-0.1, 0.1), true.y + rng.uniform(-0.1, 0.1), true.theta + 0.05)
        match = Hide().match(naive.scan_points(walls, true), field, Window(start, 0.2, 0.2, 0.1), rng)
        errors.append(error(match.pose, true)[0])
    assert np.mean(errors) < 0.005


def test_a_turned_map_gives_the_same_answer_in_its_own_frame() -> None:
    grid, walls = naive.room()
    turned = OccupancyGrid(grid.cells, grid.resolution, Pose2(5.0, -3.0, 1.2) @ grid.origin)
    true = Pose2(1.3, 0.4, 0.7)
    moved = Pose2(5.0, -3.0, 1.2) @ true
    points = naive.scan_points(walls, true)
    window = Window(Pose2(moved.x + 0.1, moved.y - 0.1, moved.theta + 0.05), 0.3, 0.3, 0.15)
    match = Hide().match(points, LikelihoodField.from_grid(turned), window, np.random.default_rng(0))
    assert error(match.pose, moved)[0] < 0.002


def test_a_corridor_leaves_its_own_direction_uncertain() -> None:
    cells = np.zeros((60, 400), dtype=np.int8)
    cells[5] = cells[-6] = 100
    field = LikelihoodField.from_grid(OccupancyGrid(cells, 0.05))
    xs = np.linspace(-3.0, 3.0, 60)
    points = np.concatenate([np.column_stack((xs, np.full(60, side))) for side in (-1.2, 1.2)])
    window = Window(Pose2(10.0, 1.5, 0.0), 0.3, 0.3, 0.1)
    covariance = Hide().match(points, field, window, np.random.default_rng(0)).covariance
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.3 / np.sqrt(3.0), rel=0.05)
    assert np.sqrt(covariance[1, 1]) < 0.05


def test_no_points_no_match(scene: tuple[LikelihoodField, NDArray[np.float64]]) -> None:
    field, _ = scene
    window = Window(Pose2(1.0, 1.0, 0.0), 0.3, 0.3, 0.1)
    for matcher in ALL:
        match = matcher.match(np.empty((0, 2)), field, window, np.random.default_rng(0))  # type: ignore[attr-defined]
        assert match.stopped is StopReason.NO_POINTS
        assert match.pose == window.centre
        assert match.evaluations == 0


def test_the_presets_are_those_of_the_papers() -> None:
    assert Hide.paper().budget == 220
    assert HarmonySearch.paper().budget == 250
    for preset in (Hide.paper(), HarmonySearch.paper()):
        assert (preset.memory_size, preset.consideration_rate) == (30, 0.88)
        assert (preset.par_min, preset.par_max) == (0.55, 0.98)
        assert preset.bandwidth_max == pytest.approx(8 / 30)
        assert preset.relative_bandwidth
        assert preset.polish_iterations == 0
        assert preset.restarts == 1
    literal = Hide.paper_literal()
    assert (literal.bandwidth_max, literal.bandwidth_min, literal.relative_bandwidth) == (8.0, 0.2, False)
    assert literal.count_improvisations
    assert (literal.improvisations_per_pass, literal.attraction, literal.differential_weight) == (14, 0.7, 0.44)


def test_evaluations_are_counted_truly(scene: tuple[LikelihoodField, NDArray[np.float64]]) -> None:
    field, walls = scene
    points = naive.scan_points(walls, Pose2(1.3, 0.4, 0.7))
    window = Window(Pose2(1.4, 0.3, 0.7), 0.2, 0.2, 0.1)
    rng = np.random.default_rng(0)
    # The memory counts, the final score of the best row is one more where not all points were searched with.
    assert Hide.paper().match(points, field, window, rng).evaluations == 221
    # 250 improvisations, 17 passes of 30 rows after every 14 of them, 30 rows to begin with.
    assert Hide.paper_literal().match(points, field, window, rng).evaluations == 30 + 250 + 17 * 30 + 1
    history = Hide().match(points, field, window, rng, keep_history=True).history
    assert len(history) == 240  # type: ignore[arg-type]
    assert (np.diff(history) >= 0.0).all()  # type: ignore[operator, type-var]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"memory_size": 1}, "memory_size is 1; it must be from 2 to 1e9"),
        ({"consideration_rate": 1.5}, "consideration_rate is 1.5; it must be from 0 to 1"),
        ({"bandwidth_min": 0.0}, "bandwidth_min is 0.0; it must be from 1e-9 to 1e9"),
        ({"budget": 0}, "budget is 0"),
        ({"improvisations_per_pass": 0}, "improvisations_per_pass is 0"),
    ],
)
def test_parameters_outside_their_range_are_refused(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        replace(Hide(), **changes)


def test_a_map_without_walls_is_refused() -> None:
    with pytest.raises(MapError, match="no occupied cell"):
        LikelihoodField.from_grid(OccupancyGrid(np.zeros((5, 5), dtype=np.int8), 0.05))
    with pytest.raises(MapError, match="at least one point"):
        LikelihoodField.from_points(np.empty((0, 2)), 1.0, 0.1, 1.0)


def test_the_field_holds_the_distance_to_the_nearest_wall() -> None:
    rng = np.random.default_rng(2)
    cells = np.where(rng.random((20, 30)) < 0.05, 100, 0).astype(np.int8)
    cells[10, 10] = 100
    grid = OccupancyGrid(cells, 0.1, Pose2(3.0, 4.0, 0.0))
    field = LikelihoodField.from_grid(grid, sigma=0.5)
    everywhere = grid.centres(np.ones_like(cells, dtype=bool))
    expected = [naive.distance_to_nearest(cells == 100, r, c) * 0.1 for r in range(20) for c in range(30)]
    np.testing.assert_allclose(field.distances(everywhere), expected, atol=2e-4)
    assert np.isinf(field.distances(np.array([[100.0, 100.0]]))[0])


def test_a_field_of_points_has_exact_distances_at_its_nodes() -> None:
    points = np.array([[0.03, 0.07], [1.0, 1.0]])
    field = LikelihoodField.from_points(points, sigma=1.0, resolution=0.25, margin=1.0)
    node = np.array([[field.T_map_field.x + 0.25 * 3, field.T_map_field.y + 0.25 * 5]])
    expected = np.hypot(*(points - node).T).min()
    assert field.distances(node)[0] == pytest.approx(expected, abs=1e-5)


def test_rigid_motion_is_exact_for_exact_pairs() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(10, 2))
    T = Pose2(0.3, -2.0, 2.5)
    found = rigid_motion(source, T @ source)
    assert error(found, T) == pytest.approx((0.0, 0.0), abs=1e-12)
