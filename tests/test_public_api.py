"""`import hsloc`: names, lazy imports, a run in one call, a matcher of one's own, results as arrays."""

from __future__ import annotations

import itertools
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imports import need_no_import
from paths import RECORDINGS

import hsloc

OFFICE = str(RECORDINGS / "office.mcap")
SLIP = str(RECORDINGS / "slip.mcap")


class MyMatcher:
    """HIDE with a name of its own."""

    def match(self, *arguments: Any) -> hsloc.Match:
        return hsloc.Hide().match(*arguments)


@pytest.fixture(scope="module")
def mine() -> hsloc.Result:
    return hsloc.run(OFFICE, matcher=MyMatcher(), end_s=12.0)


def test_every_name_is_there_and_listed() -> None:
    for name in hsloc.__all__:
        assert getattr(hsloc, name) is not None
    assert set(hsloc.__all__) <= set(dir(hsloc))
    with pytest.raises(AttributeError, match="has no attribute 'runn'"):
        hsloc.runn  # noqa: B018


def test_importing_is_cheap() -> None:
    heavy = {"numpy", "numba", "scipy", "matplotlib", "mcap", "rosbags", "ruamel"}
    need_no_import("import hsloc; from hsloc import __version__", heavy)


def test_a_matcher_of_ones_own_through_all_of_a_run(mine: hsloc.Result, tmp_path: Path) -> None:
    written = hsloc.write_results(mine, str(tmp_path / "out"))
    assert written.metrics.run.matcher == "MyMatcher"
    assert re.fullmatch(r"<WrittenResults: <Analysis: good, 0 warnings, <Comparison: 600 pairs, .*>>>", repr(written))
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["run"]["matcher"] == "MyMatcher"
    text = (tmp_path / "out" / "config.yaml").read_text()
    assert "# matcher of the caller's own: MyMatcher" in text
    named = hsloc.run(OFFICE, matcher="hide", end_s=12.0)
    np.testing.assert_array_equal(named.trajectory.poses, mine.trajectory.poses)


def test_a_result_is_a_line_and_its_poses_are_arrays(mine: hsloc.Result) -> None:
    text = repr(mine)
    assert len(text) <= 300
    for part in ("office.mcap", "localise", f"{len(mine.trajectory)} poses", "100.0 % localised", "reference"):
        assert part in text
    long = hsloc.RunRequest(logs=tuple(Path("x" * 200) / f"{k}{'y' * 90}" for k in range(9)))
    from dataclasses import replace

    assert len(repr(replace(mine, request=long))) <= 300
    frame = mine.trajectory.to_frame()
    assert list(frame.columns) == ["stamp_ns", "x", "y", "theta"]
    np.testing.assert_array_equal(frame[["x", "y", "theta"]].to_numpy(), mine.trajectory.poses)
    assert len(repr(mine.trajectory)) < 100
    assert re.fullmatch(r"<OccupancyGrid: \d+ x \d+ cells of 0.05 m, \d+ occupied>", repr(mine.grid))
    field = hsloc.LikelihoodField.from_grid(mine.grid)
    assert repr(field).startswith("<LikelihoodField: ")
    scan = hsloc.Scan(7, np.array([1.0, np.inf], dtype=np.float32), 0.0, 0.1, 0.1, 10.0)
    assert repr(scan) == "<Scan: 'laser' at 7 ns, 1 of 2 beams hit>"


def test_without_pandas_there_is_a_reason(mine: hsloc.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(hsloc.HslocError, match="to_frame needs pandas"):
        mine.trajectory.to_frame()


def test_every_localised_pose_after_the_first_match_has_a_covariance(mine: hsloc.Result) -> None:
    found = mine.pose_covariances()
    assert found.shape == (len(mine.trajectory), 3, 3)
    first = mine.diagnostics.stamps_ns[np.isfinite(mine.diagnostics.sigma[:, 0])][0]
    known = mine.trajectory.stamps_ns >= first
    assert np.isnan(found[~known]).all()
    assert np.isfinite(found[known & mine.localised]).all()
    np.testing.assert_allclose(found[known], np.swapaxes(found[known], 1, 2), atol=1e-12)
    assert (np.linalg.eigvalsh(found[known]) > 0.0).all()
    # A pose at the stamp of a matched scan has that scan's; the heading is less certain until the next match.
    matched = np.flatnonzero(np.isfinite(mine.diagnostics.sigma[:, 0]))[3:]
    rows = np.searchsorted(mine.trajectory.stamps_ns, mine.diagnostics.stamps_ns[matched])
    np.testing.assert_allclose(found[rows], mine.diagnostics.covariance[matched], rtol=1e-6, atol=1e-9)
    for begin, end in itertools.pairwise(rows):
        assert (found[begin:end, 2, 2] >= found[begin, 2, 2]).all()


def test_poses_of_a_built_map_have_covariances_relative_to_the_first() -> None:
    built = hsloc.run(SLIP, mode="slam", end_s=2.0)
    found = built.pose_covariances()
    assert found.shape == (len(built.trajectory), 3, 3)
    assert (np.linalg.eigvalsh(found) >= -1e-12).all()
    assert found[0, 0, 0] <= found[-1, 0, 0] > 0.0


@pytest.mark.parametrize(
    ("logs", "options", "text"),
    [
        ("nowhere.mcap", {}, "nowhere.mcap: no such file"),
        ([], {}, "no log was named"),
        (SLIP, {"matchr": "icp"}, "no option is called 'matchr'; did you mean matcher?"),
        (SLIP, {"matcher": 3}, "matcher is 3; it must be one of hide, harmony_search, icp, exact, or an object"),
        (SLIP, {"matcher": "magic"}, "matcher is 'magic'"),
        (SLIP, {"initial_pose": (1.0, 2.0)}, "initial_pose is (1.0, 2.0); it must be x, y [m], yaw [rad]"),
        (SLIP, {"seed": -1}, "--seed is -1; it must be a number of 0 or more"),
        (SLIP, {"seed": 1.5}, "seed is 1.5; it must be a whole number"),
        (SLIP, {"map": 7}, "map is 7; it must be a path"),
        (SLIP, {"mode": "fly"}, "mode is 'fly'; it must be one of auto, localise, slam"),
        (SLIP, {"config": 5}, "config is 5"),
        (SLIP, {"start_s": float("nan")}, "--start is nan"),
        (SLIP, {"set": "hide.budget"}, "is not KEY=VALUE"),
    ],
)
def test_wrong_input_is_an_error_of_one_line(logs: Any, options: dict[str, Any], text: str) -> None:
    with pytest.raises(hsloc.HslocError) as caught:
        hsloc.run(logs, **options)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_request_takes_texts_for_paths() -> None:
    request = hsloc.RunRequest(logs="run.mcap", map_path="map.yaml")  # type: ignore[arg-type]
    assert (request.logs, request.map_path) == ((Path("run.mcap"),), Path("map.yaml"))
    with pytest.raises(hsloc.ConfigError, match="seed: options beside a RunRequest; put them into it"):
        hsloc.run(request, seed=3)
