"""A log that is mapped in two parts: the second extends what the first left behind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.errors import ConfigError, HslocError, MapError
from hsloc.evaluation.metrics import compare
from hsloc.export.results_folder import write_results
from hsloc.log import ReadOptions
from hsloc.model.pose2 import compose_poses, wrap_angles
from hsloc.replay.run import Result, run
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

pytestmark = pytest.mark.unmeasured

OFFICE = RECORDINGS / "office.mcap"


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    """The first minute of the office: the result, and its folder."""
    folder = tmp_path_factory.mktemp("first") / "out"
    found = run(RunRequest(logs=(OFFICE,), mode="slam", read=ReadOptions(end_s=60.0)))
    write_results(found, folder)
    return found, folder


@pytest.fixture(scope="module")
def second(first: tuple[Result, Path]) -> Result:
    return run(RunRequest(logs=(OFFICE,), resume=first[1], read=ReadOptions(start_s=55.0)))


def errors_in_frame_of(first: Result, found: Result) -> NDArray[np.float64]:
    """Distances (m) from the truth, the estimate moved as is best for the first part alone."""
    assert first.reference is not None
    assert found.reference is not None
    moved = compare(first.trajectory, first.reference, alignment="se2").T_reference_estimate
    known = (found.trajectory.stamps_ns >= found.reference.stamps_ns[0]) & (
        found.trajectory.stamps_ns <= found.reference.stamps_ns[-1]
    )
    ours = compose_poses(moved.to_array(), found.trajectory.poses[known])
    truth = found.reference.interpolated(found.trajectory.stamps_ns[known])
    distances: NDArray[np.float64] = np.hypot(*(ours - truth)[:, :2].T)
    return distances


def test_the_second_part_is_right_in_the_frame_of_the_first(
    first: tuple[Result, Path], second: Result, tmp_path: Path
) -> None:
    errors = errors_in_frame_of(first[0], second)
    assert len(errors) > 2800
    assert np.sqrt((errors**2).mean()) < 0.05
    assert errors.max() < 0.1
    metrics = write_results(second, tmp_path / "out").metrics
    assert metrics.map.comparison.precision > 0.95
    assert metrics.run.map == "out, extended"
    whole = first[0].mapping.quality.keyscans + int((second.diagnostics.fitness > 0).sum())
    assert second.mapping.quality.keyscans == pytest.approx(whole, abs=2)
    assert second.grid.free().sum() > first[0].grid.free().sum() + 5000, "25 square metres that were not seen before"
    # And what was extended can be extended again.
    third = run(
        RunRequest(logs=(OFFICE,), resume=tmp_path / "out" / "map.npz", read=ReadOptions(start_s=20.0, end_s=35.0))
    )
    errors = errors_in_frame_of(first[0], third)
    assert np.sqrt((errors**2).mean()) < 0.05


def test_the_old_map_stays_where_it_was(first: tuple[Result, Path], second: Result) -> None:
    n = len(first[0].mapping.keyscan_poses)
    moved = second.mapping.keyscan_poses[:n] - first[0].mapping.keyscan_poses
    assert np.abs(moved[:, :2]).max() < 0.03
    assert np.abs(wrap_angles(moved[:, 2])).max() < 0.005


def test_the_same_inputs_give_the_same_bytes(first: tuple[Result, Path], second: Result, tmp_path: Path) -> None:
    again = run(RunRequest(logs=(OFFICE,), resume=first[1] / "map.npz", read=ReadOptions(start_s=55.0)))
    write_results(again, tmp_path / "again")
    write_results(second, tmp_path / "second")
    for name in ("map.npz", "map.pgm", "graph.g2o", "trajectory.tum"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "second" / name).read_bytes(), name


def test_a_log_of_another_building_is_not_joined(first: tuple[Result, Path]) -> None:
    with pytest.raises(MapError, match="no place of the log was recognised") as error:
        run(RunRequest(logs=(RECORDINGS / "corridor_loop.mcap",), resume=first[1], read=ReadOptions(end_s=25.0)))
    assert "\n" not in str(error.value)


def test_all_forms_of_a_map_can_be_localised_in(first: tuple[Result, Path]) -> None:
    _, folder = first
    stamps = ReadOptions(start_s=5.0, end_s=25.0)
    found = [
        run(RunRequest(logs=(OFFICE,), map_path=path, unknown_start=True, read=stamps))
        for path in (folder, folder / "map.yaml", folder / "map.npz")
    ]
    for result in found:
        errors = errors_in_frame_of(first[0], result)[result.localised]
        assert result.localised.mean() > 0.9
        assert np.sqrt((errors**2).mean()) < 0.05


def test_mistakes_are_reported(first: tuple[Result, Path], tmp_path: Path) -> None:
    _, folder = first
    wrong: dict[str, Any]
    for wrong, expected in (
        ({"resume": tmp_path}, "no map.npz there"),
        ({"resume": OFFICE}, "not a saved map"),
        ({"map_path": tmp_path}, "without a map.yaml"),
    ):
        with pytest.raises(HslocError, match=expected):
            run(RunRequest(logs=(OFFICE,), **wrong))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="leave out one"):
        RunRequest(logs=(OFFICE,), resume=folder, map_path=folder)
    with pytest.raises(ConfigError, match="leave out one"):
        RunRequest(logs=(OFFICE,), resume=folder, mode="localise")
