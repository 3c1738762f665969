"""Solving sparse symmetric systems of 3 x 3 blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import bsr_array, csc_array, tril
from scipy.sparse.linalg import splu

from hsloc.kernels.normal_equations import diagonal_blocks, selected_inverse

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy.sparse.linalg import SuperLU

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


class BlockSystem:
    """A symmetric positive definite matrix of 3 x 3 blocks with a fixed pattern: n on the diagonal, m off it.

    `rows` and `columns` (m,) are the places of the off-diagonal blocks, in either triangle; blocks that share a place
    are added up.
    """

    def __init__(self, size: int, rows: I64, columns: I64) -> None:
        self._size = size
        diagonal = np.arange(size)
        self._rows = np.concatenate((diagonal, rows, columns))
        self._columns = np.concatenate((diagonal, columns, rows))
        order = np.lexsort((self._columns, self._rows))
        key = self._rows[order] * size + self._columns[order]
        first = np.concatenate(([True], key[1:] != key[:-1])) if len(key) else np.zeros(0, dtype=bool)
        self._order = order
        self._group = np.flatnonzero(first)
        self._indices = self._columns[order][first]
        counts = np.bincount(self._rows[order][first], minlength=size)
        self._indptr = np.concatenate(([0], np.cumsum(counts)))

    def solve(self, diagonal: F64, off_diagonal: F64, right: F64) -> F64:
        """The x (n, 3) of `A x = right`."""
        solution: F64 = self._factor(diagonal, off_diagonal).solve(np.ascontiguousarray(right.reshape(-1)))
        return solution.reshape(-1, 3)

    def inverse_blocks(self, diagonal: F64, off_diagonal: F64) -> F64:
        """The blocks (n, 3, 3) on the diagonal of the inverse: covariances, where the matrix is an information."""
        factor = self._factor(diagonal, off_diagonal)
        # Without pivoting L and U have one pattern, U = D L^T.
        triangle = csc_array(tril(factor.L, -1))
        triangle.sort_indices()
        start, rows = triangle.indptr.astype(np.int64), triangle.indices.astype(np.int64)
        lower, on_diagonal = np.zeros(len(rows)), np.zeros(3 * self._size)
        selected_inverse(start, rows, triangle.data, factor.U.diagonal(), lower, on_diagonal)
        blocks = np.empty((self._size, 3, 3))
        diagonal_blocks(start, rows, lower, on_diagonal, factor.perm_c.astype(np.int64), blocks)
        return blocks

    def _factor(self, diagonal: F64, off_diagonal: F64) -> SuperLU:
        blocks = np.concatenate((diagonal, off_diagonal, off_diagonal.transpose(0, 2, 1)))
        data = np.add.reduceat(blocks[self._order], self._group, axis=0)
        matrix = csc_array(bsr_array((data, self._indices, self._indptr), shape=(3 * self._size, 3 * self._size)))
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
