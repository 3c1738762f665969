"""A built map is brought into the frame of a floor plan, if its walls fit one place of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.analysis.analyse import analyse
from hsloc.errors import ConfigError, MapError
from hsloc.log import open_log
from hsloc.maps import save_map
from hsloc.model import OccupancyGrid, Pose2
from hsloc.model.pose2 import compose_poses
from hsloc.replay.run import run
from hsloc.report.table import table_rows
from hsloc.request import RunRequest
from hsloc.slam.plan_alignment import find_on_plan

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.model import Trajectory

T_PLAN_WORLD = Pose2(3.3, -7.7, 2.1)


def drawn(name: str, T_plan_world: Pose2, scale: float = 1.0) -> OccupancyGrid:
    """The map of a recording, turned as a plan may be; doors and walls are a cell thick in both."""
    world = open_log(RECORDINGS / f"{name}.mcap").map()
    assert world is not None
    points = [T_plan_world @ world.centres(which) * scale for which in (world.free(), world.occupied())]
    corner = np.floor(np.concatenate(points).min(axis=0)) - 1.0
    cells = [np.floor((part - corner) / 0.05).astype(np.int64) for part in points]
    width, height = np.concatenate(cells).max(axis=0) + 20
    found = np.full((height, width), -1, dtype=np.int8)
    for (columns, rows), value in zip((part.T for part in cells), (0, 100), strict=True):
        found[rows, columns] = value
    return OccupancyGrid(found, 0.05, Pose2(float(corner[0]), float(corner[1])))


def free_places(grid: OccupancyGrid) -> np.ndarray:
    places = grid.centres(grid.free())[::500]
    return np.column_stack((places, np.zeros(len(places))))


@pytest.mark.parametrize("scale", [1.0, 1.01])
def test_a_map_is_found_on_its_plan(scale: float) -> None:
    plan, built = drawn("office", T_PLAN_WORLD, scale), drawn("office", Pose2(0.0, 0.0, -0.4))
    # Half of what is on the plan was not driven, and a third of the walls of the map are things that it does not have.
    cells = built.cells.copy()
    cells[:, cells.shape[1] // 2 :] = -1
    things = np.random.default_rng(0).integers((0, 0), (cells.shape[0], cells.shape[1] // 2), size=(400, 2))
    cells[tuple(things[cells[tuple(things.T)] == 0].T)] = 100
    built = OccupancyGrid(cells, built.resolution, built.origin)
    fit = find_on_plan(plan, built, free_places(built))
    assert fit.is_certain
    assert fit.T_plan_map is not None
    off = (T_PLAN_WORLD @ Pose2(0.0, 0.0, 0.4)).between(fit.T_plan_map)
    # A plan that is too large by 1 % puts the map where it fits on the whole, a tenth of a metre away.
    assert np.hypot(off.x, off.y) < (0.03 if scale == 1.0 else 0.3)
    assert abs(off.theta) < np.radians(0.3)
    assert fit.elsewhere < fit.fitness


def test_a_map_that_fits_twice_or_nowhere_is_not_placed() -> None:
    office = drawn("office", Pose2(0.0, 0.0, 0.0))
    twice = OccupancyGrid(np.hstack((office.cells, office.cells)), office.resolution, office.origin)
    fit = find_on_plan(twice, office, free_places(office))
    assert not fit.is_certain
    assert len(fit.places) == 2
    assert fit.places[0].distance(fit.places[1]) == pytest.approx(office.cells.shape[1] * 0.05, abs=0.05)
    assert not find_on_plan(drawn("hall", T_PLAN_WORLD), office, free_places(office)).is_certain
    empty = OccupancyGrid(np.zeros((20, 20), dtype=np.int8), 0.05)
    assert not find_on_plan(office, empty, free_places(office)).is_certain
    with pytest.raises(MapError, match="no occupied cell"):
        find_on_plan(empty, office, free_places(office))


def on_plan(reference: Trajectory, stamps_ns: np.ndarray) -> np.ndarray:
    return compose_poses(T_PLAN_WORLD.to_array(), reference.interpolated(stamps_ns))


@pytest.mark.unmeasured
def test_a_run_is_in_the_frame_of_the_plan(tmp_path: Path) -> None:
    for name in ("office", "hall"):
        (tmp_path / name).mkdir()
        save_map(drawn(name, T_PLAN_WORLD), tmp_path / name)
    log = RECORDINGS / "office.mcap"
    found = run(log, align_to=tmp_path / "office" / "map.yaml", end_s=12.0)
    assert found.mode == "slam", "although the log has a map"
    assert found.reference is not None
    off = found.trajectory.poses - on_plan(found.reference, found.trajectory.stamps_ns)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    metrics = analyse(found).metrics.to_json()
    assert metrics["map"]["plan"]["certain"]
    assert metrics["map"]["plan"]["walls_near"] > 0.99
    rows = {row.label: row.values for row in table_rows(analyse(found).metrics)}
    x, y, yaw = metrics["map"]["plan"]["pose"]
    assert rows["place on the floor plan"] == (f"x {x:.2f} m, y {y:.2f} m, {np.degrees(yaw):.0f}°",)
    other = run(log, align_to=tmp_path / "hall" / "map.yaml", end_s=12.0)
    metrics = analyse(other).metrics.to_json()
    assert [reason["code"] for reason in metrics["verdict_reasons"]] == ["plan_not_found"]
    assert np.abs(other.trajectory.poses[0]).max() < 1e-6, "in its own frame, with the first pose as origin"
    assert metrics["map"]["plan"]["walls_near"] is None
    (place,) = (row.values for row in table_rows(analyse(other).metrics) if row.label == "place on the floor plan")
    assert place[0].startswith("not certain; it fits best at x ")


@pytest.mark.parametrize("other", [{"resume": "before"}, {"mode": "localise"}, {"mapper": "point"}])
def test_only_the_graph_mapper_has_a_plan(other: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match="leave out --align-to"):
        RunRequest.from_values(["run.mcap"], {"align_to": "plan.yaml", **other})
