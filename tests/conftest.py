"""What all tests share: where the real logs and the fixtures are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.paths import DATA, RECORDINGS

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="session")
def recordings() -> Path:
    return RECORDINGS


@pytest.fixture(scope="session")
def data() -> Path:
    """Real logs; a test that needs them skips where they are missing."""
    if not DATA.is_dir():
        pytest.skip(f"no real logs: {DATA} is missing; set HSLOC_DATA")
    return DATA
