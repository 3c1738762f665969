"""A map that is saved, read again, and extended by a further log."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hsloc.errors import MapError
from hsloc.slam.map_state import MapState, read_state, write_state
from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import GraphMapperParameters

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.model import Odometry, PairedScan, Trajectory


@pytest.fixture(scope="module")
def state(office: tuple[list[Odometry | PairedScan], Trajectory]) -> MapState:
    mapper = Mapper(GraphMapperParameters(), np.random.default_rng(0))
    for event in office[0][: len(office[0]) // 2]:
        mapper.update(event)
    return mapper.finish().state  # type: ignore[return-value]


def test_what_is_read_is_what_was_written(state: MapState, tmp_path: Path) -> None:
    write_state(state, tmp_path / "map.npz")
    read = read_state(tmp_path / "map.npz")
    for part in ("points", "normals", "centroids", "start", "hit_of_beam", "ranges", "table_start", "geometry"):
        np.testing.assert_array_equal(getattr(read.scans, part), getattr(state.scans, part))
    for part in ("stamps_ns", "poses", "covariances", "refused"):
        np.testing.assert_array_equal(getattr(read, part), getattr(state, part))
    for ours, theirs in ((read.steps, state.steps), (read.loops, state.loops)):
        for part in ("pairs", "measured", "information", "scale"):
            np.testing.assert_array_equal(getattr(ours, part), getattr(theirs, part))
    np.testing.assert_array_equal(read.grid.cells, state.grid.cells)
    assert (read.grid.origin, read.grid.resolution) == (state.grid.origin, state.grid.resolution)
    assert read.fingerprint == state.fingerprint
    write_state(read, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "map.npz").read_bytes()


def changed(path: Path, **arrays: NDArray[Any] | np.int64) -> None:
    with np.load(path) as archive:
        kept = dict(archive)
    np.savez(path, **{**kept, **arrays})


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda path: path.write_bytes(b"P5 not at all"), "not a saved map"),
        (lambda path: path.write_bytes(path.read_bytes()[:5000]), "not a saved map"),
        (lambda path: path.unlink(), "cannot be read"),
        (lambda path: np.savez(path, walls=np.zeros(3)), "not a saved map"),
        (lambda path: changed(path, version=np.int64(99)), "version 99"),
        (lambda path: changed(path, version=np.array(["1"])), "version"),
        (lambda path: changed(path, poses=np.zeros((2, 3))), "poses"),
        (lambda path: changed(path, hit_of_beam=np.zeros(3, np.int32)), "hit_of_beam"),
        (lambda path: changed(path, ranges=np.zeros(3, np.float32)), "shape"),
        (lambda path: changed(path, points=np.zeros((3, 2))), "points"),
    ],
)
def test_files_that_are_no_saved_map_are_refused_in_one_line(
    state: MapState, tmp_path: Path, spoil: Callable[..., Any], expected: str
) -> None:
    path = tmp_path / "map.npz"
    write_state(state, path)
    spoil(path)
    with pytest.raises(MapError, match=expected) as error:
        read_state(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_indices_that_would_lead_out_of_an_array_are_refused(state: MapState, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    rows = state.scans.hit_of_beam.copy()
    rows[np.argmax(rows)] += 1000
    write_state(replace(state, scans=replace(state.scans, hit_of_beam=rows)), path)
    with pytest.raises(MapError, match="does not name the points"):
        read_state(path)
    write_state(replace(state, steps=replace(state.steps, pairs=state.steps.pairs + 5000)), path)
    with pytest.raises(MapError, match="keyscans that are not there"):
        read_state(path)
