"""Write what a simulated robot does as a log: ROS 2 CDR in MCAP, the same bytes for the same scenario."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from hashlib import file_digest
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.atomic_write import is_there
from hsloc.errors import OutputError
from hsloc.log import LogWriter, Transform3
from hsloc.model import Pose2, Scan
from hsloc.simulation.simulator import Tick, simulate
from hsloc.simulation.world_files import load_world

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.simulation.scenario import Scenario
    from hsloc.simulation.world import World

METADATA = "hsloc.scenario"
"""Name of the metadata record of what was recorded: scenario (JSON), seed, world and its sha256."""
INITIAL_POSE = "hsloc.initial_pose"
"""Name of the metadata record of the start in the map: x, y (m), theta (rad), stamp_ns."""

HEAD_DOWN = Transform3(rotation=(1.0, 0.0, 0.0, 0.0))
"""Half a turn about the x axis."""


@dataclass(frozen=True, slots=True)
class Recording:
    """What was written: seconds, metres driven, messages by kind, size in bytes and sha256 of the file."""

    path: Path
    seconds: float
    metres: float
    scans: int
    odometry: int
    start: Pose2
    size: int
    sha256: str


def record(
    scenario: Scenario,
    path: Path | str,
    world: World | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[float, float], None] | None = None,
) -> Recording:
    """Drive `scenario` and write the log to `path`.

    `world` overrides the scenario's, which is found by its name. `progress` is called with the seconds and metres
    driven, once a simulated second. The file appears only when it is complete. Raises ConfigError for a world
    that is unknown, OutputError where the file exists (unless `overwrite`) or cannot be written.
    """
    target = Path(path)
    if is_there(target) and not overwrite:
        raise OutputError(f"{target}: exists already; name another file, or overwrite it with --force")
    world = load_world(scenario.world) if world is None else world
    with LogWriter(target) as writer:
        _write_head(writer, scenario, world)
        tally = _Tally(world.start())
        for item in simulate(scenario, world):
            if isinstance(item, Scan):
                _write_scan(writer, item, scenario)
                tally.scans += 1
            else:
                _write_tick(writer, item)
                tally.count(item)
                if progress is not None and tally.odometry % max(1, round(scenario.odometry_rate_hz)) == 0:
                    progress(tally.seconds, tally.metres)
    with target.open("rb") as stream:
        digest = file_digest(stream, "sha256").hexdigest()
    return Recording(
        target,
        tally.seconds,
        tally.metres,
        tally.scans,
        tally.odometry,
        world.start(),
        target.stat().st_size,
        digest,
    )


class _Tally:
    """How long and how far. A jump of a kidnapping is not driven, and not counted."""

    JUMP = 1.0

    def __init__(self, start: Pose2) -> None:
        self.scans = self.odometry = 0
        self.seconds = self.metres = 0.0
        self._at, self._first_ns = start, -1

    def count(self, tick: Tick) -> None:
        self._first_ns = tick.stamp_ns if self._first_ns < 0 else self._first_ns
        way = self._at.distance(tick.T_map_base)
        self.metres += way if way < self.JUMP else 0.0
        self.seconds = (tick.stamp_ns - self._first_ns) * 1e-9
        self.odometry += 1
        self._at = tick.T_map_base


def _write_head(writer: LogWriter, scenario: Scenario, world: World) -> None:
    stamp, start, sensor = scenario.start_stamp_ns, world.start(), scenario.sensor
    writer.metadata(
        METADATA,
        {
            "scenario": json.dumps(scenario.to_dict(), sort_keys=True),
            "seed": str(scenario.seed),
            "world": world.name,
            "world_sha256": world.fingerprint(),
        },
    )
    pose = {name: repr(value) for name, value in (("x", start.x), ("y", start.y), ("theta", start.theta))}
    writer.metadata(INITIAL_POSE, {**pose, "stamp_ns": str(stamp)})
    if world.points is not None:
        rows = "".join(f"{x!r},{y!r}\n" for x, y in world.points.tolist())
        writer.attachment("map_points.csv", f"x_m,y_m\n{rows}".encode(), "text/csv", stamp)
    mounting = Transform3.from_pose2(sensor.mounting)
    mounting = mounting @ HEAD_DOWN if sensor.upside_down else mounting
    writer.transforms(stamp, [("base_link", sensor.frame_id, mounting)], static=True)
    writer.occupancy_grid(world.occupancy_grid(scenario.map_resolution), stamp)


def _write_tick(writer: LogWriter, tick: Tick) -> None:
    writer.transforms(tick.stamp_ns, [("odom", "base_link", tick.T_odom_base)])
    writer.odometry(tick.stamp_ns, tick.T_odom_base, covariance=tick.covariance, twist=tick.twist)
    writer.odometry(tick.stamp_ns, tick.T_map_base, topic="/ground_truth", frame_id="map")


def _write_scan(writer: LogWriter, scan: Scan, scenario: Scenario) -> None:
    if scenario.sensor.upside_down:
        # the model's scan is seen from above; the message is in the laser's own frame
        scan = replace(scan, angle_min=-scan.angle_min, angle_increment=-scan.angle_increment)
    writer.scan(scan, scan_time=scenario.scan_period_ns * 1e-9)
