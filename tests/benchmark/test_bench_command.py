from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from hsloc.cli.main import main

if TYPE_CHECKING:
    from pathlib import Path


def test_quick_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "kernel", "match", "replay", "sub-cell", "--quick", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert set(values) == {"machine", "quick", "kernel", "match", "replay", "sub_cell", "targets", "notes"}
    assert values["quick"] is True
    assert {"cpu", "cores", "load_average", "load_average_after", "python", "numpy", "numba"} <= set(values["machine"])
    assert set(values["kernel"]["ns_per_point"]) == {"best", "median", "repeats"}
    assert values["match"][0]["evaluations"] == 280
    replay = values["replay"]
    assert replay["log_seconds"] == pytest.approx(8.0, abs=0.1)
    assert replay["matched"] > 10
    assert replay["times_real_time"] == pytest.approx(replay["log_seconds"] / replay["replay_s"]["best"])
    assert set(replay["parts_s"]) == {"read", "search", "other"}
    assert all(seconds > 0.0 for seconds in replay["parts_s"].values())
    assert len(values["sub_cell"]) == 4
    assert [set(target) for target in values["targets"]] == [
        {"text", "measured", "limit", "unit", "at_least", "met"}
    ] * 4


def test_text_names_the_machine_and_what_was_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "match", "--quick"]) == 0
    out = capsys.readouterr().out
    assert "Load average before" in out
    assert "HIDE, 280 evaluations" in out
    assert "Promised and measured" in out
    assert "the tables of matching and of certificates were left out" in out
    assert "Replay of" not in out


def test_wrong_cases_are_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--cases", str(tmp_path / "nowhere.npz")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "no such file" in line
    assert main(["bench", "cases"]) == 1
    assert "--cases" in capsys.readouterr().err


def test_unknown_part_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["bench", "everything"])
    assert caught.value.code == 2
    assert "everything" in capsys.readouterr().err
