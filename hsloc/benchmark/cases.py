"""(e) Matching cases from a file: real scans, a map that was built from others, and starts that are off.

The file is an .npz with `occ` (h, w; 0 unknown, 1 free, 2 occupied; row 0 at the lowest y), `origin` (2,) of the map's
lower-left corner, `res`, `angles` (n,) and `ranges` (m, n) of the beams, `rmax`, `ref` (m, 3) true poses and
`start_track`, `start_small`, `start_large` (m, 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from time import perf_counter
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np

from hsloc.errors import ConfigError
from hsloc.matching import Window
from hsloc.model import OccupancyGrid, Pose2
from hsloc.model.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from hsloc.model.pose2 import wrap_angle

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.benchmark.methods import Method

    F64 = NDArray[np.float64]

LEVELS = {"track": (0.1, radians(5.0)), "small": (0.5, radians(20.0)), "large": (2.0, radians(45.0))}
"""How far the starts are off at most in x, y (m) and theta (rad), uniformly: the window of the search."""
SUCCESS = (0.10, 2.0)
"""Metres and degrees."""
_KEYS = ("occ", "origin", "res", "angles", "ranges", "rmax", "ref", *(f"start_{level}" for level in LEVELS))


@dataclass(frozen=True, slots=True, eq=False)
class Cases:
    """`scans` are points (n, 2) seen from the pose, `truth` and `starts[level]` poses (m, 3)."""

    name: str
    grid: OccupancyGrid
    scans: tuple[F64, ...]
    truth: F64
    starts: dict[str, F64]

    def __len__(self) -> int:
        return len(self.scans)

    def first(self, count: int) -> Cases:
        """The first `count` of them."""
        starts = {level: poses[:count] for level, poses in self.starts.items()}
        return Cases(self.name, self.grid, self.scans[:count], self.truth[:count], starts)


def read_cases(path: Path) -> Cases:
    """Raises ConfigError for a file that is missing or has not what is named above."""
    try:
        archive = np.load(path, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with archive:
            if missing := [key for key in _KEYS if key not in archive]:
                raise ConfigError(f"{path}: has no {missing[0]!r}; matching cases need {', '.join(_KEYS)}")
            values = {key: archive[key] for key in _KEYS}
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file; name an .npz with --cases") from error
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise ConfigError(f"{path}: not an .npz with matching cases: {error}") from error
    lookup = np.array((UNKNOWN, FREE, OCCUPIED), dtype=np.int8)
    origin = Pose2(float(values["origin"][0]), float(values["origin"][1]), 0.0)
    grid = OccupancyGrid(lookup[values["occ"]], float(values["res"]), origin)
    directions = np.column_stack((np.cos(values["angles"]), np.sin(values["angles"])))
    scans = []
    for ranges in values["ranges"].astype(np.float64):
        valid = np.isfinite(ranges) & (ranges > 0.0) & (ranges < float(values["rmax"]))
        scans.append(ranges[valid, None] * directions[valid])
    return Cases(path.stem, grid, tuple(scans), values["ref"], {level: values[f"start_{level}"] for level in LEVELS})


@dataclass(frozen=True, slots=True)
class CaseResult:
    """One method on one level; times are of one match each, the preparation of the map is not counted."""

    method: str
    level: str
    cases: int
    success: float
    median_ms: float
    p95_ms: float
    median_evaluations: float | None
    median_m: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "method": self.method,
            "level": self.level,
            "cases": self.cases,
            "success": self.success,
            "median_ms": self.median_ms,
            "p95_ms": self.p95_ms,
            "median_evaluations": self.median_evaluations,
            "median_error_m": self.median_m,
        }


def run_method(method: Method, cases: Cases, progress: Callable[[float], None]) -> tuple[CaseResult, ...]:
    """Match every case of every level once, after three matches to warm up."""
    results: list[CaseResult] = []
    for level, half in LEVELS.items():
        starts = cases.starts[level]
        for index in range(min(3, len(cases))):
            method.match(cases.scans[index], window_at(starts[index], half), index)
        rows = []
        for index, scan in enumerate(cases.scans):
            window = window_at(starts[index], half)
            begin = perf_counter()
            pose, evaluations = method.match(scan, window, index)
            seconds = perf_counter() - begin
            x, y, theta = cases.truth[index]
            angle = abs(np.degrees(wrap_angle(pose.theta - theta)))
            rows.append((np.hypot(pose.x - x, pose.y - y), angle, seconds * 1e3, evaluations))
            progress((len(results) + (index + 1) / len(cases)) / len(LEVELS))
        table = np.array(rows, dtype=np.float64)
        counted = bool((table[:, 3] > 0).all())
        results.append(
            CaseResult(
                method=method.name,
                level=level,
                cases=len(cases),
                success=float(((table[:, 0] < SUCCESS[0]) & (table[:, 1] < SUCCESS[1])).mean()),
                median_ms=float(np.median(table[:, 2])),
                p95_ms=float(np.percentile(table[:, 2], 95)),
                median_evaluations=float(np.median(table[:, 3])) if counted else None,
                median_m=float(np.median(table[:, 0])),
            )
        )
    return tuple(results)


def window_at(start: F64, half: tuple[float, float]) -> Window:
    """The window of a level (`LEVELS`) around a start (3,)."""
    return Window(Pose2.from_array(start), half[0], half[0], half[1])
