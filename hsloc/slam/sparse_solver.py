"""Solving sparse symmetric systems of 3 x 3 blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from numpy.typing import NDArray

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

    def solve(self, diagonal: F64, off_diagonal: F64, right: F64, damping: float = 0.0) -> F64:
        """The x (n, 3) of `A x = right`; `damping` is added to the diagonal in proportion to itself."""
        blocks = np.concatenate((diagonal, off_diagonal, off_diagonal.transpose(0, 2, 1)))
        if damping > 0.0:
            index = np.arange(3)
            blocks[: self._size, index, index] *= 1.0 + damping
        data = np.add.reduceat(blocks[self._order], self._group, axis=0)
        matrix = csc_array(bsr_array((data, self._indices, self._indptr), shape=(3 * self._size, 3 * self._size)))
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        solution: F64 = factor.solve(np.ascontiguousarray(right.reshape(-1)))
        return solution.reshape(-1, 3)
