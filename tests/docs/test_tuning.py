"""The parameters that docs/tuning.md names exist, with the defaults that it states."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from hsloc.config import Config

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "tuning.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.split("|")[1:-1]] for line in TEXT.splitlines() if line.startswith("| `")]


def values(cell: Any) -> Any:
    """The values of the parameters in the first column: `a.b` and `c` (of the same table), or `a.b1` to `b4`."""
    names = re.findall(r"`([^`]+)`", cell)
    parent, _, first = names[0].rpartition(".")
    if " to " in cell:
        stem = first[:-1]
        last = [f"{stem}{n}" for n in range(int(first[-1]), int(names[1][-1]) + 1)]
    else:
        last = [first, *names[1:]]
    owner = Config()
    for name in parent.split("."):
        owner = getattr(owner, name)
    return [getattr(owner, name) for name in last]


def test_there_are_ten() -> None:
    assert len(ROWS) == 10


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_the_defaults_are_those_of_the_program(row: Any) -> None:
    stated = [float(number) for number in re.findall(r"\d+\.?\d*", row[1].replace("0.3 deg (0.0052 rad)", "0.0052"))]
    assert values(row[0]) == pytest.approx(stated, rel=0.01)


def test_every_parameter_of_the_text_exists() -> None:
    for path in re.findall(r"`((?:hide|localiser|graph_mapper|likelihood_field)\.[a-z0-9_.]+)`", TEXT):
        owner = Config()
        for name in path.split("."):
            owner = getattr(owner, name)
