"""An attribute docstring stands directly below the attribute that it documents."""

from __future__ import annotations

import ast
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*ROOT.glob("hsloc/**/*.py"), *ROOT.glob("service/hsloc_service/**/*.py")])


def is_text(node):
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def strays(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for owner in (tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))):
        for before, node in pairwise(owner.body):
            documents = isinstance(before, ast.Assign | ast.AnnAssign) and before.end_lineno + 1 == node.lineno
            if is_text(node) and not documents:
                yield f"{path.name}:{node.lineno}"


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=lambda path: path.name)
def test_no_docstring_documents_nothing(folder):
    assert [stray for path in FILES if path.parent == folder for stray in strays(path)] == []
