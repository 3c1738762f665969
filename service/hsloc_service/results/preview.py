"""What the web page draws: the map as a picture, and paths and errors short enough for a telephone."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.model.pose2 import Pose2, compose_poses, wrap_angles
from hsloc.model.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.replay.run import Result

    Floats = NDArray[np.float64]

POSES = 3000
"""Poses of a path that are drawn; more do not show."""
SIDE = 4096
"""A map with a longer side is drawn from every n-th cell."""


def write_viewer(result: Result, folder: Path, metrics: Mapping[str, Any]) -> None:
    """Write `viewer.json` and `viewer-map.png`; times in seconds since the first pose.

    Everything is in the frame of the map that was used or drawn: the odometry begins where the trajectory does, and the
    reference is moved by the alignment of the metrics.
    """
    start = int(result.trajectory.stamps_ns[0])
    values: dict[str, Any] = {
        "map": _draw_map(result, folder / "viewer-map.png"),
        "trajectory": _path(result.trajectory.stamps_ns, result.trajectory.poses, start),
        "odometry": None,
        "reference": None,
        "errors": None,
        "fitness": _columns((result.diagnostics.stamps_ns - start) / 1e9, fitness=result.diagnostics.fitness),
    }
    if len(result.odometry) > 0:
        first = Pose2(*result.trajectory.poses[0]) @ Pose2(*result.odometry.poses[0]).inverse()
        values["odometry"] = _path(
            result.odometry.stamps_ns, compose_poses(first.to_array(), result.odometry.poses), start
        )
    if result.reference is not None and len(result.reference) > 1:
        reference = _moved(result.reference, metrics)
        values["reference"] = _path(reference.stamps_ns, reference.poses, start)
        values["errors"] = _errors(result.trajectory, reference, start)
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    (folder / "viewer.json").write_text(text, encoding="utf-8")


def _moved(reference: Trajectory, metrics: Mapping[str, Any]) -> Trajectory:
    """The reference in the frame of the estimate."""
    found = metrics.get("alignment_transform")
    if not isinstance(found, dict):
        return reference
    T_estimate_reference = Pose2(found["x"], found["y"], found["theta"]).inverse()
    return Trajectory(reference.stamps_ns, compose_poses(T_estimate_reference.to_array(), reference.poses))


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


def _errors(trajectory: Trajectory, reference: Trajectory, start: int) -> dict[str, list[float | None]]:
    """Distance and heading difference to the reference, interpolated at the stamps that it encloses."""
    stamps, known = trajectory.stamps_ns, reference.stamps_ns
    order = np.argsort(known, kind="stable")
    base = int(known[order[0]])
    t_known = (known[order] - base) / 1e9
    inside = (stamps >= base) & (stamps <= int(known[order[-1]]))
    t = (stamps[inside] - base) / 1e9
    x = np.interp(t, t_known, reference.poses[order, 0])
    y = np.interp(t, t_known, reference.poses[order, 1])
    theta = np.interp(t, t_known, np.unwrap(reference.poses[order, 2]))
    poses = trajectory.poses[inside]
    position = np.hypot(poses[:, 0] - x, poses[:, 1] - y)
    heading = np.degrees(np.abs(wrap_angles(poses[:, 2] - theta)))
    return _columns((stamps[inside] - start) / 1e9, position=position, heading=heading)


def _path(stamps: NDArray[np.int64], poses: Floats, start: int) -> dict[str, list[float | None]]:
    return _columns((stamps - start) / 1e9, x=poses[:, 0], y=poses[:, 1], theta=poses[:, 2])


def _columns(t: Floats, **columns: Floats) -> dict[str, list[float | None]]:
    """Columns of at most `POSES` rows; what is not a number becomes null."""
    step = max(1, -(-len(t) // POSES))
    return {name: _numbers(column[::step]) for name, column in {"t": t, **columns}.items()}


def _numbers(values: Floats) -> list[float | None]:
    return [round(value, 4) if np.isfinite(value) else None for value in values.tolist()]
