"""Short simulated drives, without a log in between."""

from __future__ import annotations

import pytest
from drives import drive


@pytest.fixture(scope="session")
def office():
    """The first 30 s of the office: 20 m through doors."""
    return drive("office", duration_s=30.0, seed=3)


@pytest.fixture(scope="session")
def loop():
    """A loop of corridors of 132 m, closed, with 3 % odometry drift."""
    return drive("drifting-loop", seed=5)
