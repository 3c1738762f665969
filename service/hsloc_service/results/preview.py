"""What the web page draws: the map as a picture, and paths and errors of limited length."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.model.pose2 import compose_poses
from hsloc.model.trajectory import Trajectory
from hsloc.report.data import peak_rows

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.analysis import Analysis
    from hsloc.evaluation import Comparison
    from hsloc.replay.run import Result

    Floats = NDArray[np.float64]

POSES = 3000
"""Poses of a path that are drawn; more do not show."""
SIDE = 4096
"""A map with a longer side is drawn from every n-th cell."""


def write_viewer(result: Result, analysis: Analysis, folder: Path) -> None:
    """Write `viewer.json` and `viewer-map.png`; times in seconds since the first pose.

    Everything is in the frame of the map that was used or built: the odometry begins at the trajectory's first
    localised pose, and the reference is moved by the alignment of the comparison, whose errors the curve shows.
    """
    start = int(result.trajectory.stamps_ns[0])
    odometry, reference, comparison = analysis.odometry, result.reference, analysis.comparison
    if reference is not None and comparison is not None:
        T_map_reference = comparison.T_reference_estimate.inverse()
        reference = Trajectory(reference.stamps_ns, compose_poses(T_map_reference.to_array(), reference.poses))
    values: dict[str, Any] = {
        "map": _draw_map(result, folder / "viewer-map.png"),
        "trajectory": _path(result.trajectory, start),
        "odometry": None if odometry is None else _path(odometry, start),
        "reference": None if reference is None or len(reference) < 2 else _path(reference, start),
        "errors": None if comparison is None else _errors(comparison, start),
        "fitness": _columns((result.diagnostics.stamps_ns - start) / 1e9, fitness=result.diagnostics.fitness),
    }
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    (folder / "viewer.json").write_text(text, encoding="utf-8")


def _draw_map(result: Result, path: Path) -> dict[str, Any]:
    from PIL import Image

    grid = result.grid
    step = -(-max(grid.cells.shape) // SIDE)
    cells = grid.cells[::step, ::step]
    shade = np.full(cells.shape, 205, dtype=np.uint8)
    shade[cells >= 0] = (254 - 254 * np.minimum(cells[cells >= 0], 100).astype(np.int64) // 100).astype(np.uint8)
    Image.fromarray(np.flipud(shade)).save(path, optimize=False)
    origin = grid.origin
    return {
        "image": path.name,
        "resolution": grid.resolution * step,
        "origin": [origin.x, origin.y, origin.theta],
        "width": cells.shape[1],
        "height": cells.shape[0],
    }


def _errors(comparison: Comparison, start: int) -> dict[str, list[float | None]]:
    """Distance (m) and heading difference (deg) of the pairs that metrics.json counts; no peak is left out."""
    order = np.argsort(comparison.pairs.stamps_ns, kind="stable")
    seconds = (comparison.pairs.stamps_ns[order] - start) / 1e9
    position, heading = comparison.errors.trans_part[order], comparison.errors.angle_deg[order]
    each = POSES // 2 - 4  # room for the ends of both
    rows = np.union1d(peak_rows(position, each), peak_rows(heading, each))
    return _columns(seconds[rows], position=position[rows], heading=heading[rows])


def _path(trajectory: Trajectory, start: int) -> dict[str, list[float | None]]:
    poses = trajectory.poses
    return _columns((trajectory.stamps_ns - start) / 1e9, x=poses[:, 0], y=poses[:, 1], theta=poses[:, 2])


def _columns(t: Floats, **columns: Floats) -> dict[str, list[float | None]]:
    """Columns of at most `POSES` rows; what is not a number becomes null."""
    step = max(1, -(-len(t) // POSES))
    return {name: _numbers(column[::step]) for name, column in {"t": t, **columns}.items()}


def _numbers(values: Floats) -> list[float | None]:
    return [round(value, 4) if np.isfinite(value) else None for value in values.tolist()]
