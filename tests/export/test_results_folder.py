"""Folders of results: never in the place of something else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from hsloc.errors import OutputError
from hsloc.export.results_folder import refuse_folder

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
