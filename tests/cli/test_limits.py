"""Limits for unattended use: exit code 4 and a line for each that is not kept."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from paths import RECORDINGS

from hsloc.cli.main import main

SLIP = str(RECORDINGS / "slip.mcap")


@pytest.mark.parametrize(
    ("limits", "lines"),
    [
        (["--min-localised", "1", "--max-ape", "0.5", "--max-warnings", "0", "--fail-if", "failed"], []),
        (["--max-ape", "0.0001"], ["--max-ape 0.0001: the RMSE of the position is 0.0"]),
        (
            ["--max-ape", "0.5", "--reference", "short.tum"],
            ["--max-ape 0.5: cannot be checked: "],
        ),
    ],
)
def test_replay(
    limits: list[str], lines: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("short.tum").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n3 0 0 0 0 0 0 1\n")
    code = main(["replay", SLIP, "--end", "8", "-q", "--out", "out", *limits])
    found = [line for line in capsys.readouterr().err.splitlines() if "limit not kept" in line]
    assert code == (4 if lines else 0)
    assert len(found) == len(lines)
    for line, expected in zip(found, lines, strict=True):
        assert line.startswith(f"hsloc: limit not kept: {expected}")
    assert Path("out/metrics.json").is_file()


def test_an_unknown_place_breaks_the_limits_on_localised_poses_warnings_and_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The office's robot on the map of the hall."""
    from hsloc.log import open_log
    from hsloc.maps import save_map

    grid = open_log(RECORDINGS / "hall.mcap").map()
    assert grid is not None
    save_map(grid, tmp_path)
    argv = ["replay", str(RECORDINGS / "office.mcap"), "--map", str(tmp_path / "map.yaml"), "--unknown-start"]
    limits = ["--min-localised", "0.95", "--max-warnings", "0", "--fail-if", "check"]
    assert main([*argv, "--end", "10", "-q", "--out", str(tmp_path / "out"), *limits]) == 4
    lines = [line for line in capsys.readouterr().err.splitlines() if "limit not kept" in line]
    assert [line.split()[4] for line in lines] == ["--min-localised", "--max-warnings", "--fail-if"]


def test_sweep_has_a_column_and_the_same_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["sweep", SLIP, str(RECORDINGS / "hall.mcap"), "--end", "6", "-q", "--out", str(tmp_path)]
    assert main([*argv, "--max-ape", "0.0001"]) == 4
    rows = list(csv.DictReader((tmp_path / "sweep.csv").read_text().splitlines()))
    assert all(row["limits"].startswith("--max-ape 0.0001") for row in rows)
    assert "hall-default-seed0: --max-ape" in capsys.readouterr().out
    # Other limits on the same runs: they are not done again.
    assert main([*argv, "--max-ape", "1", "--json"]) == 0
    assert {row["state"] for row in json.loads(capsys.readouterr().out)} == {"skipped"}
