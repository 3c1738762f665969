"""hsloc replay and hsloc config as a user types them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from paths import RECORDINGS

from hsloc.cli.main import main
from hsloc.config import Config, load, preset

SLIP = str(RECORDINGS / "slip.mcap")


def test_replay_prints_a_table_and_links_the_latest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["replay", SLIP, "--end", "12"]) == 0
    printed = capsys.readouterr()
    assert "APE rmse" in printed.out
    assert "results: results/slip-" in printed.out
    assert printed.err == ""
    latest = tmp_path / "results" / "latest"
    assert latest.is_symlink()
    assert (latest / "metrics.json").is_file()


def test_json_is_alone_on_stdout_and_equals_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["replay", SLIP, "--end", "8", "--json", "--out", str(out)]) == 0
    shown = json.loads(capsys.readouterr().out)
    written = json.loads((out / "metrics.json").read_text())
    assert {key: shown[key] for key in written} == written
    assert shown["timings"]["seconds"]["replay"] > 0.0
    assert written["run"]["seed"] == 0


def test_quiet_prints_nothing_and_overwrite_replaces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    for seed in ("1", "2"):
        argv = ["replay", SLIP, "--end", "5", "-q", "--overwrite", "--seed", seed, "--out", str(out)]
        assert main(argv) == 0
    assert capsys.readouterr() == ("", "")
    assert json.loads((out / "metrics.json").read_text())["run"]["seed"] == 2


@pytest.mark.parametrize("matcher", ["hs", "icp"])
def test_other_matchers_follow_the_robot_too(tmp_path: Path, capsys: pytest.CaptureFixture[str], matcher: str) -> None:
    out = tmp_path / "out"
    argv = ["replay", str(RECORDINGS / "office.mcap"), "--end", "20", "--matcher", matcher, "--json", "--out", str(out)]
    assert main(argv) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["ape"]["trans_part"]["rmse"] < 0.05
    assert shown["run"]["matcher"] == ("harmony_search" if matcher == "hs" else matcher)


def test_config_prints_what_config_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("default", "paper", "paper-literal"):
        assert main(["config", "--preset", name]) == 0
        path = tmp_path / f"{name}.yaml"
        path.write_text(capsys.readouterr().out)
        assert load(path) == preset(name)
    assert main(["config", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hide"]["memory_size"] == 30


def test_flags_stand_above_the_file_and_the_file_above_the_preset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("matcher: icp\nhide: {budget: 77}\nlocaliser: {update_min_d: 1e-1}\n")
    assert main(["config", "--preset", "paper", "--config", str(path), "--matcher", "hide", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["matcher"] == "hide"
    assert shown["hide"]["budget"] == 77
    assert shown["localiser"]["update_min_d"] == 0.1
    assert shown["likelihood_field"]["sigma"] == 1.0


def test_the_configuration_of_a_run_runs_again(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    path = tmp_path / "mine.yaml"
    path.write_text("hide: {budget: 120}\n")
    assert main(["replay", SLIP, "--end", "8", "-q", "--config", str(path), "--out", str(first)]) == 0
    again = str(first / "config.yaml")
    assert load(Path(again)).hide.budget == 120
    assert load(Path(again)) != Config()
    assert main(["replay", SLIP, "--end", "8", "-q", "--config", again, "--out", str(second)]) == 0
    assert (first / "trajectory.tum").read_bytes() == (second / "trajectory.tum").read_bytes()


def test_map_is_replay_that_draws_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", SLIP, "--end", "4", "--out", str(tmp_path / "a"), "-q"]) == 0
    assert main(["replay", SLIP, "--mode", "slam", "--end", "4", "--out", str(tmp_path / "b"), "-q"]) == 0
    for name in ("map.pgm", "map.yaml", "trajectory.tum", "config.yaml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_duration_counts_from_the_start(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", SLIP, "--start", "2", "--duration", "3", "--out", str(tmp_path / "a"), "-q"]) == 0
    assert (
        main(["replay", SLIP, "--start", "2", "--end", "5", "--out", str(tmp_path / "b"), "-q", "--no-progress"]) == 0
    )
    for name in ("trajectory.tum", "config.yaml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with pytest.raises(SystemExit) as caught:
        main(["replay", SLIP, "--duration", "3", "--end", "5"])
    assert caught.value.code == 2
    assert "argument --end: not allowed with argument --duration" in capsys.readouterr().err
    assert main(["replay", SLIP, "--start", "2", "--duration", "-1"]) == 1
    assert "--end is 1; it must be later than --start 2" in capsys.readouterr().err


def test_the_progress_bar_can_be_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    command = ["replay", SLIP, "--end", "2", "--overwrite", "--out", str(tmp_path / "a")]
    assert main(command) == 0
    assert "prepare   [" in capsys.readouterr().err
    assert main([*command, "--no-progress"]) == 0
    assert capsys.readouterr().err == ""
