"""(f) How exactly a match finds a pose within a cell, free of noise: a bias of half a cell would show here."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.matching import Hide, LikelihoodField, Window
from hsloc.model import Pose2
from hsloc.model.pose2 import wrap_angle
from hsloc.simulation.floor_plan import polygon
from hsloc.simulation.sensors import Lidar, SensorNoise
from hsloc.simulation.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

CELL = 0.05
HALF = (0.15, 0.15, radians(5.0))
CORNERS = ((-80, -50), (80, -50), (80, 20), (30, 20), (30, 70), (-80, 70))
"""Of an L-shaped room of 8 x 6 m, in cells."""
ROOMS: dict[str, tuple[float, float]] = {
    "walls through the centres of cells": (0.5, 0.0),
    "walls on the borders of cells": (0.0, 0.0),
    "walls a third of a cell from a centre": (0.5 + 1.0 / 3.0, 0.0),
    "room turned by 0.2 rad": (0.5, 0.2),
}
"""By how much of a cell the walls are shifted in x and y, and the angle by which the room is turned."""


@dataclass(frozen=True, slots=True)
class SubCell:
    """Errors of matches with the default preset, metres and degrees; `bias` is the mean signed error in x and y."""

    room: str
    matches: int
    mean_m: float
    max_m: float
    mean_deg: float
    bias_m: tuple[float, float]

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "room": self.room,
            "matches": self.matches,
            "mean_m": self.mean_m,
            "max_m": self.max_m,
            "mean_deg": self.mean_deg,
            "bias_m": list(self.bias_m),
        }


def measure_sub_cell(matches: int) -> tuple[SubCell, ...]:
    """Match `matches` scans without noise from random poses in each of the rooms."""
    return tuple(_measure(name, shift, turn, matches) for name, (shift, turn) in ROOMS.items())


def _measure(name: str, shift: float, turn: float, matches: int) -> SubCell:
    rng = np.random.default_rng(0)
    T_map_room = Pose2(0.0, 0.0, turn)
    corners = T_map_room @ ((np.array(CORNERS) + shift) * CELL)
    world = World(name, polygon(tuple(map(tuple, corners.tolist()))), np.array(((0.0, 0.0), (1.0, 0.0))))
    field = LikelihoodField.from_grid(world.occupancy_grid(CELL))
    lidar = Lidar(range_noise=0.0, range_step=2.0**-20)
    errors = []
    for _ in range(matches):
        place = rng.uniform((-3.5, -2.0, -np.pi), (1.0, 0.8, np.pi))
        truth = T_map_room @ Pose2(*place.tolist())
        scan = lidar.measure(world, 0, 0.1, truth.to_array()[None, :], np.empty((0, 3)), SensorNoise(rng, rng))
        # Not up to the border: where the map lies beside the walls, the best pose must still lie in the window.
        off = rng.uniform(-0.8, 0.8, 3) * HALF
        centre = Pose2(truth.x + off[0], truth.y + off[1], wrap_angle(truth.theta + off[2]))
        found = Hide().match(scan.points_base(), field, Window(centre, *HALF), rng).pose
        errors.append((found.x - truth.x, found.y - truth.y, np.degrees(wrap_angle(found.theta - truth.theta))))
    table = np.array(errors)
    metres = np.hypot(table[:, 0], table[:, 1])
    return SubCell(
        room=name,
        matches=matches,
        mean_m=float(metres.mean()),
        max_m=float(metres.max()),
        mean_deg=float(np.abs(table[:, 2]).mean()),
        bias_m=(float(table[:, 0].mean()), float(table[:, 1].mean())),
    )
