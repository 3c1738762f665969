"""The normal equations of poses that constrain each other: pairs of scans and edges of a graph.

A term in the pose of one scan seen from another (`hsloc.kernels.point_to_line.pair_terms`, or what an edge measured) is
moved onto the two poses in the map, and added to the 3x3 blocks of a sparse symmetric system.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from hsloc.kernels.point_to_line import PairTerm, ScanArrays, Term, pair_terms, relative

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


_SAME_M = 1e-3
_SAME_RAD = 3e-4
"""Motion of a pair (m; rad) that leaves its paired points as they are. Internal: a part of the noise of a point."""


class Blocks(NamedTuple):
    """Blocks of a sparse symmetric system that a term between poses j and i adds to: (3, 3), right side (3,)."""

    jj: F64
    ji: F64
    ii: F64
    right_j: F64
    right_i: F64


class Equations(NamedTuple):
    """A sparse symmetric system of n poses and m pairs of poses."""

    diagonal: F64
    """Shape (n, 3, 3)."""
    off_diagonal: F64
    """Shape (m, 3, 3), the blocks of rows pairs[:, 0] and columns pairs[:, 1]."""
    right: F64
    """Shape (n, 3)."""


@njit(cache=True, nogil=True)
def add_relative_term(pose_j: F64, rel: F64, term: Term, blocks: Blocks, ha: F64) -> None:
    """Move a term in the pose of i seen from j, `rel`, onto the two poses in the map, adding to the five blocks.

    With rel = R_j^T (t_i - t_j), theta_i - theta_j: A = d rel / d pose_i, B = d rel / d pose_j.
    `ha` (3, 3) is scratch; matrices this small are faster by hand than by BLAS.
    """
    information = term.information
    gradient = term.gradient
    hjj = blocks.jj
    hji = blocks.ji
    hii = blocks.ii
    gj = blocks.right_j
    gi = blocks.right_i
    c = cos(pose_j[2])
    s = sin(pose_j[2])
    # H A: A turns (x, y) by -theta_j.
    for k in range(3):
        hx = information[k, 0]
        hy = information[k, 1]
        ha[k, 0] = hx * c - hy * s
        ha[k, 1] = hx * s + hy * c
        ha[k, 2] = information[k, 2]
    for k in range(3):
        # A^T (H A), rows first
        x = ha[0, k]
        y = ha[1, k]
        ax = c * x - s * y
        ay = s * x + c * y
        at = ha[2, k]
        hii[0, k] += ax
        hii[1, k] += ay
        hii[2, k] += at
        # B = -A but for its last column, (rel_y, -rel_x, -1).
        hji[0, k] -= ax
        hji[1, k] -= ay
        hji[2, k] += rel[1] * x - rel[0] * y - at
    # H_jj = B^T H B = B^T H (-A) but for the last column, which is B^T H b.
    bx = rel[1] * information[0, 0] - rel[0] * information[0, 1] - information[0, 2]
    by = rel[1] * information[1, 0] - rel[0] * information[1, 1] - information[1, 2]
    bt = rel[1] * information[2, 0] - rel[0] * information[2, 1] - information[2, 2]
    cross_x = -(c * bx - s * by)
    cross_y = -(s * bx + c * by)
    for k in range(2):
        x = ha[0, k]
        y = ha[1, k]
        hjj[0, k] += c * x - s * y
        hjj[1, k] += s * x + c * y
    hjj[0, 2] += cross_x
    hjj[1, 2] += cross_y
    hjj[2, 0] += cross_x
    hjj[2, 1] += cross_y
    hjj[2, 2] += rel[1] * bx - rel[0] * by - bt
    ax = c * gradient[0] - s * gradient[1]
    ay = s * gradient[0] + c * gradient[1]
    gi[0] += ax
    gi[1] += ay
    gi[2] += gradient[2]
    gj[0] -= ax
    gj[1] -= ay
    gj[2] += rel[1] * gradient[0] - rel[0] * gradient[1] - gradient[2]


class PairTerms(NamedTuple):
    """Terms of m pairs of scans, in the pose of the second seen from the first; both directions together."""

    information: F64
    """Shape (m, 3, 3)."""
    gradient: F64
    """Shape (m, 3)."""
    counts: F64
    """Shape (m, 5), as in `pair_terms`, the sum over both directions."""
    observed: F64
    """Information by the normals of both scans, as in `PairTerm`, shape (m, 3, 3)."""


@njit(cache=True, nogil=True)
def add_inverse_term(rel: F64, term: Term, information: F64, gradient: F64) -> None:
    """Add a term in the inverse of `rel` (3,), as one in `rel` itself, to `information` (3, 3) and `gradient` (3,)."""
    c = cos(rel[2])
    s = sin(rel[2])
    x = rel[0]
    y = rel[1]
    # Derivative D of the inverse (-R^T t, -theta) by (t, theta): rows (-c, -s, u), (s, -c, v), (0, 0, -1).
    u = s * x - c * y
    v = c * x + s * y
    h = term.information
    g = term.gradient
    gradient[0] += s * g[1] - c * g[0]
    gradient[1] += -s * g[0] - c * g[1]
    gradient[2] += u * g[0] + v * g[1] - g[2]
    for b in range(3):
        # Column b of H D, written out: a matrix product of this size costs more than a scan's points.
        if b == 0:
            hx = s * h[0, 1] - c * h[0, 0]
            hy = s * h[1, 1] - c * h[1, 0]
            ht = s * h[2, 1] - c * h[2, 0]
        elif b == 1:
            hx = -s * h[0, 0] - c * h[0, 1]
            hy = -s * h[1, 0] - c * h[1, 1]
            ht = -s * h[2, 0] - c * h[2, 1]
        else:
            hx = u * h[0, 0] + v * h[0, 1] - h[0, 2]
            hy = u * h[1, 0] + v * h[1, 1] - h[1, 2]
            ht = u * h[2, 0] + v * h[2, 1] - h[2, 2]
        information[0, b] += s * hy - c * hx
        information[1, b] += -s * hx - c * hy
        information[2, b] += u * hx + v * hy - ht


class Evaluated(NamedTuple):
    """Where the terms of m pairs were evaluated: relative poses `at` (m, 3), NaN: never; and their `gradient` there."""

    at: F64
    gradient: F64


@njit(cache=True, nogil=True)
def evaluate_pairs(
    poses: F64, pairs: I64, scans: ScanArrays, gate: float, scale: float, terms: PairTerms, before: Evaluated
) -> None:
    """Overwrite `terms` with those of all pairs (m, 2) of scans, either scan against the other, at `poses` (n, 3).

    A pair that has hardly moved since it was evaluated `before`, with the same gate, keeps its points: its gradient
    changes by its information.
    """
    one = PairTerm(np.empty((3, 3)), np.empty(3), np.empty((3, 3)))
    term = Term(one.information, one.gradient)
    of_both = Term(one.observed, np.zeros(3))
    none = np.zeros(3)
    rel = np.empty(3)
    back = np.empty(3)
    tally = np.empty(5)
    step = np.empty(3)
    for m in range(len(pairs)):
        j = pairs[m, 0]
        i = pairs[m, 1]
        relative(poses[j], poses[i], rel)
        for a in range(3):
            step[a] = rel[a] - before.at[m, a]
        if abs(step[0]) <= _SAME_M and abs(step[1]) <= _SAME_M and abs(step[2]) <= _SAME_RAD:
            for a in range(3):
                change = 0.0
                for b in range(3):
                    change += terms.information[m, a, b] * step[b]
                terms.gradient[m, a] = before.gradient[m, a] + change
            continue
        pair_terms(i, j, rel, scans, gate, scale, one, tally)
        for a in range(3):
            terms.gradient[m, a] = one.gradient[a]
            for b in range(3):
                terms.information[m, a, b] = one.information[a, b]
                terms.observed[m, a, b] = one.observed[a, b]
        for k in range(5):
            terms.counts[m, k] = tally[k]
        relative(poses[i], poses[j], back)
        pair_terms(j, i, back, scans, gate, scale, one, tally)
        add_inverse_term(rel, term, terms.information[m], terms.gradient[m])
        add_inverse_term(rel, of_both, terms.observed[m], none)
        for k in range(5):
            terms.counts[m, k] += tally[k]
        for a in range(3):
            before.at[m, a] = rel[a]
            before.gradient[m, a] = terms.gradient[m, a]


@njit(cache=True, nogil=True)
def add_pairs(poses: F64, pairs: I64, terms: PairTerms, weight: float, equations: Equations) -> None:
    """The equations of pairs (m, 2) with `terms` that were evaluated at `poses`, times `weight` (1/m^2).

    Adds to the diagonal and the right side of `equations`; overwrites its off-diagonal blocks.
    """
    diagonal = equations.diagonal
    off_diagonal = equations.off_diagonal
    right = equations.right
    rel = np.empty(3)
    ha = np.empty((3, 3))
    information = np.empty((3, 3))
    gradient = np.empty(3)
    for m in range(len(pairs)):
        j = pairs[m, 0]
        i = pairs[m, 1]
        relative(poses[j], poses[i], rel)
        for a in range(3):
            gradient[a] = weight * terms.gradient[m, a]
            for b in range(3):
                information[a, b] = weight * terms.information[m, a, b]
                off_diagonal[m, a, b] = 0.0
        blocks = Blocks(diagonal[j], off_diagonal[m], diagonal[i], right[j], right[i])
        add_relative_term(poses[j], rel, Term(information, gradient), blocks, ha)


@njit(cache=True, nogil=True)
def add_edges(poses: F64, edges: I64, measured: F64, information: F64, scale: F64, equations: Equations) -> float:
    """The equations of edges (m, 2): pose `measured` (m, 3) of edges[:, 1] seen from edges[:, 0].

    Adds to the diagonal and the right side of `equations`; overwrites its off-diagonal blocks. `scale` (m,)
    weighs each edge down: w = scale^2 / (scale^2 + chi^2), Cauchy's weight; infinite: no robust weight. Returns the sum
    of weighted chi^2.
    """
    diagonal = equations.diagonal
    off_diagonal = equations.off_diagonal
    right = equations.right
    rel = np.empty(3)
    error = np.empty(3)
    gradient = np.empty(3)
    ha = np.empty((3, 3))
    total = 0.0
    for m in range(len(edges)):
        off_diagonal[m] = 0.0
        j = edges[m, 0]
        i = edges[m, 1]
        relative(poses[j], poses[i], rel)
        for k in range(3):
            error[k] = rel[k] - measured[m, k]
        error[2] -= 2.0 * pi * np.round(error[2] / (2.0 * pi))
        # Not by `@`: for BLAS numba imports SciPy's linear algebra, 0.2 s of a command.
        chi2 = 0.0
        for a in range(3):
            gradient[a] = 0.0
            for b in range(3):
                gradient[a] += information[m, a, b] * error[b]
            chi2 += error[a] * gradient[a]
        weight = 1.0
        if scale[m] < np.inf:
            weight = scale[m] ** 2 / (scale[m] ** 2 + chi2)
        total += weight * chi2
        blocks = Blocks(diagonal[j], off_diagonal[m], diagonal[i], right[j], right[i])
        add_relative_term(poses[j], rel, Term(weight * information[m], weight * gradient), blocks, ha)
    return total


@njit(cache=True, nogil=True)
def path_lengths(chain: F64, links: I64, lengths: F64, source: int, found: F64) -> None:
    """Write the length of the shortest path from node `source` to each of the nodes to `found` (n,).

    Nodes k and k + 1 are chain[k] apart, as far as the chain leads; the `links` (m, 2) are `lengths` (m,) long.
    """
    found[:] = np.inf
    found[source] = 0.0
    is_open = True
    while is_open:
        is_open = False
        for k in range(len(chain)):
            if found[k] + chain[k] < found[k + 1]:
                found[k + 1] = found[k] + chain[k]
        for k in range(len(chain) - 1, -1, -1):
            if found[k + 1] + chain[k] < found[k]:
                found[k] = found[k + 1] + chain[k]
        for m in range(len(links)):
            i = links[m, 0]
            j = links[m, 1]
            if found[i] + lengths[m] < found[j]:
                found[j] = found[i] + lengths[m]
                is_open = True
            elif found[j] + lengths[m] < found[i]:
                found[i] = found[j] + lengths[m]
                is_open = True
