from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.reproduction import Material, own_material, reproduce
from hsloc.reproduction.material import SEEN_FROM

if TYPE_CHECKING:
    from hsloc.reproduction import Reproduction


@pytest.fixture(scope="session")
def short_material() -> Material:
    """Our own with a scan that sees 4 m far, a drive of some 20 s, and of the map what is seen from there."""
    material = own_material()
    world, waypoints = material.world, material.world.waypoints[:2]
    assert world.points is not None
    near = np.hypot(*(world.points - waypoints.mean(axis=0)).T) < 80.0
    close = np.hypot(*(material.scan - (SEEN_FROM.x, SEEN_FROM.y)).T) < 4.0
    world = replace(world, waypoints=waypoints, points=world.points[near])
    return replace(material, scan=material.scan[close], world=world)


@pytest.fixture(scope="session")
def small(short_material: Material) -> Reproduction:
    """All experiments, two repetitions each."""
    return reproduce([short_material], seeds=2)
