from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from hsloc.cli.main import main

if TYPE_CHECKING:
    from pathlib import Path


def test_one_experiment_on_our_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "e1", "--own", "--seeds", "2", "--out", str(tmp_path / "out"), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert [material["name"] for material in values["materials"]] == ["own"]
    assert set(values["materials"][0]) == {"name", "title", "E1"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "report.md",
        "results.json",
        "fig2_own.png",
        "fig3_own.png",
    }


def test_missing_default_data_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HSLOC_DATA", str(tmp_path / "nowhere"))
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "E1", "--seeds", "1"]) == 0
    out = capsys.readouterr().out
    assert "the report's data is not at hand" in out
    assert str(tmp_path / "nowhere" / "paper") in out
    assert "our own set-up" in out
    assert (tmp_path / "results" / "latest" / "report.md").is_file()


def test_data_that_was_named_must_be_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["reproduce", "--data", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")])
    assert code == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "scan1.csv: no such file" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("wrong", [["E9"], ["--seeds", "0"], ["--seeds", "many"]])
def test_wrong_use(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["reproduce", *wrong])
    assert caught.value.code == 2
    assert wrong[-1] in capsys.readouterr().err


def test_an_existing_folder_is_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").write_text("")
    assert main(["reproduce", "--out", str(tmp_path)]) == 1
    assert "exists already" in capsys.readouterr().err
