"""A scenario: everything that a recording is made from. The same scenario gives the same bytes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass
from math import ceil, tau
from typing import TYPE_CHECKING, Any

from hsloc.errors import ConfigError
from hsloc.model import Pose2
from hsloc.simulation.odometer import OdometryNoise, Slip, SteeringNoise
from hsloc.simulation.robot import DifferentialDrive, SteeredVehicle
from hsloc.simulation.sensors import Lidar, PointSensor

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


@dataclass(frozen=True, slots=True)
class Kidnap:
    """At `at_s` seconds the robot is picked up and set down where it would have been `skip_s` seconds later.

    The world's pose jumps, the odometry does not notice.
    """

    at_s: float
    skip_s: float = 20.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """A robot with its sensors, a world by name, and what goes wrong.

    The recording ends after `duration_s` seconds or, where that is None, with the path of `laps` laps. Odometry
    comes at `odometry_rate_hz`, scans at `scan_rate_hz`, the first `scan_offset_s` after the start. `people` walk
    about. `start_stamp_ns` is the time of the first message: never the wall's.
    """

    world: str
    seed: int = 0
    robot: DifferentialDrive | SteeredVehicle = field(default_factory=DifferentialDrive)
    sensor: Lidar | PointSensor = field(default_factory=Lidar)
    odometry: OdometryNoise | SteeringNoise = field(default_factory=OdometryNoise)
    odometry_rate_hz: float = 50.0
    scan_rate_hz: float = 10.0
    scan_offset_s: float = 0.0
    laps: float = 1.0
    duration_s: float | None = None
    people: int = 0
    slips: tuple[Slip, ...] = ()
    kidnaps: tuple[Kidnap, ...] = ()
    map_resolution: float = 0.05
    start_stamp_ns: int = 1_700_000_000_000_000_000

    def __post_init__(self) -> None:
        """Raises ConfigError for what cannot be driven or measured."""
        for name, value, low, high in self._limits():
            if value is not None and not low <= value <= high:
                raise ConfigError(f"scenario: {name} is {value}; it must lie between {low:g} and {high:g}")

    def _limits(self) -> Iterator[tuple[str, float | None, float, float]]:
        """(name, value, least, most) of every number that has limits."""
        yield "seed", self.seed, 0, 2**63
        yield "odometry_rate_hz", self.odometry_rate_hz, 0.1, 10_000
        yield "scan_rate_hz", self.scan_rate_hz, 0.01, 10_000
        yield "scan_offset_s", self.scan_offset_s, 0, 1e6
        yield "laps", self.laps, 1e-3, 10_000
        yield "duration_s", self.duration_s, 1e-3, 1e6
        yield "people", self.people, 0, 1000
        yield "map_resolution", self.map_resolution, 1e-3, 100
        yield "start_stamp_ns", self.start_stamp_ns, 0, 2**31 * 10**9
        yield "robot.speed", self.robot.speed, 1e-3, 100
        yield "robot.turn_rate", self.robot.turn_rate, 1e-3, 100
        yield "sensor.beams", self.sensor.beams, 1, 100_000
        yield "sensor.range_max", self.sensor.range_max, 1e-3, 1e6
        if isinstance(self.sensor, Lidar):
            yield "sensor.field_of_view", self.sensor.field_of_view, 1e-3, tau
            yield "sensor.dropout", self.sensor.dropout, 0, 1
            yield "sensor.range_noise", self.sensor.range_noise, 0, 100
        for item in fields(self.odometry):
            yield f"odometry.{item.name}", getattr(self.odometry, item.name), 0, 1e6
        for number, slip in enumerate(self.slips, 1):
            yield f"slip {number}: at_s", slip.at_s, 0, 1e6
            yield f"slip {number}: duration_s", slip.duration_s, 0, 1e6
            yield f"slip {number}: factor", slip.factor, -100, 100
        for number, kidnap in enumerate(self.kidnaps, 1):
            yield f"kidnap {number}: at_s", kidnap.at_s, 0, 1e6
            yield f"kidnap {number}: skip_s", kidnap.skip_s, 0, 1e6

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
