"""Data of the experiments: the course report's own where it is at hand, and a set-up of ours in any case."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import ConfigError
from hsloc.model.pose2 import Pose2
from hsloc.simulation.built_in import built_in
from hsloc.simulation.sensors import Lidar, SensorNoise
from hsloc.simulation.world_files import load_world, read_rows

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.simulation.world import World

    F64 = NDArray[np.float64]

SEEN_FROM = Pose2(1.47, -0.2, 1.0)
"""Where the scan of E1 is seen from, in the frame of its points [P]."""
FILES = ("scan1.csv", "localisation_map.csv", "waypoints.csv")


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """`scan` (n, 2), metres in the map frame, is matched in E1 and E2; in E3 a vehicle drives through `world`.

    `name` goes into the names of files, `title` into headings.
    """

    name: str
    title: str
    scan: F64
    world: World


def report_material(folder: Path) -> Material:
    """The course report's data: scan1.csv, localisation_map.csv and waypoints.csv (x_m,y_m). Raises ConfigError."""
    for name in FILES:
        if not (folder / name).is_file():
            raise ConfigError(f"{folder / name}: no such file; --data must hold {', '.join(FILES)}")
    return Material(
        name="report",
        title="the course report's data",
        scan=read_rows(folder / "scan1.csv", (2,)),
        world=load_world(folder / "localisation_map.csv", folder / "waypoints.csv"),
    )


def own_material() -> Material:
    """Our own: a scan of the built-in office from its start, free of noise, and the points of the built-in `paper`.

    The scan is laid where the course report's lies, so that pose, start and box of E1 stay the same.
    """
    office = built_in("office")
    rng = np.random.default_rng(0)
    lidar = Lidar(range_noise=0.0, range_step=2.0**-20)
    start = office.start().to_array()[None, :]
    scan = lidar.measure(office, 0, 0.1, start, np.empty((0, 3)), SensorNoise(rng, rng))
    return Material(
        name="own",
        title="our own set-up (built-in worlds office and paper)",
        scan=SEEN_FROM @ scan.points_base(),
        world=built_in("paper"),
    )
