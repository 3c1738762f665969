"""What all tests share: where the real logs and the fixtures are."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))


@pytest.fixture(scope="session")
def recordings() -> Path:
    return ROOT / "recordings"


@pytest.fixture(scope="session")
def data() -> Path:
    """Real logs; a test that needs them skips where they are missing."""
    folder = Path(os.environ.get("HSLOC_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real logs: {folder} is missing; set HSLOC_DATA")
    return folder
