"""A scenario: everything that a recording is made from. The same scenario gives the same bytes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass
from math import ceil
from typing import TYPE_CHECKING, Annotated, Any

from hsloc.errors import ConfigError
from hsloc.model import Pose2
from hsloc.parameters import NonNegative, Parameters, Range
from hsloc.simulation.odometer import OdometryNoise, Slip, SteeringNoise
from hsloc.simulation.robot import DifferentialDrive, SteeredVehicle
from hsloc.simulation.sensors import Lidar, PointSensor

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Kidnap(Parameters):
    """At `at_s` seconds the robot is picked up and set down where it would have been `skip_s` seconds later.

    The world's pose jumps, the odometry does not notice.
    """

    at_s: NonNegative
    """Time of the kidnapping after the start [s]."""
    skip_s: NonNegative = 20.0
    """Time of driving after which the robot would have been where it is set down [s]."""


@dataclass(frozen=True, slots=True)
class Scenario(Parameters):
    """A robot with its sensors, a world by name, and what goes wrong.

    The recording ends after `duration_s` seconds or, where that is None, with the path of `laps` laps. Odometry
    comes at `odometry_rate_hz`, scans at `scan_rate_hz`, the first `scan_offset_s` after the start. `people` walk
    about. `start_stamp_ns` is the time of the first message: never the wall's.
    """

    world: str
    """Name of the world."""
    seed: Annotated[int, Range(0, 2**63)] = 0
    """Seed of all noise."""
    robot: DifferentialDrive | SteeredVehicle = field(default_factory=DifferentialDrive)
    """The robot and its limits."""
    sensor: Lidar | PointSensor = field(default_factory=Lidar)
    """The sensor and its noise."""
    odometry: OdometryNoise | SteeringNoise = field(default_factory=OdometryNoise)
    """The noise of the odometry."""
    odometry_rate_hz: Annotated[float, Range(0.1, 10_000)] = 50.0
    """Rate of the odometry [Hz]."""
    scan_rate_hz: Annotated[float, Range(0.01, 10_000)] = 10.0
    """Rate of the scans [Hz]."""
    scan_offset_s: Annotated[float, Range(0, 1e6)] = 0.0
    """Time of the first scan after the start [s]."""
    laps: Annotated[float, Range(1e-3, 10_000)] = 1.0
    """Number of laps of the path, where `duration_s` is None."""
    duration_s: Annotated[float, Range(1e-3, 1e6)] | None = None
    """Duration of the recording [s]; None: until the end of the path."""
    people: Annotated[int, Range(0, 1000)] = 0
    """Number of people who walk about."""
    slips: tuple[Slip, ...] = ()
    """Times at which the wheels slip."""
    kidnaps: tuple[Kidnap, ...] = ()
    """Times at which the robot is kidnapped."""
    map_resolution: Annotated[float, Range(1e-3, 100)] = 0.05
    """Side of a cell of the recorded map [m]."""
    start_stamp_ns: Annotated[int, Range(0, 2**31 * 10**9)] = 1_700_000_000_000_000_000
    """Stamp of the first message [ns]."""

    @property
    def odometry_period_ns(self) -> int:
        """Nanoseconds between odometry messages."""
        return round(1e9 / self.odometry_rate_hz)

    @property
    def scan_period_ns(self) -> int:
        """Nanoseconds between scans."""
        return round(1e9 / self.scan_rate_hz)

    def laps_needed(self, lap_length: float) -> float:
        """Laps of path, each `lap_length` metres, that last for the whole recording."""
        if self.duration_s is None:
            return self.laps
        seconds = self.duration_s + sum(kidnap.skip_s for kidnap in self.kidnaps)
        return float(ceil(seconds * self.robot.speed / lap_length) + 1)

    def to_dict(self) -> dict[str, Any]:
        """As plain values for JSON; `kind` is the class of robot, sensor and odometry."""
        result = _plain(self)
        assert isinstance(result, dict)
        return result

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> Scenario:
        """The inverse of `to_dict`. Raises ConfigError for unknown keys or kinds."""
        parsed = dict(values)
        for key in ("robot", "sensor", "odometry"):
            if key in parsed:
                parsed[key] = _typed(parsed[key])
        parsed["slips"] = tuple(_build(Slip, slip) for slip in parsed.get("slips", ()))
        parsed["kidnaps"] = tuple(_build(Kidnap, kidnap) for kidnap in parsed.get("kidnaps", ()))
        result = _build(Scenario, parsed)
        assert isinstance(result, Scenario)
        return result


_KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (DifferentialDrive, SteeredVehicle, Lidar, PointSensor, OdometryNoise, SteeringNoise)
}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        tag = {"kind": type(value).__name__} if type(value).__name__ in _KINDS else {}
        return tag | {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _typed(values: Mapping[str, Any]) -> Any:
    rest = dict(values)
    kind = rest.pop("kind", None)
    if kind not in _KINDS:
        raise ConfigError(f"scenario: kind {kind!r} is unknown; choose from {', '.join(_KINDS)}")
    if "mounting" in rest:
        rest["mounting"] = _build(Pose2, rest["mounting"])
    return _build(_KINDS[kind], rest)


def _build(kind: type, values: Mapping[str, Any]) -> Any:
    known = {item.name for item in fields(kind)}
    if unknown := sorted(set(values) - known):
        raise ConfigError(f"scenario: {kind.__name__} has no {unknown[0]!r}; it has {', '.join(sorted(known))}")
    return kind(**values)
