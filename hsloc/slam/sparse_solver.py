"""Solving sparse symmetric systems of 3 x 3 blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.block_cholesky import (
    Factor,
    factor_columns,
    factorise,
    minimum_degree,
    selected_inverse,
    solve_factor,
    sum_blocks,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy.sparse.linalg import SuperLU

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


MOST_BLOCKS_A_COLUMN = 200
"""Blocks in a column of the factor, on average, from which on SuperLU is used, which works on dense parts as a whole.
With 183, 5,000 scans of 30 laps through one office, both take the same time; with 61 SuperLU takes twice as long."""


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
        solution: F64 = self.solve_each(diagonal, off_diagonal, right[None])[0]
        return solution

    def solve_each(self, diagonal: F64, off_diagonal: F64, rights: F64) -> F64:
        """The x (k, n, 3) of `A x = right` for each of the right sides (k, n, 3)."""
        elimination = self._eliminated()
        if elimination.blocks > MOST_BLOCKS_A_COLUMN * self._size:
            columns = np.ascontiguousarray(rights.reshape(len(rights), -1).T)
            solutions: F64 = self._factor(diagonal, off_diagonal).solve(columns).T.reshape(rights.shape)
            return solutions
        return elimination.solve_each(self._summed(diagonal, off_diagonal), rights)

    def inverse_blocks(self, diagonal: F64, off_diagonal: F64) -> F64:
        """The blocks (n, 3, 3) on the diagonal of the inverse: covariances, where the matrix is an information."""
        return self.inverse_at(diagonal, off_diagonal, np.repeat(np.arange(self._size), 2).reshape(-1, 2))

    def inverse_at(self, diagonal: F64, off_diagonal: F64, places: I64) -> F64:
        """The blocks (k, 3, 3) of the inverse in the rows and columns `places` (k, 2), which the pattern has."""
        return self._eliminated().inverse_at(self._summed(diagonal, off_diagonal), places)

    def _eliminated(self) -> _Elimination:
        if self._elimination is None:
            self._elimination = _Elimination(self._indptr, self._indices)
        return self._elimination

    def _summed(self, diagonal: F64, off_diagonal: F64) -> F64:
        """The blocks of the matrix, row by row."""
        sums = np.empty((len(self._indices), 3, 3))
        sum_blocks(self._order, self._start, diagonal, off_diagonal, sums)
        return sums

    def _factor(self, diagonal: F64, off_diagonal: F64) -> SuperLU:
        # Imported where it is used: localising does without it, and it takes half a second.
        from scipy.sparse import bsr_array, csc_array
        from scipy.sparse.linalg import splu

        data = self._summed(diagonal, off_diagonal)
        matrix = csc_array(bsr_array((data, self._indices, self._indptr), shape=(3 * self._size, 3 * self._size)))
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


class _Elimination:
    """The order in which the blocks of a pattern (CSR: `indptr`, `indices`) are eliminated, and where L has blocks."""

    def __init__(self, indptr: I64, indices: I64) -> None:
        size = len(indptr) - 1
        order = np.empty(size, dtype=np.int64)
        minimum_degree(indptr, indices, order)
        place = np.empty(size, dtype=np.int64)
        place[order] = np.arange(size)
        rows, columns = place[np.repeat(np.arange(size), np.diff(indptr))], place[indices]
        upper = np.flatnonzero(rows < columns)
        upper = upper[np.lexsort((rows[upper], columns[upper]))]
        self._order, self._upper, self._place = order, upper, place
        self._diagonal = np.flatnonzero(rows == columns)[order]
        self._rows = rows[upper]
        self._start = np.concatenate(([0], np.cumsum(np.bincount(columns[upper], minlength=size)))).astype(np.int64)
        self._parent, counts = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64)
        factor_columns(self._start, self._rows, self._parent, counts)
        start = np.concatenate(([0], np.cumsum(counts)))
        self.blocks = int(start[-1])
        self._start_of_factor = start
        self._factor: Factor | None = None

    def solve_each(self, blocks: F64, rights: F64) -> F64:
        """The x (k, n, 3) of the matrix with these blocks, in the order of the pattern."""
        factor = self._factorised(blocks)
        solutions = np.empty(rights.shape)
        for right, solution in zip(rights, solutions, strict=True):
            x = np.ascontiguousarray(right[self._order], dtype=np.float64)
            solve_factor(factor, x)
            solution[self._order] = x
        return solutions

    def inverse_at(self, blocks: F64, places: I64) -> F64:
        """The blocks (k, 3, 3) of the inverse in the rows and columns `places` (k, 2) of the matrix with these."""
        factor = self._factorised(blocks)
        lower, diagonal = np.empty_like(factor.lower), np.empty_like(factor.inverse)
        selected_inverse(factor, lower, diagonal)
        size = len(diagonal)
        row, column = self._place[places.T]
        at_entries = np.repeat(np.arange(size), np.diff(factor.start)) * size + factor.rows
        entry = np.searchsorted(at_entries, np.minimum(row, column) * size + np.maximum(row, column))
        below, above = row > column, row < column
        found: F64 = diagonal[row]
        found[below] = lower[entry[below]]
        found[above] = lower[entry[above]].transpose(0, 2, 1)
        return found

    def _factorised(self, blocks: F64) -> Factor:
        if self._factor is None:
            rows, lower = np.empty(self.blocks, dtype=np.int64), np.empty((self.blocks, 3, 3))
            self._factor = Factor(self._start_of_factor, rows, lower, np.empty((len(self._order), 3, 3)))
        factorise(self._start, self._rows, blocks[self._upper], blocks[self._diagonal], self._parent, self._factor)
        return self._factor
