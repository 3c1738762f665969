"""Folders of results: never in the place of something else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from hsloc.atomic_write import whole_folder, write_text_atomically
from hsloc.errors import OutputError
from hsloc.export.results_folder import refuse_folder, write_hypotheses
from hsloc.model import Pose2
from hsloc.model.estimate import Ambiguity, LikelyPlace

if TYPE_CHECKING:
    from pathlib import Path


def test_only_results_are_overwritten(tmp_path: Path) -> None:
    refuse_folder(tmp_path / "new", False)
    refuse_folder(tmp_path, True)
    (tmp_path / "thesis.tex").write_text("do not lose me")
    with pytest.raises(OutputError, match="exists already; choose another --out, or pass --overwrite"):
        refuse_folder(tmp_path, False)
    with pytest.raises(OutputError, match="holds no results of hsloc, so it is not overwritten"):
        refuse_folder(tmp_path, True)
    with pytest.raises(OutputError, match="holds no results"):
        refuse_folder(tmp_path / "thesis.tex", True)
    for name in ("metrics.json", "config.yaml"):
        (tmp_path / name).write_text("{}")
    refuse_folder(tmp_path, True)


def test_a_file_that_cannot_be_written_is_named_in_the_folder_that_was_asked_for(tmp_path: Path) -> None:
    def into(folder: Path) -> None:
        with whole_folder(folder) as partial:
            write_text_atomically(partial / "missing" / "graph.g2o", "")

    with pytest.raises(OutputError, match=r"/out/missing/graph\.g2o: cannot be written \(No such file"):
        into(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_hypotheses_csv_has_a_line_for_each_place(tmp_path: Path) -> None:
    places = (LikelyPlace(Pose2(1.0, 2.0, 0.5), 0.75), LikelyPlace(Pose2(-9.0, 2.0, -0.5), 0.25))
    write_hypotheses(tmp_path / "hypotheses.csv", [Ambiguity(10**9, 3 * 10**9, 2 * 10**9, places)])
    assert (tmp_path / "hypotheses.csv").read_text(encoding="utf-8").splitlines() == [
        "begin,end,t,x,y,theta,probability",
        "1.000000000,3.000000000,2.000000000,1.000,2.000,0.5000,0.7500",
        "1.000000000,3.000000000,2.000000000,-9.000,2.000,-0.5000,0.2500",
    ]
