"""Solving sparse symmetric systems of 3 x 3 blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import bsr_array, csc_array, tril
from scipy.sparse.linalg import splu

from hsloc.kernels.block_cholesky import Factor, factor_columns, factorise, solve_factor, sum_blocks
from hsloc.kernels.normal_equations import diagonal_blocks, selected_inverse

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy.sparse.linalg import SuperLU

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


MOST_BLOCKS_A_COLUMN = 200
"""Blocks in a column of the factor, on average, from which on SuperLU is used, which works on dense parts as a whole.
With 183, 5,000 scans of 30 laps through one office, both take the same time; with 61 SuperLU takes twice as long."""


_ROWS_AT_ONCE = 64
"""Rows of the inverse that are solved for at once. Internal: their columns fit into memory."""


class BlockSystem:
    """A symmetric positive definite matrix of 3 x 3 blocks with a fixed pattern: n on the diagonal, m off it.

    `rows` and `columns` (m,) are the places of the off-diagonal blocks, in either triangle; blocks that share a place
    are added up. The order of elimination is found once, for all matrices of the pattern.
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
        self._start = np.append(np.flatnonzero(first), len(order))
        self._indices = self._columns[order][first]
        counts = np.bincount(self._rows[order][first], minlength=size)
        self._indptr = np.concatenate(([0], np.cumsum(counts)))
        self._elimination: _Elimination | None = None

    def solve(self, diagonal: F64, off_diagonal: F64, right: F64) -> F64:
        """The x (n, 3) of `A x = right`."""
        if self._elimination is None:
            self._elimination = _Elimination(self._indptr, self._indices)
        if self._elimination.blocks > MOST_BLOCKS_A_COLUMN * self._size:
            solution: F64 = self._factor(diagonal, off_diagonal).solve(np.ascontiguousarray(right.reshape(-1)))
            return solution.reshape(-1, 3)
        return self._elimination.solve(self._summed(diagonal, off_diagonal), right)

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

    def inverse_near(self, diagonal: F64, off_diagonal: F64, wanted: I64, reach: int) -> F64:
        """Blocks (w, reach + 1, 3, 3) of the inverse, in the rows `wanted` (w,) from the diagonal to the right.

        Beyond the last column they are zero.
        """
        factor = self._factor(diagonal, off_diagonal)
        blocks = np.zeros((len(wanted), reach + 1, 3, 3))
        for begin in range(0, len(wanted), _ROWS_AT_ONCE):
            rows = wanted[begin : begin + _ROWS_AT_ONCE]
            right = np.zeros((3 * self._size, 3 * len(rows)))
            right[(3 * rows[:, None] + np.arange(3)).reshape(-1), np.arange(3 * len(rows))] = 1.0
            columns = factor.solve(right).reshape(self._size, 3, len(rows), 3)
            for k, row in enumerate(rows.tolist()):
                near = columns[row : row + reach + 1, :, k]
                blocks[begin + k, : len(near)] = near.transpose(0, 2, 1)
        return blocks

    def _summed(self, diagonal: F64, off_diagonal: F64) -> F64:
        """The blocks of the matrix, row by row."""
        sums = np.empty((len(self._indices), 3, 3))
        sum_blocks(self._order, self._start, diagonal, off_diagonal, sums)
        return sums

    def _factor(self, diagonal: F64, off_diagonal: F64) -> SuperLU:
        data = self._summed(diagonal, off_diagonal)
        matrix = csc_array(bsr_array((data, self._indices, self._indptr), shape=(3 * self._size, 3 * self._size)))
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


class _Elimination:
    """The order in which the blocks of a pattern (CSR: `indptr`, `indices`) are eliminated, and where L has blocks."""

    def __init__(self, indptr: I64, indices: I64) -> None:
        size = len(indptr) - 1
        order = _minimum_degree(indptr, indices)
        place = np.empty(size, dtype=np.int64)
        place[order] = np.arange(size)
        rows, columns = place[np.repeat(np.arange(size), np.diff(indptr))], place[indices]
        upper = np.flatnonzero(rows < columns)
        upper = upper[np.lexsort((rows[upper], columns[upper]))]
        self._order, self._upper = order, upper
        self._diagonal = np.flatnonzero(rows == columns)[order]
        self._rows = rows[upper]
        self._start = np.concatenate(([0], np.cumsum(np.bincount(columns[upper], minlength=size)))).astype(np.int64)
        self._parent, counts = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64)
        factor_columns(self._start, self._rows, self._parent, counts)
        start = np.concatenate(([0], np.cumsum(counts)))
        self.blocks = int(start[-1])
        self._start_of_factor = start
        self._factor: Factor | None = None

    def solve(self, blocks: F64, right: F64) -> F64:
        """The x (n, 3) of the matrix with these blocks, in the order of the pattern."""
        if self._factor is None:
            rows, lower = np.empty(self.blocks, dtype=np.int64), np.empty((self.blocks, 3, 3))
            self._factor = Factor(self._start_of_factor, rows, lower, np.empty((len(self._order), 3, 3)))
        factorise(self._start, self._rows, blocks[self._upper], blocks[self._diagonal], self._parent, self._factor)
        x = np.ascontiguousarray(right[self._order], dtype=np.float64)
        solve_factor(self._factor, x)
        solution = np.empty_like(x)
        solution[self._order] = x
        return solution


def _minimum_degree(indptr: I64, indices: I64) -> I64:
    """An order of elimination (n,) with little fill, of a symmetric pattern whose diagonal is full."""
    size = len(indptr) - 1
    # SuperLU orders by the pattern alone; the values only have to be factorised without pivoting.
    values = np.ones(len(indices))
    values[np.repeat(np.arange(size), np.diff(indptr)) == indices] = 2.0 * size
    matrix = csc_array((values, indices, indptr), shape=(size, size))
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.argsort(factor.perm_c).astype(np.int64)
