from __future__ import annotations

import numpy as np

from hsloc.slam.sparse_solver import BlockSystem


def test_blocks_on_the_diagonal_are_those_of_the_dense_inverse() -> None:
    """A ring with chords: the factor fills in, and its order is not that of the matrix."""
    random = np.random.default_rng(2)
    n = 12
    rows = np.concatenate((np.arange(n), [0, 2, 5]))
    columns = np.concatenate(((np.arange(n) + 1) % n, [6, 9, 11]))
    off = random.normal(size=(len(rows), 3, 3))
    diagonal = np.zeros((n, 3, 3))
    dense = np.zeros((3 * n, 3 * n))
    for i, j, block in zip(rows, columns, off, strict=True):
        dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += block
        dense[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] += block.T
    for k in range(n):
        diagonal[k] = 20.0 * np.eye(3) + 0.1 * np.ones((3, 3))
        dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += diagonal[k]
    want = np.linalg.inv(dense)
    got = BlockSystem(n, rows, columns).inverse_blocks(diagonal, off)
    for k in range(n):
        np.testing.assert_allclose(got[k], want[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rtol=1e-9, atol=1e-12)
