"""Scan against scan: short pieces of wall, and the terms that pull one scan onto another.

Each hit of a scan carries the line fitted to the hits around it (a surfel: centroid and normal). A point of another
scan is looked up by its bearing in the scan it is compared with (projective association, as in Blais and Levine 1995),
so that no field and no tree is needed, and what one side of a wall has seen is never paired with
its other side. The residual is the distance from point to line (Chen and Medioni 1992; Censi 2008 for planar scans).

Scans are stored one after the other (`ScanArrays`, made by `hsloc.slam.keyscans`).
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F32 = NDArray[np.float32]
    F64 = NDArray[np.float64]
    I32 = NDArray[np.int32]
    I64 = NDArray[np.int64]

MOST_BEAMS = 4
"""Maximum number of beams on each side of a point's own beam. Internal: bounds the time where beams are dense."""
_NEXT_BUT_ONE = 1.4
"""Least distance of a point to the beam next but one to its own, in distances between two beams there. Internal: the
sine of one and a half angles; less than that for beams up to 20 degrees apart."""
SAME_FACE = 0.7
"""Minimum cosine between the normals of one wall in two scans. Internal: 45 degrees, faces differ by 90 or 180."""
THROUGH = 0.25
"""Distance (m) by which a beam that looked through a point ends behind it. Internal: above errors of range."""
_CLEARED = 4.0
"""Depth (m) up to which a beam without a return has looked through. Internal: as where the map is built; beyond, a wall
may have been out of range, or of glass."""

_ACROSS = 0.25
"""Squared cosine between a normal and an axis that a wall across has. Internal: far above the noise of normals."""


class ScanArrays(NamedTuple):
    """Scans one after the other, and which of their hits are used.

    In this module because a kernel's argument types decide whether it can be cached.
    """

    points: F32
    """Hits of scan k in the base's frame (m): rows start[k] to start[k + 1], shape (P, 2)."""
    normals: F32
    """Normals of the hits, shape (P, 2); (0, 0) for a hit without a surfel."""
    centroids: F32
    """Centroids of the surfels of the hits (m), shape (P, 2)."""
    start: I64
    hit_of_beam: I32
    """Row of a beam's hit within its scan, or -1; beams of scan k are entries table_start[k] to table_start[k + 1]."""
    ranges: F32
    """Range of each beam (m); infinite: no return; NaN: invalid."""
    table_start: I64
    geometry: F64
    """The laser's x, y, theta in the base, angle_min and angle_increment of each scan, shape (n, 5)."""
    chosen_hits: I32
    """Rows of the hits that are used, within their scan: of k the entries chosen_start[k] to chosen_start[k + 1]."""
    chosen_start: I64


class Term(NamedTuple):
    """Normal equations of one pose (x, y, theta): `information` (3, 3) and `gradient` (3,)."""

    information: F64
    gradient: F64


class PairTerm(NamedTuple):
    """What `pair_terms` writes: a `Term`, and the information that is `observed` by the normals of both scans (3, 3).

    Each product in it is of the normals of both. The square of one normal holds the variance of its own noise: along a
    bare corridor that alone looks like a measurement (errors in variables; both normals together are an instrument,
    Fuller 1987). It may be indefinite where there is next to none.
    """

    information: F64
    gradient: F64
    observed: F64


@njit(cache=True, nogil=True)
def relative(first: F64, second: F64, out: F64) -> None:
    """`first^-1 @ second` of two poses (x, y, theta); theta is not wrapped."""
    c = cos(first[2])
    s = sin(first[2])
    dx = second[0] - first[0]
    dy = second[1] - first[1]
    out[0] = c * dx + s * dy
    out[1] = -s * dx + c * dy
    out[2] = second[2] - first[2]


# Inlined and without branches: so a loop over points is compiled to vector instructions.
@njit(cache=True, nogil=True, inline="always")
def bearing(y: float, x: float) -> float:
    """atan2(y, x) to 1e-5 rad, in a quarter of its time (Abramowitz and Stegun 4.4.49): good to find a beam."""
    ax = abs(x)
    ay = abs(y)
    z = min(ax, ay) / max(max(ax, ay), 1e-300)
    q = z * z
    angle = z * (0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351))))
    angle = 0.5 * pi - angle if ay > ax else angle
    angle = pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


# The error model is that of NumPy: a test for each division would also keep the loop from vector instructions.
@njit(cache=True, nogil=True, error_model="numpy")
def project(points: F32, rows: I32, rel: F64, geometry: F64, out: F64) -> None:
    """Where the chosen rows (m,) of the hits of scan i lie in scan j with this `geometry` (5,), `rel` being i in j.

    Writes to `out` (4, m) the x and y of the hit turned by the angle of `rel`, the beam of j on which it lies (a number
    beyond the last beam where none is), and its distance from the laser of j. By itself, not in the loop in which hits
    are paired: there its calculations could not be done for several hits at once.
    """
    c = cos(rel[2])
    s = sin(rel[2])
    spacing = abs(geometry[4])
    per_beam = 1.0 / spacing
    sense = 1.0 if geometry[4] > 0.0 else -1.0
    zero_angle = geometry[2] + geometry[3]
    x0 = rel[0] - geometry[0]
    y0 = rel[1] - geometry[1]
    for q in range(len(rows)):
        px = np.float64(points[rows[q], 0])
        py = np.float64(points[rows[q], 1])
        out[0, q] = c * px - s * py
        out[1, q] = s * px + c * py
    for q in range(len(rows)):
        lx = x0 + out[0, q]
        ly = y0 + out[1, q]
        angle = sense * (bearing(ly, lx) - zero_angle) + 0.5 * spacing
        angle -= 2.0 * pi * np.floor(angle * (0.5 / pi))
        out[2, q] = angle * per_beam
        out[3, q] = sqrt(lx * lx + ly * ly)


# Inlined: called, these two would make `pair_terms` a fifteenth slower.
@njit(cache=True, nogil=True, inline="always")
def nearest_hit(
    x: float, y: float, middle: int, gate: float, spread: float, hit_of_beam: I32, points: F32
) -> tuple[int, float]:
    """The hit that is nearest to a point in the frame of a scan, and the squared distance.

    The scan is given by the hits of its beams and their `points`. The point is on the beam `middle`, where two beams
    are `spread` metres apart; the beams within the `gate` on either side are tried, one at least and `MOST_BEAMS` at
    most. Without a hit -1, and an infinite distance.
    """
    n = len(hit_of_beam)
    best = np.inf
    chosen = -1
    for k in range(max(middle - 1, 0), min(middle + 2, n)):
        row = hit_of_beam[k]
        if row >= 0:
            ex = x - np.float64(points[row, 0])
            ey = y - np.float64(points[row, 1])
            squared = ex * ex + ey * ey
            if squared < best:
                best = squared
                chosen = row
    # The point is one and a half beams or more from all others.
    if gate < spread or best < (_NEXT_BUT_ONE * spread) ** 2:
        return chosen, best
    reach = min(int(gate / (spread + 1e-9)) + 1, MOST_BEAMS)
    for side in range(2):
        low = middle - reach if side == 0 else middle + 2
        high = middle - 1 if side == 0 else middle + reach + 1
        for k in range(max(low, 0), min(high, n)):
            row = hit_of_beam[k]
            if row >= 0:
                ex = x - np.float64(points[row, 0])
                ey = y - np.float64(points[row, 1])
                squared = ex * ex + ey * ey
                if squared < best:
                    best = squared
                    chosen = row
    return chosen, best


@njit(cache=True, nogil=True, inline="always")
def ends_around(beam: int, ranges: F32) -> tuple[int, float, float]:
    """Of a beam of a scan with these ranges and those next to it how many are known, how near and how far they end (m).

    A beam without a return ends at `_CLEARED`.
    """
    nearest = np.inf
    farthest = 0.0
    known = 0
    for k in range(max(beam - 1, 0), min(beam + 2, len(ranges))):
        end = np.float64(ranges[k])
        if end == np.inf:
            end = np.float64(_CLEARED)
        if end == end:
            known += 1
            nearest = min(nearest, end)
            farthest = max(farthest, end)
    return known, nearest, farthest


@njit(cache=True, nogil=True, error_model="numpy")
def pair_terms(
    i: int, j: int, rel: F64, scans: ScanArrays, gate: float, scale: float, term: PairTerm, counts: F64
) -> None:
    """Equations of scan i against scan j, the pose of i in j being `rel` (x, y, theta).

    Overwrites `term`: information = sum w J^T J and gradient = sum w J^T r with the residuals r (m) and their
    derivatives by `rel`, weights w = 1 / (1 + r^2 / scale^2)^2 (Geman-McClure), and `counts` =
    (paired within `gate`, conflicts: points where j looked through, points in j's field of view, sum of w r^2, sum of
    w). Of scan i the chosen hits are used.
    """
    geometry = scans.geometry
    # Slices, taken once: each look into the tuple of arrays in a loop counts references.
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
    rx = rel[0]
    ry = rel[1]
    rt = rel[2]
    c = cos(rt)
    s = sin(rt)
    n_beams = len(ranges)
    spacing = abs(geometry[j, 4])
    projected = np.empty((4, len(rows)))
    project(own_points, rows, rel, geometry[j], projected)
    gate2 = gate * gate
    weaken = 1.0 / (scale * scale)
    paired = conflicts = seen = 0
    squares = weights = 0.0
    xx = xy = xt = yy = yt = tt = gx = gy = gt = 0.0
    both_xx = both_xy = both_xt = both_yy = both_yt = both_tt = 0.0
    for q in range(len(rows)):
        a = rows[q]
        mx = np.float64(own_normals[a, 0])
        my = np.float64(own_normals[a, 1])
        if mx == 0.0 and my == 0.0:
            continue
        middle = int(projected[2, q])
        if middle >= n_beams:
            continue
        seen += 1
        dx = projected[0, q]
        dy = projected[1, q]
        depth = projected[3, q]
        x = rx + dx
        y = ry + dy
        # The hit nearest to the point, among the beams around its own.
        chosen, best = nearest_hit(x, y, middle, gate, spacing * depth, hit_of_beam, points)
        if best > gate2:
            # Did j look through the point? Only where all three beams around it ended well behind it.
            known, nearest, _ = ends_around(middle, ranges)
            if known >= 2 and depth + THROUGH < nearest:
                conflicts += 1
                continue
            if chosen < 0 or best > gate2 + (2.0 * spacing * depth) ** 2:
                continue
        nx = np.float64(normals[chosen, 0])
        ny = np.float64(normals[chosen, 1])
        # Both sides must have seen the same face of the wall; (0, 0), no surfel, fails here too.
        ox = c * mx - s * my
        oy = s * mx + c * my
        if nx * ox + ny * oy < SAME_FACE:
            continue
        ex = x - np.float64(centroids[chosen, 0])
        ey = y - np.float64(centroids[chosen, 1])
        r = nx * ex + ny * ey
        if abs(r) > gate:
            continue
        w = 1.0 / (1.0 + r * r * weaken)
        w *= w
        jt = ny * dx - nx * dy
        paired += 1
        squares += w * r * r
        weights += w
        wx = w * nx
        wy = w * ny
        wt = w * jt
        xx += wx * nx
        xy += wx * ny
        xt += wx * jt
        yy += wy * ny
        yt += wy * jt
        tt += wt * jt
        gx += wx * r
        gy += wy * r
        gt += wt * r
        ot = oy * dx - ox * dy
        both_xx += wx * ox
        both_xy += wx * oy + wy * ox
        both_xt += wx * ot + wt * ox
        both_yy += wy * oy
        both_yt += wy * ot + wt * oy
        both_tt += wt * ot
    information = term.information
    information[0, 0] = xx
    information[0, 1] = information[1, 0] = xy
    information[0, 2] = information[2, 0] = xt
    information[1, 1] = yy
    information[1, 2] = information[2, 1] = yt
    information[2, 2] = tt
    observed = term.observed
    observed[0, 0] = both_xx
    observed[0, 1] = observed[1, 0] = 0.5 * both_xy
    observed[0, 2] = observed[2, 0] = 0.5 * both_xt
    observed[1, 1] = both_yy
    observed[1, 2] = observed[2, 1] = 0.5 * both_yt
    observed[2, 2] = both_tt
    term.gradient[0] = gx
    term.gradient[1] = gy
    term.gradient[2] = gt
    counts[0] = paired
    counts[1] = conflicts
    counts[2] = seen
    counts[3] = squares
    counts[4] = weights


@njit(cache=True, nogil=True, error_model="numpy")
def add_agreement(
    i: int, j: int, rel: F64, axis: tuple[float, float], scans: ScanArrays, gate: float, scale: float, sums: F64
) -> None:
    """Add to `sums` (2,) the agreement of scan i with scan j, and the number of points that j can judge.

    The agreement is the weight of points on walls of j, less the number of points that j looked through. What is out
    of the view of j, behind a wall, or beyond 4 m where j has no return, it cannot judge. With an `axis` in the frame
    of j only points on walls across it count, within 60 degrees, each as the squared cosine; (0, 0): all count alike.
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
    geometry = scans.geometry[j]
    spacing = abs(geometry[4])
    projected = np.empty((4, len(rows)))
    project(own_points, rows, rel, geometry, projected)
    agreement = judged = 0.0
    is_directed = axis[0] != 0.0 or axis[1] != 0.0
    for q in range(len(rows)):
        a = rows[q]
        mx = np.float64(own_normals[a, 0])
        my = np.float64(own_normals[a, 1])
        x = rel[0] + projected[0, q]
        y = rel[1] + projected[1, q]
        ox = c * mx - s * my
        oy = s * mx + c * my
        counts_as = (ox * axis[0] + oy * axis[1]) ** 2 if is_directed else 1.0
        if counts_as < _ACROSS:
            continue
        # From behind a wall j cannot have seen this face of it.
        if ox * (x - geometry[0]) + oy * (y - geometry[1]) >= 0.0:
            continue
        middle = int(projected[2, q])
        if middle >= len(ranges):
            continue
        depth = projected[3, q]
        chosen, best = nearest_hit(x, y, middle, gate, spacing * depth, hit_of_beam, points)
        known, nearest, farthest = ends_around(middle, ranges)
        if best > gate * gate and known >= 2 and depth + THROUGH < nearest:
            judged += counts_as
            agreement -= counts_as
            continue
        if chosen >= 0 and best <= gate * gate + (2.0 * spacing * depth) ** 2:
            nx = np.float64(normals[chosen, 0])
            ny = np.float64(normals[chosen, 1])
            ex = x - np.float64(centroids[chosen, 0])
            ey = y - np.float64(centroids[chosen, 1])
            distance = nx * ex + ny * ey
            if nx * ox + ny * oy >= SAME_FACE and abs(distance) <= gate:
                judged += counts_as
                agreement += counts_as / (1.0 + (distance / scale) ** 2) ** 2
                continue
        # A wall near the point that is not the point's, unless j does not know.
        if chosen >= 0 and known >= 2 and depth <= farthest + THROUGH:
            judged += counts_as
    sums[0] += agreement
    sums[1] += judged
