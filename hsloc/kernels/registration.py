"""Registration point to line: one scan onto several others, and the motions between the scans of a short stretch.

Gauss-Newton on the terms of `hsloc.kernels.point_to_line.pair_terms`, taken in both directions. One scan onto others
that stand still has a prior on its pose. A direction that no wall fixes has no gradient, so that there the pose stays
where the prior has it. A field of scores does not have this property: it prefers the pose at which the scans overlap
most. The motions of a stretch are what its scans alone say, without odometry.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from hsloc.kernels.block_cholesky import solve_in_place
from hsloc.kernels.levenberg_marquardt import solve_damped
from hsloc.kernels.normal_equations import Blocks, PairTerms, add_relative_term
from hsloc.kernels.point_to_line import PairTerm, ScanArrays, Term, add_agreement, pair_terms, relative

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_STILL_M = 2e-4
_STILL_RAD = 1e-4
"""A step smaller than both ends the registration. Internal: a hundredth of the noise of a point; of 1,500 registrations
of a real log 99 in 100 end within 0.2 mm of where more rounds lead."""

_CELLS = 1 << 31
"""Squares of a grid from one column to the next. Internal: more than any map has."""
_PRIOR = 0.1
"""Information (1/m^2; 1/rad^2) of each pose by itself. Internal: keeps the equations solvable if nothing is seen."""


class RegistrationParameters(NamedTuple):
    """How points are paired and weighed."""

    gates: tuple[float, float, float]
    """Maximum distance [m] of a point to the wall that it is paired with, in rounds 1, 2 and from 3 on."""
    scale_of_gate: float
    """Scale of the Geman-McClure weight, as a part of the gate."""
    weight: float
    """Information [1/m^2] of a paired point."""
    prior_scale: float
    """Scale of the Cauchy weight on the chi of the prior; infinite: the prior is trusted."""
    rounds: int
    """Gauss-Newton steps at most."""


class Grid(NamedTuple):
    """Squares of `side` metres, and the numbers of those in which scans lie (n,), ascending."""

    side: float
    cells: I64

    @staticmethod
    def of(positions: F64, side: float) -> tuple[Grid, I64]:
        """The grid of positions (n, 2), and their order in it (n,), stable within a square."""
        corner = np.floor(positions / side).astype(np.int64)
        number = corner[:, 0] * _CELLS + corner[:, 1]
        order = np.argsort(number, kind="stable")
        return Grid(side, number[order]), order


class Scene(NamedTuple):
    """n scans, of which those from `first_moving` on move together and the others stand still."""

    first_moving: int
    scan_poses: F64
    """Of the fixed scans in the map, of the moving ones as seen from the pose that is sought, shape (n, 3)."""
    rows: I64
    """Which of `scans` each of the n is."""
    scans: ScanArrays


class Prior(NamedTuple):
    """What is known of the pose beforehand, in the map."""

    pose: F64
    information: F64
    """Shape (3, 3)."""


@njit(cache=True, nogil=True)
def add_pairs(pose: F64, scene: Scene, gate: float, p: RegistrationParameters, term: Term, counts: F64) -> None:
    """Add the equations of the scans that move with `pose` against those that stand still.

    Adds to `term`, by (x, y, theta) of `pose` in the map, and to `counts` (5,) as in `pair_terms`.
    """
    first_moving = scene.first_moving
    scan_poses = scene.scan_poses
    information = term.information
    gradient = term.gradient
    moved = np.empty(3)
    rel = np.empty(3)
    one = PairTerm(np.empty((3, 3)), np.empty(3), np.empty((3, 3)))
    one_term = Term(one.information, one.gradient)
    tally = np.empty(5)
    ha = np.empty((3, 3))
    away = np.zeros((3, 3))
    off = np.zeros((3, 3))
    lost = np.zeros(3)
    block = np.zeros((3, 3))
    pull = np.zeros(3)
    onto_first = Blocks(block, off, away, pull, lost)
    onto_second = Blocks(away, off, block, lost, pull)
    c = np.cos(pose[2])
    s = np.sin(pose[2])
    for k in range(first_moving, len(scan_poses)):
        dx = c * scan_poses[k, 0] - s * scan_poses[k, 1]
        dy = s * scan_poses[k, 0] + c * scan_poses[k, 1]
        moved[0] = pose[0] + dx
        moved[1] = pose[1] + dy
        moved[2] = pose[2] + scan_poses[k, 2]
        block[:] = 0.0
        pull[:] = 0.0
        for m in range(first_moving):
            for direction in range(2):
                i = scene.rows[k if direction == 0 else m]
                j = scene.rows[m if direction == 0 else k]
                if direction == 0:
                    relative(scan_poses[m], moved, rel)
                else:
                    relative(moved, scan_poses[m], rel)
                pair_terms(i, j, rel, scene.scans, gate, p.scale_of_gate * gate, one, tally)
                counts += tally
                for a in range(3):
                    one.gradient[a] *= p.weight
                    for b in range(3):
                        one.information[a, b] *= p.weight
                if direction == 0:
                    add_relative_term(scan_poses[m], rel, one_term, onto_second, ha)
                else:
                    add_relative_term(moved, rel, one_term, onto_first, ha)
        # From the moved scan's pose to `pose`: x and y shift with it, theta also swings the scan around it.
        information += block
        for a in range(3):
            swing = block[a, 1] * dx - block[a, 0] * dy
            information[a, 2] += swing
            information[2, a] += swing
        information[2, 2] += dx * dx * block[1, 1] + dy * dy * block[0, 0] - 2.0 * dx * dy * block[0, 1]
        gradient += pull
        gradient[2] += pull[1] * dx - pull[0] * dy


@njit(cache=True, nogil=True)
def register(pose: F64, scene: Scene, prior: Prior, p: RegistrationParameters, information: F64, counts: F64) -> float:
    """Move `pose` (3,), in place, to where the moving scans fit the fixed ones and the prior best.

    Writes the `information` (3, 3) of the pairs alone and their `counts` (5,), at the pose before the last step.
    Returns the chi of that pose against the prior.
    """
    gradient = np.empty(3)
    step = np.empty(3)
    error = np.empty(3)
    total = np.empty((3, 3))
    term = Term(information, gradient)
    chi2 = 0.0
    for k in range(p.rounds):
        gate = p.gates[min(k, 2)]
        information[:] = 0.0
        gradient[:] = 0.0
        counts[:] = 0.0
        add_pairs(pose, scene, gate, p, term, counts)
        for a in range(3):
            error[a] = pose[a] - prior.pose[a]
        error[2] -= 2.0 * pi * np.round(error[2] / (2.0 * pi))
        chi2 = 0.0
        for a in range(3):
            for b in range(3):
                chi2 += error[a] * prior.information[a, b] * error[b]
        weight = 1.0
        if p.prior_scale < np.inf:
            weight = p.prior_scale**2 / (p.prior_scale**2 + chi2)
        for a in range(3):
            for b in range(3):
                total[a, b] = information[a, b] + weight * prior.information[a, b]
                gradient[a] += weight * prior.information[a, b] * error[b]
        solve_damped(total, gradient, 0.0, step)
        for a in range(3):
            pose[a] -= step[a]
        still = abs(step[0]) < _STILL_M and abs(step[1]) < _STILL_M and abs(step[2]) < _STILL_RAD
        if still and k >= 2:
            break
    return sqrt(chi2)


@njit(cache=True, nogil=True)
def nearest_partners(poses: F64, sorts: I64, known: I64, grid: Grid, most: int, partners: I64) -> None:
    """Write the scans that each scan is compared with to `partners` (n, most), the nearest first, -1 where none is.

    Of the `known` scans within `grid.side` metres the nearest of each sort counts, `sorts` (n,), and of these the
    nearest; half a metre counts as a radian. `known` are in the order of their cells, and ascending within each.
    """
    n = len(poses)
    radius2 = grid.side * grid.side
    best = np.empty(n)
    scan = np.empty(n, dtype=np.int64)
    kind = np.empty(n, dtype=np.int64)
    for k in range(n):
        found = 0
        column = int(np.floor(poses[k, 0] / grid.side))
        row = int(np.floor(poses[k, 1] / grid.side))
        for across in range(column - 1, column + 2):
            first = np.searchsorted(grid.cells, across * _CELLS + row - 1)
            last = np.searchsorted(grid.cells, across * _CELLS + row + 2)
            for p in range(first, last):
                other = known[p]
                dx = poses[other, 0] - poses[k, 0]
                dy = poses[other, 1] - poses[k, 1]
                if other == k or dx * dx + dy * dy > radius2:
                    continue
                turn = poses[other, 2] - poses[k, 2]
                turn -= 2.0 * pi * np.round(turn / (2.0 * pi))
                distance = sqrt(dx * dx + dy * dy) + 0.5 * abs(turn)
                at = 0
                while at < found and kind[at] != sorts[other]:
                    at += 1
                if at == found:
                    found += 1
                    kind[at] = sorts[other]
                elif distance > best[at] or (distance == best[at] and other > scan[at]):
                    continue
                best[at] = distance
                scan[at] = other
        for taken in range(most):
            nearest = -1
            for at in range(found):
                if scan[at] >= 0 and (
                    nearest < 0 or best[at] < best[nearest] or (best[at] == best[nearest] and scan[at] < scan[nearest])
                ):
                    nearest = at
            partners[k, taken] = scan[nearest] if nearest >= 0 else -1
            if nearest >= 0:
                scan[nearest] = -1


@njit(cache=True, nogil=True)
def _add_transformed(matrix: F64, covariance: F64, out: F64) -> None:
    """Add `matrix covariance matrix^T`, all (3, 3), to `out`."""
    for a in range(3):
        for b in range(3):
            for i in range(3):
                for j in range(3):
                    out[a, b] += matrix[a, i] * covariance[i, j] * matrix[b, j]


@njit(cache=True, nogil=True)
def window_motions(
    poses: F64, pairs: I64, terms: PairTerms, weight: float, windows: I64, motions: F64, covariances: F64
) -> None:
    """Write the pose of the last scan of each window (m, 2), seen from its first, and its covariance.

    Of the `pairs` (k, 2), sorted, those within a window are solved for with `terms` that were evaluated at `poses`
    (n, 3), times `weight`: `motions` (m, 3) and `covariances` (m, 3, 3), in the frame of the first.
    """
    starts = np.searchsorted(pairs[:, 0], np.arange(len(poses) + 1))
    rel = np.empty(3)
    ha = np.empty((3, 3))
    jj = np.empty((3, 3))
    ji = np.empty((3, 3))
    ii = np.empty((3, 3))
    gj = np.empty(3)
    gi = np.empty(3)
    for w in range(len(windows)):
        begin = windows[w, 0]
        end = windows[w, 1]
        size = 3 * (end - begin)
        matrix = np.zeros((size, size))
        right = np.zeros((size, 4))
        for k in range(size):
            matrix[k, k] = _PRIOR
        for m in range(starts[begin], starts[end]):
            if pairs[m, 1] > end:
                continue
            # The first scan stays: it has no rows.
            j = 3 * (pairs[m, 0] - begin - 1)
            i = 3 * (pairs[m, 1] - begin - 1)
            pose_j = poses[pairs[m, 0]]
            relative(pose_j, poses[pairs[m, 1]], rel)
            jj[:] = 0.0
            ji[:] = 0.0
            ii[:] = 0.0
            gj[:] = 0.0
            gi[:] = 0.0
            term = Term(weight * terms.information[m], weight * terms.gradient[m])
            add_relative_term(pose_j, rel, term, Blocks(jj, ji, ii, gj, gi), ha)
            for a in range(3):
                right[i + a, 3] -= gi[a]
                if j >= 0:
                    right[j + a, 3] -= gj[a]
                for b in range(3):
                    matrix[i + a, i + b] += ii[a, b]
                    if j >= 0:
                        matrix[j + a, j + b] += jj[a, b]
                        matrix[j + a, i + b] += ji[a, b]
                        matrix[i + b, j + a] += ji[a, b]
        for a in range(3):
            right[size - 3 + a, a] = 1.0
        solve_in_place(matrix, right)
        last = poses[end] + right[size - 3 :, 3]
        relative(poses[begin], last, motions[w])
        c = np.cos(poses[begin, 2])
        s = np.sin(poses[begin, 2])
        turn = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
        covariances[w] = 0.0
        _add_transformed(turn, right[size - 3 :, :3], covariances[w])


@njit(cache=True, nogil=True)
def composed_motions(steps: F64, step_covariances: F64, windows: I64, motions: F64, covariances: F64) -> None:
    """Write the motion along each window (m, 2) by `steps` (n - 1, 3) with `step_covariances` (n - 1, 3, 3) alone.

    `motions` (m, 3) and `covariances` (m, 3, 3) are in the frame of the first scan, to first order.
    """
    for w in range(len(windows)):
        x = y = theta = 0.0
        total = np.zeros((3, 3))
        for k in range(windows[w, 0], windows[w, 1]):
            c = np.cos(theta)
            s = np.sin(theta)
            dx = c * steps[k, 0] - s * steps[k, 1]
            dy = s * steps[k, 0] + c * steps[k, 1]
            along = np.array(((1.0, 0.0, -dy), (0.0, 1.0, dx), (0.0, 0.0, 1.0)))
            turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
            before = total
            total = np.zeros((3, 3))
            _add_transformed(along, before, total)
            _add_transformed(turn, step_covariances[k], total)
            x += dx
            y += dy
            theta += steps[k, 2]
        motions[w, 0] = x
        motions[w, 1] = y
        motions[w, 2] = theta
        covariances[w] = total


@njit(cache=True, nogil=True)
def displaced_agreement(
    poses: F64,
    groups: tuple[I64, I64],
    displacements: F64,
    axis: tuple[float, float],
    scans: ScanArrays,
    gate: float,
    scale: float,
    out: F64,
) -> None:
    """Write the agreement of two groups of scans with the second displaced by (m, 2) in the map (m).

    To `out` (m, 2): the sum of `add_agreement`, and that over the points which the other side can judge, equal where
    all of them lie on walls. With an `axis` in the map only points on walls across it count; (0, 0): all.
    """
    rel = np.empty(3)
    moved = np.empty(3)
    for k in range(len(displacements)):
        out[k] = 0.0
        for a in groups[0]:
            for b in groups[1]:
                moved[0] = poses[b, 0] + displacements[k, 0]
                moved[1] = poses[b, 1] + displacements[k, 1]
                moved[2] = poses[b, 2]
                relative(poses[a], moved, rel)
                add_agreement(b, a, rel, _seen_from(axis, poses[a, 2]), scans, gate, scale, out[k])
                relative(moved, poses[a], rel)
                add_agreement(a, b, rel, _seen_from(axis, moved[2]), scans, gate, scale, out[k])


@njit(cache=True, nogil=True, inline="always")
def _seen_from(axis: tuple[float, float], heading: float) -> tuple[float, float]:
    """A direction in the map in a frame with this heading."""
    c = np.cos(heading)
    s = np.sin(heading)
    return c * axis[0] + s * axis[1], c * axis[1] - s * axis[0]
