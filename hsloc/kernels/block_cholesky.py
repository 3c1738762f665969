"""Cholesky factorisation of sparse symmetric systems of 3 x 3 blocks.

The pattern of the factor is found once; then each matrix of that pattern costs a few operations a block. The algorithm
is that of Davis (2005), "Algorithm 849: a concise sparse Cholesky factorization package", on blocks.

Covariances are blocks of the inverse, at the places where the factor has blocks. With `A = L D L^T` the entries of
`Z = A^-1` obey `Z = D^-1 L^-1 + (I - L^T) Z` (Takahashi, Fagan and Chin 1973; Erisman and Tinney 1975): from the last
column to the first, each block at a place of `L` needs only such blocks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


class Factor(NamedTuple):
    """`L D L^T` of a symmetric positive definite matrix of n x n blocks (3, 3), L unit lower triangular.

    Column k of L has the blocks lower[start[k] : start[k + 1]] in the rows of the same entries; `inverse` (n, 3, 3) is
    that of D.
    """

    start: I64
    rows: I64
    lower: F64
    inverse: F64


@njit(cache=True, nogil=True)
def minimum_degree(start: I64, columns: I64, order: I64) -> None:
    """Write an order of elimination with little fill to `order` (n,): always a node with the fewest neighbours.

    `start` (n + 1,) and `columns` are the symmetric pattern row by row; its diagonal does not count. What is eliminated
    is kept as an element, the list of its neighbours, and the number of a node's neighbours is bounded by its elements
    (Amestoy, Davis and Duff 1996, "An approximate minimum degree ordering algorithm").
    """
    n = len(order)
    # The row of a node holds the elements at it, then the nodes beside it: of them there are never more than at first.
    row = columns.copy()
    elements = np.zeros(n, dtype=np.int64)
    nodes = np.zeros(n, dtype=np.int64)
    first = np.full(n + 1, -1, dtype=np.int64)
    before = np.full(n, -1, dtype=np.int64)
    after = np.full(n, -1, dtype=np.int64)
    degree = np.empty(n, dtype=np.int64)
    for i in range(n):
        for p in range(start[i], start[i + 1]):
            if columns[p] != i:
                row[start[i] + nodes[i]] = columns[p]
                nodes[i] += 1
        degree[i] = nodes[i]
    for i in range(n - 1, -1, -1):
        _enlist(i, degree[i], first, before, after)
    # Members of element e: pool[begin[e] : begin[e] + size[e]]. Of no size is one that is part of another.
    pool = np.empty(2 * len(columns) + n, dtype=np.int64)
    begin = np.zeros(n, dtype=np.int64)
    size = np.zeros(n, dtype=np.int64)
    used = 0
    marked = np.full(n, -1, dtype=np.int64)
    outside = np.zeros(n, dtype=np.int64)
    counted = np.full(n, -1, dtype=np.int64)
    least = 0
    for step in range(n):
        while first[least] < 0:
            least += 1
        k = first[least]
        _delist(k, degree[k], first, before, after)
        order[step] = k
        marked[k] = step
        if used + n > len(pool):
            larger = np.empty(2 * len(pool) + n, dtype=np.int64)
            larger[:used] = pool[:used]
            pool = larger
        begin[k] = used
        for p in range(start[k], start[k] + elements[k]):
            e = row[p]
            for q in range(begin[e], begin[e] + size[e]):
                if marked[pool[q]] != step:
                    marked[pool[q]] = step
                    pool[used] = pool[q]
                    used += 1
            size[e] = 0
        for p in range(start[k] + elements[k], start[k] + elements[k] + nodes[k]):
            if marked[row[p]] != step:
                marked[row[p]] = step
                pool[used] = row[p]
                used += 1
        size[k] = used - begin[k]
        for q in range(begin[k], used):
            i = pool[q]
            for p in range(start[i], start[i] + elements[i]):
                e = row[p]
                if counted[e] != step:
                    counted[e] = step
                    outside[e] = size[e]
                outside[e] -= 1
        for q in range(begin[k], used):
            i = pool[q]
            kept = 0
            neighbours = size[k] - 1
            last_element = start[i] + elements[i]
            for p in range(start[i], last_element):
                e = row[p]
                if size[e] > 0 and outside[e] > 0:
                    row[start[i] + kept] = e
                    kept += 1
                    neighbours += outside[e]
                else:
                    size[e] = 0
            # Nodes of the new element are its neighbours by it; at least one entry is free for the element itself.
            beside = 0
            for p in range(last_element, last_element + nodes[i]):
                if marked[row[p]] != step:
                    row[start[i] + kept + beside] = row[p]
                    beside += 1
            if beside > 0:
                row[start[i] + kept + beside] = row[start[i] + kept]
            row[start[i] + kept] = k
            elements[i] = kept + 1
            nodes[i] = beside
            _delist(i, degree[i], first, before, after)
            degree[i] = min(neighbours + beside, degree[i] + size[k] - 1, n - step - 2)
            _enlist(i, degree[i], first, before, after)
            least = min(least, degree[i])


@njit(cache=True, nogil=True)
def _enlist(node: int, degree: int, first: I64, before: I64, after: I64) -> None:
    """Put a node at the head of the list of those with its degree."""
    before[node] = -1
    after[node] = first[degree]
    if first[degree] >= 0:
        before[first[degree]] = node
    first[degree] = node


@njit(cache=True, nogil=True)
def _delist(node: int, degree: int, first: I64, before: I64, after: I64) -> None:
    """Take a node out of the list of those with its degree."""
    if before[node] >= 0:
        after[before[node]] = after[node]
    else:
        first[degree] = after[node]
    if after[node] >= 0:
        before[after[node]] = before[node]


@njit(cache=True, nogil=True)
def factor_columns(start: I64, rows: I64, parent: I64, counts: I64) -> None:
    """Write the elimination tree to `parent` (n,), -1 at its roots, and the `counts` (n,) of blocks of L by column.

    `start` (n + 1,) and `rows` are the pattern of the matrix above the diagonal, column by column.
    """
    n = len(parent)
    visited = np.empty(n, dtype=np.int64)
    for k in range(n):
        parent[k] = -1
        counts[k] = 0
        visited[k] = k
        for p in range(start[k], start[k + 1]):
            i = rows[p]
            while visited[i] != k:
                if parent[i] == -1:
                    parent[i] = k
                counts[i] += 1
                visited[i] = k
                i = parent[i]


@njit(cache=True, nogil=True)
def sum_blocks(order: I64, start: I64, diagonal: F64, off_diagonal: F64, sums: F64) -> None:
    """Write the sums of groups of blocks to `sums` (k, 3, 3): group k has the numbers order[start[k] : start[k + 1]].

    Numbered are the n of the `diagonal`, the m of `off_diagonal`, and the transposes of these.
    """
    n = len(diagonal)
    m = len(off_diagonal)
    for k in range(len(sums)):
        for a in range(3):
            for b in range(3):
                total = 0.0
                for p in range(start[k], start[k + 1]):
                    block = order[p]
                    if block < n:
                        total += diagonal[block, a, b]
                    elif block < n + m:
                        total += off_diagonal[block - n, a, b]
                    else:
                        total += off_diagonal[block - n - m, b, a]
                sums[k, a, b] = total


@njit(cache=True, nogil=True)
def factorise(start: I64, rows: I64, upper: F64, diagonal: F64, parent: I64, factor: Factor) -> None:
    """Write rows, lower blocks and inverse of `factor`, whose `start` is known.

    The matrix has blocks `upper` (m, 3, 3) at the pattern `start`, `rows` and `diagonal` (n, 3, 3).
    """
    n = len(diagonal)
    begin = factor.start
    out_rows = factor.rows
    lower = factor.lower
    inverse = factor.inverse
    filled = np.zeros(n, dtype=np.int64)
    visited = np.full(n, -1, dtype=np.int64)
    pattern = np.empty(n, dtype=np.int64)
    path = np.empty(n, dtype=np.int64)
    y = np.zeros((n, 3, 3))
    d = np.empty((3, 3))
    x = np.empty((3, 3))
    for k in range(n):
        # Row k of L is a solution of the rows before; its pattern are the paths to k in the tree.
        top = n
        visited[k] = k
        for p in range(start[k], start[k + 1]):
            i = rows[p]
            for a in range(3):
                for b in range(3):
                    y[i, a, b] += upper[p, a, b]
            length = 0
            while visited[i] != k:
                path[length] = i
                length += 1
                visited[i] = k
                i = parent[i]
            while length > 0:
                length -= 1
                top -= 1
                pattern[top] = path[length]
        for a in range(3):
            for b in range(3):
                d[a, b] = diagonal[k, a, b]
        for q in range(top, n):
            i = pattern[q]
            for a in range(3):
                for b in range(3):
                    x[a, b] = y[i, a, b]
                    y[i, a, b] = 0.0
            last = begin[i] + filled[i]
            for p in range(begin[i], last):
                row = out_rows[p]
                for a in range(3):
                    for b in range(3):
                        y[row, a, b] -= lower[p, a, 0] * x[0, b] + lower[p, a, 1] * x[1, b] + lower[p, a, 2] * x[2, b]
            for a in range(3):
                for b in range(3):
                    lower[last, a, b] = (
                        x[0, a] * inverse[i, 0, b] + x[1, a] * inverse[i, 1, b] + x[2, a] * inverse[i, 2, b]
                    )
            for a in range(3):
                for b in range(3):
                    d[a, b] -= lower[last, a, 0] * x[0, b] + lower[last, a, 1] * x[1, b] + lower[last, a, 2] * x[2, b]
            out_rows[last] = k
            filled[i] += 1
        xx = d[1, 1] * d[2, 2] - d[1, 2] * d[2, 1]
        xy = d[0, 2] * d[2, 1] - d[0, 1] * d[2, 2]
        xz = d[0, 1] * d[1, 2] - d[0, 2] * d[1, 1]
        yy = d[0, 0] * d[2, 2] - d[0, 2] * d[2, 0]
        yz = d[0, 2] * d[1, 0] - d[0, 0] * d[1, 2]
        zz = d[0, 0] * d[1, 1] - d[0, 1] * d[1, 0]
        scale = 1.0 / (d[0, 0] * xx + d[1, 0] * xy + d[2, 0] * xz)
        inverse[k, 0, 0] = xx * scale
        inverse[k, 0, 1] = inverse[k, 1, 0] = xy * scale
        inverse[k, 0, 2] = inverse[k, 2, 0] = xz * scale
        inverse[k, 1, 1] = yy * scale
        inverse[k, 1, 2] = inverse[k, 2, 1] = yz * scale
        inverse[k, 2, 2] = zz * scale


@njit(cache=True, nogil=True)
def solve_factor(factor: Factor, x: F64) -> None:
    """Solve with the factor, in place: `x` (n, 3) is the right side before."""
    start = factor.start
    rows = factor.rows
    lower = factor.lower
    inverse = factor.inverse
    n = len(x)
    for k in range(n):
        x0 = x[k, 0]
        x1 = x[k, 1]
        x2 = x[k, 2]
        for p in range(start[k], start[k + 1]):
            for a in range(3):
                x[rows[p], a] -= lower[p, a, 0] * x0 + lower[p, a, 1] * x1 + lower[p, a, 2] * x2
    for k in range(n - 1, -1, -1):
        x0 = x[k, 0]
        x1 = x[k, 1]
        x2 = x[k, 2]
        for a in range(3):
            x[k, a] = inverse[k, a, 0] * x0 + inverse[k, a, 1] * x1 + inverse[k, a, 2] * x2
        for p in range(start[k], start[k + 1]):
            row = rows[p]
            for a in range(3):
                x[k, a] -= lower[p, 0, a] * x[row, 0] + lower[p, 1, a] * x[row, 1] + lower[p, 2, a] * x[row, 2]


@njit(cache=True, nogil=True)
def selected_inverse(factor: Factor, lower: F64, diagonal: F64) -> None:
    """Write the inverse's blocks at the places of the factor to `lower` (m, 3, 3), and its diagonal's (n, 3, 3)."""
    start = factor.start
    rows = factor.rows
    below = factor.lower
    n = len(diagonal)
    place = np.full(n, -1, dtype=np.int64)
    product = np.zeros((n, 3, 3))
    value = np.empty((3, 3))
    total = np.empty((3, 3))
    for j in range(n - 1, -1, -1):
        for q in range(start[j], start[j + 1]):
            place[rows[q]] = q
            product[rows[q]] = 0.0
        # product = Z[s, s] L[s, j], s the rows of column j; Z is symmetric, and its lower half is at hand.
        for q in range(start[j], start[j + 1]):
            column = rows[q]
            for a in range(3):
                for b in range(3):
                    value[a, b] = below[q, a, b]
            for a in range(3):
                for b in range(3):
                    total[a, b] = (
                        diagonal[column, a, 0] * value[0, b]
                        + diagonal[column, a, 1] * value[1, b]
                        + diagonal[column, a, 2] * value[2, b]
                    )
            for p in range(start[column], start[column + 1]):
                row = rows[p]
                at = place[row]
                if at < 0:
                    continue
                for a in range(3):
                    for b in range(3):
                        product[row, a, b] += (
                            lower[p, a, 0] * value[0, b] + lower[p, a, 1] * value[1, b] + lower[p, a, 2] * value[2, b]
                        )
                        total[a, b] += (
                            lower[p, 0, a] * below[at, 0, b]
                            + lower[p, 1, a] * below[at, 1, b]
                            + lower[p, 2, a] * below[at, 2, b]
                        )
            for a in range(3):
                for b in range(3):
                    product[column, a, b] += total[a, b]
        for a in range(3):
            for b in range(3):
                diagonal[j, a, b] = factor.inverse[j, a, b]
        for q in range(start[j], start[j + 1]):
            row = rows[q]
            for a in range(3):
                for b in range(3):
                    lower[q, a, b] = -product[row, a, b]
                    diagonal[j, a, b] += (
                        below[q, 0, a] * product[row, 0, b]
                        + below[q, 1, a] * product[row, 1, b]
                        + below[q, 2, a] * product[row, 2, b]
                    )
            place[row] = -1


@njit(cache=True, nogil=True)
def solve_in_place(matrix: F64, right: F64) -> None:
    """Write `matrix^-1 right` (n, m) to `right`, of a positive definite matrix (n, n), by `L L^T`, which overwrites it.

    Not by `np.linalg`: for LAPACK numba imports SciPy's linear algebra, 0.2 s of a command.
    """
    n = len(matrix)
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / matrix[j, j] if j < i else np.sqrt(total)
        for m in range(right.shape[1]):
            total = right[i, m]
            for k in range(i):
                total -= matrix[i, k] * right[k, m]
            right[i, m] = total / matrix[i, i]
    for i in range(n - 1, -1, -1):
        for m in range(right.shape[1]):
            total = right[i, m]
            for k in range(i + 1, n):
                total -= matrix[k, i] * right[k, m]
            right[i, m] = total / matrix[i, i]
