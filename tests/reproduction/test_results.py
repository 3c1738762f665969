from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from hsloc.errors import OutputError
from hsloc.reproduction import results as results_module
from hsloc.reproduction.results import write_results

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.reproduction import Reproduction


@pytest.fixture(scope="module")
def written(small: Reproduction, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder of results, and the text that came with it."""
    folder = tmp_path_factory.mktemp("results") / "out"
    return folder, write_results(small, folder, ["a note"])


def test_folder_holds_report_results_and_figures(written: tuple[Path, str]) -> None:
    folder, text = written
    names = {path.name for path in folder.iterdir()}
    assert names == {"report.md", "results.json", *(f"fig{n}_own.png" for n in range(2, 9))}
    values = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert values["notes"] == ["a note"]
    assert len(values["materials"][0]["E1"]) == 7
    assert len(values["materials"][0]["E3"]) == 12
    assert len(values["materials"][0]["E4"]) == 12
    assert all(verdict["met"] for verdict in values["verdicts"])
    for word in ("a note", "0.0447 / 0.0623 / 0.0351", "0.572 / 0.886 / 0.0386", "0.467", "19000", "0.96"):
        assert word in text
    assert "0.223 / 0.333 / 0.0356" in text
    report = (folder / "report.md").read_text(encoding="utf-8")
    assert report.startswith(text)
    assert report.count("![fig") == 7


@pytest.mark.parametrize("number", range(2, 9))
def test_figures_are_drawn(written: tuple[Path, str], number: int) -> None:
    with Image.open(written[0] / f"fig{number}_own.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape[1] >= 1400
    # Blue of HIDE or vermillion of HS in every third of the width: no panel is empty.
    colours = [(0, 114, 178)] if number == 3 else [(213, 94, 0)] if number == 2 else [(0, 114, 178), (213, 94, 0)]
    for third in np.array_split(pixels, 2 if number > 3 else 3, axis=1):
        found = [(np.abs(third - colour).sum(axis=2) < 30).sum() for colour in colours]
        assert max(found) > 100


def test_same_results_give_the_same_pictures(small: Reproduction, written: tuple[Path, str], tmp_path: Path) -> None:
    write_results(small, tmp_path / "b")
    for path in sorted(written[0].glob("*.png")):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_folder_is_not_overwritten_unasked(small: Reproduction, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        write_results(small, tmp_path / "out")
    assert (tmp_path / "out" / "mine.txt").read_text() == "mine"


def test_nothing_half_written_stays(small: Reproduction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> list[Path]:
        raise KeyboardInterrupt

    monkeypatch.setattr(results_module, "draw_figures", fail)
    with pytest.raises(KeyboardInterrupt):
        write_results(small, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
