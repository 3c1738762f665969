"""The configuration reaches every search, and a matcher is recorded only where it was used (B6)."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.analysis.scan_statistics import ExtrinsicsCheck
from hsloc.cli.main import main
from hsloc.config import Config
from hsloc.errors import ConfigError
from hsloc.localisation.relocaliser import RelocaliserParameters
from hsloc.matching import Hide
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.model import IDENTITY, OccupancyGrid, Scan
from hsloc.replay.run import run
from hsloc.request import RunRequest

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.matching import Match

SLIP = RECORDINGS / "slip.mcap"
MAPPED = {"mode": "slam", "end_s": 4.0}


class Counting:
    """A matcher that counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def match(self, *arguments: Any) -> Match:
        self.calls += 1
        return Hide().match(*arguments)


def test_the_graph_mapper_refuses_a_matcher_that_it_would_not_use() -> None:
    for values in ({"matcher": "icp"}, {"matcher": "hs"}, {"matcher": Counting()}, {"set": ["matcher=icp"]}):
        with pytest.raises(ConfigError, match="the graph mapper has a matcher of its own and would not use"):
            run(RunRequest.from_values([SLIP], {**MAPPED, **values}))


def test_a_mapping_run_names_no_matcher_and_the_point_mapper_its_own(tmp_path: Path) -> None:
    argv = ["map", str(SLIP), "-q", "--end", "3", "--out"]
    assert main([*argv, str(tmp_path / "graph")]) == 0
    assert json.loads((tmp_path / "graph/metrics.json").read_text())["run"]["matcher"] is None
    assert "graph mapper, preset default" in (tmp_path / "graph/report.html").read_text()
    assert main([*argv, str(tmp_path / "point"), "--mapper", "point", "--matcher", "hs"]) == 0
    assert json.loads((tmp_path / "point/metrics.json").read_text())["run"]["matcher"] == "harmony_search"


def test_a_map_is_extended_with_the_configured_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search of the log's place on the saved map used a bare Hide(), default parameters and default sigma."""
    from hsloc.slam import map_extension

    seen: list[tuple[Any, ...]] = []
    real = map_extension.Relocaliser  # type: ignore[attr-defined]

    def spy(*arguments: Any) -> Any:
        seen.append(arguments)
        return real(*arguments)

    assert main(["map", str(SLIP), "-q", "--end", "6", "--out", str(tmp_path / "first")]) == 0
    monkeypatch.setattr(map_extension, "Relocaliser", spy)
    config = replace(
        Config(),
        hide=Hide(budget=250),
        localiser=replace(Config().localiser, relocaliser=RelocaliserParameters(budget=5_000)),
        likelihood_field=replace(Config().likelihood_field, sigma=0.3),
    )
    values = {**MAPPED, "resume": tmp_path / "first", "config": config}
    run(RunRequest.from_values([SLIP], values))
    _, field, matcher, parameters, *_ = seen[0]
    assert matcher == Hide(budget=250)
    assert parameters.budget == 5_000
    assert field.sigma == 0.3


def test_the_check_of_the_mounting_uses_the_runs_matcher() -> None:
    cells = np.zeros((60, 60), dtype=np.int8)
    cells[[10, 50], 10:51] = 100
    cells[10:51, [10, 50]] = 100
    matcher = Counting()
    field = LikelihoodField.from_grid(OccupancyGrid(cells, 0.1, IDENTITY), 0.2)
    check = ExtrinsicsCheck(field, matcher, 100, 2)
    scan = Scan(0, np.full(90, 2.0, dtype=np.float32), 0.0, 0.07, 0.1, 10.0, frame_id="front")
    check.add(scan, IDENTITY)
    assert matcher.calls == 1
