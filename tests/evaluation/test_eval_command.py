"""`hsloc eval` as a user runs it, with the user's mistakes."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from evaluation_paths import disturb, make_path

from hsloc.cli import eval as command
from hsloc.errors import EvaluationError
from hsloc.evaluation.metrics import evaluate
from hsloc.evaluation.rpe import Delta
from hsloc.model.pose2 import relative_poses
from hsloc.trajectory_io.tum import format_stamp, write_tum

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.model import Trajectory


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser(prog="hsloc eval")
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(argument) for argument in arguments]))


@pytest.fixture
def files(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> tuple[Trajectory, list[Trajectory]]:
    monkeypatch.chdir(tmp_path)
    reference = make_path(rng, 200)
    estimates = [disturb(rng, reference, sigma=sigma) for sigma in (0.01, 0.1)]
    write_tum("reference.tum", reference)
    for name, estimate in zip(("good.tum", "bad.tum"), estimates, strict=True):
        write_tum(name, estimate)
    first, second = np.arange(0, 150, 10), np.arange(0, 150, 10) + 40
    relative = relative_poses(reference.poses[first], reference.poses[second])
    with open("checked.relations", "w") as stream:
        for i, j, (x, y, theta) in zip(first, second, relative, strict=True):
            stamps = (format_stamp(int(reference.stamps_ns[row])) for row in (i, j))
            stream.write(f"{' '.join(stamps)} {x:.9f} {y:.9f} 0 0 0 {theta:.9f}\n")
    return reference, estimates


def test_one_table_for_several_estimates(
    files: tuple[Trajectory, list[Trajectory]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("reference.tum", "good.tum", "bad.tum", "--alignment", "se2") == 0
    out, err = capsys.readouterr()
    assert err == ""
    table = out.split("\n\n")[1].splitlines()
    assert table[0].split() == ["rmse", "mean", "median", "std", "min", "max", "sse", "n"]
    reference, estimates = files
    for row, estimate in zip(table[2:4], estimates, strict=True):
        expected = evaluate(estimate, reference, alignment="se2").ape.trans_part
        assert row.split()[1] == f"{expected.rmse:.4f}"
        assert row.split()[-1] == "200"
    assert [line for line in table if not line.startswith(" ")] == [
        "APE translation (m)", "APE rotation (deg)", "RPE translation (m) per 1 m", "RPE rotation (deg) per 1 m",
    ]  # fmt: skip


def test_json(files: tuple[Trajectory, list[Trajectory]], capsys: pytest.CaptureFixture[str]) -> None:
    assert run("reference.tum", "good.tum", "--json", "--delta", "2", "--delta-unit", "s") == 0
    document = json.loads(capsys.readouterr().out)
    reference, (good, _) = files
    expected = evaluate(good, reference, deltas=(Delta(2.0, "s"),))
    (found,) = document["estimates"]
    assert found["estimate"] == "good.tum"
    assert found["ape"]["trans_part"]["rmse"] == pytest.approx(expected.ape.trans_part.rmse, abs=1e-9)
    assert found["rpe"]["delta_unit"] == "s"
    assert found["rpe"]["angle_deg"]["max"] == pytest.approx(expected.rpe[0].statistics.angle_deg.max, abs=1e-6)


def test_relations_beside_a_reference_and_alone(
    files: tuple[Trajectory, list[Trajectory]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("reference.tum", "good.tum", "--relations", "checked.relations", "--json") == 0
    (found,) = json.loads(capsys.readouterr().out)["estimates"]
    assert found["relations"]["matched"] == 15
    assert found["relations"]["trans_part"]["mean"] < 0.1
    assert "ape" in found
    assert run("good.tum", "--relations", "checked.relations", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["reference"] is None
    assert "ape" not in document["estimates"][0]
    assert run("reference.tum", "bad.tum", "--no-reference", "--relations", "checked.relations") == 0
    out = capsys.readouterr().out
    assert "reference.tum: 15 relations matched, 0 not" in out
    assert "relations rotation (deg)" in out
    assert "APE" not in out


def test_mistakes(files: tuple[Trajectory, list[Trajectory]], capsys: pytest.CaptureFixture[str]) -> None:
    assert run("reference.tum") == 2
    assert "give REFERENCE and at least one ESTIMATE" in capsys.readouterr().err
    assert run("reference.tum", "good.tum", "--no-reference") == 2
    assert "--relations" in capsys.readouterr().err
    for wrong in (("--delta", "0"), ("--t-max-diff", "-1"), ("--t-max-diff", "x"), ("--alignment", "sim3")):
        with pytest.raises(SystemExit) as caught:
            run("reference.tum", "good.tum", *wrong)
        assert caught.value.code == 2
    with pytest.raises(EvaluationError, match=r"none\.tum: no such file"):
        run("reference.tum", "none.tum")
    with pytest.raises(EvaluationError, match=r"delta is 1\.5 frames"):
        run("reference.tum", "good.tum", "--delta", "1.5", "--delta-unit", "frames")
    with pytest.raises(EvaluationError, match=r"good\.tum: no pose of the estimate .* overlap by 0\.000 s"):
        run("reference.tum", "good.tum", "--t-offset", "1000")
    assert capsys.readouterr().out == ""


def test_folders_of_results_have_their_own_reference(
    files: tuple[Trajectory, list[Trajectory]], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    reference, estimates = files
    for name, estimate in zip(("first", "second"), estimates, strict=True):
        (tmp_path / name).mkdir()
        write_tum(tmp_path / name / "trajectory.tum", estimate)
        write_tum(tmp_path / name / "reference.tum", reference)
    assert run("first", "second", "--json") == 0
    alone = json.loads(capsys.readouterr().out)
    assert [entry["estimate"] for entry in alone["estimates"]] == ["first", "second"]
    assert alone["reference"] is None
    assert run("reference.tum", "first", "bad.tum", "--json") == 0
    named = json.loads(capsys.readouterr().out)
    for a, b in zip(alone["estimates"], named["estimates"], strict=True):
        assert a["ape"] == b["ape"]
    assert run("first") == 0
    assert "APE translation" in capsys.readouterr().out
    (tmp_path / "second" / "reference.tum").unlink()
    with pytest.raises(EvaluationError, match=r"second.reference\.tum"):
        run("first", "second")
