"""Sparse systems of 3 x 3 blocks against dense ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hsloc.kernels.block_cholesky import minimum_degree, solve_in_place
from hsloc.slam import sparse_solver
from hsloc.slam.sparse_solver import BlockSystem


def test_a_sparse_system_is_that_of_its_dense_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    rows, columns = np.array([0, 1, 3, 0, 0]), np.array([1, 2, 0, 3, 1])
    off = random.normal(size=(5, 3, 3))
    diagonal = np.broadcast_to(30.0 * np.eye(3), (4, 3, 3)).copy()
    right = random.normal(size=(4, 3))
    dense = np.zeros((12, 12))
    for k in range(4):
        dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += diagonal[k]
    for i, j, block in zip(rows, columns, off, strict=True):
        dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += block
        dense[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] += block.T
    expected = np.linalg.solve(dense, right.reshape(-1)).reshape(4, 3)
    system = BlockSystem(4, rows, columns)
    np.testing.assert_allclose(system.solve(diagonal, off, right), expected, rtol=1e-9)
    np.testing.assert_allclose(system.solve(2.0 * diagonal, 2.0 * off, right), 0.5 * expected, rtol=1e-9)
    both = np.stack((expected, -2.0 * expected))
    np.testing.assert_allclose(system.solve_each(diagonal, off, np.stack((right, -2.0 * right))), both, rtol=1e-9)
    monkeypatch.setattr(sparse_solver, "MOST_BLOCKS_A_COLUMN", 0)  # as with much fill: by SuperLU
    np.testing.assert_allclose(system.solve(diagonal, off, right), expected, rtol=1e-9)
    np.testing.assert_allclose(system.solve_each(diagonal, off, np.stack((right, -2.0 * right))), both, rtol=1e-9)


@pytest.mark.parametrize("chords", [0, 3, 20])
def test_a_ring_with_chords_that_fill_the_factor_in(rng: Any, chords: int) -> None:
    n = 14
    rows = np.concatenate((np.arange(n), rng.integers(0, n, chords)))
    columns = np.concatenate(((np.arange(n) + 1) % n, (rows[n:] + rng.integers(1, n, chords)) % n))
    off, right = rng.normal(size=(len(rows), 3, 3)), rng.normal(size=(n, 3))
    diagonal = np.broadcast_to(100.0 * np.eye(3), (n, 3, 3)) + 0.1
    dense = np.zeros((n, 3, n, 3))
    for k in range(n):
        dense[k, :, k] = diagonal[k]
    for i, j, block in zip(rows, columns, off, strict=True):
        dense[i, :, j] += block
        dense[j, :, i] += block.T
    system, matrix = BlockSystem(n, rows, columns), dense.reshape(3 * n, 3 * n)
    expected = np.linalg.solve(matrix, right.reshape(-1)).reshape(n, 3)
    np.testing.assert_allclose(system.solve(diagonal, off, right), expected, rtol=1e-9, atol=1e-12)
    inverse, every = np.linalg.inv(matrix).reshape(n, 3, n, 3), np.arange(n)
    got = system.inverse_blocks(diagonal, off)
    np.testing.assert_allclose(got, inverse[every, :, every], rtol=1e-9, atol=1e-12)
    for first, second in ((rows, columns), (columns, rows), (every, every)):  # in either triangle
        got = system.inverse_at(diagonal, off, np.column_stack((first, second)))
        np.testing.assert_allclose(got, inverse[first, :, second], rtol=1e-9, atol=1e-12)


def _fill(links: set[tuple[int, int]], order: Any) -> int:
    """Links that come up while the nodes are eliminated in this order: the neighbours of each are joined."""
    near: dict[int, set[int]] = {int(k): set() for k in order}
    for i, j in links:
        near[i].add(j)
        near[j].add(i)
    added = 0
    for k in map(int, order):
        for i in near[k]:
            missing = near[k] - near[i] - {i}
            added += sum(i < j for j in missing)
            near[i] = (near[i] | missing) - {k}
        del near[k]
    return added


@pytest.mark.parametrize("chords", [0, 5, 40])
def test_the_order_of_elimination_has_each_node_once_and_little_fill(rng: Any, chords: int) -> None:
    n = 40
    ends = np.concatenate((np.column_stack((np.arange(n - 1), np.arange(1, n))), rng.integers(0, n, (chords, 2))))
    links = {(int(min(pair)), int(max(pair))) for pair in ends if pair[0] != pair[1]}
    places = np.array([*links, *((j, i) for i, j in links), *((k, k) for k in range(n))])
    places = places[np.lexsort((places[:, 1], places[:, 0]))]
    order = np.empty(n, dtype=np.int64)
    minimum_degree(np.searchsorted(places[:, 0], np.arange(n + 1)), places[:, 1].copy(), order)
    assert sorted(order) == list(range(n))
    fill = _fill(links, order)
    if chords == 0:
        assert fill == 0
    else:
        assert fill < 0.8 * np.mean([_fill(links, rng.permutation(n)) for _ in range(5)])


def test_a_dense_system_is_solved_as_by_lapack(rng: Any) -> None:
    root, right = rng.normal(size=(12, 12)), rng.normal(size=(12, 4))
    matrix = root @ root.T + 1e-6 * np.eye(12)
    expected = np.linalg.solve(matrix, right)
    solve_in_place(matrix, right)
    np.testing.assert_allclose(right, expected, rtol=1e-6)
