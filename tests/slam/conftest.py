"""Short simulated drives, made once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from drives import drive

if TYPE_CHECKING:
    from hsloc.model import Odometry, PairedScan, Trajectory


@pytest.fixture(scope="session")
def office() -> tuple[list[Odometry | PairedScan], Trajectory]:
    """The first 30 s of the office: 20 m through doors."""
    return drive("office", duration_s=30.0, seed=3)


@pytest.fixture(scope="session")
def loop() -> tuple[list[Odometry | PairedScan], Trajectory]:
    """A loop of corridors of 132 m, closed, with 3 % odometry drift."""
    return drive("drifting-loop", seed=5)
