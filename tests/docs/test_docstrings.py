"""An attribute docstring stands directly below the attribute that it documents."""

from __future__ import annotations

import ast
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*ROOT.glob("hsloc/**/*.py"), *ROOT.glob("service/hsloc_service/**/*.py")])


def is_text(node: Any) -> Any:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def strays(path: Path) -> Iterator[Any]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    owners: list[ast.Module | ast.ClassDef] = [tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))]
    for owner in owners:
        for before, node in pairwise(owner.body):
            documents = isinstance(before, ast.Assign | ast.AnnAssign) and (before.end_lineno or 0) + 1 == node.lineno
            if is_text(node) and not documents:
                yield f"{path.name}:{node.lineno}"


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=lambda path: path.name)
def test_no_docstring_documents_nothing(folder: Path) -> None:
    assert [stray for path in FILES if path.parent == folder for stray in strays(path)] == []
