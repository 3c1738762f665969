"""How well two scans agree on walls: what their points say of the motion between them, and whether another place fits.

Points are looked up in the other scan as in `hsloc.kernels.point_to_line.pair_terms`.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from hsloc.kernels.normal_equations import PairTerms, add_inverse_term, relative
from hsloc.kernels.point_to_line import ScanArrays, Term, bearing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_MOST_BEAMS = 4
_SAME_FACE = 0.7
_THROUGH = 0.25
_CLEARED = 4.0
"""These four as in `point_to_line`."""
_UNKNOWN = -1
_ELSEWHERE = -2
_LOOKED_THROUGH = -3


@njit(cache=True, nogil=True)
def wall_at(point: F64, normal: F64, j: int, scans: ScanArrays, gate: float) -> tuple[int, float]:
    """The hit of scan j on whose wall a point with a normal lies, both (2,) in the frame of j, and the distance (m).

    Instead of a hit: -1 where j does not know (out of its view, behind a wall, no return beyond 4 m), -2 where j saw a
    wall near the point that is not the point's, -3 where j looked through the point.
    """
    first = scans.table_start[j]
    n_beams = scans.table_start[j + 1] - first
    geometry = scans.geometry[j]
    sense = 1.0 if geometry[4] > 0.0 else -1.0
    spacing = abs(geometry[4])
    lx = point[0] - geometry[0]
    ly = point[1] - geometry[1]
    angle = sense * (bearing(ly, lx) - geometry[2] - geometry[3]) + 0.5 * spacing
    angle -= 2.0 * pi * np.floor(angle / (2.0 * pi))
    middle = int(angle / spacing)
    if middle >= n_beams:
        return _UNKNOWN, 0.0
    depth = sqrt(lx * lx + ly * ly)
    reach = min(int(gate / (depth * spacing + 1e-9)) + 1, _MOST_BEAMS)
    best = np.inf
    chosen = -1
    for k in range(max(middle - reach, 0), min(middle + reach + 1, n_beams)):
        row = scans.hit_of_beam[first + k]
        if row >= 0:
            hit = scans.start[j] + row
            ex = point[0] - np.float64(scans.points[hit, 0])
            ey = point[1] - np.float64(scans.points[hit, 1])
            if ex * ex + ey * ey < best:
                best = ex * ex + ey * ey
                chosen = hit
    nearest = np.inf
    farthest = 0.0
    known = 0
    for k in range(max(middle - 1, 0), min(middle + 2, n_beams)):
        end = np.float64(scans.ranges[first + k])
        if end == np.inf:
            end = np.float64(_CLEARED)
        if end == end:
            known += 1
            nearest = min(nearest, end)
            farthest = max(farthest, end)
    if best > gate * gate and known >= 2 and depth + _THROUGH < nearest:
        return _LOOKED_THROUGH, 0.0
    if chosen >= 0 and best <= gate * gate + (2.0 * spacing * depth) ** 2:
        nx = np.float64(scans.normals[chosen, 0])
        ny = np.float64(scans.normals[chosen, 1])
        ex = point[0] - np.float64(scans.centroids[chosen, 0])
        ey = point[1] - np.float64(scans.centroids[chosen, 1])
        distance = nx * ex + ny * ey
        if nx * normal[0] + ny * normal[1] >= _SAME_FACE and abs(distance) <= gate:
            return chosen, distance
    if chosen < 0 or known < 2 or depth > farthest + _THROUGH:
        return _UNKNOWN, 0.0
    return _ELSEWHERE, 0.0


@njit(cache=True, nogil=True)
def add_information(i: int, j: int, rel: F64, scans: ScanArrays, gate: float, scale: float, information: F64) -> None:
    """Overwrite `information` (3, 3) with that of scan i against scan j, the pose of i in j being `rel` (3,).

    As in `pair_terms`, but each product is of the normals of both scans. The square of one normal holds the variance
    of its own noise: along a bare corridor that alone looks like a measurement (errors in variables; both normals
    together are an instrument, Fuller 1987). It may be indefinite where there is next to none.
    """
    c = cos(rel[2])
    s = sin(rel[2])
    point = np.empty(2)
    normal = np.empty(2)
    information[:] = 0.0
    one = np.empty(3)
    other = np.empty(3)
    for q in range(scans.chosen_start[i], scans.chosen_start[i + 1]):
        a = scans.start[i] + scans.chosen_hits[q]
        mx = np.float64(scans.normals[a, 0])
        my = np.float64(scans.normals[a, 1])
        dx = c * np.float64(scans.points[a, 0]) - s * np.float64(scans.points[a, 1])
        dy = s * np.float64(scans.points[a, 0]) + c * np.float64(scans.points[a, 1])
        point[0] = rel[0] + dx
        point[1] = rel[1] + dy
        normal[0] = c * mx - s * my
        normal[1] = s * mx + c * my
        hit, distance = wall_at(point, normal, j, scans, gate)
        if hit < 0:
            continue
        w = 1.0 / (1.0 + (distance / scale) ** 2) ** 2
        one[0] = np.float64(scans.normals[hit, 0])
        one[1] = np.float64(scans.normals[hit, 1])
        one[2] = one[1] * dx - one[0] * dy
        other[0] = normal[0]
        other[1] = normal[1]
        other[2] = normal[1] * dx - normal[0] * dy
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
    """Add to `sums` (2,) the agreement of scan i with scan j, and the number of points on which j has a say.

    The agreement is the weight of points on walls of j, less the number of points that j looked through.
    """
    c = cos(rel[2])
    s = sin(rel[2])
    point = np.empty(2)
    normal = np.empty(2)
    for q in range(scans.chosen_start[i], scans.chosen_start[i + 1]):
        a = scans.start[i] + scans.chosen_hits[q]
        px = np.float64(scans.points[a, 0])
        py = np.float64(scans.points[a, 1])
        point[0] = rel[0] + c * px - s * py
        point[1] = rel[1] + s * px + c * py
        normal[0] = c * np.float64(scans.normals[a, 0]) - s * np.float64(scans.normals[a, 1])
        normal[1] = s * np.float64(scans.normals[a, 0]) + c * np.float64(scans.normals[a, 1])
        # From behind a wall j cannot have seen this face of it.
        away = normal[0] * (point[0] - scans.geometry[j, 0]) + normal[1] * (point[1] - scans.geometry[j, 1])
        if away >= 0.0:
            continue
        hit, distance = wall_at(point, normal, j, scans, gate)
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

    It is a part of the points on which the other side has a say: near 1 where all lie on walls.
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
