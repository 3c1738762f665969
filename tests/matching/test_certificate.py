"""What a certificate states holds, and the exact matcher keeps what it promises."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import naive
import numpy as np
import pytest

from hsloc.benchmark.cases import LEVELS, read_cases
from hsloc.errors import ConfigError
from hsloc.matching import (
    CertificateParameters,
    Exact,
    Hide,
    Icp,
    LikelihoodField,
    StopReason,
    Window,
    certify,
    summarise,
)
from hsloc.matching.exact import heuristic
from hsloc.model import OccupancyGrid, Pose2


@pytest.fixture(scope="module")
def scene() -> Any:
    grid, walls = naive.room()
    return LikelihoodField.from_grid(grid), walls


def corridor() -> Any:
    """A plain corridor without ends in sight: every place along it fits."""
    cells = np.zeros((40, 400), dtype=np.int8)
    cells[8, :] = cells[31, :] = 100
    field = LikelihoodField.from_grid(OccupancyGrid(cells, 0.05, Pose2()))
    points = np.array([(x, y) for x in np.arange(-2.0, 2.01, 0.1) for y in (-0.575, 0.575)])
    return field, points


def test_the_match_of_a_room_is_optimal_and_distinct(scene: Any) -> None:
    field, walls = scene
    true = Pose2(1.3, 0.4, 0.7)
    points = naive.scan_points(walls, true)
    window = Window(Pose2(1.5, 0.2, 0.6), 0.5, 0.5, 0.35)
    match = certify(
        Hide().match(points, field, window, np.random.default_rng(0)), points, field, window, CertificateParameters()
    )
    certificate = match.certificate
    assert certificate is not None
    assert certificate.is_optimal
    assert certificate.is_distinct
    assert 0.0 <= certificate.gap <= 0.01 + 1e-9
    assert certificate.rival_bound <= match.fitness - 0.05 + 1e-9
    assert certificate.rival is None
    assert match.pose.distance(true) < 0.01


def test_a_match_in_the_wrong_place_is_replaced_and_the_gain_is_reported(scene: Any) -> None:
    field, walls = scene
    true = Pose2(1.3, 0.4, 0.7)
    points = naive.scan_points(walls, true)
    window = Window(Pose2(1.5, 0.2, 0.6), 0.5, 0.5, 0.35)
    right = Hide().match(points, field, window, np.random.default_rng(0))
    wrong_pose = Pose2(1.8, 0.1, 0.5)
    wrong = replace(right, pose=wrong_pose, fitness=field.fitness(points, wrong_pose))
    match = certify(wrong, points, field, window, CertificateParameters())
    assert match.certificate is not None
    assert match.certificate.gain == pytest.approx(match.fitness - wrong.fitness)
    assert match.certificate.is_optimal
    assert match.fitness >= right.fitness - 0.01
    assert match.pose.distance(true) < 0.01
    assert match.fitness == pytest.approx(field.fitness(points, match.pose), abs=1e-6)


def test_a_corridor_is_optimal_but_not_distinct() -> None:
    field, points = corridor()
    window = Window(Pose2(10.0, 1.0, 0.0), 1.0, 0.3, 0.1)
    match = Exact().match(points, field, window, np.random.default_rng(0))
    certificate = match.certificate
    assert certificate is not None
    assert certificate.is_optimal
    assert not certificate.is_distinct
    assert certificate.rival is not None
    assert certificate.rival.distance(match.pose) >= 0.3 - 0.01
    assert field.fitness(points, certificate.rival) > match.fitness - 0.05
    assert certificate.rival_bound >= field.fitness(points, certificate.rival) - 1e-6


def test_work_that_does_not_suffice_is_admitted(scene: Any, rng: Any) -> None:
    field, walls = scene
    points = naive.scan_points(walls, Pose2(1.3, 0.4, 0.7)) + rng.normal(0.0, 0.05, (180, 2))
    window = Window(Pose2(1.5, 0.2, 0.6), 0.5, 0.5, 0.35)
    match = Exact(certificate=CertificateParameters(max_boxes=8)).match(points, field, window, np.random.default_rng(0))
    assert match.certificate is not None
    assert not match.certificate.is_optimal
    assert not match.certificate.is_distinct
    assert match.certificate.gap > 0.01
    assert match.stopped is StopReason.BUDGET


def test_the_field_may_be_turned_in_the_map(scene: Any) -> None:
    grid, walls = naive.room()
    turned = OccupancyGrid(grid.cells, grid.resolution, Pose2(2.0, 1.0, 0.5))
    field = LikelihoodField.from_grid(turned)
    true = Pose2(1.3, 0.4, 0.7)
    points = naive.scan_points(walls, true)
    moved = turned.origin @ grid.origin.inverse() @ true
    window = Window(Pose2(moved.x + 0.2, moved.y - 0.1, moved.theta + 0.1), 0.4, 0.4, 0.3)
    match = Exact().match(points, field, window, np.random.default_rng(0))
    assert match.pose.distance(moved) < 0.01
    assert match.certificate is not None
    assert match.certificate.is_optimal


def test_the_same_seed_gives_the_same_match(scene: Any) -> None:
    field, walls = scene
    points = naive.scan_points(walls, Pose2(1.3, 0.4, 0.7))
    window = Window(Pose2(1.5, 0.2, 0.6), 0.5, 0.5, 0.35)
    first, second = (Exact().match(points, field, window, np.random.default_rng(3)) for _ in range(2))
    assert first.pose == second.pose
    assert first.certificate == second.certificate
    assert first.stopped is StopReason.PROVEN
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_without_points_nothing_is_proven(scene: Any) -> None:
    field, _ = scene
    match = Exact().match(np.empty((0, 2)), field, Window(Pose2(), 1.0, 1.0, 1.0), np.random.default_rng(0))
    assert match.certificate is None
    assert match.stopped is StopReason.NO_POINTS


def test_many_windows_are_searched_by_the_heuristic_alone() -> None:
    seed = Hide(budget=100)
    assert heuristic(Exact(seed=seed)) is seed
    icp = Icp()
    assert heuristic(icp) is icp


def test_the_summary_of_a_run(scene: Any) -> None:
    field, points = corridor()
    matches = [
        Exact().match(points, field, Window(Pose2(10.0, 1.0, 0.0), half, 0.3, 0.1), np.random.default_rng(0))
        for half in (0.2, 1.0)
    ]
    summary = summarise(match.certificate for match in matches if match.certificate is not None)
    assert summary is not None
    assert (summary.scans, summary.optimal, summary.distinct) == (2, 1.0, 0.5)
    # Points on the middle of the walls score 1, and nothing scores more.
    assert summary.median_gap == pytest.approx(0.0, abs=1e-6)
    assert summary.max_gain == max(match.certificate.gain for match in matches if match.certificate is not None)
    assert summarise([]) is None


@pytest.mark.parametrize(
    ("name", "value"), [("epsilon", 0.0), ("margin", -0.1), ("radius", 0.0), ("angle", float("nan")), ("max_boxes", 0)]
)
def test_parameters_out_of_range_are_refused_by_name(name: Any, value: Any) -> None:
    with pytest.raises(ConfigError, match=name):
        CertificateParameters(**{name: value})


@pytest.mark.data
@pytest.mark.parametrize("level", ["small", "large"])
def test_every_fifth_real_case_is_proven_and_as_fit_as_hide(data: Any, level: Any) -> None:
    cases = read_cases(data / "match-cases" / "intel.npz")
    field = LikelihoodField.from_grid(cases.grid)
    half = LEVELS[level]
    for index in range(0, len(cases), 5):
        window = Window(Pose2.from_array(cases.starts[level][index]), half[0], half[0], half[1])
        points = cases.scans[index]
        hide = Hide().match(points, field, window, np.random.default_rng(index))
        match = Exact().match(points, field, window, np.random.default_rng(index))
        assert match.certificate is not None
        assert match.certificate.is_optimal
        assert match.fitness >= hide.fitness - 1e-9
