"""How well two scans agree on walls: what their points say of the motion between them, and whether another place fits.

Points are looked up in the other scan as in `hsloc.kernels.point_to_line.pair_terms`.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from hsloc.kernels.normal_equations import PairTerms, add_inverse_term, relative
from hsloc.kernels.point_to_line import (
    MOST_BEAMS,
    SAME_FACE,
    THROUGH,
    ScanArrays,
    Term,
    beam_towards,
    ends_around,
    nearest_hit,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_UNKNOWN = -1
_ELSEWHERE = -2
_LOOKED_THROUGH = -3


@njit(cache=True, nogil=True)
def wall_at(
    x: float, y: float, normal_x: float, normal_y: float, j: int, scans: ScanArrays, gate: float
) -> tuple[int, float]:
    """The hit of scan j on whose wall a point with a normal lies, both in the frame of j, and the distance (m).

    Instead of a hit: -1 where j does not know (out of its view, behind a wall, no return beyond 4 m), -2 where j saw a
    wall near the point that is not the point's, -3 where j looked through the point.
    """
    geometry = scans.geometry[j]
    spacing = abs(geometry[4])
    lx = x - geometry[0]
    ly = y - geometry[1]
    middle = beam_towards(lx, ly, geometry[2] + geometry[3], geometry[4])
    if middle >= scans.table_start[j + 1] - scans.table_start[j]:
        return _UNKNOWN, 0.0
    depth = sqrt(lx * lx + ly * ly)
    reach = min(int(gate / (depth * spacing + 1e-9)) + 1, MOST_BEAMS)
    chosen, best = nearest_hit(x, y, j, middle - reach, middle + reach, scans)
    known, nearest, farthest = ends_around(middle, j, scans)
    if best > gate * gate and known >= 2 and depth + THROUGH < nearest:
        return _LOOKED_THROUGH, 0.0
    if chosen >= 0 and best <= gate * gate + (2.0 * spacing * depth) ** 2:
        nx = np.float64(scans.normals[chosen, 0])
        ny = np.float64(scans.normals[chosen, 1])
        ex = x - np.float64(scans.centroids[chosen, 0])
        ey = y - np.float64(scans.centroids[chosen, 1])
        distance = nx * ex + ny * ey
        if nx * normal_x + ny * normal_y >= SAME_FACE and abs(distance) <= gate:
            return chosen, distance
    if chosen < 0 or known < 2 or depth > farthest + THROUGH:
        return _UNKNOWN, 0.0
    return _ELSEWHERE, 0.0


@njit(cache=True, nogil=True)
def turned_hit(q: int, i: int, c: float, s: float, scans: ScanArrays) -> tuple[float, float, float, float]:
    """The chosen hit q of scan i and its normal, turned by the angle with cosine `c` and sine `s`."""
    a = scans.start[i] + scans.chosen_hits[q]
    px = np.float64(scans.points[a, 0])
    py = np.float64(scans.points[a, 1])
    mx = np.float64(scans.normals[a, 0])
    my = np.float64(scans.normals[a, 1])
    return c * px - s * py, s * px + c * py, c * mx - s * my, s * mx + c * my


@njit(cache=True, nogil=True)
def add_information(i: int, j: int, rel: F64, scans: ScanArrays, gate: float, scale: float, information: F64) -> None:
    """Overwrite `information` (3, 3) with that of scan i against scan j, the pose of i in j being `rel` (3,).

    As in `pair_terms`, but each product is of the normals of both scans. The square of one normal holds the variance
    of its own noise: along a bare corridor that alone looks like a measurement (errors in variables; both normals
    together are an instrument, Fuller 1987). It may be indefinite where there is next to none.
    """
    c = cos(rel[2])
    s = sin(rel[2])
    information[:] = 0.0
    one = np.empty(3)
    other = np.empty(3)
    for q in range(scans.chosen_start[i], scans.chosen_start[i + 1]):
        dx, dy, nx, ny = turned_hit(q, i, c, s, scans)
        hit, distance = wall_at(rel[0] + dx, rel[1] + dy, nx, ny, j, scans, gate)
        if hit < 0:
            continue
        w = 1.0 / (1.0 + (distance / scale) ** 2) ** 2
        one[0] = np.float64(scans.normals[hit, 0])
        one[1] = np.float64(scans.normals[hit, 1])
        one[2] = one[1] * dx - one[0] * dy
        other[0] = nx
        other[1] = ny
        other[2] = ny * dx - nx * dy
        for k in range(3):
            for m in range(3):
                information[k, m] += 0.5 * w * (one[k] * other[m] + one[m] * other[k])


@njit(cache=True, nogil=True)
def evaluate_information(
    poses: F64, pairs: I64, scans: ScanArrays, gate: float, scale: float, terms: PairTerms
) -> None:
    """Overwrite the information of `terms`, of all pairs (m, 2) of scans at `poses` (n, 3), by `add_information`."""
    one = Term(np.empty((3, 3)), np.zeros(3))
    rel = np.empty(3)
    back = np.empty(3)
    lost = np.zeros(3)
    for m in range(len(pairs)):
        j = pairs[m, 0]
        i = pairs[m, 1]
        relative(poses[j], poses[i], rel)
        add_information(i, j, rel, scans, gate, scale, terms.information[m])
        relative(poses[i], poses[j], back)
        add_information(j, i, back, scans, gate, scale, one.information)
        add_inverse_term(rel, one, terms.information[m], lost)


@njit(cache=True, nogil=True)
def add_agreement(i: int, j: int, rel: F64, scans: ScanArrays, gate: float, scale: float, sums: F64) -> None:
    """Add to `sums` (2,) the agreement of scan i with scan j, and the number of points that j can judge.

    The agreement is the weight of points on walls of j, less the number of points that j looked through.
    """
    c = cos(rel[2])
    s = sin(rel[2])
    for q in range(scans.chosen_start[i], scans.chosen_start[i + 1]):
        dx, dy, nx, ny = turned_hit(q, i, c, s, scans)
        x = rel[0] + dx
        y = rel[1] + dy
        # From behind a wall j cannot have seen this face of it.
        if nx * (x - scans.geometry[j, 0]) + ny * (y - scans.geometry[j, 1]) >= 0.0:
            continue
        hit, distance = wall_at(x, y, nx, ny, j, scans, gate)
        if hit == _UNKNOWN:
            continue
        sums[1] += 1.0
        if hit >= 0:
            sums[0] += 1.0 / (1.0 + (distance / scale) ** 2) ** 2
        elif hit == _LOOKED_THROUGH:
            sums[0] -= 1.0


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
