"""Paths for the tests of hsloc.evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np

from hsloc.model import OccupancyGrid, Pose2, ScanDiagnostics, Trajectory, wrap_angles
from hsloc.model.pose2 import relative_poses

START_NS = 1_700_000_000_123_456_789


def make_path(
    rng: Any, n: Any, *, period_ns: int = 20_000_000, start_ns: Any = START_NS, step: float = 0.05, jitter_ns: int = 0
) -> Any:
    """A wandering robot: n poses, a smooth path with turns through +-pi."""
    turns = np.cumsum(rng.normal(0.0, 0.02, n)) * 0.3
    theta = rng.uniform(-3.0, 3.0) + np.cumsum(turns)
    steps = np.abs(rng.normal(step, 0.3 * step, n))
    xy = np.cumsum(np.column_stack((steps * np.cos(theta), steps * np.sin(theta))), axis=0)
    stamps = start_ns + period_ns * np.arange(n, dtype=np.int64)
    if jitter_ns:
        stamps = stamps + rng.integers(-jitter_ns, jitter_ns, n)
    return Trajectory(stamps, np.column_stack((xy + rng.uniform(-5, 5, 2), wrap_angles(theta))))


def disturb(
    rng: Any, path: Any, *, sigma: float = 0.03, sigma_theta: float = 0.01, every: int = 1, shift_ns: int = 0
) -> Any:
    """The same path with noise, seen every so many poses and a little later."""
    poses = path.poses[::every].copy()
    poses[:, :2] += rng.normal(0.0, sigma, (len(poses), 2))
    poses[:, 2] = wrap_angles(poses[:, 2] + rng.normal(0.0, sigma_theta, len(poses)))
    return Trajectory(path.stamps_ns[::every] + shift_ns, poses)


def office(
    rng: Any, *, width_m: float = 24.0, height_m: float = 14.0, resolution: float = 0.05, noise: bool = True
) -> Any:
    """A map of rooms along a corridor, as a mapper would leave it: unknown outside, frayed where it saw little."""
    rows, columns = round(height_m / resolution), round(width_m / resolution)
    cells = np.full((rows + 40, columns + 40), -1, dtype=np.int8)
    inside = cells[20:-20, 20:-20]
    inside[:] = 0
    low, high = round(rows * 0.4), round(rows * 0.6)

    def wall(r0: int, r1: int, c0: int, c1: int) -> None:
        inside[max(r0, 0) : r1 + 1, max(c0, 0) : c1 + 1] = 100

    for r0, r1 in ((0, 1), (rows - 2, rows), (low, low + 1), (high, high + 1)):
        wall(r0, r1, 0, columns)
    wall(0, rows, 0, 1)
    wall(0, rows, columns - 2, columns)
    rooms = max(round(width_m / 5.0), 1)
    door = round(1.0 / resolution)
    for room in range(rooms):
        column = round(columns * room / rooms)
        middle = round(columns * (room + 0.5) / rooms)
        if room:
            wall(0, low, column, column + 1)
            wall(high, rows, column, column + 1)
        for row in (low, high):
            inside[row : row + 2, middle - door // 2 : middle + door // 2] = 0
    for _ in range(rooms * 3):
        r, c = rng.integers(4, rows - 14), rng.integers(4, columns - 14)
        if not low - 12 < r < high + 4:
            wall(r, r + int(rng.integers(3, 9)), c, c + int(rng.integers(3, 9)))
    if noise:
        inside[(rng.random(inside.shape) < 0.15) & (inside == 100)] = -1
    return OccupancyGrid(cells, resolution, Pose2(-width_m / 2 - 1.0, -height_m / 2 - 1.0, 0.0))


def drive(waypoints: Any, *, speed: float = 0.6, rate_hz: float = 50.0, start_ns: Any = START_NS) -> Any:
    """A path through waypoints with rounded corners."""
    corners = np.array(waypoints, dtype=float)
    ways = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    s = np.arange(0.0, ways[-1], speed / rate_hz)
    xy = np.column_stack([np.interp(s, ways, corners[:, axis]) for axis in (0, 1)])
    reach = max(int(0.4 * rate_hz / speed), 1)
    padded = np.pad(xy, ((reach, reach), (0, 0)), mode="edge")
    window = np.ones(2 * reach + 1) / (2 * reach + 1)
    xy = np.column_stack([np.convolve(padded[:, axis], window, mode="valid") for axis in (0, 1)])
    step = np.gradient(xy, axis=0)
    theta = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    stamps = start_ns + (np.arange(len(s)) * 1e9 / rate_hz).astype(np.int64)
    return Trajectory(stamps, np.column_stack((xy, wrap_angles(theta))))


def odometry_of(rng: Any, path: Any, *, drift: float = 0.02) -> Any:
    """The odometry of wheels: each step with a noise and a bias, from the origin."""
    deltas = relative_poses(path.poses[:-1], path.poses[1:])
    deltas[:, 0] *= 1.0 + drift * 0.5
    deltas[:, 2] += rng.normal(drift * 0.01, 0.002, len(deltas))
    pose, poses = Pose2(), [Pose2()]
    for delta in deltas:
        pose = pose @ Pose2.from_array(delta)
        poses.append(pose)
    return Trajectory(path.stamps_ns, np.array([pose.to_array() for pose in poses]))


def estimate_of(rng: Any, path: Any, *, sigma: float = 0.008) -> Any:
    """An estimate whose error wanders smoothly, as that of a localiser does."""
    n = len(path)
    knots = max(n // 40, 4)
    error = np.column_stack(
        [np.interp(np.arange(n), np.linspace(0, n, knots), rng.normal(0, s, knots)) for s in (sigma, sigma, sigma / 3)]
    )
    poses = path.poses + error
    poses[:, 2] = wrap_angles(poses[:, 2])
    return Trajectory(path.stamps_ns, poses)


def diagnostics_of(rng: Any, path: Any, *, every: int = 5, rejected: float = 0.01, lost: Any = ()) -> Any:
    """Scans along a path: mostly matched, some refused, some passed over, and lost in the given spans (s)."""
    stamps = path.stamps_ns[::every]
    n = len(stamps)
    seconds = (stamps - stamps[0]) / 1e9
    status = np.full(n, "matched", dtype=object)
    status[rng.random(n) < 0.25] = "predicted"
    status[rng.random(n) < rejected] = "rejected"
    for begin, end in lost:
        inside = np.flatnonzero((seconds >= begin) & (seconds < end))
        status[inside] = "searching"
        if len(inside) and inside[-1] + 1 < n:
            status[inside[-1] + 1] = "relocalised"
    reasons = {"predicted": "moved less than 0.1 m and 5 deg", "rejected": "fitness 0.41 below 0.55", "searching": ""}
    fitness = np.clip(0.9 + 0.04 * np.sin(seconds / 9) + rng.normal(0, 0.015, n), 0, 1)
    fitness[status == "rejected"] = rng.uniform(0.3, 0.5, (status == "rejected").sum())
    fitness[np.isin(status, ["predicted", "searching"])] = np.nan
    sigma = np.abs(rng.normal([0.006, 0.006, 0.002], [0.001, 0.001, 0.0003], (n, 3)))
    sigma[status == "predicted"] *= 1.5
    sigma[status == "rejected"] *= 4
    sigma[status == "searching"] = np.nan
    evaluations = np.where(np.isin(status, ["predicted"]), 0, rng.integers(270, 300, n))
    return ScanDiagnostics(
        stamps,
        tuple(status),
        fitness,
        sigma,
        evaluations,
        tuple(reasons.get(name, "") for name in status),
        np.full((n, 3, 3), np.nan),
    )
