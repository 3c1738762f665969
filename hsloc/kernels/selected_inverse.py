"""Entries of the inverse of a sparse symmetric matrix, at the places where its Cholesky factor has entries.

With `A = L D L^T` the entries of `Z = A^-1` obey `Z = D^-1 L^-1 + (I - L^T) Z` (Takahashi, Fagan and Chin 1973; Erisman
and Tinney 1975): from the last column to the first, each entry at a place of `L` needs only such entries.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


@njit(cache=True, nogil=True)
def selected_inverse(start: I64, rows: I64, factor: F64, pivots: F64, lower: F64, diagonal: F64) -> None:
    """Write the inverse's entries below the diagonal to `lower` (nnz,), and its diagonal to `diagonal` (n,).

    `factor` (nnz,) is the unit lower triangle without its diagonal, column k at entries start[k] to start[k + 1] with
    ascending `rows` (nnz,), and `pivots` (n,) is D.
    """
    n = len(pivots)
    place = np.full(n, -1, dtype=np.int64)
    product = np.zeros(n)
    for j in range(n - 1, -1, -1):
        for q in range(start[j], start[j + 1]):
            place[rows[q]] = q
            product[rows[q]] = 0.0
        # product = Z[s, s] L[s, j], s the rows of column j; Z is symmetric, and its lower half is at hand.
        for q in range(start[j], start[j + 1]):
            column = rows[q]
            value = factor[q]
            total = diagonal[column] * value
            for p in range(start[column], start[column + 1]):
                at = place[rows[p]]
                if at >= 0:
                    product[rows[p]] += lower[p] * value
                    total += lower[p] * factor[at]
            product[column] += total
        entry = 1.0 / pivots[j]
        for q in range(start[j], start[j + 1]):
            lower[q] = -product[rows[q]]
            entry += factor[q] * product[rows[q]]
            place[rows[q]] = -1
        diagonal[j] = entry


@njit(cache=True, nogil=True)
def diagonal_blocks(start: I64, rows: I64, lower: F64, diagonal: F64, order: I64, blocks: F64) -> None:
    """Write the 3 x 3 blocks on the diagonal of the inverse to `blocks` (m, 3, 3); `order` (3 m,) is where each
    row of the matrix is in the factorised one."""
    for k in range(len(blocks)):
        for a in range(3):
            blocks[k, a, a] = diagonal[order[3 * k + a]]
            for b in range(a):
                one = order[3 * k + a]
                other = order[3 * k + b]
                column = min(one, other)
                begin = start[column]
                at = begin + np.searchsorted(rows[begin : start[column + 1]], max(one, other))
                blocks[k, a, b] = blocks[k, b, a] = lower[at]
