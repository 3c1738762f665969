"""A scan prepared for `hsloc.kernels.point_to_line`: hits, pieces of wall around them, and which are compared."""

from __future__ import annotations

from math import atan2, cos, pi, sin, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from hsloc.kernels.fitness import median
from hsloc.kernels.point_to_line import bearing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]

_MOST_NEIGHBOURS = 16
"""Maximum number of hits on each side of a hit. Internal: bounds the time where beams are dense."""
_DIRECTIONS = 16
"""Sectors of the normals among which hits are chosen. Internal: walls of one direction in each, 22.5 degrees."""
_ROUGHEST_M = 0.06
"""Largest standard deviation (m) of hits from their line. Internal: more is a hedge or a heap; twice a poor lidar's."""
_THICKEST = 0.08
"""Largest variance across a line as a part of that along it. Internal: less says no direction."""
_ROUGH_M = 0.03
"""Largest standard deviation (m) of hits from their line where no side is straight. Internal: as of the noise of a poor
lidar; clutter bends as much, and holds scans together where there is nothing else."""
_BENT = 2.5
"""Hits that are farther from their line than the noise of ranges makes them, by this factor, are not of one wall.
Internal: of four hits with Gaussian noise one set in 500."""
_UNEVEN_M = 0.005
"""Unevenness (m) of a wall, beside the noise. Internal: plaster, joints and skirting boards."""
_FACING = 0.3
"""Least cosine between a beam and a normal with which the noise of ranges is seen. Internal: at a grazing wall the
unevenness counts more."""
_FEWEST_LINES = 20
"""Number of lines that the noise is known by. Internal: of each half of them the median, of ten."""


@njit(cache=True, nogil=True)
def place_hits(ranges: F32, limits: tuple[float, float], directions: F64, pose: tuple[float, ...], points: F64) -> int:
    """Write the hits of a scan, in the order of its beams, to the first rows of `points` (n, 2); returns how many.

    Hits are finite and within the `limits`, both included. `directions` (n, 2) are unit vectors along the beams;
    `pose` is x, y (m), cosine and sine of the heading of the laser in the frame of the points.
    """
    x, y, c, s = pose
    low, high = np.float32(limits[0]), np.float32(limits[1])
    count = 0
    for k in range(len(ranges)):
        value = ranges[k]
        if not (np.isfinite(value) and low <= value <= high):
            continue
        ahead = np.float64(value) * directions[k, 0]
        aside = np.float64(value) * directions[k, 1]
        points[count, 0] = x + c * ahead - s * aside
        points[count, 1] = y + s * ahead + c * aside
        count += 1
    return count


@njit(cache=True, nogil=True)
def list_beams(ranges: F32, limits: F32, beams: I32, hit_of_beam: I32, clean: F32) -> int:
    """Write the beams that hit to `beams` (n,), for each beam its hit or -1, and `clean` ranges; returns how many hit.

    A hit is within the `limits` (2,), both included. Of the others those without a return stay infinite; what is
    invalid becomes NaN.
    """
    count = 0
    for k in range(len(ranges)):
        value = ranges[k]
        is_hit = np.isfinite(value) and limits[0] <= value <= limits[1]
        hit_of_beam[k] = count if is_hit else -1
        clean[k] = value if is_hit or value == np.inf else np.float32(np.nan)
        if is_hit:
            beams[count] = k
            count += 1
    return count


@njit(cache=True, nogil=True)
def drop_isolated(ranges: F32, limits: F32, spacing: float, kept: F32) -> tuple[int, int]:
    """Write the ranges to `kept` (n,), isolated hits as NaN; returns how many hit, and how many of these are isolated.

    A hit is isolated if none of the two beams on each side hit the same wall: none is as near as a wall seen at 10 deg
    would leave it (`spacing` is the angle between beams in rad). Hits are finite and within the `limits` (2,).
    """
    hits = 0
    isolated = 0
    n = len(ranges)
    for i in range(n):
        kept[i] = ranges[i]
        a = np.float64(ranges[i])
        if not (np.isfinite(a) and limits[0] <= ranges[i] <= limits[1]):
            continue
        hits += 1
        is_alone = True
        for k in (i + 1, i - 1, i + 2, i - 2):
            if k < 0 or k >= n or not (np.isfinite(ranges[k]) and limits[0] <= ranges[k] <= limits[1]):
                continue
            b = np.float64(ranges[k])
            angle = abs(k - i) * spacing
            gap = sqrt(max(a * a + b * b - 2.0 * a * b * cos(angle), 0.0))
            if gap <= 0.1 + 6.0 * angle * min(a, b):
                is_alone = False
                break
        if is_alone:
            isolated += 1
            kept[i] = np.float32(np.nan)
    return hits, isolated


class Line(NamedTuple):
    """What `_fit_line` writes."""

    centroid: F64
    """Shape (2,) (m)."""
    normal: F64
    """Unit vector (2,) towards the laser."""
    spread: F64
    """Shape (3,): variance across the line (m^2), cosine between beam and normal, distance from the laser (m)."""


@njit(cache=True, nogil=True)
def fit_surfels(
    points: F32, beams: I32, spacing: float, radius: float, normals: F32, centroids: F32, origin: F64
) -> None:
    """Fit a line to the hits around each hit; writes unit `normals` towards `origin` (the laser) and `centroids`.

    The neighbours are those within `radius` metres, and at least two on either side, as long as the wall goes on:
    no gap between two beams longer than a wall seen at a grazing angle would leave (`spacing` is the angle between
    beams in rad). Where they are not straight within the noise of the ranges, which the scan itself shows, those on
    one side are taken, three at least, and in clutter, where these are not straight either, all as long as they are
    near the line; else the hit gets the normal (0, 0). A line around a corner, with its few hits on either side, lies
    elsewhere from each place: steps along corridors came out millimetres too long by it, whatever the noise.
    """
    n = len(points)
    line = Line(np.empty(2), np.empty(2), np.empty(3))
    spread = np.full((n, 3), np.nan)
    for i in range(n):
        normals[i] = np.float32(0.0)
        centroids[i] = points[i]
        if _fit_line(points, beams, i, (2, 2), spacing, radius, origin, line):
            for k in range(2):
                normals[i, k] = line.normal[k]
                centroids[i, k] = line.centroid[k]
            spread[i] = line.spread
    known = spread[~np.isnan(spread[:, 0])]
    if len(known) < _FEWEST_LINES:
        return
    constant, slope = _range_variance(known)
    for i in range(n):
        if spread[i, 0] <= _limit(spread[i], constant, slope):
            continue
        best = np.inf
        if not spread[i, 0] <= _ROUGH_M**2:  # NaN: there is no line
            normals[i] = np.float32(0.0)
        for side in range(2):
            if not _fit_line(points, beams, i, (3 - 3 * side, 3 * side), spacing, radius, origin, line):
                continue
            bend = line.spread[0] / _limit(line.spread, constant, slope)
            if bend <= min(best, 1.0):
                best = bend
                for k in range(2):
                    normals[i, k] = line.normal[k]
                    centroids[i, k] = line.centroid[k]


@njit(cache=True, nogil=True)
def _fit_line(
    points: F32, beams: I32, i: int, least: tuple[int, int], spacing: float, radius: float, origin: F64, line: Line
) -> bool:
    """Write the `line` of hit i and of those before and after it; False if there is none.

    `least` are the numbers of hits that are taken on either side however far they are; where it is 0 none are.
    """
    n = len(points)
    x0 = np.float64(points[i, 0])
    y0 = np.float64(points[i, 1])
    count = 1
    sx = 0.0
    sy = 0.0
    sxx = 0.0
    sxy = 0.0
    syy = 0.0
    for side in range(2):
        direction = 2 * side - 1
        k = i
        for step in range(_MOST_NEIGHBOURS if least[side] > 0 else 0):
            k += direction
            if k < 0 or k >= n or abs(beams[k] - beams[k - direction]) > 2:
                break
            px = np.float64(points[k, 0])
            py = np.float64(points[k, 1])
            qx = np.float64(points[k - direction, 0])
            qy = np.float64(points[k - direction, 1])
            depth = sqrt((px - origin[0]) ** 2 + (py - origin[1]) ** 2)
            gap = sqrt((px - qx) ** 2 + (py - qy) ** 2)
            if gap > min(0.1 + 4.0 * spacing * depth, 0.8):
                break
            dx = px - x0
            dy = py - y0
            if step >= least[side] and dx * dx + dy * dy > radius * radius:
                break
            count += 1
            sx += dx
            sy += dy
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
    if count < 4:
        return False
    mx = sx / count
    my = sy / count
    cxx = sxx / count - mx * mx
    cxy = sxy / count - mx * my
    cyy = syy / count - my * my
    half = 0.5 * (cxx + cyy)
    root = sqrt(0.25 * (cxx - cyy) ** 2 + cxy * cxy)
    smaller = max(half - root, 0.0)
    larger = half + root
    if larger <= 1e-6 or smaller > _ROUGHEST_M**2 or smaller > _THICKEST * larger:
        return False
    # The normal is the eigenvector of the smaller eigenvalue: turned by a right angle from the larger one's.
    angle = 0.5 * atan2(2.0 * cxy, cxx - cyy)
    nx = -sin(angle)
    ny = cos(angle)
    across = nx * (origin[0] - x0) + ny * (origin[1] - y0)
    sense = -1.0 if across < 0.0 else 1.0
    line.normal[0] = sense * nx
    line.normal[1] = sense * ny
    line.centroid[0] = x0 + mx
    line.centroid[1] = y0 + my
    away = sqrt((origin[0] - x0) ** 2 + (origin[1] - y0) ** 2)
    line.spread[0] = smaller * count / (count - 2)
    line.spread[1] = abs(across) / max(away, 1e-9)
    line.spread[2] = away
    return True


@njit(cache=True, nogil=True)
def _limit(spread: F64, constant: float, slope: float) -> float:
    """Variance (m^2) across a line up to which its hits are of one wall."""
    variance: float = (constant + slope * spread[2] ** 2) * spread[1] ** 2 + _UNEVEN_M**2
    return _BENT**2 * variance


@njit(cache=True, nogil=True)
def _range_variance(spread: F64) -> tuple[float, float]:
    """Variance of the ranges of a scan, constant (m^2) and by the square of the range, by the `spread` (n, 3) of lines.

    Corners are few, so that medians, of the near and of the far half, leave them aside.
    """
    away = spread[:, 2]
    of_ranges = spread[:, 0] / np.maximum(spread[:, 1], _FACING) ** 2
    near = away <= median(away)
    variance = median(of_ranges[near])
    if near.all():
        return variance, 0.0
    near_squared, far_squared = median(away[near]) ** 2, median(away[~near]) ** 2
    slope = max(median(of_ranges[~near]) - variance, 0.0) / (far_squared - near_squared)
    constant = variance - slope * near_squared
    if constant < 0.0:
        return 0.0, variance / near_squared
    return constant, slope


@njit(cache=True, nogil=True)
def choose_hits(normals: F32, most: int, chosen: I32) -> int:
    """Choose about `most` hits that have a surfel, evenly by the directions of their walls; returns how many.

    In a corridor nearly all hits lie on its two sides, and only a handful, on door frames and at its end, fix
    the position along it: of a frequent direction every n-th hit is taken, of a rare one all (normal-space
    sampling, Rusinkiewicz and Levoy 2001). Writes the rows into `chosen`, in ascending order.
    """
    n = len(normals)
    counts = np.zeros(_DIRECTIONS, dtype=np.int64)
    direction = np.full(n, -1, dtype=np.int64)
    for i in range(n):
        nx = np.float64(normals[i, 0])
        ny = np.float64(normals[i, 1])
        if nx != 0.0 or ny != 0.0:
            direction[i] = int((bearing(ny, nx) / (2.0 * pi) + 1.0) * _DIRECTIONS) % _DIRECTIONS
            counts[direction[i]] += 1
    # The quota: the largest that no more than `most` hits in all are within.
    quota = 1
    while quota < n and np.minimum(counts, quota + 1).sum() <= most:
        quota += 1
    taken = 0
    passed = np.zeros(_DIRECTIONS, dtype=np.int64)
    for i in range(n):
        k = direction[i]
        if k < 0:
            continue
        keep = min(counts[k], quota)
        # The j-th of a direction is kept where j * keep / counts steps over a whole number.
        if (passed[k] + 1) * keep // counts[k] > passed[k] * keep // counts[k]:
            chosen[taken] = i
            taken += 1
        passed[k] += 1
    return taken
