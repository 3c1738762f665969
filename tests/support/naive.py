"""Slow, obvious versions of the kernels, and small worlds to try things in."""

from __future__ import annotations

from math import cos, floor, sin
from typing import Any

import numpy as np

from hsloc.model import OccupancyGrid, Pose2


def bilinear(scores: Any, u: Any, v: Any) -> Any:
    """Score at (u, v) in cells, bilinear between the nodes of `scores` (h, w); 0 outside."""
    height, width = scores.shape
    if not (0 <= u < width - 1 and 0 <= v < height - 1):
        return 0.0
    iu, iv = floor(u), floor(v)
    fu, fv = u - iu, v - iv
    return (
        (1 - fu) * (1 - fv) * scores[iv, iu]
        + fu * (1 - fv) * scores[iv, iu + 1]
        + (1 - fu) * fv * scores[iv + 1, iu]
        + fu * fv * scores[iv + 1, iu + 1]
    )


def score_sum(scores: Any, points: Any, x: Any, y: Any, theta: Any) -> Any:
    """Sum of the bilinear scores of points (n, 2) moved by a pose, all in cells."""
    total = 0.0
    scores = np.asarray(scores, dtype=np.float64)
    for px, py in np.asarray(points, dtype=np.float64):
        total += bilinear(scores, x + cos(theta) * px - sin(theta) * py, y + sin(theta) * px + cos(theta) * py)
    return total


def largest_score(scores: Any, u_low: float, u_high: float, v_low: float, v_high: float, sizes: Any, step: int) -> int:
    """The greatest node, in steps of 1 / 255 rounded up, of the square of whole entries that covers a rectangle.

    An entry is step x step nodes; the square begins at the entry of the rectangle's corner, has the smallest of `sizes`
    that covers the rectangle and one node more, and is 255 where none of them does.
    """
    height, width = scores.shape
    entries = -(-height // step), -(-width // step)
    u0, u1 = floor(u_low) // step, (floor(u_high) + 1) // step
    v0, v1 = floor(v_low) // step, (floor(v_high) + 1) // step
    if u1 < 0 or v1 < 0 or u0 >= entries[1] or v0 >= entries[0]:
        return 0
    fitting = [size for size in sizes if size >= max(u1 - u0, v1 - v0) + 1]
    if not fitting:
        return 255
    rows = slice(max(v0, 0) * step, max((v0 + fitting[0]) * step, 0))
    columns = slice(max(u0, 0) * step, max((u0 + fitting[0]) * step, 0))
    under = scores[rows, columns]
    return min(int(np.ceil(float(under.max()) * 255.0 + 1e-4)), 255) if under.size else 0


def distance_to_nearest(cells: Any, row: Any, column: Any) -> Any:
    """Distance in cells from a cell's centre to the nearest occupied cell's centre, by looking at all of them."""
    rows, columns = np.nonzero(cells)
    return float(np.hypot(rows - row, columns - column).min())


def room(resolution: float = 0.05, width: int = 160, height: int = 120) -> Any:
    """A room with one inner wall; the walls run through the centres of cells. Returns (grid, wall segments (n, 4))."""
    cells = np.zeros((height, width), dtype=np.int8)
    cells[5, 5:-5] = cells[-6, 5:-5] = 100
    cells[5:-5, 5] = cells[5:-5, -6] = 100
    cells[5:60, 80] = 100
    grid = OccupancyGrid(cells, resolution, Pose2(-1.0, -2.0, 0.0))
    x0, y0 = -1.0 + 5.5 * resolution, -2.0 + 5.5 * resolution
    x1, y1 = -1.0 + (width - 5.5) * resolution, -2.0 + (height - 5.5) * resolution
    xm, ym = -1.0 + 80.5 * resolution, -2.0 + 59.5 * resolution
    walls = [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0), (xm, y0, xm, ym)]
    return grid, np.array(walls)


def cast(walls: Any, x: Any, y: Any, angle: Any) -> Any:
    """Distance along a ray to the nearest wall segment; inf if it meets none."""
    best = np.inf
    dx, dy = cos(angle), sin(angle)
    for ax, ay, bx, by in walls:
        ex, ey = bx - ax, by - ay
        denominator = dx * ey - dy * ex
        if abs(denominator) < 1e-12:
            continue
        t = ((ax - x) * ey - (ay - y) * ex) / denominator
        s = ((ax - x) * dy - (ay - y) * dx) / denominator
        if t > 0 and -1e-9 <= s <= 1 + 1e-9:
            best = min(best, t)
    return best


def scan_points(walls: Any, pose: Any, beams: int = 180) -> Any:
    """End points, seen from the pose, of beams all around; shape (n, 2)."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    ranges = np.array([cast(walls, pose.x, pose.y, pose.theta + angle) for angle in angles])
    return np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles)))[np.isfinite(ranges)]


def beam_classes(
    cells: Any,
    ends: Any,
    origin: Any,
    scores: Any,
    fits: float,
    margin: float,
) -> Any:
    """Of each beam 0 at a wall, 1 in free space, 2 behind a wall, 3 where nothing is mapped."""

    def cell(x: float, y: float) -> int:
        row, column = int(np.floor(y)), int(np.floor(x))
        return int(cells[row, column]) if 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1] else -1

    found = []
    for (x, y), score in zip(ends, scores, strict=True):
        length = float(np.hypot(x - origin[0], y - origin[1]))
        steps = np.arange(max(int(np.ceil(length - margin)), 0)) / length
        walls = [cell(*(origin + part * ((x, y) - origin))) >= 65 for part in steps]
        if score >= np.float32(fits):
            found.append(0)
        else:
            found.append(2 if any(walls) else 1 if cell(x, y) >= 0 else 3)
    return np.array(found, dtype=np.int8)


def wall_information(
    points: Any,
    normals: Any,
    weights: Any,
    variances: tuple[float, float],
    rows: Any,
    doubtful: float,
) -> Any:
    """Information of (x, y, theta) at the pose 0, from the inverse of each row's covariance written out as a matrix."""
    total = np.zeros((3, 3))
    for row in np.unique(rows):
        members = np.flatnonzero((rows == row) & (np.abs(normals).sum(axis=1) > 0.0))
        if len(members) == 0:
            continue
        n, p, w = normals[members], points[members], weights[members]
        major = np.where(np.abs(n[:, 0]) > np.abs(n[:, 1]), n[:, 0], n[:, 1])
        n = n * np.where(major < 0.0, -1.0, 1.0)[:, None]
        jacobian = np.column_stack((n, n[:, 1] * p[:, 0] - n[:, 0] * p[:, 1]))
        covariance = np.diag(variances[0] / w) + variances[1]
        trusted = w.sum() / (w.sum() + doubtful)
        total += trusted * jacobian.T @ np.linalg.inv(covariance) @ jacobian
    return total
