"""A scan of the built-in office, and the map it belongs to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from hsloc.matching import LikelihoodField
from hsloc.model import Pose2, Scan, Truth
from hsloc.simulation.built_in import built_in
from hsloc.simulation.presets import OFFICE
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import events

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """`points` (n, 2), metres, seen from the base at `truth`; the field is that of the default preset, 5 cm."""

    points: NDArray[np.float64]
    truth: Pose2
    field: LikelihoodField


def office_scene() -> Scene:
    """The first scan, of a lidar that sees far enough for all of its 360 beams to hit a wall."""
    world, sensor = built_in("office"), Lidar(range_max=60.0)
    truth, points = Pose2(), None
    for event in events(replace(OFFICE, sensor=sensor, duration_s=0.2), world):
        if isinstance(event, Truth):
            truth = event.T_map_base
        elif isinstance(event, Scan):
            points = event.points_base()
            break
    assert points is not None
    return Scene(points, truth, LikelihoodField.from_grid(world.occupancy_grid(0.05)))
