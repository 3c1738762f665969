"""How well scans agree on walls, as they are and displaced: whether another place fits as well; and by which hits.

Points are looked up in the other scan as in `hsloc.kernels.point_to_line.pair_terms`.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from hsloc.kernels.normal_equations import relative
from hsloc.kernels.point_to_line import (
    MOST_BEAMS,
    SAME_FACE,
    THROUGH,
    ScanArrays,
    beam_towards,
    bearing,
    ends_around,
    nearest_hit,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    I64 = NDArray[np.int64]

_DIRECTIONS = 16
"""Sectors of the normals among which hits are chosen. Internal: walls of one direction in each, 22.5 degrees."""


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


@njit(cache=True, nogil=True)
def add_agreement(i: int, j: int, rel: F64, scans: ScanArrays, gate: float, scale: float, sums: F64) -> None:
    """Add to `sums` (2,) the agreement of scan i with scan j, and the number of points that j can judge.

    The agreement is the weight of points on walls of j, less the number of points that j looked through. What is out
    of the view of j, behind a wall, or beyond 4 m where j has no return, it cannot judge.
    """
    c = cos(rel[2])
    s = sin(rel[2])
    own = slice(scans.start[i], scans.start[i + 1])
    own_points = scans.points[own]
    own_normals = scans.normals[own]
    rows = scans.chosen_hits[scans.chosen_start[i] : scans.chosen_start[i + 1]]
    hits = slice(scans.start[j], scans.start[j + 1])
    points = scans.points[hits]
    normals = scans.normals[hits]
    centroids = scans.centroids[hits]
    beams = slice(scans.table_start[j], scans.table_start[j + 1])
    hit_of_beam = scans.hit_of_beam[beams]
    ranges = scans.ranges[beams]
    laser_x = scans.geometry[j, 0]
    laser_y = scans.geometry[j, 1]
    zero_angle = scans.geometry[j, 2] + scans.geometry[j, 3]
    increment = scans.geometry[j, 4]
    spacing = abs(increment)
    agreement = 0.0
    judged = 0
    for a in rows:
        px = np.float64(own_points[a, 0])
        py = np.float64(own_points[a, 1])
        mx = np.float64(own_normals[a, 0])
        my = np.float64(own_normals[a, 1])
        x = rel[0] + (c * px - s * py)
        y = rel[1] + (s * px + c * py)
        ox = c * mx - s * my
        oy = s * mx + c * my
        lx = x - laser_x
        ly = y - laser_y
        # From behind a wall j cannot have seen this face of it.
        if ox * lx + oy * ly >= 0.0:
            continue
        middle = beam_towards(lx, ly, zero_angle, increment)
        if middle >= len(ranges):
            continue
        depth = sqrt(lx * lx + ly * ly)
        reach = min(int(gate / (depth * spacing + 1e-9)) + 1, MOST_BEAMS)
        chosen, best = nearest_hit(x, y, middle, reach, spacing * depth, hit_of_beam, points)
        known, nearest, farthest = ends_around(middle, ranges)
        if best > gate * gate and known >= 2 and depth + THROUGH < nearest:
            judged += 1
            agreement -= 1.0
            continue
        if chosen >= 0 and best <= gate * gate + (2.0 * spacing * depth) ** 2:
            nx = np.float64(normals[chosen, 0])
            ny = np.float64(normals[chosen, 1])
            ex = x - np.float64(centroids[chosen, 0])
            ey = y - np.float64(centroids[chosen, 1])
            distance = nx * ex + ny * ey
            if nx * ox + ny * oy >= SAME_FACE and abs(distance) <= gate:
                judged += 1
                agreement += 1.0 / (1.0 + (distance / scale) ** 2) ** 2
                continue
        # A wall near the point that is not the point's, unless j does not know.
        if chosen >= 0 and known >= 2 and depth <= farthest + THROUGH:
            judged += 1
    sums[0] += agreement
    sums[1] += judged


@njit(cache=True, nogil=True)
def displaced_agreement(
    poses: F64, groups: tuple[I64, I64], displacements: F64, scans: ScanArrays, gate: float, scale: float, out: F64
) -> None:
    """Write to `out` (m,) the agreement of two groups of scans with the second displaced by (m, 2) in the map (m).

    It is a part of the points that the other side can judge: near 1 where all lie on walls.
    """
    rel = np.empty(3)
    moved = np.empty(3)
    sums = np.empty(2)
    for k in range(len(displacements)):
        sums[:] = 0.0
        for a in groups[0]:
            for b in groups[1]:
                moved[0] = poses[b, 0] + displacements[k, 0]
                moved[1] = poses[b, 1] + displacements[k, 1]
                moved[2] = poses[b, 2]
                relative(poses[a], moved, rel)
                add_agreement(b, a, rel, scans, gate, scale, sums)
                relative(moved, poses[a], rel)
                add_agreement(a, b, rel, scans, gate, scale, sums)
        out[k] = sums[0] / max(sums[1], 1.0)
