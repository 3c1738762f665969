from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from hsloc.reproduction import Material, own_material, reproduce

if TYPE_CHECKING:
    from hsloc.reproduction import Reproduction


@pytest.fixture(scope="session")
def short_material() -> Material:
    """Our own, with a drive of some 30 s."""
    material = own_material()
    return replace(material, world=replace(material.world, waypoints=material.world.waypoints[:2]))


@pytest.fixture(scope="session")
def small(short_material: Material) -> Reproduction:
    """All experiments, three repetitions each."""
    return reproduce([short_material], seeds=3)
