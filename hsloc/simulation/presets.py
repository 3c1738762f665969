"""Scenarios by name: one for each built-in world, and those in which something goes wrong."""

from __future__ import annotations

from dataclasses import replace
from math import pi, radians

from hsloc.errors import ConfigError
from hsloc.model import Pose2
from hsloc.simulation.odometer import OdometryNoise, Slip, SteeringNoise
from hsloc.simulation.robot import DifferentialDrive, SteeredVehicle
from hsloc.simulation.scenario import Kidnap, Scenario
from hsloc.simulation.sensors import Lidar, PointSensor

AHEAD = Lidar(mounting=Pose2(0.182, 0.0, 0.0))
"""A full-turn lidar in front of the axle."""
WIDE = Lidar(beams=271, field_of_view=radians(270.0), range_max=20.0, mounting=Pose2(0.213, 0.031, 0.0))
"""One that does not see behind itself."""
SIDEWAYS = Lidar(range_max=18.0, mounting=Pose2(-0.047, 0.0, pi / 2.0))
"""One mounted turned to the left, as on a TurtleBot 4."""
HANGING = Lidar(range_max=12.0, mounting=Pose2(0.141, -0.018, 0.3), upside_down=True)
"""A laser that is mounted upside down, and not straight."""

BRISK = DifferentialDrive(speed=1.2, turn_rate=1.5)
DRIFTING = OdometryNoise(alpha1=2e-4, alpha2=2.5e-5, alpha3=1e-3, alpha4=2e-4)
"""About 3 % of the path length over a loop of 130 m, and more where heading errors happen early."""

OFFICE = Scenario("office", robot=BRISK, sensor=AHEAD)
CORRIDOR_LOOP = Scenario("corridor-loop", robot=BRISK, sensor=WIDE, laps=1.05)
HALL = Scenario("hall", robot=DifferentialDrive(speed=1.5), sensor=SIDEWAYS, odometry_rate_hz=25.0, scan_offset_s=0.007)

SCENARIOS: dict[str, Scenario] = {
    "office": OFFICE,
    "corridor-loop": CORRIDOR_LOOP,
    "hall": HALL,
    "paper": Scenario(
        "paper",
        robot=SteeredVehicle(),
        sensor=PointSensor(),
        odometry=SteeringNoise(),
        odometry_rate_hz=40.0,
        scan_rate_hz=5.0,
        map_resolution=0.1,
    ),
    "kidnapped": replace(
        OFFICE,
        sensor=HANGING,
        odometry_rate_hz=25.0,
        duration_s=60.0,
        kidnaps=(Kidnap(at_s=30.0, skip_s=21.0),),
    ),
    "slip": replace(
        OFFICE,
        sensor=replace(AHEAD, dropout=0.25),
        duration_s=60.0,
        people=2,
        slips=(
            Slip(at_s=12.0, duration_s=1.5, factor=1.6),
            Slip(at_s=31.0, duration_s=1.0, factor=1.2, turn_rate=0.35),
            Slip(at_s=48.0, duration_s=2.0, factor=0.5),
        ),
    ),
    "two-laps": replace(CORRIDOR_LOOP, laps=2.05),
    "figure-of-eight": Scenario("figure-of-eight", robot=BRISK, sensor=WIDE, odometry=DRIFTING, laps=1.05),
    "symmetric-corridor": Scenario(
        "symmetric-corridor",
        robot=BRISK,
        sensor=replace(WIDE, range_max=8.0),
        odometry=DRIFTING,
        laps=2.0,
    ),
    "drifting-loop": replace(CORRIDOR_LOOP, odometry=DRIFTING),
}
"""By name. A scenario that bears the name of a world is what `hsloc record --world` starts from."""

ANY_WORLD = Scenario("", sensor=AHEAD)
"""What a world from a file is driven with."""


def preset(name: str) -> Scenario:
    """The scenario of that name. Raises ConfigError for an unknown one."""
    key = name.replace("_", "-")
    if key not in SCENARIOS:
        raise ConfigError(f"scenario {name!r} is unknown; choose from {', '.join(SCENARIOS)}")
    return SCENARIOS[key]
