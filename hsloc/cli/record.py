"""Drive a simulated robot through a world and write the log that it would have written."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import fields, replace
from math import isfinite, radians
from typing import TYPE_CHECKING, Any, TypeVar

from hsloc.cli.arguments import pose, seed, to_pose
from hsloc.cli.progress import ProgressLine
from hsloc.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from _typeshed import DataclassInstance

    from hsloc.simulation.recorder import Recording
    from hsloc.simulation.scenario import Scenario
    from hsloc.simulation.world import World

T = TypeVar("T", bound="DataclassInstance")

HELP = "drive a simulated robot and write its log"
EXAMPLES = """
  hsloc record office.mcap --world office --seed 3
  hsloc record floor.mcap --world floor.yaml --waypoints path.txt
  hsloc record --list
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hsloc record`."""
    parser.add_argument("out", nargs="?", metavar="OUT.mcap", help="Log to write.")
    what = parser.add_argument_group("what to drive")
    what.add_argument(
        "--world",
        metavar="WORLD",
        help="office, corridor-loop, hall, paper, ... (--list), or a file: a nav2 map (.yaml), "
        "a text of segments `x0 y0 x1 y1`, or one of points `x y`",
    )
    what.add_argument("--scenario", metavar="NAME", help="A world together with its faults (--list).")
    what.add_argument(
        "--waypoints",
        metavar="FILE",
        help="Path of the robot: a text of points `x y` [m]; closed if the last is the first.",
    )
    what.add_argument("--list", action="store_true", help="List worlds and scenarios, and exit.")
    what.add_argument("--seed", type=seed, metavar="N", help="Seed of all noise (default: 0).")
    what.add_argument(
        "--duration", type=float, metavar="S", help="Time to record [s] (default: until the end of the path)."
    )
    what.add_argument("--laps", type=float, metavar="N", help="Number of laps (default: the scenario's).")
    what.add_argument("--speed", type=float, metavar="M/S", help="Largest speed of the robot [m/s].")
    what.add_argument("--people", type=int, metavar="N", help="Number of people who walk about.")
    what.add_argument(
        "--map-resolution", type=float, metavar="M", help="Side of a cell of /map [m] (default: 0.05; paper 0.1)."
    )

    lidar = parser.add_argument_group("lidar")
    lidar.add_argument("--beams", type=int, metavar="N", help="Number of beams of a scan.")
    lidar.add_argument("--fov", type=float, metavar="DEG", help="Field of view [deg].")
    lidar.add_argument("--range-max", type=float, metavar="M", help="Largest range; beyond it, readings are +inf [m].")
    lidar.add_argument("--range-noise", type=float, metavar="M", help="Standard deviation of a range [m].")
    lidar.add_argument("--dropout", type=float, metavar="P", help="Share of readings that are lost [0 to 1].")
    lidar.add_argument(
        "--mounting",
        type=pose,
        metavar="X,Y,YAW",
        help="Pose of the laser in the base frame: x, y [m], yaw [rad].",
    )
    lidar.add_argument("--upside-down", action="store_true", default=None, help="Mount the laser upside down.")
    lidar.add_argument(
        "--motion-distortion",
        action="store_true",
        default=None,
        help="Measure each beam at its own time during the sweep.",
    )
    lidar.add_argument("--scan-rate", type=float, metavar="HZ", help="Rate of the scans [Hz].")

    odometry = parser.add_argument_group("odometry (Probabilistic Robotics, Table 5.6)")
    for number, meaning in enumerate(
        ("turns from turning", "turns from driving", "distance from driving", "distance from turning"), 1
    ):
        odometry.add_argument(f"--alpha{number}", type=float, metavar="A", help=f"Noise of {meaning}.")
    odometry.add_argument(
        "--noise-interval",
        type=float,
        metavar="S",
        help="Time for which a sample of the noise is kept [s]; 0: one sample for each message.",
    )
    odometry.add_argument("--odometry-rate", type=float, metavar="HZ", help="Rate of the odometry [Hz].")
    odometry.add_argument(
        "--slip",
        type=_numbers(2, 3, 4),
        action="append",
        metavar="AT,S[,FACTOR[,DEG/S]]",
        help="From AT on, for S seconds, the wheels count FACTOR times the distance and turn by DEG/S.",
    )
    odometry.add_argument(
        "--kidnap-at",
        type=_numbers(1, 2),
        action="append",
        metavar="AT[,SKIP]",
        help="At AT seconds the robot is kidnapped to where it would be SKIP seconds later (default: 20).",
    )

    parser.add_argument("--force", action="store_true", help="Overwrite OUT.mcap.")
    parser.add_argument("--json", action="store_true", help="Print the summary as JSON.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print nothing.")


def run(arguments: argparse.Namespace) -> int:
    """Record; returns the exit code."""
    from hsloc.simulation.presets import preset
    from hsloc.simulation.recorder import record
    from hsloc.simulation.world_files import load_world

    if arguments.list:
        _print_list(arguments.json)
        return 0
    if arguments.out is None or (arguments.world is None) == (arguments.scenario is None):
        lacks = (
            "a file to write: hsloc record OUT.mcap --world office"
            if arguments.out is None
            else "one of --world and --scenario (see --list)"
        )
        print(f"hsloc record: error: give {lacks}", file=sys.stderr)
        return 2
    world = load_world(arguments.world or preset(arguments.scenario).world, arguments.waypoints)
    scenario = build_scenario(arguments, world)
    if not arguments.quiet:
        for warning in world.warnings:
            print(f"hsloc: warning: {warning}", file=sys.stderr)
    way = world.lap_length() * scenario.laps_needed(world.lap_length())
    with ProgressLine(arguments.quiet) as line:

        def show(seconds: float, metres: float) -> None:
            share = metres / way if scenario.duration_s is None else seconds / scenario.duration_s
            line.show("record", share, f"{seconds:.0f} s, {metres:.0f} m, {seconds / line.elapsed:.0f} x real time")

        recording = record(scenario, arguments.out, world, overwrite=arguments.force, progress=show)
    if arguments.json:
        print(json.dumps(_summary(recording, scenario)))
    elif not arguments.quiet:
        print(
            f"{recording.path}: {recording.seconds:.1f} s, {recording.metres:.1f} m, {recording.scans} scans, "
            f"{recording.size / 1e6:.2f} MB, sha256 {recording.sha256}"
        )
    return 0


def build_scenario(arguments: argparse.Namespace, world: World) -> Scenario:
    """The scenario that the arguments describe. Raises ConfigError for what does not fit together."""
    from hsloc.simulation.odometer import Slip
    from hsloc.simulation.presets import ANY_WORLD, SCENARIOS, preset
    from hsloc.simulation.scenario import Kidnap

    if arguments.scenario is not None:
        base = preset(arguments.scenario)
    elif world.points is not None:
        base = SCENARIOS["paper"]
    else:
        base = SCENARIOS.get(world.name, ANY_WORLD)
    sensor = _changed(
        base.sensor,
        beams=("--beams", arguments.beams),
        field_of_view=("--fov", None if arguments.fov is None else radians(arguments.fov)),
        range_max=("--range-max", arguments.range_max),
        range_noise=("--range-noise", arguments.range_noise),
        dropout=("--dropout", arguments.dropout),
        mounting=("--mounting", to_pose(arguments.mounting)),
        upside_down=("--upside-down", arguments.upside_down),
        motion_distortion=("--motion-distortion", arguments.motion_distortion),
    )
    alphas = {f"alpha{i}": (f"--alpha{i}", getattr(arguments, f"alpha{i}")) for i in range(1, 5)}
    odometry = _changed(base.odometry, **alphas, interval_s=("--noise-interval", arguments.noise_interval))
    slips = [Slip(*slip[:3], *map(radians, slip[3:])) for slip in arguments.slip or ()]
    kidnaps = [Kidnap(*kidnap) for kidnap in arguments.kidnap_at or ()]
    return _changed(
        base,
        world=("--world", world.name),
        seed=("--seed", arguments.seed),
        robot=("--speed", _changed(base.robot, speed=("--speed", arguments.speed))),
        sensor=("", sensor),
        odometry=("", odometry),
        odometry_rate_hz=("--odometry-rate", arguments.odometry_rate),
        scan_rate_hz=("--scan-rate", arguments.scan_rate),
        laps=("--laps", arguments.laps),
        duration_s=("--duration", arguments.duration),
        people=("--people", arguments.people),
        slips=("--slip", tuple(slips) or None),
        kidnaps=("--kidnap-at", tuple(kidnaps) or None),
        map_resolution=("--map-resolution", arguments.map_resolution),
    )


def _changed(thing: T, **changes: tuple[str, object]) -> T:
    """A dataclass with some fields changed: name=(option, value), where None leaves the field as it is."""
    wanted = {name: (option, value) for name, (option, value) in changes.items() if value is not None}
    for name, (option, _) in wanted.items():
        if name not in {item.name for item in fields(thing)}:
            raise ConfigError(f"{option} does not apply here: the {type(thing).__name__} has no {name}; leave it out")
    return replace(thing, **{name: value for name, (_, value) in wanted.items()})


def _numbers(*counts: int) -> Callable[[str], tuple[float, ...]]:
    """An argument of a given number of values with commas between."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in text.split(","))
        except ValueError:
            values = ()
        if len(values) not in counts or not all(map(isfinite, values)):
            wanted = " or ".join(map(str, counts))
            raise argparse.ArgumentTypeError(f"{text!r}: {wanted} numbers with commas between are wanted")
        return values

    return parse


def _summary(recording: Recording, scenario: Scenario) -> dict[str, Any]:
    return {
        "path": str(recording.path),
        "world": scenario.world,
        "seed": scenario.seed,
        "seconds": round(recording.seconds, 9),
        "metres": round(recording.metres, 6),
        "scans": recording.scans,
        "odometry": recording.odometry,
        "start_pose": [recording.start.x, recording.start.y, recording.start.theta],
        "bytes": recording.size,
        "sha256": recording.sha256,
        "scenario": scenario.to_dict(),
    }


def _print_list(as_json: bool) -> None:
    from hsloc.simulation.built_in import WORLDS
    from hsloc.simulation.presets import SCENARIOS

    if as_json:
        print(json.dumps({"worlds": list(WORLDS), "scenarios": list(SCENARIOS)}))
        return
    print("worlds (--world NAME)")
    for name, make in WORLDS.items():
        print(f"  {name:20} {(make.__doc__ or '').splitlines()[0]}")
    print("scenarios (--scenario NAME)")
    for name, scenario in SCENARIOS.items():
        print(f"  {name:20} {describe(scenario)}")


def describe(scenario: Scenario) -> str:
    """A scenario in a line."""
    parts = [scenario.world, type(scenario.sensor).__name__]
    parts.append(f"{scenario.laps:g} laps" if scenario.duration_s is None else f"{scenario.duration_s:g} s")
    parts += [f"slip at {slip.at_s:g} s" for slip in scenario.slips]
    parts += [f"kidnapped at {kidnap.at_s:g} s" for kidnap in scenario.kidnaps]
    parts += [f"{scenario.people} people"] if scenario.people else []
    dropout = getattr(scenario.sensor, "dropout", 0.0)
    parts += [f"{dropout:.0%} dropouts"] if dropout else []
    return ", ".join(parts)
