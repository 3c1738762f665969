"""(d) Peak memory of a log, and of one ten times as long."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from hsloc.errors import HslocError
from hsloc.replay.run import run
from hsloc.request import RunRequest
from hsloc.simulation.presets import OFFICE
from hsloc.simulation.recorder import record

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.simulation.scenario import Scenario

TIMES = 10

_CHILD = """
import json, sys
from pathlib import Path
from hsloc.replay.run import run
from hsloc.request import RunRequest

result = run(RunRequest(logs=(Path(sys.argv[1]),)))
try:
    # Not ru_maxrss: on Linux that starts with the peak of the process that started this one.
    lines = Path("/proc/self/status").read_text().splitlines()
    (peak,) = (int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
except (OSError, ValueError):
    import resource
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
paths = [path for path in (result.trajectory, result.odometry, result.reference) if path is not None]
kept = sum(path.stamps_ns.nbytes + path.poses.nbytes for path in paths)
print(json.dumps({"peak": peak, "trajectory": kept, "seconds": result.summary.duration_s}))
"""


@dataclass(frozen=True, slots=True)
class Memory:
    """Bytes of resident memory at the peak of a replay, and of the result's own trajectories (three of them).

    `long_*` belong to the log that is ten times as long.
    """

    seconds: float
    peak: int
    trajectory: int
    long_seconds: float
    long_peak: int
    long_trajectory: int

    @property
    def growth(self) -> float:
        """How much more the long log needs, as a part of the short one's peak."""
        return self.long_peak / self.peak - 1.0

    @property
    def growth_but_trajectory(self) -> float:
        """The same without the trajectories themselves."""
        return (self.long_peak - self.long_trajectory) / (self.peak - self.trajectory) - 1.0

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "short": {"seconds": self.seconds, "peak_bytes": self.peak, "trajectory_bytes": self.trajectory},
            "long": {
                "seconds": self.long_seconds,
                "peak_bytes": self.long_peak,
                "trajectory_bytes": self.long_trajectory,
            },
            "growth": self.growth,
            "growth_but_trajectory": self.growth_but_trajectory,
        }


def measure_memory(folder: Path, seconds: float | None = None) -> Memory:
    """Record two drives through the office into `folder` and replay each in a process of its own.

    The short one is a lap (113 s) or `seconds`. Raises HslocError where the process fails.
    """
    if seconds is None:
        short, long = replace(OFFICE, seed=1), replace(OFFICE, seed=1, laps=float(TIMES))
    else:
        short = replace(OFFICE, seed=1, duration_s=seconds)
        long = replace(OFFICE, seed=1, duration_s=TIMES * seconds)
    warm_up = folder / "warm-up.mcap"
    record(replace(short, duration_s=8.0), warm_up)
    run(RunRequest(logs=(warm_up,)))  # a process that has to compile the kernels needs 100 MB for that alone
    one, ten = (_replayed(scenario, folder / f"{name}.mcap") for name, scenario in (("short", short), ("long", long)))
    return Memory(
        one["seconds"], int(one["peak"]), int(one["trajectory"]),
        ten["seconds"], int(ten["peak"]), int(ten["trajectory"]),
    )  # fmt: skip


def _replayed(scenario: Scenario, path: Path) -> dict[str, float]:
    record(scenario, path)
    child = subprocess.run([sys.executable, "-c", _CHILD, str(path)], capture_output=True, text=True, check=False)
    if child.returncode != 0:
        last = (child.stderr.strip().splitlines() or ["no output"])[-1]
        raise HslocError(f"{path}: the replay in a process of its own failed: {last}")
    values: dict[str, float] = json.loads(child.stdout)
    return values
