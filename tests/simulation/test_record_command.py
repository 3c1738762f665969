"""`hsloc record`, also in the hands of a user who makes mistakes."""

from __future__ import annotations

import argparse
import json
from math import pi
from typing import TYPE_CHECKING

import pytest

from hsloc.cli import record as command
from hsloc.errors import HslocError
from hsloc.log import open_log
from hsloc.simulation.scenario import Scenario

if TYPE_CHECKING:
    from pathlib import Path


def run(*words: Path | float | str) -> int:
    parser = argparse.ArgumentParser(prog="hsloc record")
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(word) for word in words]))


def scenario_of(path: Path) -> Scenario:
    return Scenario.from_dict(json.loads(open_log(path).metadata()["hsloc.scenario"]["scenario"]))


def test_records_and_prints_what(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run.mcap"
    assert run(out, "--world", "office", "--seed", 7, "--duration", 2) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{out}: 2.0 s, ")
    assert "21 scans" in printed.out
    assert printed.err == ""  # no terminal, no progress
    assert scenario_of(out).seed == 7


def test_summary_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "x.mcap", "--world", "corridor_loop", "--duration", 1, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["world"] == "corridor-loop"
    assert summary["scans"] == 11
    assert summary["bytes"] == (tmp_path / "x.mcap").stat().st_size
    assert Scenario.from_dict(summary["scenario"]) == scenario_of(tmp_path / "x.mcap")


def test_quiet_prints_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "x.mcap", "--world", "hall", "--duration", 0.5, "-q") == 0
    assert capsys.readouterr() == ("", "")


def test_every_option_reaches_the_scenario(tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    words = "--world office --duration 1 --speed 0.5 --people 2 --map-resolution 0.1 --beams 90 --fov 180 --range-max 9"
    words += " --range-noise 0.02 --dropout 0.1 --mounting=-0.1,0.2,1.5 --upside-down --motion-distortion --scan-rate 5"
    words += " --alpha1 0.1 --alpha2 0.2 --alpha3 0.3 --alpha4 0.4 --noise-interval 0 --odometry-rate 25"
    words += " --slip 3,2 --slip 6,1,0.5,90 --kidnap-at 4 --kidnap-at 5,6 --laps 2"
    assert run(out, *words.split()) == 0
    scenario = scenario_of(out)
    sensor, odometry = scenario.sensor, scenario.odometry
    assert (scenario.robot.speed, scenario.people, scenario.map_resolution, scenario.laps) == (0.5, 2, 0.1, 2.0)
    assert (sensor.beams, sensor.range_max, sensor.range_noise, sensor.dropout) == (90, 9.0, 0.02, 0.1)
    assert (sensor.field_of_view, sensor.upside_down, sensor.motion_distortion) == (pytest.approx(pi), True, True)
    assert (sensor.mounting.x, sensor.mounting.y, sensor.mounting.theta) == (-0.1, 0.2, 1.5)
    assert (odometry.alpha1, odometry.alpha2, odometry.alpha3, odometry.alpha4) == (0.1, 0.2, 0.3, 0.4)
    assert (odometry.interval_s, scenario.odometry_rate_hz, scenario.scan_rate_hz) == (0.0, 25.0, 5.0)
    assert [(s.at_s, s.duration_s, s.factor) for s in scenario.slips] == [(3, 2, 1.5), (6, 1, 0.5)]
    assert scenario.slips[1].turn_rate == pytest.approx(pi / 2)
    assert [(k.at_s, k.skip_s) for k in scenario.kidnaps] == [(4, 20), (5, 6)]


def test_a_world_of_points_is_driven_and_seen_as_in_the_report(tmp_path: Path) -> None:
    (tmp_path / "site.csv").write_text("x_m,y_m\n10,2\n3,14\n-5,6\n")
    (tmp_path / "way.csv").write_text("x_m,y_m\n0,0\n30,0\n")
    words = ("--world", tmp_path / "site.csv", "--waypoints", tmp_path / "way.csv")
    assert run(tmp_path / "x.mcap", *words) == 0
    scenario = scenario_of(tmp_path / "x.mcap")
    assert scenario.world == "site"
    assert (scenario.sensor.beams, scenario.robot.speed, scenario.scan_rate_hz) == (14_400, 3.0, 5.0)


def test_list_names_worlds_and_scenarios(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--list") == 0
    listed = capsys.readouterr().out
    assert "corridor-loop" in listed
    assert "kidnapped" in listed
    assert run("--list", "--json") == 0
    assert "office" in json.loads(capsys.readouterr().out)["worlds"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--world", "moon"], "world 'moon' is neither built in"),
        (["--scenario", "moon"], "scenario 'moon' is unknown; choose from office"),
        (["--world", "paper", "--fov", "90"], "--fov does not apply here: the PointSensor has no field_of_view"),
        (["--scenario", "paper", "--alpha1", "0.1"], "--alpha1 does not apply here"),
        (["--world", "office", "--dropout", "2"], "Lidar.dropout is 2.0; it must be from 0 to 1"),
        (["--world", "office", "--beams", "0"], "Lidar.beams is 0"),
        (["--world", "office", "--duration", "nan"], "duration_s is nan"),
        (["--world", "office", "--speed", "0"], "DifferentialDrive.speed is 0.0; it must be from 0.001 to 100"),
        (["--world", "office", "--map-resolution", "0.001"], "map_resolution 0.001 makes a map of"),
        (["--world", "office", "--waypoints", "nowhere.csv"], "nowhere.csv: no such file"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(tmp_path: Path, words: list[str], message: str) -> None:
    with pytest.raises(HslocError) as caught:
        run(tmp_path / "x.mcap", *words)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ["--mounting", "1,2"],
        ["--slip", "1"],
        ["--kidnap-at", "soon"],
        ["--seed", "-1"],
        ["--seed", "x"],
    ],
)
def test_words_that_are_no_numbers_are_wrong_use(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        run(tmp_path / "x.mcap", "--world", "office", *words)
    assert caught.value.code == 2
    assert words[0] in capsys.readouterr().err


@pytest.mark.parametrize("words", [[], ["x.mcap"], ["x.mcap", "--world", "office", "--scenario", "slip"]])
def test_what_is_missing_is_named(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*words) == 2
    assert capsys.readouterr().err.startswith("hsloc record: error: give ")


def test_existing_files_are_kept_but_for_force(tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    out.write_text("precious")
    with pytest.raises(HslocError, match="exists already; name another file, or overwrite it with --force"):
        run(out, "--world", "office", "--duration", 1)
    assert out.read_text() == "precious"
    assert run(out, "--world", "office", "--duration", 1, "--force", "-q") == 0


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(HslocError, match="cannot be written"):
        run(tmp_path / "nowhere" / "x.mcap", "--world", "office", "--duration", 1)
