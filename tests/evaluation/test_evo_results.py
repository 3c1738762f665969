"""evo reads what `hsloc eval --save-results` writes, and it is what evo would have written."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import matplotlib
import numpy as np
import pytest
from evaluation_paths import disturb, make_path

from hsloc.cli.main import main
from hsloc.report.png import FORMATS
from hsloc.trajectory_io.tum import write_tum

if TYPE_CHECKING:
    from types import SimpleNamespace


@pytest.fixture
def files(tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    reference = make_path(rng, 300)
    write_tum("reference.tum", reference)
    for name, sigma in (("good", 0.01), ("bad", 0.1)):
        write_tum(f"{name}.tum", disturb(rng, reference, sigma=sigma))


@pytest.mark.parametrize("alignment", ["none", "origin", "se2"])
@pytest.mark.parametrize(("delta", "unit"), [(1.0, "m"), (10.0, "frames")])
def test_the_files_hold_what_evo_would_have_saved(
    files: None, evo: SimpleNamespace, alignment: str, delta: float, unit: Literal["frames", "m", "s"], tmp_path: Path
) -> None:
    from evo.tools.file_interface import load_res_file

    options = ["--alignment", alignment, "--delta", str(delta), "--delta-unit", unit]
    assert main(["eval", "reference.tum", "good.tum", *options, "--save-results", "out"]) == 0
    align = {"align": alignment == "se2", "align_origin": alignment == "origin"}
    for relation in ("trans_part", "angle_deg"):
        for measure in ("ape", "rpe"):
            pair = evo.associate(evo.read("reference.tum"), evo.read("good.tum"))
            if measure == "ape":
                theirs = evo.ape(*pair, evo.relations[relation], **align)
            else:
                pieces = {"delta": delta, "delta_unit": evo.units[unit], "all_pairs": False}
                theirs = evo.rpe(*pair, evo.relations[relation], **pieces, **align)
            ours = load_res_file(str(tmp_path / "out" / f"good.{measure}_{relation}.zip"))
            assert ours.info["title"] == theirs.info["title"]
            assert ours.info["label"] == theirs.info["label"]
            assert (ours.info["ref_name"], ours.info["est_name"]) == ("reference.tum", "good.tum")
            assert ours.stats == pytest.approx(theirs.stats, abs=1e-6, rel=1e-9)
            assert ours.np_arrays.keys() == theirs.np_arrays.keys()
            for name, values in theirs.np_arrays.items():
                np.testing.assert_allclose(ours.np_arrays[name], values, atol=2e-6, err_msg=name)


def test_evo_res_prints_the_same_statistics(
    files: None, evo: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    plots = [f"errors{ending}" for ending in FORMATS]
    for name in plots:
        assert main(["eval", "reference.tum", "good.tum", "bad.tum", "--save-results", "out", "--save-plot", name]) == 0
    assert Path("errors.png").read_bytes()[:4] == b"\x89PNG"
    assert "good.tum" in Path("errors.svg").read_text()
    assert main(["eval", "reference.tum", "good.tum", "--save-plot", "errors.bmp"]) == 1
    matplotlib.use("agg")  # as where there is no display
    assert main(["eval", "reference.tum", "good.tum", "--plot"]) == 1
    printed = capsys.readouterr()
    assert "use --save-plot" in printed.err
    table = printed.out.split("APE translation (m)\n")[1].splitlines()
    expected = {row.split()[0]: [float(value) for value in row.split()[1:8]] for row in table[:2]}
    command = [
        str(Path(sys.executable).with_name("evo_res")),
        "out/good.ape_trans_part.zip",
        "out/bad.ape_trans_part.zip",
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "HOME": str(evo.home)}
    )
    text = re.sub(r"\x1b\[\d*m", "", done.stdout)
    assert "APE w.r.t. translation part (m)" in text
    header = next(line.split() for line in text.splitlines() if "rmse" in line)
    for name, ours in expected.items():
        theirs = next(line.split()[1:] for line in text.splitlines() if line.startswith(name))
        by_name = dict(zip(header, map(float, theirs), strict=True))
        found = [by_name[key] for key in ("rmse", "mean", "median", "std", "min", "max", "sse")]
        assert found == pytest.approx(ours, abs=1e-4)


def test_the_same_results_are_the_same_bytes_and_names_do_not_clash(files: None) -> None:
    for folder in ("a/run", "b/run"):
        Path(folder).mkdir(parents=True)
        for name in ("reference", "trajectory"):
            source = "reference.tum" if name == "reference" else "good.tum"
            (Path(folder) / f"{name}.tum").write_bytes(Path(source).read_bytes())
    for out in ("first", "second"):
        assert main(["eval", "a/run", "b/run", "--save-results", out]) == 0
    names = sorted(path.name for path in Path("first").iterdir())
    measures = ("ape_angle_deg", "ape_trans_part", "rpe_angle_deg", "rpe_trans_part")
    assert names == [f"{run}_run.{measure}.zip" for run in "ab" for measure in measures]
    for name in names:
        assert (Path("first") / name).read_bytes() == (Path("second") / name).read_bytes()


def test_a_path_shorter_than_a_piece_has_no_rpe_and_relations_alone_no_errors(
    files: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", "reference.tum", "good.tum", "--delta", "1e6", "--save-results", "out"]) == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["good.ape_angle_deg.zip", "good.ape_trans_part.zip"]
    Path("checked.relations").write_text("1 2 0 0 0 0 0 0\n")
    options = ["--relations", "checked.relations", "--save-results", "none"]
    capsys.readouterr()
    assert main(["eval", "good.tum", "--no-reference", *options]) in (1, 2)
    assert not Path("none").exists()
